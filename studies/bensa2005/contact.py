"""One stroke: the felt, its contact with the body step by step, and free decay afterwards.

**Felt laws** with time steps that never create energy:

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

**Contact.** The felt's force is constant over a step. The motion of body and hammer under a constant force is exact,

    z ← e^{λh} z + β (e^{λh} - 1)/λ F        y_H ← y_H + h v_H - h²/(2 M_H) F        v_H ← v_H - h F/M_H

and the gap at the end of the step is `gap = e - C F`. One equation remains, gap + C F(gap) = e, with rising F. The only
error is that of the force, of order 2 in h. Energy never rises: hammer and body lose F Δgap, and the felt stores at
most that.
"""

from __future__ import annotations

import math
from typing import NamedTuple, cast

import numpy as np
from scipy.optimize import brentq

from pianofit.errors import FitError

from .body import Body

__all__ = ["FELTS", "Felt", "FeltState", "Contact", "ring", "strike"]

FELTS = ("hunt-crossley", "memory", "power")
# Gauss-Legendre quadrature on (0, 1): nodes and weights.
POINTS = tuple(((x + 1) / 2, w / 2) for x, w in np.transpose(np.polynomial.legendre.leggauss(4)).tolist())
EPSILON = 4 * np.finfo(float).eps
MOST_CONTACT = 0.05  # s
LOOK = 32  # steps between two tests for the end of the contact
BLOCK = 256  # samples per row of the table of powers


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


class Contact(NamedTuple):
    """States from the first contact on, at t = 0, h, 2h, ...; `force` is that of the following step."""

    step: float  # h, s
    states: np.ndarray  # z, complex [steps, rows of the body]
    force: np.ndarray  # N [steps]; the last is 0
    gap: np.ndarray  # u, m [steps]
    dent: np.ndarray  # û, m [steps]
    memory: np.ndarray  # c, m^p [steps]
    hammer: np.ndarray  # y_H, m, and v_H, m/s [steps, 2]


def strike(body: Body, felt: Felt, mass: float, velocity: float, rate: float) -> Contact:
    """Compute the contact of a hammer of `mass`, kg, and `velocity`, m/s, with the body at rest; `rate` steps a second.

    Raises
    ------
    FitError
        If the contact has not ended after 50 ms.
    """
    h = 1 / rate
    decay = np.exp(body.poles * h)
    push = body.drive * np.expm1(body.poles * h) / body.poles
    row = body.under @ body.vectors
    compliance = float(np.real(row @ push)) + h**2 / (2 * mass)
    z, state, y, v = np.zeros_like(body.poles), FeltState(), 0.0, velocity
    states, trace = [], []
    while not _contact_ended(body, z, state, y, v, len(states)):
        if len(states) > MOST_CONTACT * rate:
            raise FitError(f"velocity={velocity:g} m/s: the contact has not ended after {MOST_CONTACT:g} s")
        moved = decay * z
        force, after = _solve_contact(felt, h, state, y + h * v - float(np.real(row @ moved)), compliance)
        states.append(z)
        trace.append((force, *state, y, v))
        z, state = moved + push * force, after
        y, v = y + h * v - h**2 / (2 * mass) * force, v - h / mass * force
    columns = np.array([*trace, (0.0, *state, y, v)])
    force, gap, dent, memory = columns[:, :4].T
    return Contact(h, np.array([*states, z]), force, gap, dent, memory, columns[:, 4:])


def _solve_contact(felt: Felt, h: float, state: FeltState, free: float, compliance: float) -> tuple[float, FeltState]:
    """Solve gap + C F(gap) = free, with F rising from 0."""
    most, apart = felt.advance(state, free, h)
    if most == 0.0:
        return most, apart

    def excess(gap: float) -> float:
        return gap + compliance * felt.advance(state, gap, h)[0] - free

    least = free - compliance * most
    if excess(least) < 0:  # otherwise the force is below the rounding
        least = cast(float, brentq(excess, least, free, xtol=1e-22, rtol=EPSILON))
    return felt.advance(state, least, h)


def _contact_ended(body: Body, z: np.ndarray, state: FeltState, y: float, v: float, steps: int) -> bool:
    """Return True if the hammer moves away, out of reach of a string with the present energy (Cauchy-Schwarz)."""
    if steps % LOOK or state.gap >= state.dent or v > 0 or y >= 0:
        return False
    reach = np.linalg.norm(np.real(body.vectors @ z)) * np.linalg.norm(body.under)
    return bool(y + reach < 0)


def ring(body: Body, stroke: Contact, rate: float, samples: int) -> np.ndarray:
    """Return the velocity at the pickup, m/s [samples], at `rate`, an integer fraction of the rate of the stroke.

    Exponentials above half of `rate` are left out, as by an ideal anti-aliasing filter.
    """
    below = np.imag(body.poles) < np.pi * rate
    row, poles = (body.pickup @ body.vectors)[below], body.poles[below] / rate
    stride = round(1 / (stroke.step * rate))
    head = np.real(stroke.states[::stride][:samples][:, below] @ row)
    last = len(stroke.force) - 1  # end of the contact
    amplitude = stroke.states[-1][below] * row * np.exp(poles * (len(head) - last / stride))
    # With n = 256 i + j the sum of exponentials is one product of two short tables of powers.
    starts = np.exp(np.outer(np.arange(0, samples - len(head), BLOCK), poles)) * amplitude
    tail = np.real(starts @ np.exp(np.outer(poles, np.arange(BLOCK)))).ravel()
    return np.concatenate([head, tail])[:samples]
