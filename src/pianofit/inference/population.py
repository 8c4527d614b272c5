"""Candidates of a search: where each is, what F says there, and how its descent is going."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import numpy as np

from .reports import Report

__all__ = ["Part", "Population", "chosen"]


class Part(NamedTuple):
    """What candidates have of one table; [B, ...] throughout."""

    phi: np.ndarray  # [B, 4]
    w: np.ndarray  # [B, R, K]
    residual: np.ndarray  # [B, R, K]
    jacobian: np.ndarray  # what moves the law [B, R, K, size]
    report: Report
    inverse: np.ndarray  # approximate inverse Hessian of F by φ [B, 4, 4]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Population:
    """Candidates on their way down: θ, then φ and w of every table, and how each is going. [B, ...] throughout."""

    z: np.ndarray
    offset: np.ndarray  # what a contact stepped without end would add to the levels, dB [B, R, K]
    parts: tuple[Part, ...]
    damping: np.ndarray  # Levenberg and Marquardt's
    gained: np.ndarray  # by the last step, F

    def __len__(self) -> int:
        return len(self.z)

    @property
    def phi(self) -> tuple[np.ndarray, ...]:
        """Of every table [B, 4]."""
        return tuple(part.phi for part in self.parts)

    @property
    def w(self) -> tuple[np.ndarray, ...]:
        """Of every table [B, R, K]."""
        return tuple(part.w for part in self.parts)

    @property
    def level(self) -> Part:
        """Of the table of levels, which is the first."""
        return self.parts[0]

    def take(self, which: np.ndarray) -> Population:
        """Some of them, in this order."""
        return jax.tree.map(lambda x: x[which], self)

    def put(self, which: np.ndarray, other: Population) -> Population:
        """With some replaced by `other`'s."""

        def replaced(mine: np.ndarray, new: np.ndarray) -> np.ndarray:
            mine = mine.copy()
            mine[which] = new
            return mine

        return jax.tree.map(replaced, self, other)

    def join(self, other: Population) -> Population:
        """Both."""
        return jax.tree.map(lambda *pair: np.concatenate(pair), self, other)


def chosen(first: np.ndarray, one, other):
    """Of `one` where `first` [B], else of `other`: trees of arrays [B, ...]."""
    return jax.tree.map(lambda a, b: np.where(first.reshape(-1, *(1,) * (np.ndim(a) - 1)), a, b), one, other)
