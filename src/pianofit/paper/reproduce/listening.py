"""The paper's informal listening test, made honest: which of two sounds is nearer the reference.

The page draws sides and order in the browser, anew for every listener; it holds the sounds under names that say
nothing. All are equally loud. A control, the reference itself against another sound, shows whether the listener could
hear anything at all.
"""

from __future__ import annotations

import base64
import json
import os
from typing import NamedTuple

import numpy as np

from ... import __version__
from ...report.sound import make_clips
from .sheet import write_sheet

__all__ = ["MEASURED", "Heard", "Question", "write_listening"]

MEASURED = "measured"
# What one question takes a listener, min.
MINUTES = 0.25


class Heard(NamedTuple):
    """A sound of the test."""

    what: str  # "measured", or what is behind it
    velocity: float  # m/s
    samples: np.ndarray  # [samples], all sounds alike long and with the same onset


class Question(NamedTuple):
    """Which of the pair is nearer the reference, asked so many times."""

    reference: Heard
    pair: tuple[Heard, Heard]
    times: int = 2


def write_listening(
    path: str | os.PathLike[str], questions: list[Question], rate: int, onset: float, seed: int, origin: str
) -> None:
    """Write the page.

    Parameters
    ----------
    onset : of all sounds, s.
    seed : of the names the sounds go by.
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
    pairs = list(dict.fromkeys((q.pair[0].what, q.pair[1].what) for q in questions))
    count = sum(q.times for q in questions)
    test = {
        "version": __version__,
        "seed": seed,
        "sounds": {clip.name: clip.uri.split(",", 1)[1] for clip in sorted(clips, key=lambda clip: clip.name)},
        "key": base64.b64encode(json.dumps(key).encode()).decode(),
        "questions": [
            {"reference": names[id(q.reference)], "pair": [names[id(h)] for h in q.pair], "times": q.times}
            for q in questions
        ],
        "comparisons": [
            {"first": first, "second": second} for first, second in pairs if MEASURED not in (first, second)
        ],
    }
    write_sheet(
        path, "listening.html.j2", ("audio.js", "listening.js"), test=test, count=count, origin=origin, seed=seed,
        minutes=max(1, round(MINUTES * count)), version=__version__,
        controls=sum(q.times for q in questions if any(h.what == MEASURED for h in q.pair)),
    )  # fmt: skip
