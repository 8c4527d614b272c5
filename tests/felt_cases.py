"""Felts for tests, and independent references: other methods to step, to solve and to compute energy."""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import model_cases as cases
import numpy as np
import scipy.integrate
import scipy.optimize
from model_cases import GEOMETRY, HAMMER, RATE, STRING

from pianofit.felt import RelaxingHammer
from pianofit.parameters import Hammer

LOSSLESS = STRING._replace(b1=0.0, b2=0.0)
ELASTIC = HAMMER._replace(mu=0.0)
STULOV = RelaxingHammer(*ELASTIC, epsilon=0.4, tau=60e-6)
HAMMERS = {
    "power": ELASTIC,
    "hunt-crossley": HAMMER,
    "stulov": STULOV,
    "stulov, faster than the step": STULOV._replace(tau=3e-6),
    "stulov, slow": STULOV._replace(epsilon=0.9, tau=1e-3),
    "both losses": STULOV._replace(mu=0.1),
}
RETURNING = Hammer(K_H=1e13, mu=0.0, p=2.5, M_H=1e-3, v_H0=2.0)  # has a recontact


def memory_of(hammer) -> tuple[float, float]:
    """ε and τ; a felt that does not relax has ε = 0."""
    return (hammer.epsilon, hammer.tau) if isinstance(hammer, RelaxingHammer) else (0.0, 1.0)


def base(u, hammer):
    """g = u²/(u + d) of a felt with a skin of thickness d, else u; 0 when apart."""
    pressed, skin = np.maximum(u, 0.0), getattr(hammer, "skin", 0.0)
    return pressed**2 / np.maximum(pressed + skin, 1e-300) if skin else pressed


def remembered(c: float, old: float, new: float, s: float) -> float:
    """c after a step s = δt/τ, over which u^p changes linearly from `old` to `new`."""
    rate = (new - old) / s
    return new - rate + (c - old + rate) * math.exp(-s)


def memories(u: np.ndarray, hammer, step: float) -> np.ndarray:
    """c [steps] of a felt with compression `u`."""
    a, c = np.maximum(u, 0.0) ** hammer.p, [0.0]
    for old, new in itertools.pairwise(a):
        c.append(remembered(c[-1], old, new, step / memory_of(hammer)[1]))
    return np.array(c)


def law(u, w, c, hammer):
    pressed = base(u, hammer) ** hammer.p
    return np.maximum(hammer.K_H * (pressed * np.maximum(1 + hammer.mu * w, 0) - memory_of(hammer)[0] * c), 0.0)


def speeds(u: np.ndarray, hammer, step: float) -> np.ndarray:
    w = [float(hammer.v_H0)]
    for change in np.diff(u):
        w.append(2 * change / step - w[-1])
    return np.array(w)


def relative(found, expected) -> float:
    found, expected = np.asarray(found), np.asarray(expected)
    return float(np.abs(found - expected).max() / np.abs(expected).max())


class Blow(NamedTuple):
    """Result of `stepped`, step by step."""

    force: np.ndarray  # N [steps]
    u: np.ndarray  # m
    hammer: np.ndarray  # y_H, v_H [steps, 2]


def stepped(modes, hammer, steps: int) -> Blow:
    """Crank-Nicolson mode by mode (design §2); each step's force by Brent's method."""
    omega2, alpha, phi, gamma = (np.asarray(x) for x in (modes.omega2, modes.alpha, modes.strike, modes.modal_gain))
    a, epsilon = float(modes.step) / 2, memory_of(hammer)[0]
    s = 2 * a / memory_of(hammer)[1]
    D = 1 + 2 * a * alpha + a**2 * omega2
    q = v = np.zeros_like(omega2)
    y, vy, F, old, c = 0.0, float(hammer.v_H0), 0.0, 0.0, 0.0
    # Change of compression and its speed per newton in this step.
    soft_w = a * float(phi @ (gamma / D)) + a / hammer.M_H
    soft_u = a * soft_w
    rows = [(F, 0.0, y, vy)]
    for _ in range(steps - 1):
        v1 = ((1 - 2 * a * alpha - a**2 * omega2) * v - 2 * a * omega2 * q + a * gamma * F) / D
        w0 = vy - a / hammer.M_H * F - float(phi @ v1)
        u0 = y + a * (2 * vy - a / hammer.M_H * F) - float(phi @ (q + a * (v + v1)))

        def excess(F1: float, u0=u0, w0=w0, c=c, old=old) -> float:
            u = u0 - soft_u * F1
            new = max(u, 0.0) ** hammer.p
            now = remembered(c, old, new, s)
            lossy = new * max(1 + hammer.mu * (w0 - soft_w * F1), 0.0)
            return F1 - max(hammer.K_H * (lossy - epsilon * now), 0.0)

        F1 = 0.0
        if excess(0.0) < 0:
            F1 = float(scipy.optimize.brentq(excess, 0.0, u0 / soft_u, xtol=1e-300, rtol=8.9e-16))  # pyright: ignore[reportArgumentType]
        new_v = v1 + a * gamma * F1 / D
        q, v = q + a * (v + new_v), new_v
        y, vy = y + a * (2 * vy - a / hammer.M_H * (F + F1)), vy - a / hammer.M_H * (F + F1)
        F, u = F1, y - float(phi @ q)
        new = max(u, 0.0) ** hammer.p
        c, old = remembered(c, old, new, s), new
        rows.append((F, u, y, vy))
    force, u, y_H, v_H = np.array(rows).T
    return Blow(force, u, np.stack([y_H, v_H], axis=1))


ORDER_MODES = 16


def motion(hammer, times: np.ndarray) -> np.ndarray:
    """Force at `times` from the equations of motion, q¨ + 2αq˙ + ω²q = γF, τċ = u^p - c, by DOP853."""
    beta, n = np.arange(1, ORDER_MODES + 1) * math.pi / GEOMETRY.length, ORDER_MODES
    omega2, alpha = STRING.c**2 * beta**2 + STRING.kappa**2 * beta**4, STRING.b1 + STRING.b2 * beta**2
    phi = np.asarray(cases.table(STRING, GEOMETRY, rate=RATE, n_modes=n).strike)
    gamma, tau = 2 * phi / GEOMETRY.mass, memory_of(hammer)[1]

    def pushed(s):
        u, w = s[-3] - phi @ s[:n], s[-2] - phi @ s[n : 2 * n]
        return float(law(u, w, s[-1], hammer)), u

    def rates(_, s):
        q, v = s[:n], s[n : 2 * n]
        F, u = pushed(s)
        own = [s[-2], -F / hammer.M_H, (max(u, 0.0) ** hammer.p - s[-1]) / tau]
        return np.concatenate([v, gamma * F - omega2 * q - 2 * alpha * v, own])

    start = np.zeros(2 * n + 3)
    start[-2] = hammer.v_H0
    size = np.concatenate([np.full(n, 1e-4 / n), np.full(n, 0.1), [1e-4, 1.0, 1e-4**hammer.p]])
    solved = scipy.integrate.solve_ivp(
        rates, (0, times[-1]), start, method="DOP853", t_eval=times, rtol=1e-12, atol=1e-12 * size
    )
    return np.array([pushed(s)[0] for s in solved.y.T])
