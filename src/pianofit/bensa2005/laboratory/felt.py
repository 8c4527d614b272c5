"""Felts, stepped so that none ever gives back more than it was given.

`Hunt-Crossley`, the paper's:   F = K u^p (1 + μ u̇), never below 0
`memory`, Stulov's:             F = K (a - ε c), never below 0,   ċ = (a - c)/τ,   a = û^p

With `c` written as an integral this is K [u^p - (ε/τ) ∫ u^p exp(-(t - s)/τ) ds]. û is the felt's own compression: that
of hammer and string, u, while they touch. When the force has fallen to 0 they part and the felt relaxes by itself at
a = ε c: it has kept a dent, and is touched again where that then ends. What it has stored,

    S = K [û^(p+1)/(p+1) - ε c û + ε p/(p+1) c^((p+1)/p)],     dS/dt = F dû/dt + K ε (c^(1/p) - û)(a - c)/τ,

falls but for what F puts in, since the last term is never positive. A step takes `a` as piecewise linear; then c(t) is
a formula, and the constant force that does the same work as F along that path, ∫F dû/Δu, keeps the balance of energy
at any step: hammer and string move exactly under a constant force. With ε = μ = 0 both are the elastic power law.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

__all__ = ["FELTS", "Felt", "FeltState"]

FELTS = ("hunt-crossley", "memory", "power")
# Gauss-Legendre on (0, 1): node and weight.
POINTS = tuple(((x + 1) / 2, w / 2) for x, w in np.transpose(np.polynomial.legendre.leggauss(4)).tolist())


class FeltState(NamedTuple):
    """Where the felt is."""

    gap: float = 0.0  # u = y_H - y_s, m; below `dent` hammer and string are apart
    dent: float = 0.0  # û, m
    memory: float = 0.0  # c, m^p


class Felt(NamedTuple):
    """F = K [u^p (1 + μ u̇) - ε c]; one of μ and ε is 0."""

    K: float  # N/m^p, of a sudden compression; a slow one feels K (1 - ε)
    p: float
    mu: float = 0.0  # s/m
    eps: float = 0.0
    tau: float = 1.0  # s

    def advance(self, state: FeltState, gap: float, step: float) -> tuple[float, FeltState]:
        """The force of a step to the next `gap`, which takes `step`, s: N, and the state after it."""
        ratio, a0, c0 = step / self.tau, state.dent**self.p, state.memory
        lag = -math.expm1(-ratio) / ratio
        # c at the end is base + gain · a1; a felt left alone ends at a1 = ε c1.
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
        # The part of the way on which they touched; at most 1, or hammer and string would be given what the felt lost.
        way = gap - state.gap
        part = 1.0 if touched and state.gap == state.dent else min(max((dent - state.dent) / way, 0.0), 1.0)
        speed = max(1 + self.mu * way / step, 0.0)
        return max(mean * part * speed, 0.0), FeltState(gap, dent, base + gain * a1)

    def _mean_force(self, state: FeltState, dent: float, a1: float, ratio: float) -> float:
        """∫ K (u^p - ε c) du/Δu from one dent to the next, by Gauss-Legendre quadrature."""
        a0, total = state.dent**self.p, 0.0
        rise = a1 - a0
        for node, weight in POINTS:
            a = (state.dent + node * (dent - state.dent)) ** self.p
            if self.eps:
                s = (a - a0) / rise if abs(rise) > 1e-9 * a else node  # the time at which the path has come to a
                c = a + rise / ratio * math.expm1(-ratio * s) + (state.memory - a0) * math.exp(-ratio * s)
                a -= self.eps * c
            total += weight * a
        return self.K * total
