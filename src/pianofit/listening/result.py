"""Count the answers of listening tests: hits by condition, with intervals and p values."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import ParameterError
from ..io.files import load_json, printable, short_repr
from .page import ANSWERS

__all__ = ["Count", "count_answers"]

# Largest file of answers, bytes. Thousands of trials need less.
LARGEST_FILE = 2**24
# Confidence of the intervals.
CONFIDENCE = 0.95
HINT = "give a file that a page of pianofit listen saved"


class Count(NamedTuple):
    """Answers to one condition."""

    condition: str
    hits: int
    of: int
    p: float  # two-sided, of a fair coin, exact
    interval: tuple[float, float]  # of the share of hits, 95 %, Clopper and Pearson (1934)


def count_answers(files: Sequence[Path]) -> list[Count]:
    """Count the answers of all files by condition.

    Raises `ParameterError` if a file has no answers, or two files have the same.
    """
    from scipy.stats import binomtest

    hits: dict[str, list[bool]] = {}
    files_by_content: dict[str, Path] = {}
    for path in files:
        trials, text = _trials(path)
        if text in files_by_content:
            raise ParameterError(
                f"{printable(path)}: has the same answers as {printable(files_by_content[text])}; give each file once"
            )
        files_by_content[text] = path
        for condition, hit in trials:
            hits.setdefault(condition, []).append(hit)
    counts = []
    for condition, found in hits.items():
        test = binomtest(sum(found), len(found))
        low, high = test.proportion_ci(CONFIDENCE, method="exact")
        counts.append(Count(condition, sum(found), len(found), float(test.pvalue), (float(low), float(high))))
    return counts


def _trials(path: Path) -> tuple[list[tuple[str, bool]], str]:
    """Return condition and hit of each answer, and the content of the file in a normal form."""
    where = printable(path)
    content = load_json(path, LARGEST_FILE, "answers of a listening test", HINT, ParameterError)
    if not isinstance(content, dict) or content.get("schema") != ANSWERS or not isinstance(content.get("trials"), list):
        found = short_repr(content.get("schema")) if isinstance(content, dict) else "none"
        raise ParameterError(f"{where}: not answers of a listening test (schema {found}, must be {ANSWERS}); {HINT}")
    trials = [_trial(trial, f"{where}: trials[{n}]") for n, trial in enumerate(content["trials"])]
    if not trials:
        raise ParameterError(f"{where}: has no answers; {HINT}")
    return trials, json.dumps(content, sort_keys=True)


def _trial(trial: Any, where: str) -> tuple[str, bool]:
    if not isinstance(trial, dict):
        raise ParameterError(f"{where} is {short_repr(trial)}, not an answer; {HINT}")
    condition, chosen, hit = (trial.get(name) for name in ("condition", "chosen", "hit"))
    if not (isinstance(condition, str) and chosen in ("a", "b") and hit in ("a", "b")):
        raise ParameterError(
            f"{where}: condition is {short_repr(condition)}, chosen {short_repr(chosen)}, hit {short_repr(hit)}; {HINT}"
        )
    return printable(condition), chosen == hit
