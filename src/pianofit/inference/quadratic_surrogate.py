"""Quadratic surrogate of F with φ and w fixed: one quadratic of the residuals for any number of candidates.

With C at the nodes of τ and of the gains, F = -log Σ_t weight_t exp(-½ rᵀC_t⁻¹r - ...) is concave in the quadratics. It
therefore lies below ½ rᵀQr + constant, Q = Σ_t p_t C_t⁻¹, with the nodes' weights p at a residual, and touches it
there: a step that lowers the surrogate lowers F. F lies below it with any other weights too. With the weights of one
node of the gains, minimising the surrogate minimises F of that node alone. Censored partials are left out.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .batched_model import thread_pool
from .derivatives import Evaluation, dense_terms
from .likelihood import ObservationTable

__all__ = ["QuadraticSurrogate"]


class QuadraticSurrogate(NamedTuple):
    """½ rᵀQr + constant over the detected entries."""

    Q: np.ndarray  # [detected, detected]
    at: np.ndarray  # flat indices of the detected entries in [R, K]
    constant: float  # makes surrogates of several nodes of the gains comparable

    @classmethod
    def of(
        cls, table: ObservationTable, phi: np.ndarray, w: np.ndarray | None = None, residual: np.ndarray | None = None,
        gains: int | None = None,
    ):  # fmt: skip
        """Build it at φ and w, 1 if None; the nodes' weights are those at `residual` [R, K].

        Parameters
        ----------
        residual : if None, only the node of the middle τ is used, and the constant is that of a zero residual.
        gains : one node of the gains. If None, all are used, or the last without a residual.
        """
        ones = np.ones_like(table.value)
        terms = dense_terms(table, 0 * ones if residual is None else residual, phi, ones if w is None else w)
        weight = terms.weight
        if residual is None:
            weight = np.zeros_like(weight)
            weight[len(weight) // 2] = 1.0
            gains = -1 if gains is None else gains
        if gains is not None:
            selected = np.zeros_like(weight)
            selected[:, gains] = weight[:, gains] + np.finfo(float).tiny
            weight = selected / selected.sum()
        at = np.flatnonzero(np.asarray(table.detected))
        constant = float((weight * (terms.nll_per_node - table.log_weight)).sum()) if residual is None else 0.0
        return cls(np.tensordot(weight, terms.inverse, 2)[np.ix_(at, at)], at, constant)

    def whole(self, count: int) -> np.ndarray:
        """Q [count, count], 0 for entries that are not detected."""
        Q = np.zeros((count, count))
        Q[np.ix_(self.at, self.at)] = self.Q
        return Q

    def __call__(self, residual: np.ndarray, jacobian: np.ndarray) -> Evaluation:
        """Value at residuals [B, R, K], gradient and curvature by the parameters of `jacobian`."""
        count, size = len(residual), jacobian.shape[-1]
        entries = int(np.prod(residual.shape[1:]))
        r = residual.reshape(count, entries)[:, self.at]
        J = jacobian.reshape(count, entries, size)[:, self.at]
        weighted = r @ self.Q
        curvature = np.array(list(thread_pool().map(lambda own: own.T @ (self.Q @ own), J))).reshape(count, size, size)
        return Evaluation(
            0.5 * (weighted * r).sum(axis=1) + self.constant, -np.einsum("bi,bin->bn", weighted, J), curvature,
            np.zeros((count, 4)), np.zeros_like(residual),
        )  # fmt: skip
