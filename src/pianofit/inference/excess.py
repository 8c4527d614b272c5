"""Integration over the excess σ of every table, beyond a quadratic approximation at the minimum of F.

F has its minimum at the σ with which the levels are met best, and every free parameter lowers that σ. With n levels and
k parameters that follow them, σ at the minimum is too small by √((n - k)/n): the degrees of freedom are missing. With
few levels this factor, and not the noise, would set the intervals. The marginal posterior of σ has them,

    p(σ | data) ∝ exp(-F(θ, σ)) |H(σ)|^(-1/2),      H(σ) the curvature of F by θ, the other φ and log w at this σ

because a small σ also makes the volume of the parameters small. The posterior of θ is the mean over p(σ | data) of
Gaussians with the covariances at each σ. With many levels it is Laplace's Gaussian. With few it is Student's t.
(Rue, Martino and Chopin 2009, J. R. Stat. Soc. B 71, with the mean kept at the minimum.)

The three tables are independent given θ, so their curvatures add, and the nodes of σ form a product grid.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from .curvature import TablePoint, marginalise_nuisances
from .derivatives import evaluate
from .likelihood import em_weights

# First distance of two nodes of log σ, in standard deviations of log σ if no parameter followed the levels: 1/√(2n).
# Each further one is twice as far from the minimum. The trapezoidal rule integrates a Gaussian at this spacing to 2 %.
SPACING = 2.0
# Nodes whose density is lower than the highest by this factor's logarithm have no weight.
NEGLIGIBLE = 6.0
# Maximum number of nodes on one side: at the last, 16 spacings away, σ no longer matters or is as large as its prior.
MOST = 5


class ExcessNodes(NamedTuple):
    """Nodes of log σ of one table at one minimum."""

    log_density: np.ndarray  # -F - ½ log|H| of φ and log w, and the logarithm of the quadrature's weight [nodes]
    curvature: np.ndarray  # of F by θ, with the other φ and log w integrated out [nodes, size, size]
    score: np.ndarray  # log marginal density with σ of the other tables at the minimum, over the highest [nodes]


def _node(point: TablePoint, log_sigma: float) -> tuple[float, np.ndarray]:
    """-F - ½ log|H| of φ and log w at a σ, and the curvature by θ [size, size]."""
    moved = point._replace(phi=np.array([log_sigma, *point.phi[1:]]))
    if log_sigma != point.phi[0]:  # one step of EM: the weights change little with σ
        table, *values, _ = moved
        one = evaluate(table, *(x[None] for x in values))
        moved = moved._replace(w=em_weights(table, one.by_log_w[0], moved.w))
    found = marginalise_nuisances(moved)
    return -found.nll - 0.5 * found.log_det, found.curvature


def excess_nodes(point: TablePoint, log_det: Callable[[np.ndarray], float], reach: float) -> ExcessNodes:
    """Nodes of one table, outward from the minimum until the marginal density of σ is negligible.

    Parameters
    ----------
    log_det : log|H| of the free θ from the curvature of this table [size, size].
    reach : range of log σ, in standard deviations of its prior.
    """
    mean, sd = (float(np.asarray(x)[0]) for x in point.table.prior)
    spacing = SPACING / np.sqrt(2 * float(np.asarray(point.table.detected).sum()) + 1 / sd**2)
    centre = float(point.phi[0])
    found = {centre: _node(point, centre)}
    scores = {centre: found[centre][0] - 0.5 * log_det(found[centre][1])}
    for offsets in (spacing * 2.0 ** np.arange(MOST), -spacing * 2.0 ** np.arange(MOST)):
        for at in np.clip(centre + offsets, mean - reach * sd, mean + reach * sd).tolist():
            found[at] = _node(point, at)
            scores[at] = found[at][0] - 0.5 * log_det(found[at][1])
            if scores[at] < max(scores.values()) - NEGLIGIBLE:
                break
    nodes = sorted(found)
    # The trapezoidal rule; at its ends the density is negligible, or the range ends.
    width = np.gradient(nodes) if len(nodes) > 1 else np.ones(1)
    density = np.array([found[x][0] for x in nodes]) + np.log(width)
    score = np.array([scores[x] for x in nodes])
    return ExcessNodes(density, np.array([found[x][1] for x in nodes]), score - score.max())
