"""The command's work: compute everything, write the files, then the pages."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path

from ... import __version__
from ...model.cache import keep_programs
from .findings import Findings, compute
from .page import Book, Section
from .plan import FULL, Plan
from .sections_fit import compared, remaining, results
from .sections_model import choices, limits, problem
from .sections_search import band3, tables
from .sections_sound import sounds, write_test
from .verdict import WORDS, Verdict, joined

__all__ = ["reproduce"]

TITLE = "Parameter fitting for piano sound synthesis, reproduced"
SUBTITLE = (
    "J. Bensa, O. Gipouloux and R. Kronland-Martinet, J. Acoust. Soc. Am. 118, 495–504 (2005), by pianofit's own code"
)
WARNING = (
    "The paper's recordings are not public. Everything on this page was measured on sounds that pianofit's laboratory "
    "computed: the paper's string and hammer with its final values, and with things that its model leaves out. Every "
    "number was computed in this run, and every judgement follows from numbers by a rule. What comes out here can come "
    "out; whether it did on the paper's recordings cannot be told from here."
)


def reproduce(
    folder: Path, seed: int = 0, *, plan: Plan = FULL, progress: Callable[[str, float], None] = lambda *_: None
) -> list[Verdict]:
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
    book = Book(folder)
    sections = _sections(book, found)
    write_test(book, found)
    verdicts = [item for section in sections for item in section.items if isinstance(item, Verdict)]
    book.publish(
        sections, title=TITLE, subtitle=SUBTITLE, warning=WARNING, summary=_summary(verdicts),
        footer=f"Made by pianofit {__version__}: pianofit reproduce --seed {seed}.",
    )  # fmt: skip
    progress("done", 1.0)
    return verdicts


def _sections(book: Book, found: Findings) -> list[Section]:
    makers = (choices, problem, tables, band3, results, compared, remaining, limits, sounds)
    return [make(book, found) for make in makers]


def _summary(verdicts: list[Verdict]) -> str:
    """How many claims came out."""
    count = Counter(verdict.outcome for verdict in verdicts)
    said = [f"{count[key]} {words}" for key, words in WORDS.items() if count[key]]
    return (
        f"Of {len(verdicts)} claims tested, {joined(said)}. The sections below show each, and why not where it did not."
    )
