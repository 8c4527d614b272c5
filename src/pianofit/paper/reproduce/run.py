"""The command's work: compute everything, write the files, then the pages."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ... import __version__
from ...errors import OutputError
from ...io import encode_wav, replace_file
from ...listening.page import Heard, Question, write_listening
from ...model.cache import keep_programs
from ...parameters import PARAMETERS
from ...report.drawing import png, styled, svg
from ...report.kit import data_uri, write_page
from ...report.sound import Clip, make_clips
from ..laboratory import chosen
from .cases import RECIPES
from .claims import SYMBOLS, WORDS, Claim
from .direct import NOTE
from .figures import FIGURES
from .judged import judge
from .studies import FULL, Findings, Plan, Stroke, compute
from .tables import Table, tables

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Book", "reproduce"]

SECONDS = 2.2  # of each sound that a page plays
LEAD = 0.05  # s of silence before those of the listening test
# What the listening test asks of a stroke: which of two is nearer the measured one; and of one of them also the last.
PAIRS = (("paper", "initial"), ("paper", "global"), ("read", "initial"), ("read", "global"), ("default", "read"))


@dataclass
class Book:
    """What the page shows, and the same beside it as files: figures as PNG, tables as CSV, sounds as WAV."""

    folder: Path
    figures: dict[str, str] = field(default_factory=dict)  # name -> address within the page
    tables: dict[str, Table] = field(default_factory=dict)
    players: dict[str, list[Clip]] = field(default_factory=dict)  # name -> sounds, equally loud
    files: list[str] = field(default_factory=list)

    def draw(self, name: str, figure: Callable[[], Figure]) -> None:
        """Keep a figure for the page and write its PNG."""
        with styled():
            made = figure()
            self.figures[name] = data_uri("image/svg+xml", svg(made))
            self._write(f"figures/{name}.png", png(made))

    def tabulate(self, name: str, table: Table) -> None:
        """Keep a table for the page and write it as CSV, numbers with all their digits."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(table.columns)
        writer.writerows([float(x) if isinstance(x, np.floating) else x for x in row] for row in table.rows)
        self._write(f"data/{name}.csv", text.getvalue().encode())
        self.tables[name] = table

    def play(self, name: str, sounds: dict[str, np.ndarray], rate: int, full_scale: float) -> None:
        """Write sounds, m/s [samples], as files of this full scale, m/s, and keep equally loud ones for the page."""
        for label, samples in sounds.items():
            words = "".join(c if c.isalnum() or c == "." else " " for c in f"{name} {label}".lower()).split()
            self._write(f"sounds/{'-'.join(words)}.wav", encode_wav(samples / full_scale, rate))
        self.players[name] = make_clips({label: _cut(samples, rate) for label, samples in sounds.items()}, rate)

    def _write(self, name: str, content: bytes) -> None:
        target = self.folder / name
        try:
            target.parent.mkdir(exist_ok=True)
        except OSError as error:
            raise OutputError(
                f"{target.parent}: no folder can be made here ({error.strerror}); choose another"
            ) from None
        replace_file(target, content)
        self.files.append(name)


def reproduce(
    folder: Path, seed: int = 0, *, plan: Plan = FULL, progress: Callable[[str, float], None] = lambda *_: None
) -> list[Claim]:
    """Write `index.html`, `listening.html` and the files behind them to `folder`, and return what came of each claim.

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
    keep_programs()
    found = compute(plan, seed, progress)
    progress("pages", 0.99)
    book, claims = Book(folder), judge(found)
    for name, table in tables(found).items():
        book.tabulate(name, table)
    for name, figure in FIGURES.items():
        book.draw(name, lambda figure=figure: figure(found))
    _play(book, plan.origin, found.origin, {"initial": "initial"} | RECIPES)
    for velocity, stroke in found.predictions.items():
        names = {"paper": "predicted, three bands", "read": "predicted, string read", "initial": "initial"}
        _play(book, velocity, stroke, names)
    _write_test(folder, found)
    write_page(
        folder / "index.html", "index.html.j2", package="pianofit.paper.reproduce", styles=("claims.css",),
        scripts=("audio.js", "player.js"), filters={"symbol": _symbol},
        title="Parameter fitting for piano sound synthesis, reproduced", version=__version__, f=found, claims=claims,
        words=WORDS, book=book, recipes=RECIPES, note=NOTE, scale=chosen.SCALE,
    )  # fmt: skip
    progress("done", 1.0)
    return [*claims.values()]


def _symbol(name: str) -> str:
    """A parameter with its unit, a recipe or a band by its name on the page; another word as it is."""
    if name in SYMBOLS:
        unit = PARAMETERS[name].unit.replace("^p", "ᵖ")
        return SYMBOLS[name] if unit == "1" else f"{SYMBOLS[name]}, {unit}"
    return RECIPES.get(name, name)


def _play(book: Book, velocity: float, stroke: Stroke, names: dict[str, str]) -> None:
    """Sounds of one stroke as files and for the player, the measured one first; `names`: sound -> what it is called."""
    made = {label: stroke.sounds[name] for name, label in ({"measured": "measured"} | names).items()}
    book.play(f"{velocity:.3f}", made, stroke.case.recording.rate, chosen.SCALE)


def _write_test(folder: Path, f: Findings) -> None:
    """Write `listening.html`."""
    questions, rate = [], f.origin.case.recording.rate
    for velocity in f.plan.heard:
        heard = {
            name: Heard(RECIPES.get(name, name), f"{velocity:g} m/s", np.pad(_cut(x, rate), (int(LEAD * rate), 0)))
            for name, x in f.strokes[velocity].sounds.items()
        }
        asked = [(heard[a], heard[b]) for a, b in PAIRS if a in heard]
        questions += [Question(heard["measured"], pair) for pair in asked]
        questions.append(Question(heard["measured"], (heard["measured"], heard["initial"]), 1))
    write_listening(
        folder / "listening.html", questions, rate, LEAD, f.seed, program="pianofit reproduce",
        about="the sounds of “pianofit reproduce”",
        origin="measurements of pianofit's own laboratory, which stand for the paper's: those are not public",
        key=folder / "listening-key.json",
    )  # fmt: skip


def _cut(samples: np.ndarray, rate: int) -> np.ndarray:
    return samples[: int(SECONDS * rate)]
