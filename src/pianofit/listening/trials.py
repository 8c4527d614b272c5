"""Sounds, questions and trials of a listening test."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from ..schema.listening import TrialEntry

Kind = Literal["abx", "nearer"]
KINDS: tuple[Kind, ...] = ("abx", "nearer")


@dataclass(frozen=True, eq=False)
class ListeningSound:
    """One sound of the test. Equal samples do not make two sounds equal."""

    what: str  # name of the set, hidden until the end
    case: str  # note or stroke; all sounds of a question have the same
    samples: np.ndarray  # [samples] or [channels, samples], all sounds with the same onset


class Question(NamedTuple):
    """A question about a reference and a pair, repeated `times` times.

    `nearer`: which sound of the pair is nearer to the reference? If the pair contains the reference, it is hidden.
    `abx`: which sound of the pair is X? X is drawn from the pair for each repetition; `reference` is not used.
    """

    reference: ListeningSound
    pair: tuple[ListeningSound, ListeningSound]
    times: int = 2
    kind: Kind = "nearer"

    @property
    def condition(self) -> str:
        """Name of the condition. Answers of one condition are counted together."""
        first, second = (sound.what for sound in self.pair)
        if self.kind == "abx":
            return f"ABX: {first} or {second}"
        if self.reference not in self.pair:
            return f"nearer to {self.reference.what}: {first} than {second}"
        other = next(sound for sound in self.pair if sound is not self.reference)
        return f"hidden reference: {self.reference.what} next to {other.what}"


def draw_trials(
    questions: list[Question], names: Mapping[ListeningSound, str], draw: np.random.Generator
) -> Iterator[TrialEntry]:
    """Yield the trials in random order, first all `abx`, then all `nearer`, with the `names` of the sounds."""
    for kind in KINDS:
        asked = [question for question in questions if question.kind == kind for _ in range(question.times)]
        for n in draw.permutation(len(asked)):
            question = asked[n]
            side, x = draw.integers(2, size=2)
            a, b = question.pair[:: -1 if side else 1]
            reference = question.pair[x] if kind == "abx" else question.reference
            hit = reference if reference in question.pair else question.pair[0]
            yield TrialEntry(question.condition, kind, *(names[sound] for sound in (reference, a, b, hit)))
