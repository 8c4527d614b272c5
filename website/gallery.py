"""The gallery: scripts in docs/gallery/ are run as notebooks and become pages with their pictures and sounds."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import jupytext
import nbformat
from digest import digest
from nbclient import NotebookClient
from nbconvert import MarkdownExporter

SECONDS = 600  # allowed for a cell, on a slow machine without compiled programs


def gallery_files(root: Path) -> dict[str, str | bytes]:
    """Run the scripts and return the files of their pages.

    A run is kept in build/gallery for as long as the script and the package do not change.

    Parameters
    ----------
    root : folder of the repository.

    Returns
    -------
    Path below the site's folder, to its content: a page, its pictures, and the notebook with its outputs.
    """
    found: dict[str, str | bytes] = {}
    package = digest(*sorted((root / "src").rglob("*.py")))
    for script in sorted((root / "docs" / "gallery").glob("*.py")):
        kept = root / "build" / "gallery" / f"{script.stem}-{package}-{digest(script)}.ipynb"
        if not kept.exists():
            kept.parent.mkdir(parents=True, exist_ok=True)
            nbformat.write(_run(script), kept)
        found |= _page(script.stem, nbformat.read(kept, as_version=4))
    return found


def _run(script: Path) -> nbformat.NotebookNode:
    """Run a script as a notebook in an empty folder. A cell that fails fails the build."""
    notebook = jupytext.read(script)
    with tempfile.TemporaryDirectory() as folder:
        client = NotebookClient(
            notebook, timeout=SECONDS, kernel_name="python3", resources={"metadata": {"path": folder}}
        )
        # A font cache of another environment would name fonts that are not there, and matplotlib would say so.
        fonts = script.parents[2] / "build" / "gallery" / "matplotlib"
        return client.execute(env={**os.environ, "MPLCONFIGDIR": str(fonts)})


def _page(name: str, notebook: nbformat.NotebookNode) -> dict[str, str | bytes]:
    text, resources = MarkdownExporter().from_notebook_node(
        notebook, resources={"unique_key": name, "output_files_dir": f"{name}_files"}
    )
    links = f'\n\n[Script]({name}.py "percent script for Jupyter and editors") · [Notebook]({name}.ipynb)\n'
    pictures = {f"gallery/{uri}": data for uri, data in resources["outputs"].items()}
    return {f"gallery/{name}.md": text + links, f"gallery/{name}.ipynb": nbformat.writes(notebook), **pictures}
