"""What the recording fixes and what it does not: covariance, intervals and a status for every parameter.

Residuals are in units of measured noise and estimated scatter, and gain and path are fitted along, so the curvature's
inverse is the covariance with both unknown. A parameter whose standard deviation is not well below the spread it
started with has been told nothing by the recording: it is not identifiable, however good the fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from .space import NAMES, K, P, Space

__all__ = ["Run", "intervals", "neighbours", "statuses", "tangled", "to_stiffness", "whole_covariance"]

# The data must at least halve the spread that was put in, else the answer is the prior's.
TOLD = 0.5
# Where nothing was put in, a factor e^±1 is no knowledge.
LOOSE = 0.5
# Eigenvalues of the scaled curvature below this are rounding.
FLOOR = 1e-14
# Neighbours are alike if they are by so many standard deviations of what chance would give, and at most so far;
# residuals count up to so many of theirs.
CHANCE, MOST_ALIKE, OUTLYING = 2.0, 0.95, 2.5
# Of the three kinds of residuals.
LEVEL = 2
# Beats and glides bend neighbouring partials this much alike.
DOUBTED = 0.95
# Two parameters whose estimates correlate more than this are told apart poorly.
TANGLED = 0.98


class Run(NamedTuple):
    """Residuals of one kind, of one take or of several that are missed alike, and how alike they are."""

    rows: np.ndarray  # int [residuals]
    number: np.ndarray  # k [residuals]
    likeness: float  # ρ: of two that are n partials apart, ρⁿ
    take: np.ndarray | int = 0  # [residuals]
    across: float = 0.0  # τ: of two takes, beside
    doubt: np.ndarray | float = 0.0  # [residuals]: share of the standard deviation that beats or a glide may have made

    @property
    def correlation(self) -> np.ndarray:
        """Of the residuals [residuals, residuals]."""
        apart, take = np.abs(self.number[:, None] - self.number), np.broadcast_to(self.take, self.number.shape)
        doubt = np.broadcast_to(self.doubt, self.number.shape)
        rest, same = np.sqrt(1 - doubt**2), take[:, None] == take
        alike = self.likeness**apart * np.where(same, 1.0, self.across)
        return np.outer(rest, rest) * alike + np.outer(doubt, doubt) * DOUBTED**apart


def neighbours(
    standard: np.ndarray, found: np.ndarray, calibrated: bool = False, doubt: np.ndarray | None = None
) -> list[Run]:
    """How alike residuals of neighbouring partials are, for frequency, decay and level.

    What a model misses in a partial it misses in the next: a path is smooth, beats slow down from one to the other.
    Such residuals say less than as many that are independent. Of each kind one number is estimated from all takes, and
    0 is taken where chance would give as much. Nor are levels of calibrated takes independent of each other, where they
    are missed for the felt's window: no path of their own has taken that out of what they have in common.

    Parameters
    ----------
    standard : residuals over their standard deviations [residuals], those of frequency, decay and level first.
    found : bool [takes, rows]
    doubt : [3, takes, rows], share of each standard deviation that neighbours have in common for certain.
    """
    cells, runs = found.size, []
    doubt = np.zeros((3, *found.shape)) if doubt is None else doubt
    kinds = np.clip(standard[: 3 * cells], -OUTLYING, OUTLYING).reshape(3, *found.shape)
    for kind, values in enumerate(kinds):
        beside = found[:, 1:] & found[:, :-1]
        pairs = (values[:, 1:] * values[:, :-1])[beside].sum()
        power = 0.5 * ((values[:, 1:] ** 2 + values[:, :-1] ** 2)[beside]).sum()
        likeness = pairs / power if power > 0 else 0.0
        chance = CHANCE / np.sqrt(max(beside.sum(axis=1).max(), 1))
        likeness = float(min(likeness, MOST_ALIKE)) if likeness > chance else 0.0
        across = _across(values, found) if kind == LEVEL and calibrated else 0.0
        # A glide makes all takes tenser; frequencies and decays of takes are weighed as one take's.
        together = kind == LEVEL and (across > 0 or bool(doubt[kind].any()))
        for some in [range(len(found))] if together else [[take] for take in range(len(found))]:
            there = found & np.isin(np.arange(len(found)), some)[:, None]
            take, k = np.nonzero(there)
            rows = kind * cells + take * found.shape[1] + k
            runs.append(Run(rows, k, likeness, take, across, doubt[kind][there]))
    return runs


def _across(values: np.ndarray, found: np.ndarray) -> float:
    """How alike residuals [takes, rows] of one partial in several takes are; 0 where chance would give as much."""
    count = found.sum(axis=0)
    total, own = np.where(found, values, 0.0).sum(axis=0), np.where(found, values**2, 0.0).sum(axis=0)
    several = count > 1
    # Σ over pairs of takes a < b of r_a r_b, and of (r_a² + r_b²)/2.
    pairs, power = 0.5 * (total**2 - own)[several].sum(), 0.5 * ((count - 1) * own)[several].sum()
    likeness = pairs / power if power > 0 else 0.0
    return float(min(likeness, MOST_ALIKE)) if likeness > CHANCE / np.sqrt(max(several.sum(), 1)) else 0.0


def whole_covariance(
    jacobian: np.ndarray, variance: np.ndarray, space: Space, pressed: np.ndarray, runs: Sequence[Run] = ()
) -> np.ndarray:
    """Covariance of a search point [size, size]: zero for what is fixed; what is pressed against a bound is held there.

    A sandwich: the curvature's inverse on both sides of what the residuals' `variance` [residuals] and the likeness of
    neighbours among them make of it, so that rows which weigh more than their noise warrants do not pretend to know
    more.
    """
    active = np.flatnonzero(space.free & ~pressed)
    j = jacobian[:, active]
    scale = np.sqrt((j**2).sum(axis=0)) + 1e-300
    # An eigenvalue at the rounding floor is a direction without any data: its variance is huge, not infinite.
    value, vector = np.linalg.eigh((j / scale).T @ (j / scale))
    known = value > FLOOR
    inverse = (vector[:, known] / value[known]) @ vector[:, known].T / np.outer(scale, scale)
    scores = j * np.sqrt(variance)[:, None]
    power = scores.T @ scores
    for run in runs:
        power += scores[run.rows].T @ (run.correlation - np.eye(len(run.number))) @ scores[run.rows]
    inner = inverse @ power @ inverse
    inner += vector[:, ~known] @ vector[:, ~known].T / FLOOR / np.outer(scale, scale)
    full = np.zeros((len(space.free), len(space.free)))
    full[np.ix_(active, active)] = inner
    return full


def to_stiffness(cov: np.ndarray, values: np.ndarray, log_u: float) -> np.ndarray:
    """From the searched force at the reference compression to log K_H = log F_ref - p log u_ref."""
    change = np.eye(len(NAMES))
    change[K, P] = -values[P] * log_u
    return change @ cov @ change.T


def intervals(cov: np.ndarray, values: np.ndarray, freedom: np.ndarray | int) -> dict[str, tuple[float, float] | None]:
    """95 % intervals by name, symmetric in log(value); None for what was not fitted.

    `freedom` are the degrees of freedom that are left, of all or of each [names].
    """
    reach = stdtrit(np.maximum(freedom, 1), 0.975) * np.sqrt(np.diag(cov))
    return {
        name: (float(v * np.exp(-min(r, 700.0))), float(v * np.exp(min(r, 700.0)))) if r > 0 else None
        for name, v, r in zip(NAMES, values, reach, strict=True)
    }


def statuses(cov: np.ndarray, space: Space, at_bound: np.ndarray, fixed: dict[str, str]) -> dict[str, str]:
    """`free`, `fixed`, `assumed`, `at-bound` or `not-identifiable`, by name."""
    sd, spread = np.sqrt(np.diag(cov)), space.spread[: len(NAMES)]
    vague = sd > np.where(np.isfinite(spread), np.minimum(TOLD * spread, LOOSE), LOOSE)
    result = {}
    for i, name in enumerate(NAMES):
        if not space.free[i]:
            result[name] = fixed.get(name, "fixed")
        elif at_bound[i]:
            result[name] = "at-bound"
        else:
            result[name] = "not-identifiable" if vague[i] else "free"
    return result


def tangled(cov: np.ndarray) -> list[tuple[str, str, float]]:
    """Pairs of parameters that the recording does not tell apart, with their correlation."""
    sd = np.sqrt(np.diag(cov))
    return [
        (NAMES[j], NAMES[i], float(r))
        for i in range(len(NAMES))
        for j in range(i)
        if sd[i] > 0 and sd[j] > 0 and abs(r := cov[i, j] / (sd[i] * sd[j])) > TANGLED
    ]
