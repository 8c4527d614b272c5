"""Sections of the page: Tables II and III, and band 3 with the searches in it."""

from __future__ import annotations

from ...criterion import BANDS
from ...parameters import FIT_NAMES, PARAMETERS
from ...report.words import number
from . import figures_search
from .band3 import WITHIN
from .figures_fit import SYMBOLS
from .findings import Findings
from .fits import RECIPES, shares
from .page import Book, Paragraph, Section, Sheet
from .studies import STRINGS
from .verdict import or_else, percent
from .verdicts_fit import annealing_escapes, changes_as_printed, local_minima, string_found

__all__ = ["READ_INSTEAD", "band3", "tables"]

READ_INSTEAD = ("With the string read off its partials in place of steps 1 and 2", "string read")
RULING = 3  # partials of a band that are named


def tables(book: Book, f: Findings) -> Section:
    """Tables II and III."""
    t = f.tables
    text = (
        "The laboratory's string and hammer have the paper's final values: the truth is the paper's own last column. "
        "The fits start from the paper's initial values. The full laboratory's felt has memory and no μ. The blow has "
        f"{number(t.true['v_H0'], 5)} m/s."
    )
    printed = {name: value for name, value in t.printed_final.items() if name in t.printed_initial}
    found, read = (t.found[f"full: {RECIPES[recipe]}"] for recipe in STRINGS)
    return Section(
        "tables",
        "Tables II and III",
        [
            Paragraph(text),
            string_found(t.true, found, shares(f.origin.case)),
            _shares(book, f),
            or_else(
                *READ_INSTEAD,
                changes_as_printed(t.printed_initial, printed, found),
                changes_as_printed(t.printed_initial, printed, read),
            ),
            _table(book, f, "table-2", "Table II, the string; ideal and full are the laboratories.", FIT_NAMES[:4]),
            _table(book, f, "table-3", "Table III, the hammer.", FIT_NAMES[4:]),
            _intervals(book, f),
        ],
    )


def _table(book: Book, f: Findings, name: str, caption: str, parameters: tuple[str, ...]) -> Sheet:
    t = f.tables
    columns = {"paper: initial": t.printed_initial, "paper: final": t.printed_final, "truth": t.true} | t.found
    rows = [(p, *(column.get(p) for column in columns.values())) for p in parameters]
    file = book.tabulate(name, ("parameter", *columns), rows)
    shown = [(_symbol(p), *(number(x, 4) for x in values)) for p, *values in rows]
    return Sheet(file, caption, ("parameter", *columns), shown)


def _shares(book: Book, f: Findings) -> Sheet:
    """The partials that rule the criterion, the strongest of each band."""
    every = [(band, k, share) for band, by in shares(f.origin.case).items() for k, share in by.items()]
    file = book.tabulate("shares", ("band", "partial", "share"), every)
    strongest = {band: sorted((x for x in every if x[0] == band), key=lambda x: -x[2])[:RULING] for band in BANDS[1:]}
    shown = [
        (band.replace("band", "band "), *(f"{k}: {percent(share)}" for _, k, share in rows))
        for band, rows in strongest.items()
    ]
    caption = "The partials that rule the criterion: their shares in ∫ |S|⁴, by which equation 19 weighs."
    return Sheet(file, caption, ("", "first", "second", "third"), shown)


def _symbol(name: str) -> str:
    unit = PARAMETERS[name].unit.replace("^p", "ᵖ")
    return SYMBOLS[name] if unit == "1" else f"{SYMBOLS[name]}, {unit}"


def _intervals(book: Book, f: Findings) -> Sheet:
    """What the default recipe says of its own certainty."""
    t = f.tables
    ends = [f"{column}, {end}" for column in t.intervals for end in ("from", "to")]
    rows = [(p, *(x for by in t.intervals.values() for x in (by[p] or (None, None)))) for p in FIT_NAMES]
    file = book.tabulate("intervals", ("parameter", *ends), rows)
    shown = [
        (_symbol(p), number(t.true.get(p), 6), *(_span(*pair) for pair in zip(x[::2], x[1::2], strict=True)))
        for p, *x in rows
    ]
    caption = "The default recipe's 95 % intervals, beside the truth."
    return Sheet(file, caption, ("parameter", "truth", *t.intervals), shown)


def _span(low: float | None, high: float | None) -> str:
    return "–" if low is None else f"{number(low, 6)} to {number(high, 6)}"


def band3(book: Book, f: Findings) -> Section:
    """Local minima, and the searches."""
    plane, run = f.plane, f.race
    text = (
        f"One measurement of the full laboratory ({number(f.plan.origin)} m/s); the string is held at its truth, the "
        "hammer's five parameters are free. All searches have the same box about the paper's initial values, and the "
        f"same {len(run.start)} starts in it, of which the first is the paper's own and the others are random."
    )
    kinds = ("gradient", "squares", "annealed", "polished")
    _files(book, f, kinds)
    return Section(
        "band3",
        "Band 3: local minima, gradient and annealing",
        [
            Paragraph(text),
            local_minima([m.cost for m in plane.minima], [m.cost for m in run.minima]),
            book.draw("band-3", lambda: figures_search.plane(plane)),
            annealing_escapes(len(run.start), {kind: run.reached(kind) for kind in kinds}, WITHIN),
            book.draw(
                "searches",
                lambda: figures_search.searches(run),
                gradient=run.evaluations["gradient"],
                annealing=run.evaluations["annealing"],
                settled=int(run.settled.sum()),
                starts=len(run.start),
            ),
        ],
    )


def _files(book: Book, f: Findings, kinds: tuple[str, ...]) -> None:
    plane, run = f.plane, f.race
    grid = [
        (float(a), float(b), float(plane.criterion[i, j]))
        for i, a in enumerate(plane.first)
        for j, b in enumerate(plane.second)
    ]
    book.tabulate("band-3", (*(f"log_{name}_over_true" for name in plane.names), "criterion"), grid)
    ends = zip(run.start, *(getattr(run, kind) for kind in kinds), strict=True)
    book.tabulate("searches", ("start", *kinds), [tuple(map(float, row)) for row in ends])
