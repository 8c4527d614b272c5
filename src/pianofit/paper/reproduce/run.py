"""The command's work: compute everything, write the files, then the pages."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ... import __version__
from ...model.cache import keep_programs
from ...parameters import PARAMETERS
from ...report.kit import write_page
from ...report.listening import Heard, Question, write_listening
from ..laboratory import chosen
from . import figures_fit, figures_model, figures_search
from .book import Book
from .cases import RECIPES
from .claims import SYMBOLS, Claim
from .judged import SPANS, judge
from .plan import FULL, Plan
from .studies import STRINGS, Findings, compute
from .tables import write_tables

__all__ = ["reproduce"]

MEASURED = "measured"
# s of the sounds in the listening test, and of silence before them.
SECONDS, LEAD = 2.2, 0.05


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
    write_tables(book, found)
    _draw(book, found)
    _play(book, found)
    _write_test(folder, found)
    write_page(
        folder / "index.html", "index.html.j2", package="pianofit.paper.reproduce", styles=("claims.css",),
        scripts=("audio.js", "player.js"), filters={"symbol": _symbol},
        title="Parameter fitting for piano sound synthesis, reproduced", version=__version__, f=found, claims=claims,
        book=book, recipes=RECIPES, scale=chosen.SCALE,
    )  # fmt: skip
    progress("done", 1.0)
    return [*claims.values()]


def _symbol(name: str) -> str:
    """A parameter with its unit, a recipe or a band by its name on the page; another word as it is."""
    if name in SYMBOLS:
        unit = PARAMETERS[name].unit.replace("^p", "ᵖ")
        return SYMBOLS[name] if unit == "1" else f"{SYMBOLS[name]}, {unit}"
    return RECIPES.get(name, name)


def _draw(book: Book, f: Findings) -> None:
    """All figures."""
    named = {RECIPES[recipe]: f.repeated[recipe] for recipe in STRINGS}
    errors = {kind: [getattr(p, kind).level_db for p in f.predictions] for kind in ("initial", "nearest")}
    errors |= {recipe: [p.predicted[recipe].level_db for p in f.predictions] for recipe in STRINGS}
    velocities, true = [p.velocity for p in f.predictions], f.origin.case.measurement.true
    shown = {recipe: RECIPES[recipe] for recipe in f.plan.effect_recipes}
    for name, figure in {
        "figure-2": lambda: figures_model.force_over_time(f.strikes, f.trip),
        "figure-3": lambda: figures_model.force_over_compression(f.strikes[-1]),
        "figure-4": lambda: figures_model.velocity_spectra(f.strikes),
        "band-3": lambda: figures_search.plane(f.plane),
        "searches": lambda: figures_search.searches(f.race),
        "figure-6": lambda: figures_fit.spectra(f.origin),
        "figure-7": lambda: figures_fit.waveforms(f.at(f.plan.waveform), SPANS),
        "descriptors": lambda: figures_fit.descriptors(f.strokes),
        "predictions": lambda: figures_fit.predicted_levels(errors, velocities, f.plan.origin),
        "repeated": lambda: figures_fit.repeated_values(named, true, f.tables.printed_final),
        "effects": lambda: figures_fit.remains(f.effects, shown),
        "kappa": lambda: figures_model.kappa_by_grid(f.bends),
        "b2": lambda: figures_model.b2_over_decades(f.blindness),
    }.items():
        book.draw(name, figure)


def _play(book: Book, f: Findings) -> None:
    """Sounds as files and for the players: the fitted velocity, and those that were predicted from it."""
    rate, origin = f.origin.case.recording.rate, f.plan.origin
    order = (MEASURED, "initial", *(RECIPES[recipe] for recipe in ("global", "paper", "read", "default")))
    book.play(f"{origin:.3f}", {name: f.origin.sounds[name] for name in order}, rate, chosen.SCALE)
    for one in f.predictions:
        own = f.at(one.velocity).sounds
        sounds = {
            MEASURED: own[MEASURED], "predicted, three bands": one.sounds["paper"],
            "predicted, string read": one.sounds["read"], "initial": own["initial"],
        }  # fmt: skip
        book.play(f"{one.velocity:.3f}", sounds, rate, chosen.SCALE)


def _write_test(folder: Path, f: Findings) -> None:
    """Write `listening.html`."""
    questions, rate = [], f.origin.case.recording.rate
    three, read, whole, default = (RECIPES[recipe] for recipe in ("paper", "read", "global", "default"))
    for stroke in f.strokes:
        velocity = stroke.case.velocity
        if velocity not in f.plan.heard:
            continue
        heard = {name: Heard(name, velocity, _cut(samples, rate)) for name, samples in stroke.sounds.items()}
        pairs = [(three, "initial"), (three, whole), (read, "initial"), (read, whole)]
        pairs += [(default, read)] if default in heard else []
        questions += [Question(heard[MEASURED], (heard[a], heard[b])) for a, b in pairs]
        questions.append(Question(heard[MEASURED], (heard[MEASURED], heard["initial"]), 1))
    write_listening(
        folder / "listening.html", questions, rate, LEAD, f.seed, program="pianofit reproduce",
        about="the sounds of “pianofit reproduce”",
        origin="measurements of pianofit's own laboratory, which stand for the paper's: those are not public",
    )  # fmt: skip


def _cut(samples: np.ndarray, rate: int) -> np.ndarray:
    return np.pad(samples[: int(SECONDS * rate)], (int(LEAD * rate), 0))
