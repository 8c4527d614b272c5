"""What came of a listening test: how often listeners were right, and how sure that is."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import ParameterError
from ..io.files import load_json, printable, short_repr
from .page import ANSWERS

__all__ = ["Count", "count_answers"]

# Of a file of answers, bytes: thousands of trials have less.
LARGEST_FILE = 2**24
# Of the intervals.
CONFIDENCE = 0.95
WAY_OUT = "give what a page of pianofit listen or pianofit reproduce saved"


class Count(NamedTuple):
    """Answers to one condition."""

    condition: str
    hits: int
    of: int
    p: float  # two-sided, of a fair coin, exact
    interval: tuple[float, float]  # of the share of hits, 95 %, Clopper and Pearson (1934)


def count_answers(files: Sequence[Path]) -> list[Count]:
    """Counts over all files, condition by condition.

    Raises `ParameterError` where a file holds no answers, or two hold the same.
    """
    from scipy.stats import binomtest

    hits: dict[str, list[bool]] = {}
    seen: dict[str, Path] = {}
    for path in files:
        trials, text = _trials(path)
        if text in seen:
            raise ParameterError(
                f"{printable(path)}: holds the same answers as {printable(seen[text])}; give each once"
            )
        seen[text] = path
        for condition, hit in trials:
            hits.setdefault(condition, []).append(hit)
    counts = []
    for condition, found in hits.items():
        test = binomtest(sum(found), len(found))
        low, high = test.proportion_ci(CONFIDENCE, method="exact")
        counts.append(Count(condition, sum(found), len(found), float(test.pvalue), (float(low), float(high))))
    return counts


def _trials(path: Path) -> tuple[list[tuple[str, bool]], str]:
    """Of each answer what was asked and whether it was a hit; and the file's content in one form."""
    where = printable(path)
    content = load_json(path, LARGEST_FILE, "answers of a listening test", WAY_OUT, ParameterError)
    if not isinstance(content, dict) or content.get("schema") != ANSWERS or not isinstance(content.get("trials"), list):
        found = short_repr(content.get("schema")) if isinstance(content, dict) else "none"
        raise ParameterError(f"{where}: no answers of a listening test (schema {found}, must be {ANSWERS}); {WAY_OUT}")
    trials = [_trial(trial, f"{where}: trials[{n}]") for n, trial in enumerate(content["trials"])]
    if not trials:
        raise ParameterError(f"{where}: no question was answered; {WAY_OUT}")
    return trials, json.dumps(content, sort_keys=True)


def _trial(trial: Any, where: str) -> tuple[str, bool]:
    if not isinstance(trial, dict):
        raise ParameterError(f"{where} is {short_repr(trial)}, no answer; {WAY_OUT}")
    condition, chosen, hit = (trial.get(name) for name in ("condition", "chosen", "hit"))
    if not (isinstance(condition, str) and chosen in ("a", "b") and hit in ("a", "b")):
        raise ParameterError(
            f"{where}: condition is {short_repr(condition)}, chosen {short_repr(chosen)}, hit {short_repr(hit)}; {WAY_OUT}"
        )
    return printable(condition), chosen == hit
