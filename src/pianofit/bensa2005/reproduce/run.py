"""The command's work: compute everything, write the files, then the pages."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ... import __version__
from ...io.files import encode_wav, replace_file, write_error
from ...io.table_output import write_csv
from ...listening.page import Question, TestSound, write_listening
from ...model.program_cache import enable_program_cache
from ...parameters import PARAMETERS
from ...report.drawing import page_style, png, svg
from ...report.html import data_uri, write_page
from ...report.sound import Clip, make_clips
from ..laboratory import chosen
from .claims import SYMBOLS, WORDS, Claim, judge
from .direct import NOTE
from .figures import FIGURES
from .strokes import RECIPES, SOUNDS, Stroke
from .studies import FULL, Findings, Plan, compute
from .tables import tables

__all__ = ["reproduce"]

SECONDS = 2.2  # of each sound that a page plays
LEAD = 0.05  # s of silence before those of the listening test
# Sounds of velocities that were not fitted, on the page: name -> what it is called there.
PREDICTED = {
    "measured": "measured", "paper": "predicted, three bands", "read": "predicted, string read", "initial": "initial",
}  # fmt: skip
# What the listening test asks of a stroke: which of two is nearer the measured one; and of one of them also the last.
PAIRS = (("paper", "initial"), ("paper", "global"), ("read", "initial"), ("read", "global"), ("default", "read"))


def reproduce(
    folder: Path, seed: int = 0, *, plan: Plan = FULL, progress: Callable[[str, float], None] = lambda *_: None
) -> list[Claim]:
    """Write `index.html`, `listening.html` and the files behind them to `folder`, and return what came of each claim.

    What the page shows is also beside it: figures as PNG, tables as CSV, sounds as WAV.

    Parameters
    ----------
    folder : exists, and is to be written to.
    seed : of everything random; the same seed gives the same files.
    progress : called with a stage's name and the fraction done.

    Raises
    ------
    OutputError
        If something cannot be written.
    """
    enable_program_cache()
    found = compute(plan, seed, progress)
    progress("pages", 0.99)
    claims, numbers = judge(found), tables(found)
    shown = {plan.origin: (found.origin, SOUNDS)} | {v: (one, PREDICTED) for v, one in found.predictions.items()}
    for name in ("data", "figures", "sounds"):
        try:
            (folder / name).mkdir(exist_ok=True)
        except OSError as error:
            raise write_error(folder / name, error, "choose another --out") from None
    for name, table in numbers.items():
        write_csv(folder / f"data/{name}.csv", table.columns, table.rows)
    figures = {name: _drawn(folder / f"figures/{name}.png", draw, found) for name, draw in FIGURES.items()}
    players = {f"{v:.3f}": played(folder / "sounds", f"{v:.3f}", *each) for v, each in shown.items()}
    files = [f"data/{name}.csv" for name in numbers] + [f"figures/{name}.png" for name in figures]
    files += [f"sounds/{_file(name, clip.name)}" for name, clips in players.items() for clip in clips]
    _write_test(folder, found)
    write_page(
        folder / "index.html", "index.html.j2", package="pianofit.bensa2005.reproduce", styles=("claims.css",),
        scripts=("audio.js", "player.js"), filters={"symbol": _symbol},
        title="Parameter fitting for piano sound synthesis, reproduced", version=__version__, f=found, claims=claims,
        words=WORDS, figures=figures, tables=numbers, players=players, files=files, recipes=RECIPES, note=NOTE,
        scale=chosen.SCALE,
    )  # fmt: skip
    progress("done", 1.0)
    return [*claims.values()]


def _drawn(target: Path, draw: Callable, found: Findings) -> str:
    """Write a figure's PNG, and return its address within the page."""
    with page_style():
        figure = draw(found)
        shown = data_uri("image/svg+xml", svg(figure))
        replace_file(target, png(figure))
    return shown


def played(folder: Path, name: str, stroke: Stroke, names: dict[str, str]) -> list[Clip]:
    """Write a stroke's sounds at their own levels, and return equally loud ones for the page."""
    rate, sounds = stroke.recording.rate, {label: stroke.sounds[sound] for sound, label in names.items()}
    for label, samples in sounds.items():
        replace_file(folder / _file(name, label), encode_wav(samples / chosen.SCALE, rate))
    return make_clips({label: _cut(samples, rate) for label, samples in sounds.items()}, rate)


def _file(name: str, label: str) -> str:
    """What a sound is saved as."""
    return f"{name}-{label.replace(',', '').replace(' ', '-')}.wav"


def _symbol(name: str) -> str:
    """A parameter with its unit, a recipe or a band by its name on the page; another word as it is."""
    if name in SYMBOLS:
        unit = PARAMETERS[name].unit.replace("^p", "ᵖ")
        return SYMBOLS[name] if unit == "1" else f"{SYMBOLS[name]}, {unit}"
    return RECIPES.get(name, name)


def _write_test(folder: Path, f: Findings) -> None:
    """Write `listening.html`."""
    questions, rate = [], f.origin.recording.rate
    for velocity in f.plan.heard:
        heard = {
            name: TestSound(SOUNDS[name], f"{velocity:g} m/s", np.pad(_cut(x, rate), (int(LEAD * rate), 0)))
            for name, x in f.strokes[velocity].sounds.items()
        }
        questions += [Question(heard["measured"], (heard[a], heard[b])) for a, b in PAIRS if a in heard]
        questions.append(Question(heard["measured"], (heard["measured"], heard["initial"]), 1))
    write_listening(
        folder / "listening.html", questions, rate, LEAD, f.seed, program="pianofit reproduce",
        about="the sounds of “pianofit reproduce”",
        origin="measurements of pianofit's own laboratory, which stand for the paper's: those are not public",
        key=folder / "listening-key.json",
    )  # fmt: skip


def _cut(samples: np.ndarray, rate: int) -> np.ndarray:
    return samples[: int(SECONDS * rate)]
