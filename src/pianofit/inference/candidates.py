"""Candidates of a search: where each is, what F says there, and how its descent is going."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import numpy as np

from .derivatives import Evaluation

__all__ = ["TableState", "Candidates", "chosen"]


class TableState(NamedTuple):
    """What candidates have of one table; [B, ...] throughout."""

    phi: np.ndarray  # [B, 4]
    w: np.ndarray  # [B, R, K]
    residual: np.ndarray  # [B, R, K]
    jacobian: np.ndarray  # what moves the law [B, R, K, size]
    derivatives: Evaluation
    inverse: np.ndarray  # approximate inverse Hessian of F by φ [B, 4, 4]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Candidates:
    """Candidates on their way down: θ, then φ and w of every table, and how each is going. [B, ...] throughout."""

    theta: np.ndarray
    offset: np.ndarray  # what a contact stepped without end would add to the levels, dB [B, R, K]
    parts: tuple[TableState, ...]
    damping: np.ndarray  # Levenberg and Marquardt's
    last_decrease: np.ndarray  # by the last step, F

    def __len__(self) -> int:
        return len(self.theta)

    @property
    def phi(self) -> tuple[np.ndarray, ...]:
        """Of every table [B, 4]."""
        return tuple(part.phi for part in self.parts)

    @property
    def w(self) -> tuple[np.ndarray, ...]:
        """Of every table [B, R, K]."""
        return tuple(part.w for part in self.parts)

    @property
    def level(self) -> TableState:
        """Of the table of levels, which is the first."""
        return self.parts[0]

    def take(self, which: np.ndarray) -> Candidates:
        """Some of them, in this order."""
        return jax.tree.map(lambda x: x[which], self)

    def put(self, which: np.ndarray, other: Candidates) -> Candidates:
        """With some replaced by `other`'s."""

        def replaced(mine: np.ndarray, new: np.ndarray) -> np.ndarray:
            mine = mine.copy()
            mine[which] = new
            return mine

        return jax.tree.map(replaced, self, other)

    def join(self, other: Candidates) -> Candidates:
        """Both."""
        return jax.tree.map(lambda *pair: np.concatenate(pair), self, other)


def chosen(first: np.ndarray, one, other):
    """Of `one` where `first` [B], else of `other`: trees of arrays [B, ...]."""
    return jax.tree.map(lambda a, b: np.where(first.reshape(-1, *(1,) * (np.ndim(a) - 1)), a, b), one, other)
