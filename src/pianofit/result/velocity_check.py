"""Measured hammer velocities compared with the sound. A contradiction gives a warning, not an error.

Two observations need neither a gain nor a unit. Felt stiffens under compression, so a faster stroke is brighter: levels
rise more towards high frequencies. The change in brightness also determines the felt exponent. So a wrong ratio of the
velocities gives an exponent outside the range of felts.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from ..analysis import Analysis
from ..inference import FitProblem, InferenceResult
from ..io.files import printable
from .statuses import PIANIST_VELOCITY_RATIO

__all__ = ["brightening", "contradictory_velocities"]

# A faster stroke must be duller than a slower one by this many standard errors. In 55 pairs of neighbouring layers of
# three real pianos the louder one is always brighter, in 51 of them by more than this.
DULLER_STANDARD_ERRORS = 3.0
# Slopes above this are ignored, dB an octave: half of the smallest of those 55, 0.94, for a step of 2.4 dB.
DULLER_SLOPE = -0.5
# Mean level difference, dB, below which a faster stroke counts as fainter. A normalised file stays above it.
FAINTER_DB = -3.0
FEWEST_COMMON = 5  # common partials for a slope with a standard error
# Scatter of a partial's level from stroke to stroke, dB, added to its standard error.
STROKE_SCATTER_DB = 1.0
# Standard deviations by which the felt exponent may deviate from its prior: 1.4 to 3.8 in the middle of the keyboard.
EXPONENT_Z = 2.5


def brightening(slower: Analysis, faster: Analysis) -> tuple[float, float, float]:
    """Change of the levels from one stroke to another, over their common partials.

    Returns
    -------
    Slope in dB an octave, its standard error (infinite for too few common partials), and mean change in dB.
    """
    a, b = slower.partials, faster.partials
    number, i, j = np.intersect1d(a.number, b.number, return_indices=True)
    if len(number) < FEWEST_COMMON:
        return 0.0, np.inf, 0.0
    change = b.level[j] - a.level[i]
    weight = 1 / (a.level_error[i] ** 2 + b.level_error[j] ** 2 + STROKE_SCATTER_DB**2)
    octaves = np.log2(number)
    octaves = octaves - np.average(octaves, weights=weight)
    mean = float(np.average(change, weights=weight))
    spread = float(weight @ octaves**2)
    slope = float(weight @ (octaves * change)) / spread
    residual = change - mean - slope * octaves
    error = float(np.sqrt(weight @ residual**2 / (len(number) - 2) / spread))
    return slope, error, mean


def contradictory_velocities(fit: InferenceResult) -> list[str]:
    """Warnings about measured velocities that contradict the recordings; empty if none do."""
    problem, lines = fit.problem, []
    groups = [*_measured(problem)]
    if surest := min((pair for group in groups for pair in _contradictions(problem, group)), default=None):
        _, slow, fast, difference = surest
        lines.append(
            f"{_named(problem, fast)} is {difference} than {_named(problem, slow)}. A faster stroke is louder and "
            "brighter. Check the measured velocities."
        )
    given = sorted(v for v in problem.measured_velocity if v is not None)
    if given and given[-1] > PIANIST_VELOCITY_RATIO * given[0]:
        lines.append(
            f"The measured velocities, {given[0]:g} to {given[-1]:g} m/s, differ by more than a factor of "
            f"{PIANIST_VELOCITY_RATIO:g}, the range of a pianist. Check them and their unit, m/s."
        )
    compared = any(len({v for v, _ in group}) > 1 for group in groups)
    return lines or (_implausible_exponent(fit, given) if compared else [])


def _measured(problem: FitProblem) -> Iterator[list[tuple[float, int]]]:
    """For each output path: velocity, m/s, and index of its recordings with a measured velocity, slowest first."""
    layout = problem.structure
    for group in sorted(set(layout.group)):
        speeds = [(problem.measured_velocity[s], i) for i, s in enumerate(layout.stroke) if layout.group[i] == group]
        yield sorted((v, i) for v, i in speeds if v is not None)


def _contradictions(problem: FitProblem, group: Sequence[tuple[float, int]]) -> Iterator[tuple[float, int, int, str]]:
    """Neighbouring strokes of a path group whose sounds contradict the order of their velocities.

    Yields a score (lowest for the surest), the indices of the slower and the faster recording, and the difference.
    """
    for (v, slow), (w, fast) in pairwise(group):
        slope, error, mean = brightening(problem.analyses[slow], problem.analyses[fast])
        words = [f"duller (by {-slope:.1f} dB an octave)"] * (
            slope < min(DULLER_SLOPE, -DULLER_STANDARD_ERRORS * error)
        )
        words += [f"fainter (by {-mean:.1f} dB)"] * (mean < FAINTER_DB)
        if v < w and words:
            yield slope / error + mean, slow, fast, " and ".join(words)


def _named(problem: FitProblem, recording: int) -> str:
    speed = problem.measured_velocity[problem.structure.stroke[recording]]
    return f"{printable(Path(problem.recordings[recording].path).name)} ({speed:g} m/s)"


def _implausible_exponent(fit: InferenceResult, given: Sequence[float]) -> list[str]:
    """A warning about a felt exponent outside the range of felts, which a wrong ratio of velocities explains."""
    u = fit.problem.parametrisation
    if u.force_and_exponent_index is None or not u.free[exponent := u.force_and_exponent_index[1]]:
        return []
    z_score = float(fit.estimate.theta[exponent] - u.mean[exponent]) / float(u.sd[exponent])
    if abs(z_score) < EXPONENT_Z:
        return []
    side, differ = ("above", "less") if z_score > 0 else ("below", "more")
    return [
        f"The felt exponent {u.names[exponent]} = {np.exp(fit.estimate.theta[exponent]):.2g} is {side} the range of "
        f"felts. The measured velocities, {given[0]:g} to {given[-1]:g} m/s, differ {differ} than the sound does. "
        "Check them."
    ]
