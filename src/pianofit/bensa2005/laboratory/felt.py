"""Felt laws with time steps that never create energy.

`hunt-crossley`, the paper's:   F = K u^p (1 + μ u̇), never below 0
`memory`, Stulov's:             F = K (a - ε c), never below 0,   ċ = (a - c)/τ,   a = û^p

With `c` written as an integral this is K [u^p - (ε/τ) ∫ u^p exp(-(t - s)/τ) ds]. û is the compression of the felt
itself. It equals the compression u of hammer and string during contact. When the force has fallen to 0, they separate
and the free felt relaxes at a = ε c. It keeps a dent, and the next contact begins at the depth of the dent. The stored
energy

    S = K [û^(p+1)/(p+1) - ε c û + ε p/(p+1) c^((p+1)/p)],     dS/dt = F dû/dt + K ε (c^(1/p) - û)(a - c)/τ,

rises only by the work of F, since the last term is never positive. Within a step, `a` is linear in time, so c(t) has a
closed form. The step uses the constant force that does the same work as F along that path, ∫F dû/Δu. This balances the
energy at any step size, because hammer and string move exactly under a constant force. With ε = μ = 0 both are the
elastic power law.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

__all__ = ["FELTS", "Felt", "FeltState"]

FELTS = ("hunt-crossley", "memory", "power")
# Gauss-Legendre quadrature on (0, 1): nodes and weights.
POINTS = tuple(((x + 1) / 2, w / 2) for x, w in np.transpose(np.polynomial.legendre.leggauss(4)).tolist())


class FeltState(NamedTuple):
    """State of the felt."""

    gap: float = 0.0  # u = y_H - y_s, m; no contact below `dent`
    dent: float = 0.0  # û, m
    memory: float = 0.0  # c, m^p


class Felt(NamedTuple):
    """F = K [u^p (1 + μ u̇) - ε c]; one of μ and ε is 0."""

    K: float  # N/m^p, for a sudden compression; K (1 - ε) for a slow one
    p: float
    mu: float = 0.0  # s/m
    eps: float = 0.0
    tau: float = 1.0  # s

    def advance(self, state: FeltState, gap: float, step: float) -> tuple[float, FeltState]:
        """Return the force, N, of a step to the next `gap`, m, with duration `step`, s, and the state after it."""
        ratio, a0, c0 = step / self.tau, state.dent**self.p, state.memory
        lag = -math.expm1(-ratio) / ratio
        # c at the end of the step is base + gain · a1. A free felt ends at a1 = ε c1.
        base, gain = a0 * lag + (c0 - a0) * math.exp(-ratio), 1 - lag
        a1 = self.eps * base / (1 - self.eps * gain)
        touched = gap > 0 and gap**self.p > a1
        if not touched and (state.gap < state.dent or state.dent == 0):
            c1 = c0 * math.exp(-(1 - self.eps) * ratio)
            return 0.0, FeltState(gap, (self.eps * c1) ** (1 / self.p), c1)
        if touched:
            a1, dent = gap**self.p, gap
        else:
            dent = a1 ** (1 / self.p)
        mean = self._mean_force(state, dent, a1, ratio)
        # Part of the step with contact. Above 1, hammer and string would gain the energy that the felt dissipates.
        change = gap - state.gap
        part = 1.0 if touched and state.gap == state.dent else min(max((dent - state.dent) / change, 0.0), 1.0)
        loss = max(1 + self.mu * change / step, 0.0)
        return max(mean * part * loss, 0.0), FeltState(gap, dent, base + gain * a1)

    def _mean_force(self, state: FeltState, dent: float, a1: float, ratio: float) -> float:
        """∫ K (u^p - ε c) du/Δu from one dent to the next, by Gauss-Legendre quadrature."""
        a0, total = state.dent**self.p, 0.0
        rise = a1 - a0
        for node, weight in POINTS:
            a = (state.dent + node * (dent - state.dent)) ** self.p
            if self.eps:
                s = (a - a0) / rise if abs(rise) > 1e-9 * a else node  # relative time at which the path reaches a
                c = a + rise / ratio * math.expm1(-ratio * s) + (state.memory - a0) * math.exp(-ratio * s)
                a -= self.eps * c
            total += weight * a
        return self.K * total
