"""Which recordings are takes of one string, which of them comes first, and what each has of its own.

The first take is the one on whose hammer velocity the others rest: the fastest whose velocity was measured, else the
brightest. Which take is the fastest comes out of the fit, and it is the fastest's velocity that is then assumed. Levels
are no guide: a library may have brought all its layers to one peak. Takes of one `group` in the setup share a path,
takes of one `gain_group` a gain, and of those levels are a guide. Takes of one `strike` are one blow through several
microphones: they share its velocity, and its pitch, for clocks of recorders differ by hundredths of a cent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..analysis import Analysis
from ..errors import FitError
from ..initial import Start, starting_values
from ..recording import Recording, one_line
from ..setup_file import Setup
from ..setup_file import Take as Known
from .space import Layout

__all__ = ["Take", "arranged"]

# Takes of one key are within this of each other, cents; the next key is 100 away.
SAME_KEY = 40.0
# A take with fewer partials above its noise says nothing of the hammer.
FEWEST = 3
# The brightest of several takes is assumed to have been struck at this, m/s: layers of a library end at fortissimo.
ASSUMED_FASTEST = 4.0
# From layer to layer velocity is taken to fall by this factor, until the fit knows better.
LAYER = 0.6


@dataclass(frozen=True)
class Take:
    """One recording, analysed, and how hard it was struck over the first take."""

    recording: Recording
    analysis: Analysis
    ratio: float = 1.0
    ratio_known: bool = False


def arranged(
    recordings: Sequence[Recording], analyses: Sequence[Analysis], setup: Setup, velocity: float | None = None
) -> tuple[list[Take], Start, Layout, list[int]]:
    """Takes with the first one first, where they start, what they share, and where each stands in what was given.

    Parameters
    ----------
    velocity : measured hammer velocity, m/s, of a single take; overrides the setup's.

    Raises
    ------
    FitError
        Naming the file that is given twice, of another key, or all noise.
    """
    _refuse(recordings, analyses)
    known = [_entry(recording, setup, len(recordings)) for recording in recordings]
    strikes = _strikes(known)
    told = {b: k.v_H0 for b, k in zip(strikes, known, strict=True) if k.v_H0 is not None}
    speed = [velocity if velocity is not None else told.get(b) for b in strikes]
    order = _order(speed, strikes, [_brightness(a) for a in analyses])
    first = order[0]
    start = starting_values(analyses[first], replace(setup, takes=()), speed[first])
    if len(order) > 1 and start.fixed.get("v_H0") == "assumed" and "v_H0" not in setup.initial:
        values = start.values | {"v_H0": ASSUMED_FASTEST}
        start = replace(start, values=values, initial=start.initial | {"v_H0": ASSUMED_FASTEST})
    ratios = _ratios([speed[i] for i in order], [strikes[i] for i in order], start.values["v_H0"])
    takes = [Take(recordings[i], analyses[i], *ratio) for i, ratio in zip(order, ratios, strict=True)]
    return takes, start, _layout([known[i] for i in order]), order


def _refuse(recordings: Sequence[Recording], analyses: Sequence[Analysis]) -> None:
    names = [one_line(Path(r.path).name) for r in recordings]
    for i, (name, recording, analysis) in enumerate(zip(names, recordings, analyses, strict=True)):
        for other in range(i):
            if recording.sha256 == recordings[other].sha256:
                raise FitError(f"{name} and {names[other]} are the same recording; give it once")
        if len(recordings) > 1 and len(analysis.partials) < FEWEST:
            raise FitError(f"{name}: only {len(analysis.partials)} partials stand above its noise; leave it out")
        cents = 1200 * np.log2(analysis.f0 / np.median([a.f0 for a in analyses]))
        if abs(cents) > SAME_KEY:
            raise FitError(
                f"{name}: its pitch, {analysis.f0:.2f} Hz, is {abs(cents):.0f} cents from that of the other takes; all "
                "must be of one key"
            )


def _entry(recording: Recording, setup: Setup, count: int) -> Known:
    """What the setup says of this recording: the [[take]] of its name, or the only one of a single recording."""
    name = Path(recording.path).name
    for known in setup.takes:
        if Path(known.file or "").name == name:
            return known
    return setup.takes[0] if count == 1 and setup.takes else Known()


def _brightness(analysis: Analysis) -> float:
    """Mean partial number, weighted by amplitude: harder is brighter."""
    amplitude = 10 ** (analysis.partials.level / 20)
    return float((analysis.partials.number * amplitude).sum() / amplitude.sum())


def _strikes(known: Sequence[Known]) -> list[int]:
    """Of each take: the first that hears the same blow."""
    names = [(k.strike, i) if k.strike is None else (k.strike, 0) for i, k in enumerate(known)]
    return [names.index(name) for name in names]


def _order(speed: Sequence[float | None], strikes: Sequence[int], brightness: Sequence[float]) -> list[int]:
    """Where each take stands: blow after blow, by velocity or brightness; a blow is as bright as its brightest take."""
    best = {b: max(x for x, other in zip(brightness, strikes, strict=True) if other == b) for b in strikes}
    return sorted(
        range(len(speed)),
        key=lambda i: (speed[i] is None, -(speed[i] or 0.0), -best[strikes[i]], strikes[i], -brightness[i]),
    )


def _ratios(speed: Sequence[float | None], strikes: Sequence[int], first: float) -> list[tuple[float, bool]]:
    """Velocities over the first take's, and whether they were measured; the unknown ones fall from blow to blow."""
    ratios, last, before = [], 1.0, strikes[0]
    for strike, v in zip(strikes, speed, strict=True):
        last = v / first if v is not None else last * (LAYER if strike != before else 1.0)
        ratios.append((last, v is not None))
        before = strike
    return ratios


def _layout(known: Sequence[Known]) -> Layout:
    groups = [k.group or "" for k in known]
    gains = [(k.gain_group, i) if k.gain_group is None else (k.gain_group, 0) for i, k in enumerate(known)]
    names = list(dict.fromkeys(groups))
    return Layout(tuple(names.index(g) for g in groups), tuple(gains.index(g) for g in gains), tuple(_strikes(known)))
