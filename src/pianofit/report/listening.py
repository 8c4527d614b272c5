"""A blind listening test as a page: which of two sounds is nearer the reference.

Any two sets of sounds can be asked about. The page draws sides and order in the browser, anew for every listener; it
holds the sounds under names, drawn by a seed, that say nothing. All are equally loud. A control, the reference itself
against another sound, shows whether the listener could hear anything at all. The answers are saved as JSON.
"""

from __future__ import annotations

import base64
import json
import os
from typing import NamedTuple

import numpy as np

from .. import __version__
from .kit import write_page
from .sound import make_clips

__all__ = ["Heard", "Question", "write_listening"]

# What one question takes a listener, min.
MINUTES = 0.25


class Heard(NamedTuple):
    """A sound of the test."""

    what: str  # what it is, hidden until the end
    velocity: float  # of its stroke, m/s
    samples: np.ndarray  # [samples], all sounds alike long and with the same onset


class Question(NamedTuple):
    """Which of the pair is nearer the reference, asked so many times. With the reference in the pair: a control."""

    reference: Heard
    pair: tuple[Heard, Heard]
    times: int = 2

    @property
    def control(self) -> bool:
        """Whether one of the two is the reference itself."""
        return any(one is self.reference for one in self.pair)


def write_listening(
    path: str | os.PathLike[str], questions: list[Question], rate: int, onset: float, seed: int, *, program: str,
    about: str, origin: str,
) -> None:  # fmt: skip
    """Write the page.

    Parameters
    ----------
    onset : of all sounds, s.
    seed : of the names the sounds go by.
    program : what made it, for the footer and the file of answers.
    about : what is tested, in words that follow "A blind listening test on".
    origin : what the references are, in words that follow "The references are".

    Raises
    ------
    OutputError
        If `path` cannot be written.
    """
    sounds = list({id(h): h for q in questions for h in (q.reference, *q.pair)}.values())
    order = np.random.default_rng(seed).permutation(len(sounds))
    names = {id(sound): f"s{n:02d}" for sound, n in zip(sounds, order, strict=True)}
    clips = make_clips({names[id(h)]: h.samples for h in sounds}, rate, onset)
    key = {names[id(h)]: {"what": h.what, "velocity": h.velocity} for h in sounds}
    pairs = dict.fromkeys((q.pair[0].what, q.pair[1].what) for q in questions if not q.control)
    count = sum(q.times for q in questions)
    test = {
        "program": program,
        "version": __version__,
        "seed": seed,
        "sounds": {clip.name: clip.uri.split(",", 1)[1] for clip in sorted(clips, key=lambda clip: clip.name)},
        "key": base64.b64encode(json.dumps(key).encode()).decode(),
        "questions": [
            {"reference": names[id(q.reference)], "pair": [names[id(h)] for h in q.pair], "times": q.times}
            for q in questions
        ],
        "comparisons": [{"first": first, "second": second} for first, second in pairs],
    }
    write_page(
        path, "listening.html.j2", styles=("listening.css",), scripts=("audio.js", "listening.js"),
        title="Which is nearer?", test=test, count=count, about=about, origin=origin,
        minutes=max(1, round(MINUTES * count)), controls=sum(q.times for q in questions if q.control),
    )  # fmt: skip
