"""What the pages have in common: templates that escape all text, one script named by its hash, numbers as text."""

from __future__ import annotations

import base64
import hashlib
import os
from importlib.resources import files
from typing import Any

from ...io import replace_file
from ...report.words import number

__all__ = ["write_sheet"]


def write_sheet(path: str | os.PathLike[str], template: str, scripts: tuple[str, ...], **content: Any) -> None:
    """Write one self-contained page, whole or not at all.

    Parameters
    ----------
    template, scripts : names of files beside this one; the scripts are run as one.

    Raises
    ------
    OutputError
        If `path` cannot be written.
    """
    from jinja2 import Environment, StrictUndefined

    script = "".join(_asset(name) for name in scripts)
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=StrictUndefined)
    environment.filters["number"] = number
    html = environment.from_string(_asset(template)).render(
        style=_asset("page.css", "pianofit.report") + _asset("extra.css"),
        script=script,
        script_hash=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
        **content,
    )
    replace_file(path, html.encode("utf-8", errors="replace"))


def _asset(name: str, package: str = "pianofit.paper.reproduce") -> str:
    return files(package).joinpath(name).read_text(encoding="utf-8")
