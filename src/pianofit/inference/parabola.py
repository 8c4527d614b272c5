"""F of residuals while φ and w are held: one parabola for any number of candidates.

With C at the nodes of τ and of the gains, F = -log Σ_t share_t exp(-½ rᵀC_t⁻¹r - ...) is concave in the parabolas, so
it lies below ½ rᵀQr + constant, Q = Σ_t p_t C_t⁻¹ with the nodes' weights p at a residual, and touches it there: what
lowers the parabola lowers F. Partials that are absent are not in it.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..model.cache import kept
from .lanes import pool
from .likelihood import Report, Table, factored, responsibilities

__all__ = ["Parabola"]


@kept
def precision_matrix(table: Table, phi, w, residual, _):
    """Q of what is found, over recordings and partials [RK, RK], with the nodes' weights at `residual` [R, K]."""
    weight = responsibilities(table, residual, phi, w)
    return (_averaged(table, phi, w, weight),)


@kept
def middle_matrix(table: Table, phi, w, _):
    """Q at the node of the middle τ and of gains apart: before anything is known of a residual."""
    nodes = len(table.share)
    return (_averaged(table, phi, w, jnp.zeros(nodes).at[nodes // 2].set(1.0)),)


def _averaged(table: Table, phi, w, weight):
    pieces = factored(table, phi, w)
    _, groups, size, _ = pieces.root.shape
    recordings = table.value.shape[0]
    d = pieces.precision.ravel()
    flat = table.columns.reshape(-1, recordings * size)

    def add(total, node):
        root, lower, scale, share = node
        loadings = jnp.einsum("rg,gkl->glrk", table.group, root).reshape(groups * size, recordings * size)
        b = jnp.concatenate([loadings, scale[:, None] * flat])
        solved = jax.scipy.linalg.solve_triangular(lower, b * d, lower=True)
        return total + share * (jnp.diag(d) - solved.T @ solved), None

    start = jnp.zeros((recordings * size, recordings * size))
    return jax.lax.scan(add, start, (pieces.root, pieces.cholesky, table.scale, weight))[0]


class Parabola(NamedTuple):
    """½ rᵀQr over what is found."""

    Q: np.ndarray  # [found, found]
    at: np.ndarray  # where what is found stands in [R, K], flat

    @classmethod
    def of(cls, table: Table, phi: np.ndarray, w: np.ndarray | None = None, residual: np.ndarray | None = None):
        """At φ and w, 1 if None; the nodes' weights at `residual` [R, K], if there is one."""
        w = np.ones_like(table.value) if w is None else w
        program = (middle_matrix, ()) if residual is None else (precision_matrix, (residual,))
        (Q,) = program[0](table, phi, w, *program[1], None)
        at = np.flatnonzero(np.asarray(table.found))
        return cls(np.asarray(Q)[np.ix_(at, at)], at)

    def whole(self, count: int) -> np.ndarray:
        """Q [count, count], 0 where nothing was found."""
        Q = np.zeros((count, count))
        Q[np.ix_(self.at, self.at)] = self.Q
        return Q

    def __call__(self, residual: np.ndarray, jacobian: np.ndarray) -> Report:
        """The parabola at residuals [B, R, K], its gradient and curvature by what moves them by `jacobian`."""
        count, size = len(residual), jacobian.shape[-1]
        r = residual.reshape(count, -1)[:, self.at]
        J = jacobian.reshape(count, -1, size)[:, self.at]
        push = r @ self.Q
        curvature = np.stack(list(pool().map(lambda own: own.T @ (self.Q @ own), J)))
        return Report(
            0.5 * (push * r).sum(axis=1), -np.einsum("bi,bin->bn", push, J), curvature,
            np.zeros((count, 4)), np.zeros_like(residual),
        )  # fmt: skip
