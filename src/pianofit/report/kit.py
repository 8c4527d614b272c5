"""What every page has in common: one file that holds all it shows, in one style, and loads nothing.

Its content security policy lets nothing be loaded from anywhere and runs no script but its own, named by its hash. All
text from outside goes through Jinja's autoescape, and none of it into the script. Templates extend
`report/kit.html.j2`.
"""

from __future__ import annotations

import base64
import hashlib
import os
from collections.abc import Sequence
from importlib.resources import files
from typing import Any

from ..io import replace_file
from .numbers import number

__all__ = ["picture", "write_sheet"]


def write_sheet(
    path: str | os.PathLike[str],
    template: str,
    *,
    title: str,
    contents: Sequence[tuple[str, str]],
    script: str = "",
    **content: Any,
) -> None:
    """Write one page to `path`, whole or not at all.

    Parameters
    ----------
    template, script : files of the package, such as "report/page.html.j2"; the script may be left out.
    title : plain text.
    contents : of the page: (id of the heading, words).

    Raises
    ------
    OutputError
        If `path` cannot be written.
    """
    from jinja2 import Environment, FunctionLoader

    environment = Environment(loader=FunctionLoader(_asset), autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters["number"] = number
    text = _asset(script) if script else ""
    html = environment.get_template(template).render(
        title=title,
        contents=contents,
        style=_asset("report/page.css"),
        script=text,
        script_hash=base64.b64encode(hashlib.sha256(text.encode()).digest()).decode(),
        **content,
    )
    replace_file(path, html.encode("utf-8", errors="replace"))


def picture(panels: Sequence[bytes]) -> list[str]:
    """The addresses of a picture's panels, SVG, as a page has them."""
    return ["data:image/svg+xml;base64," + base64.b64encode(svg).decode() for svg in panels]


def _asset(name: str) -> str:
    return files("pianofit").joinpath(name).read_text(encoding="utf-8")
