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

__all__ = ["FELTS", "Felt", "FeltState", "Stepper"]

FELTS = ("hunt-crossley", "memory", "power")
# Gauss-Legendre on (0, 1): node and weight.
POINTS = tuple(((x + 1) / 2, w / 2) for x, w in np.transpose(np.polynomial.legendre.leggauss(4)).tolist())


class Felt(NamedTuple):
    """F = K [u^p (1 + μ u̇) - ε c]; one of μ and ε is 0."""

    K: float  # N/m^p, of a sudden compression; a slow one feels K (1 - ε)
    p: float
    mu: float = 0.0  # s/m
    eps: float = 0.0
    tau: float = 1.0  # s


class FeltState(NamedTuple):
    """Where the felt is."""

    gap: float = 0.0  # u = y_H - y_s, m; below `dent` hammer and string are apart
    dent: float = 0.0  # û, m
    memory: float = 0.0  # c, m^p


class Stepper:
    """A felt with a time step, s: `advance` goes from a state to the next `gap`."""

    def __init__(self, felt: Felt, step: float):
        self.felt, self.step, self.ratio = felt, step, step / felt.tau
        self.kept = math.exp(-self.ratio)  # of the memory, over a step
        self.lag = -math.expm1(-self.ratio) / self.ratio
        self.relaxed = math.exp(-(1 - felt.eps) * self.ratio)

    def advance(self, state: FeltState, gap: float) -> tuple[float, FeltState]:
        """The force of the step, N, and the state after it."""
        felt = self.felt
        a0, c0 = state.dent**felt.p, state.memory
        # c at the end is base + gain · a1; a felt left alone ends at a1 = ε c1.
        base, gain = a0 * self.lag + (c0 - a0) * self.kept, 1 - self.lag
        a1 = felt.eps * base / (1 - felt.eps * gain)
        touched = gap > 0 and gap**felt.p > a1
        if not touched and (state.gap < state.dent or state.dent == 0):
            c1 = c0 * self.relaxed
            return 0.0, FeltState(gap, (felt.eps * c1) ** (1 / felt.p), c1)
        if touched:
            a1, dent = gap**felt.p, gap
        else:
            dent = a1 ** (1 / felt.p)
        mean = self._mean_force(state.dent, dent, a0, a1, c0)
        # The part of the way on which they touched; at most 1, or hammer and string would be given what the felt lost.
        way = gap - state.gap
        part = 1.0 if touched and state.gap == state.dent else min(max((dent - state.dent) / way, 0.0), 1.0)
        speed = max(1 + felt.mu * way / self.step, 0.0)
        return max(mean * part * speed, 0.0), FeltState(gap, dent, base + gain * a1)

    def _mean_force(self, u0: float, u1: float, a0: float, a1: float, c0: float) -> float:
        """∫ K (u^p - ε c) du / (u1 - u0), by Gauss-Legendre quadrature."""
        felt, total, rise = self.felt, 0.0, a1 - a0
        for node, weight in POINTS:
            a = (u0 + node * (u1 - u0)) ** felt.p
            if felt.eps:
                s = (a - a0) / rise if abs(rise) > 1e-9 * a else node  # the time at which the path has come to a
                c = a + rise / self.ratio * math.expm1(-self.ratio * s) + (c0 - a0) * math.exp(-self.ratio * s)
                a -= felt.eps * c
            total += weight * a
        return felt.K * total
