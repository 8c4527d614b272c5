"""The page of a blind test: which of two sounds is a third, or is nearer to it.

The order of the questions and the sides of the sounds are drawn by a seed before the page is written. The page holds
the sounds under names that say nothing, and the order and what they are in a form that no eye reads; a key beside it
says both in plain words. All sounds are equally loud. The answers are saved as JSON.
"""

from __future__ import annotations

import base64
import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from .. import __version__
from ..io.files import json_text, replace_file
from ..report.html import write_page
from ..report.sound import Clip, make_clips

__all__ = ["ANSWERS", "TestSound", "Question", "write_listening"]

# Schema of the answers that a page saves, and of its key.
ANSWERS = 2
# What one question takes a listener, min.
MINUTES = 0.25


@dataclass(frozen=True, eq=False)
class TestSound:
    """A sound of the test, which is no other however alike."""

    what: str  # what it is, hidden until the end
    case: str  # which note or stroke, which all sounds of a question share
    samples: np.ndarray  # [samples] or [channels, samples], all sounds with the same onset


class Question(NamedTuple):
    """About a reference and a pair, asked so many times.

    `nearer`: which of the pair is nearer the reference? With the reference in the pair: which is the reference, hidden?
    `abx`: which of the pair is X? X is one of them, drawn for each time by the seed, whatever `reference` is.
    """

    reference: TestSound
    pair: tuple[TestSound, TestSound]
    times: int = 2
    kind: Literal["abx", "nearer"] = "nearer"

    @property
    def condition(self) -> str:
        """What is counted together, in words."""
        first, second = (one.what for one in self.pair)
        if self.kind == "abx":
            return f"ABX: {first} or {second}"
        if self.reference not in self.pair:
            return f"nearer to {self.reference.what}: {first} than {second}"
        other = next(one for one in self.pair if one is not self.reference)
        return f"hidden reference: {self.reference.what} beside {other.what}"


class Trial(NamedTuple):
    """One question as it is put."""

    question: Question
    reference: TestSound
    a: TestSound
    b: TestSound

    @property
    def hit(self) -> TestSound:
        """Which answer counts: the reference where it is one of the two, or else the first of the pair."""
        return self.reference if self.reference in (self.a, self.b) else self.question.pair[0]


def write_listening(
    path: str | os.PathLike[str], questions: list[Question], rate: int, onset: float, seed: int, *, program: str,
    about: str, origin: str, key: str | os.PathLike[str], seconds: float = 8.0,
) -> list[tuple[TestSound, Clip]]:  # fmt: skip
    """Write the page, and the key to it.

    Parameters
    ----------
    onset : of all sounds, s.
    seed : of the order, the sides, every X and the names the sounds go by.
    program : what made it, for the footer and the file of answers.
    about : what is tested, in words that follow "A blind listening test on".
    origin : what the references are, in words that follow "The references are".
    key : a JSON file that says what the page hides: by name what each sound is, and the trials in their order.
    seconds : what is heard of each sound at most, s.

    Returns
    -------
    The sounds, and each as it is heard, under the name it goes by.

    Raises `OutputError` if a file cannot be written.
    """
    draw = np.random.default_rng(seed)
    sounds = list(dict.fromkeys(h for q in questions for h in (q.reference, *q.pair)))
    names = {h: f"s{n:03d}" for h, n in zip(sounds, draw.permutation(len(sounds)), strict=True)}
    trials = list(_drawn(questions, draw))
    clips = make_clips({name: h.samples for h, name in names.items()}, rate, onset, seconds=seconds)
    facts = {"schema": ANSWERS, "program": program, "version": __version__, "seed": seed}
    hidden: dict[str, Any] = {
        "sounds": {name: {"what": h.what, "case": h.case} for h, name in names.items()},
        "trials": [
            {"condition": t.question.condition, "kind": t.question.kind}
            | {role: names[getattr(t, role)] for role in ("reference", "a", "b", "hit")}
            for t in trials
        ],
    }
    test = facts | {
        "sounds": {clip.name: clip.text for clip in sorted(clips, key=lambda c: c.name)},
        "hidden": base64.b64encode(json.dumps(hidden).encode()).decode(),
    }
    counts = {kind: sum(t.question.kind == kind for t in trials) for kind in ("abx", "nearer")}
    write_page(
        path, "listening.html.j2", package="pianofit.listening", styles=("listening.css",),
        scripts=("audio.js", "listening.js"), title="A blind listening test", test=test, counts=counts,
        count=len(trials), about=about, origin=origin, minutes=max(1, round(MINUTES * len(trials))),
        controls=sum(t.question.condition.startswith("hidden reference") for t in trials),
    )  # fmt: skip
    replace_file(key, json_text(facts | hidden).encode())
    return [*zip(sounds, clips, strict=True)]


def _drawn(questions: list[Question], draw: np.random.Generator) -> Iterator[Trial]:
    """The trials in their order, those of one kind together: what is asked changes once."""
    for kind in ("abx", "nearer"):
        asked = [question for question in questions if question.kind == kind for _ in range(question.times)]
        for n in draw.permutation(len(asked)):
            question = asked[n]
            side, x = draw.integers(2, size=2)
            a, b = question.pair[:: -1 if side else 1]
            yield Trial(question, question.pair[x] if kind == "abx" else question.reference, a, b)
