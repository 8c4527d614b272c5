"""One stroke: the hammer on the body, step by step until it has left for good, and the ringing after that.

Over a step the felt's force is constant. Under it the body's exponentials and the hammer's parabola are exact,

    z ← e^{λh} z + β (e^{λh} - 1)/λ F        y_H ← y_H + h v_H - h²/(2 M_H) F        v_H ← v_H - h F/M_H

and the gap at the end of the step is `gap = e - C F`, so that one equation is left, gap + C F(gap) = e, with F rising.
The only error is the force's, of order 2 in h. Energy never rises: the force takes F Δgap from hammer and body, and the
felt stores no more of it (see `felt`).
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
LOOK = 32  # steps between two looks at whether the hammer has gone for good
BLOCK = 256  # samples that one row of a table of powers goes


class Stroke(NamedTuple):
    """What happened from the first touch on, at t = 0, h, 2h, ...; `force` is that of the step that follows."""

    step: float  # h, s
    states: np.ndarray  # z, complex [steps, rows of the body]
    force: np.ndarray  # N [steps]; the last is 0
    gap: np.ndarray  # u, m [steps]
    dent: np.ndarray  # û, m [steps]
    memory: np.ndarray  # c, m^p [steps]
    hammer: np.ndarray  # y_H, m, and v_H, m/s [steps, 2]


def strike(body: Body, felt: Felt, mass: float, velocity: float, rate: float) -> Stroke:
    """Let a hammer of `mass`, kg, meet the resting body with `velocity`, m/s; `rate` steps a second.

    Raises
    ------
    FitError
        If the hammer is still about after 50 ms.
    """
    h = 1 / rate
    turn = np.exp(body.poles * h)
    push = body.drive * np.expm1(body.poles * h) / body.poles
    row = body.under @ body.vectors
    compliance = float(np.real(row @ push)) + h**2 / (2 * mass)
    z, state, y, v = np.zeros_like(body.poles), FeltState(), 0.0, velocity
    states, trace = [], []
    while not _gone(body, z, state, y, v, len(states)):
        if len(states) > MOST_CONTACT * rate:
            raise FitError(f"velocity={velocity:g} m/s: the hammer is still at the string after {MOST_CONTACT:g} s")
        moved = turn * z
        force, after = _meet(felt, h, state, y + h * v - float(np.real(row @ moved)), compliance)
        states.append(z)
        trace.append((force, *state, y, v))
        z, state = moved + push * force, after
        y, v = y + h * v - h**2 / (2 * mass) * force, v - h / mass * force
    columns = np.array([*trace, (0.0, *state, y, v)])
    force, gap, dent, memory = columns[:, :4].T
    return Stroke(h, np.array([*states, z]), force, gap, dent, memory, columns[:, 4:])


def _meet(felt: Felt, h: float, state: FeltState, free: float, compliance: float) -> tuple[float, FeltState]:
    """Solve gap + C F(gap) = free, where F rises from 0."""
    most, apart = felt.advance(state, free, h)
    if most == 0.0:
        return most, apart

    def excess(gap: float) -> float:
        return gap + compliance * felt.advance(state, gap, h)[0] - free

    least = free - compliance * most
    if excess(least) < 0:  # else a touch too faint to move the last digit
        least = cast(float, brentq(excess, least, free, xtol=1e-22, rtol=EPSILON))
    return felt.advance(state, least, h)


def _gone(body: Body, z: np.ndarray, state: FeltState, y: float, v: float, steps: int) -> bool:
    """Whether the hammer moves away and is out of reach of a string with the energy there is (Cauchy-Schwarz)."""
    if steps % LOOK or state.gap >= state.dent or v > 0 or y >= 0:
        return False
    reach = np.linalg.norm(np.real(body.vectors @ z)) * np.linalg.norm(body.under)
    return bool(y + reach < 0)


def ring(body: Body, stroke: Stroke, rate: float, samples: int) -> np.ndarray:
    """The pickup's velocity, m/s [samples] at `rate`, a whole fraction of the stroke's.

    Exponentials above half of `rate` are left out, as an ideal filter before the sampling would.
    """
    heard = np.imag(body.poles) < np.pi * rate
    row, poles = (body.pickup @ body.vectors)[heard], body.poles[heard] / rate
    every = round(1 / (stroke.step * rate))
    head = np.real(stroke.states[::every][:samples][:, heard] @ row)
    last = len(stroke.force) - 1  # from here on nothing pushes
    amplitude = stroke.states[-1][heard] * row * np.exp(poles * (len(head) - last / every))
    # With n = 256 i + j the sum of exponentials is one product of two short tables of powers.
    starts = np.exp(np.outer(np.arange(0, samples - len(head), BLOCK), poles)) * amplitude
    tail = np.real(starts @ np.exp(np.outer(poles, np.arange(BLOCK)))).ravel()
    return np.concatenate([head, tail])[:samples]
