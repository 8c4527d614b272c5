"""One stroke: contact of hammer and body step by step, and free decay afterwards.

The felt's force is constant over a step. The motion of body and hammer under a constant force is exact,

    z ← e^{λh} z + β (e^{λh} - 1)/λ F        y_H ← y_H + h v_H - h²/(2 M_H) F        v_H ← v_H - h F/M_H

and the gap at the end of the step is `gap = e - C F`. One equation remains, gap + C F(gap) = e, with rising F. The only
error is that of the force, of order 2 in h. Energy never rises: hammer and body lose F Δgap, and the felt stores at
most that (see `felt`).
"""

from __future__ import annotations

from typing import NamedTuple, cast

import numpy as np
from scipy.optimize import brentq

from ...errors import FitError
from .body import Body
from .felt import Felt, FeltState

__all__ = ["Stroke", "ring", "strike"]

EPSILON = 4 * np.finfo(float).eps
MOST_CONTACT = 0.05  # s
LOOK = 32  # steps between two tests for the end of the contact
BLOCK = 256  # samples per row of the table of powers


class Stroke(NamedTuple):
    """States from the first contact on, at t = 0, h, 2h, ...; `force` is that of the following step."""

    step: float  # h, s
    states: np.ndarray  # z, complex [steps, rows of the body]
    force: np.ndarray  # N [steps]; the last is 0
    gap: np.ndarray  # u, m [steps]
    dent: np.ndarray  # û, m [steps]
    memory: np.ndarray  # c, m^p [steps]
    hammer: np.ndarray  # y_H, m, and v_H, m/s [steps, 2]


def strike(body: Body, felt: Felt, mass: float, velocity: float, rate: float) -> Stroke:
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
    return Stroke(h, np.array([*states, z]), force, gap, dent, memory, columns[:, 4:])


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


def ring(body: Body, stroke: Stroke, rate: float, samples: int) -> np.ndarray:
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
