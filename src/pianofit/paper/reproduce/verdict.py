"""What came of each of the paper's claims: a sentence with its numbers, chosen by the numbers.

Every function of `verdicts_model` and `verdicts_fit` takes what was measured in this run, and nothing else, and decides
by a rule that stands in the function. A claim made of several parts comes out in part when only some of them do. `why`
is what the run itself found to explain what did not come out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from ...report.words import number

__all__ = ["WORDS", "Verdict", "joined", "listed", "or_else", "outcome_of", "percent"]

WORDS = {"yes": "came out", "part": "came out in part", "no": "did not come out"}


@dataclass(frozen=True)
class Verdict:
    """One claim, and what came of it."""

    claim: str
    where: str  # in the paper
    outcome: str  # a key of `WORDS`
    sentence: str
    why: str = ""
    instead: str = ""  # what became of it when done otherwise, in a few words

    @property
    def word(self) -> str:
        """The outcome in words."""
        return WORDS[self.outcome]


def outcome_of(parts: Sequence[bool]) -> str:
    """Say whether all, some or none of the claim's parts came out."""
    return "yes" if all(parts) else "part" if any(parts) else "no"


def or_else(how: str, short: str, first: Verdict, second: Verdict) -> Verdict:
    """`first`; where it did not come out whole, it also says what became of the same claim done otherwise.

    Parameters
    ----------
    how, short : how it was done otherwise, as the beginning of a sentence and in a word or two.
    """
    if first.outcome == "yes":
        return first
    why = f"{first.why} {how}, it {second.word}: {second.sentence}".strip()
    return replace(first, why=why, instead=f"{short}: {second.word}")


def joined(texts: Sequence[str]) -> str:
    """Join as a, b and c."""
    return texts[0] if len(texts) == 1 else f"{', '.join(texts[:-1])} and {texts[-1]}"


def listed(values: Sequence[float], digits: int = 3) -> str:
    """Numbers as a, b and c."""
    return joined([number(float(v), digits) for v in values])


def percent(share: float, digits: int = 2) -> str:
    """Write a share as a percentage."""
    return f"{number(100 * share, digits)} %"
