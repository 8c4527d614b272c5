"""One HTML file that shows an instrument: every parameter over the keyboard with the literature's behind it, every key.

It is made by `report.kit` and runs no script.
"""

from __future__ import annotations

import os
from typing import Any

from ..numbers import number
from ..report import kit
from .figures import draw
from .gather import HIGHEST_KEY, LOUDEST, LOWEST_KEY, reference_compression
from .laws import OUTLYING
from .words import STATES, counts

__all__ = ["write_page"]


def write_page(path: str | os.PathLike[str], document: dict[str, Any]) -> None:
    """Write the page of a document of `build_instrument`, whole or not at all.

    Raises `OutputError` if `path` cannot be written.
    """
    found, figures = counts(document), draw(document)
    kit.write_page(
        path, "page.html.j2", package="pianofit.keyboard", strict=False, title=document["name"] or "Instrument",
        contents=True,
        doc=document,
        quantity=document["quantity"],
        known=sum(key["fit"] is not None for key in document["keys"]),
        states=[(state, found[state], words) for state, words in STATES.items() if found[state]],
        figures={name: kit.picture(panels) for name, panels in figures.items()},
        rows=[_row(key) for key in document["keys"]],
        outlying=f"{OUTLYING:g}", loudest=f"{LOUDEST:g}",
        u_low=1e3 * reference_compression(LOWEST_KEY), u_high=1e3 * reference_compression(HIGHEST_KEY),
    )  # fmt: skip


def _row(key: dict[str, Any]) -> dict[str, Any]:
    s, h, g, fit = key["string"], key["hammer"], key["geometry"], key["fit"]
    rounded = [key["told"]["B"]["value"], s["b1"], s["b2"], 1e3 * h["M_H"], 1e3 * g["mass"], h["K_H"]]
    cells = [
        f"{s['c'] / (2 * g['length']):.2f}", *(number(x, 3) for x in rounded), f"{h['p']:.3f}", number(h["mu"], 2),
        str(fit["recordings"]) if fit else "–",
        f"{fit['levels_db']:.2f}" if fit and fit["levels_db"] is not None else "–",
    ]  # fmt: skip
    moved = [f"{n} ({t['state']})" if t["state"] == "outlier" else n for n, t in key["told"].items()
             if t.get("state") in ("pulled", "outlier")]  # fmt: skip
    return {"note": key["note"], "state": key["state"], "cells": cells, "words": ", ".join(moved), "fit": fit}
