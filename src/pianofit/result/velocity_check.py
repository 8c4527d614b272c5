"""Measured hammer velocities compared with the sound: what contradicts them is a question to the user, not an error.

Two observations need neither a gain nor a unit. A felt is a hardening spring, so a faster stroke is brighter: its
partials gain level towards high frequencies. And the exponent of the felt follows from how much brighter it is, so a
wrong ratio of the velocities shows as an exponent that no felt has.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from ..analysis import Analysis
from ..inference.pipeline import InferenceResult
from ..inference.problem import FitProblem
from ..io.files import printable

__all__ = ["brightening", "questioned"]

# Standard errors by which a faster stroke must be duller than a slower one. Of 55 pairs of neighbouring layers of three
# real pianos all are brighter where they are louder, 51 by more than this.
SURE = 3.0
# The least slope that counts, dB an octave: half of the smallest of those 55, 0.94, which is a step of 2.4 dB.
DULLER = -0.5
# Mean level difference, dB, below which a faster stroke counts as fainter: a file that was normalised is not.
FAINTER = -3.0
FEWEST = 5  # partials in common, for a slope with an error
# Roughness of a partial's level from stroke to stroke, dB, next to its standard error.
ROUGH = 1.0
# Standard deviations of its prior by which a felt's exponent may leave the literature's: 1.4 to 3.8 in the middle.
UNLIKELY = 2.5
# Hammer velocities of a pianist, fortissimo over pianissimo: 6 over 0.3 m/s (Askenfelt and Jansson 1991).
VELOCITIES = 20.0


def brightening(slower: Analysis, faster: Analysis) -> tuple[float, float, float]:
    """How levels change from one stroke to another, over the partials that both have.

    Returns
    -------
    The slope in dB an octave and its standard error (infinite if too few partials are common), and the mean change, dB.
    """
    a, b = slower.partials, faster.partials
    number, i, j = np.intersect1d(a.number, b.number, return_indices=True)
    if len(number) < FEWEST:
        return 0.0, np.inf, 0.0
    change = b.level[j] - a.level[i]
    weight = 1 / (a.level_error[i] ** 2 + b.level_error[j] ** 2 + ROUGH**2)
    octaves = np.log2(number)
    octaves = octaves - np.average(octaves, weights=weight)
    mean = float(np.average(change, weights=weight))
    spread = float(weight @ octaves**2)
    slope = float(weight @ (octaves * change)) / spread
    left = change - mean - slope * octaves
    error = float(np.sqrt(weight @ left**2 / (len(number) - 2) / spread))
    return slope, error, mean


def questioned(fit: InferenceResult) -> list[str]:
    """What to say of measured velocities that contradict the recordings; empty if none do."""
    problem, said = fit.problem, []
    paths = [*_measured(problem)]
    if found := min((one for path in paths for one in _reversed(problem, path)), default=None):
        _, slow, fast, what = found
        said.append(
            f"{_named(problem, fast)} is {what} than {_named(problem, slow)}. A faster stroke is louder and brighter: "
            "check the measured velocities."
        )
    given = sorted(v for v in problem.measured_velocity if v is not None)
    if given and given[-1] > VELOCITIES * given[0]:
        said.append(
            f"The measured velocities, {given[0]:g} to {given[-1]:g} m/s, differ by more than {VELOCITIES:g} times. "
            "A pianist's do not: check them and their unit, m/s."
        )
    compared = any(len({v for v, _ in path}) > 1 for path in paths)
    return said or (_exponent(fit, given) if compared else [])


def _measured(problem: FitProblem) -> Iterator[list[tuple[float, int]]]:
    """For each output path its recordings with a measured velocity, slowest first: velocity, m/s, and place."""
    layout = problem.layout
    for group in sorted(set(layout.group)):
        speeds = [(problem.measured_velocity[s], i) for i, s in enumerate(layout.stroke) if layout.group[i] == group]
        yield sorted((v, i) for v, i in speeds if v is not None)


def _reversed(problem: FitProblem, path: Sequence[tuple[float, int]]) -> Iterator[tuple[float, int, int, str]]:
    """Neighbours of a path that contradict the order of their velocities.

    A score, the least for the surest; the places of the slower and the faster one; and what the faster one is.
    """
    for (v, slow), (w, fast) in pairwise(path):
        slope, error, mean = brightening(problem.analyses[slow], problem.analyses[fast])
        words = [f"duller (by {-slope:.1f} dB an octave)"] * (slope < min(DULLER, -SURE * error))
        words += [f"fainter (by {-mean:.1f} dB)"] * (mean < FAINTER)
        if v < w and words:
            yield slope / error + mean, slow, fast, " and ".join(words)


def _named(problem: FitProblem, at: int) -> str:
    speed = problem.measured_velocity[problem.layout.stroke[at]]
    return f"{printable(Path(problem.recordings[at].path).name)} ({speed:g} m/s)"


def _exponent(fit: InferenceResult, given: Sequence[float]) -> list[str]:
    """What to say of an exponent that no felt has, which a wrong ratio of velocities explains."""
    u = fit.problem.unknowns
    if u.force_and_exponent_index is None or not u.free[at := u.force_and_exponent_index[1]]:
        return []
    away = float(fit.found.z[at] - u.mean[at]) / float(u.sd[at])
    if abs(away) < UNLIKELY:
        return []
    side, differ = ("above", "less") if away > 0 else ("below", "more")
    return [
        f"The felt's exponent {u.names[at]} = {np.exp(fit.found.z[at]):.2g} is {side} that of felts: the measured "
        f"velocities, {given[0]:g} to {given[-1]:g} m/s, differ {differ} than the sound does. Check them."
    ]
