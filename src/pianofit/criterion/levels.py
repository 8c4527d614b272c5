"""Levels of partials, in dB, through an unknown but smooth output path.

A pickup, a soundboard, a microphone multiply every partial by a level of its own. Over log frequency the path is a sum
of a few cosines, held small by a penalty: enough for a tone control or a microphone's slope, too little to swallow the
zeros and the roll-off by which a hammer is known.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

__all__ = ["SAME_PARTIAL", "OutputPath", "level_error_db"]

# A frequency within this, relative, of a partial's is that partial's: the pitch of takes differs by cents.
SAME_PARTIAL = 0.005


class OutputPath(NamedTuple):
    """A path known at some partials' frequencies, Hz, ascending.

    In between it is linear in log frequency, beyond it is level.
    """

    frequency: np.ndarray
    db: np.ndarray
    decay: np.ndarray | None = None  # of each partial's decay rate over that of the string's law

    def at(self, frequency: np.ndarray) -> np.ndarray:
        """The path in dB at `frequency`, Hz [any number]: a partial's own, if it is one that is known."""
        between = np.interp(np.log(np.maximum(frequency, 1e-9)), np.log(self.frequency), self.db)
        nearest, near = self._nearest(frequency)
        return np.where(near, self.db[nearest], between)

    def decay_at(self, frequency: np.ndarray) -> np.ndarray:
        """Decay rate over the law's at `frequency`, Hz: a partial's own, and 1 where none was heard."""
        if self.decay is None:
            return np.ones(len(frequency))
        nearest, near = self._nearest(frequency)
        return np.where(near, self.decay[nearest], 1.0)

    def _nearest(self, frequency: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Which of the path's partials is next to each `frequency`, and whether it is the same."""
        nearest = np.abs(frequency[:, None] - self.frequency).argmin(axis=1)
        return nearest, np.abs(frequency / self.frequency[nearest] - 1) < SAME_PARTIAL


def level_error_db(model: np.ndarray, measured: np.ndarray) -> float:
    """Rms difference of levels [partials], dB, with one gain removed."""
    difference = model - measured
    return float(np.sqrt(np.mean((difference - difference.mean()) ** 2)))
