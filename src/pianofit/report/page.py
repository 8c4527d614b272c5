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
from pathlib import PurePath
from typing import Any

from ..io import replace_file
from . import known, numbers, words
from .curves import Curves, Strikes, TakeCurves
from .figures import draw_figures
from .sound import Clip, make_clips

__all__ = ["Curves", "write_report"]

# Of the sounds beside the three of the first take: up to this rate, and as long as leaves the page some megabytes.
LIGHT_RATE, LIGHT_SECONDS, SHORTEST, LIGHT_SAMPLES = 32_000, 4.0, 1.5, 1_000_000


def write_report(
    path: str | os.PathLike[str],
    fit: dict[str, Any],
    curves: Curves,
    title: str,
    held_out: dict[str, Any] | None = None,
) -> None:
    """Write the page to `path`, whole or not at all.

    Parameters
    ----------
    fit
        The content of `fit.json`. A missing entry is a missing sentence, never an error.
    title
        Plain text, such as the name of the file and the note.
    held_out
        What `predict.cross_validate` returned of the same takes, to be shown beside their fit.

    Raises
    ------
    OutputError
        If `path` cannot be written.
    """
    from jinja2 import Environment

    names = _names(fit, held_out)
    fit = {key: _named(names, entry) for key, entry in fit.items() if entry is not None}
    held_out = _named(names, held_out)
    onset = _onset(fit.get("takes", []))
    sounds = {
        "original": curves.sound_original,
        "initial": curves.sound_initial,
        "fitted": curves.sound_fitted,
    }
    left_out = known.held_out_rows(held_out)
    figures = draw_figures(
        curves, tuple(fit.get("criterion", {}).get("dropped") or ()), tuple(left_out["takes"]) if left_out else ()
    )
    script = _asset("player.js")
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters["number"] = numbers.number
    html = environment.from_string(_asset("page.html.j2")).render(
        title=title,
        fit=fit,
        notices=words.notices(fit),
        tiles=words.tiles(fit),
        groups=words.groups(fit),
        comparison=words.comparison(fit),
        glide=words.glide(fit),
        bands=words.bands(fit),
        invariants=words.invariants(fit),
        rows=words.rows(fit),
        minima=words.minima(fit),
        how_sure=words.how_sure(fit),
        clips=make_clips(sounds, curves.sound_rate, onset),
        strikes=_strikes(curves.strikes),
        players=_players(curves, fit.get("takes", [])),
        told=known.told(fit),
        felt_scale=known.felt_scale(fit),
        scale_open=known.open_scale(fit),
        stulov=curves.felt is not None and curves.felt.slow is not None,
        held_out=left_out,
        groups_of_takes=len(curves.paths),
        figures={name: _data_uri("image/svg+xml", svg) for name, svg in figures.items()},
        has_path=curves.path is not None,
        style=_asset("page.css"),
        script=script,
        script_hash=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
        data=json.dumps(fit, indent=2, ensure_ascii=False, default=str),
    )
    replace_file(path, html.encode("utf-8", errors="replace"))


def _names(*documents: dict[str, Any] | None) -> dict[str, str]:
    """The path of every recording -> its name; the longest path first."""
    takes = [take for document in documents for take in (document or {}).get("takes") or () if isinstance(take, dict)]
    files = {str(take.get("file") or "") for take in takes}
    return {file: PurePath(file).name for file in sorted(files, key=len, reverse=True) if PurePath(file).name}


def _named(names: dict[str, str], value: Any) -> Any:
    """`value` with names instead of paths in all text: a page is shown to others, who need not know any folder."""
    if isinstance(value, dict):
        return {key: _named(names, entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_named(names, entry) for entry in value]
    if isinstance(value, str):
        for path, name in names.items():
            value = value.replace(path, name)
    return value


def _onset(takes: list[dict[str, Any]]) -> float:
    """When the note of the first take begins, s."""
    ordered = sorted(takes, key=lambda take: not take.get("first"))
    return next((take["onset_s"] for take in ordered if take.get("onset_s") is not None), 0.0)


def _strikes(strikes: Strikes | None) -> dict[str, Any] | None:
    """The sounds of the slider, which keep their loudness to each other."""
    if strikes is None:
        return None
    sounds = {f"{numbers.number(v, 3)} m/s": x for v, x in zip(strikes.velocity, strikes.sounds, strict=True)}
    clips = make_clips(sounds, strikes.rate, lead_in=0.0, matched=False, highest_rate=LIGHT_RATE)
    return {"clips": clips, "first": strikes.first, "inside": strikes.inside}


def _players(curves: Curves, takes: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Recorded and fitted sound of every take but the first, which has its own player."""
    others = [take for i, take in enumerate(curves.takes) if i != curves.first]
    seconds = max(SHORTEST, min(LIGHT_SECONDS, LIGHT_SAMPLES / (2 * max(len(others), 1) * LIGHT_RATE)))
    names = {i: PurePath(str(take.get("file") or f"take {i}")).name for i, take in enumerate(takes, start=1)}
    return [
        {"id": f"take-{take.place}", "place": take.place, "file": names.get(take.place, f"take {take.place}"),
         "velocity": take.velocity, "clips": _pair(take, seconds)}
        for take in others
    ]  # fmt: skip


def _pair(take: TakeCurves, seconds: float) -> list[Clip]:
    sounds = {"original": take.sound_original, "fitted": take.sound_fitted}
    return make_clips(sounds, take.sound_rate, take.onset, seconds=seconds, highest_rate=LIGHT_RATE)


def _asset(name: str) -> str:
    return files("pianofit.report").joinpath(name).read_text(encoding="utf-8")


def _data_uri(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
