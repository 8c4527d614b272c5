"""Candidates of a search: the position of each, F and its derivatives there, and the state of its minimisation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import numpy as np

from .derivatives import Evaluation

__all__ = ["TableState", "Candidates", "select"]


class TableState(NamedTuple):
    """State of the candidates in one table; [B, ...] throughout."""

    phi: np.ndarray  # [B, 4]
    w: np.ndarray  # [B, R, K]
    residual: np.ndarray  # [B, R, K]
    jacobian: np.ndarray  # derivatives of the model by θ [B, R, K, size]
    derivatives: Evaluation
    inverse: np.ndarray  # approximate inverse Hessian of F by φ [B, 4, 4]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Candidates:
    """Candidates: θ, then φ and w of every table, and the state of each minimisation. [B, ...] throughout."""

    theta: np.ndarray
    offset: np.ndarray  # discretisation error of the contact in the levels, dB [B, R, K]
    parts: tuple[TableState, ...]
    damping: np.ndarray  # of Levenberg-Marquardt
    last_decrease: np.ndarray  # decrease of F by the last step

    def __len__(self) -> int:
        return len(self.theta)

    @property
    def phi(self) -> tuple[np.ndarray, ...]:
        """φ of every table [B, 4]."""
        return tuple(part.phi for part in self.parts)

    @property
    def w(self) -> tuple[np.ndarray, ...]:
        """w of every table [B, R, K]."""
        return tuple(part.w for part in self.parts)

    @property
    def level(self) -> TableState:
        """State of the table of levels, which is the first."""
        return self.parts[0]

    def take(self, which: np.ndarray) -> Candidates:
        """Select some, in this order."""
        return jax.tree.map(lambda x: x[which], self)

    def put(self, which: np.ndarray, other: Candidates) -> Candidates:
        """Replace some by those of `other`."""

        def replaced(old: np.ndarray, new: np.ndarray) -> np.ndarray:
            out = old.copy()
            out[which] = new
            return out

        return jax.tree.map(replaced, self, other)

    def join(self, other: Candidates) -> Candidates:
        """Append those of `other`."""
        return jax.tree.map(lambda *pair: np.concatenate(pair), self, other)


def select(mask: np.ndarray, one, other):
    """`one` where `mask` [B] is true, else `other`: trees of arrays [B, ...]."""
    return jax.tree.map(lambda a, b: np.where(mask.reshape(-1, *(1,) * (np.ndim(a) - 1)), a, b), one, other)
