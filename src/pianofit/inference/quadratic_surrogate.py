"""F of residuals while φ and w are held: one parabola for any number of candidates.

With C at the nodes of τ and of the gains, F = -log Σ_t share_t exp(-½ rᵀC_t⁻¹r - ...) is concave in the parabolas, so
it lies below ½ rᵀQr + constant, Q = Σ_t p_t C_t⁻¹ with the nodes' weights p at a residual, and touches it there: what
lowers the parabola lowers F. With any other weights it lies below as well: with those of one node of the gains the
parabola finds what that node alone would. Partials that are absent are not in it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .batched_model import thread_pool
from .derivatives import Evaluation, dense_terms
from .likelihood import ObservationTable

__all__ = ["QuadraticSurrogate"]


class QuadraticSurrogate(NamedTuple):
    """½ rᵀQr + constant over what is found."""

    Q: np.ndarray  # [found, found]
    at: np.ndarray  # where what is found stands in [R, K], flat
    constant: float  # by which parabolas of several nodes of the gains can be compared

    @classmethod
    def of(
        cls, table: ObservationTable, phi: np.ndarray, w: np.ndarray | None = None, residual: np.ndarray | None = None,
        gains: int | None = None,
    ):  # fmt: skip
        """At φ and w, 1 if None; the nodes' weights are those at `residual` [R, K].

        Parameters
        ----------
        residual : before one is known all is at the node of the middle τ, and the constant is as if none were left.
        gains : one node of the gains; all of them if None, or the last where no residual is known.
        """
        one = np.ones_like(table.value)
        o = dense_terms(table, 0 * one if residual is None else residual, phi, one if w is None else w)
        weight = o.weight
        if residual is None:
            weight = np.zeros_like(weight)
            weight[len(weight) // 2] = 1.0
            gains = -1 if gains is None else gains
        if gains is not None:
            only = np.zeros_like(weight)
            only[:, gains] = weight[:, gains] + np.finfo(float).tiny
            weight = only / only.sum()
        at = np.flatnonzero(np.asarray(table.detected))
        constant = float((weight * (o.each - table.log_weight)).sum()) if residual is None else 0.0
        return cls(np.tensordot(weight, o.inverse, 2)[np.ix_(at, at)], at, constant)

    def whole(self, count: int) -> np.ndarray:
        """Q [count, count], 0 where nothing was found."""
        Q = np.zeros((count, count))
        Q[np.ix_(self.at, self.at)] = self.Q
        return Q

    def __call__(self, residual: np.ndarray, jacobian: np.ndarray) -> Evaluation:
        """The parabola at residuals [B, R, K], its gradient and curvature by what moves them by `jacobian`."""
        count, size = len(residual), jacobian.shape[-1]
        entries = int(np.prod(residual.shape[1:]))
        r = residual.reshape(count, entries)[:, self.at]
        J = jacobian.reshape(count, entries, size)[:, self.at]
        push = r @ self.Q
        curvature = np.array(list(thread_pool().map(lambda own: own.T @ (self.Q @ own), J))).reshape(count, size, size)
        return Evaluation(
            0.5 * (push * r).sum(axis=1) + self.constant, -np.einsum("bi,bin->bn", push, J), curvature,
            np.zeros((count, 4)), np.zeros_like(residual),
        )  # fmt: skip
