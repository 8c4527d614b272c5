"""One HTML file that says what was fitted and how well, shows it, and lets it be heard.

Everything is inside the file: pictures, sounds, style and script. Its content security policy lets nothing be loaded
from anywhere and runs no script but its own, named by its hash. All text from outside goes through Jinja's autoescape,
and none of it into the script: the player reads its sounds from the links that also let them be saved.
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
from importlib.resources import files
from typing import Any

from . import words
from .curves import Curves
from .figures import draw_figures
from .output import replace_file
from .sound import make_clips

__all__ = ["Curves", "write_report"]


def write_report(path: str | os.PathLike[str], fit: dict[str, Any], curves: Curves, title: str) -> None:
    """Write the page to `path`, whole or not at all.

    Parameters
    ----------
    fit
        The content of `fit.json`. A missing entry is a missing sentence, never an error.
    title
        Plain text, such as the name of the file and the note.

    Raises
    ------
    OutputError
        If `path` cannot be written.
    """
    from jinja2 import Environment

    fit = {key: entry for key, entry in fit.items() if entry is not None}
    onset = next((take["onset_s"] for take in fit.get("takes", []) if take.get("onset_s") is not None), 0.0)
    sounds = {
        "original": curves.sound_original,
        "initial": curves.sound_initial,
        "fitted": curves.sound_fitted,
    }
    figures = draw_figures(curves, tuple(fit.get("criterion", {}).get("dropped") or ()))
    script = _asset("player.js")
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters["number"] = words.number
    html = environment.from_string(_asset("page.html.j2")).render(
        title=title,
        fit=fit,
        notices=words.notices(fit),
        tiles=words.tiles(fit),
        groups=words.groups(fit),
        comparison=words.comparison(fit),
        glide=words.glide(fit),
        bands=words.bands(fit),
        rows=words.rows(fit),
        clips=make_clips(sounds, curves.sound_rate, onset),
        figures={name: _data_uri("image/svg+xml", svg) for name, svg in figures.items()},
        has_path=curves.path is not None,
        style=_asset("page.css"),
        script=script,
        script_hash=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
        data=json.dumps(fit, indent=2, ensure_ascii=False, default=str),
    )
    replace_file(path, html.encode("utf-8", errors="replace"))


def _asset(name: str) -> str:
    return files("pianofit.report").joinpath(name).read_text(encoding="utf-8")


def _data_uri(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
