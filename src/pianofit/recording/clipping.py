"""Detection of clipping: flat runs at an extreme that the wave reaches with a slope."""

from __future__ import annotations

import numpy as np

from ..errors import RecordingError
from .noise import offset

__all__ = ["count_clipped"]

MIN_RUN = 3  # samples; the shortest flat run at an extreme that counts as clipped
MIN_EXTREME = 0.25  # of the largest sample; a lower extreme is the edge of a one-sided wave
DITHER_STEPS = 2.5  # steps; triangular dither spreads a clipped top over two, and half a step covers rounding
MIN_OVERSHOOT = 4.0  # spreads by which the slope extrapolates beyond a clipped top; unclipped notes reach 2.3


def count_clipped(used: np.ndarray, onset: int, rate: int, step: float) -> tuple[int, tuple[str, ...]]:
    """Count the clipped samples of `used` [samples, channels], and warn; raise if the attack is clipped."""
    columns = [column - offset(column) for column in used.T]
    runs = np.concatenate([_flat_runs(sign * column, step) for column in columns for sign in (1, -1)])
    if len(runs) == 0:
        return 0, ()
    lengths, first = runs[:, 1] - runs[:, 0], runs[:, 0].min() / rate
    early = lengths[(runs[:, 0] >= onset) & (runs[:, 0] < onset + 0.5 * rate)].sum()
    if early > 0.1 * used.shape[1] * min(0.5 * rate, len(used) - onset):
        raise RecordingError(f"is clipped beyond use: {early} samples in the first 0.5 s; record it with less gain")
    return int(lengths.sum()), (
        f"clipped: {lengths.sum()} samples, the first at {first:.3f} s; record it with less gain",
    )


def _flat_runs(y: np.ndarray, step: float) -> np.ndarray:
    """Start and stop of the runs in which `y` was clipped at its highest value [runs, 2].

    A later gain moves the highest value to any level, and dither spreads it over two steps. A slow, unclipped wave also
    stays on its highest quantised value for some samples, but its slope vanishes there. A clipped wave arrives with a
    slope that extrapolates to many steps beyond the top.
    """
    top, spread = y.max(), DITHER_STEPS * step
    if top < MIN_EXTREME * np.abs(y).max():
        return np.zeros((0, 2), int)
    runs = np.flatnonzero(np.diff(np.concatenate([[0], (y >= top - spread).astype(np.int8), [0]]))).reshape(-1, 2)
    runs = runs[runs[:, 1] - runs[:, 0] >= MIN_RUN]
    if len(runs) == 0:
        return runs
    values = np.unique(y[y > 0.5 * top])
    overshoot = MIN_OVERSHOOT * (spread + max(step, float(np.diff(values).min(initial=top))))
    padded = np.pad(y, 2, constant_values=top)  # a run that touches an end is judged by the slope on its other side
    start, stop = runs[:, 0] + 2, runs[:, 1] + 2
    entering = 2 * padded[start - 1] - padded[start - 2] - top
    leaving = 2 * padded[stop] - padded[stop + 1] - top
    return runs if np.any(np.maximum(entering, leaving) > overshoot) else runs[:0]  # one clipping level for all runs
