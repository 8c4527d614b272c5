"""Shared by the tests of the model: cases, compiled functions, and slow references written from the equations.

The references are plain NumPy: the paper's scheme with its matrices on its grid (eq. 16 and 17, one dense Newton solve
per step), the same scheme mode by mode, and the modal equations of motion under a Runge-Kutta solver of order 8.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.integrate
import scipy.optimize

from pianofit import model
from pianofit.model.contact import impulse_amplitude
from pianofit.model.differentiable_sums import z_transform
from pianofit.model.free_motion import free_motion
from pianofit.model.free_response import _log_growth
from pianofit.parameters import Geometry, Hammer, String

STRING = String(c=304.1, kappa=1.737, b1=0.568, b2=2e-4)
HAMMER = Hammer(K_H=1.09949e10, mu=0.1998, p=2.56, M_H=5.687e-3, v_H0=0.8)
GEOMETRY = Geometry(length=1.0, mass=0.00618, strike_position=0.12, width=0.02, pickup=0.3)
RATE = 88_200.0

table = jax.jit(model.mode_table, static_argnames=("n_modes", "quantity", "kind"))
strike = jax.jit(model.strike, static_argnames=("steps",))
ringing = jax.jit(model.modal_amplitudes)
release = jax.jit(free_motion)


@jax.jit
def string_energy(modes, drive):
    """Energy of every mode after the pulse, J, extrapolated to t = 0."""
    amplitude = impulse_amplitude(modes) * z_transform(drive, _log_growth(modes, len(drive)))
    at_node = modes.modal_gain == 0
    mass = jnp.where(at_node, 0.0, modes.strike / jnp.where(at_node, 1.0, modes.modal_gain))
    return 0.5 * mass * modes.omega2 * jnp.abs(amplitude) ** 2


def hit(string, hammer, geometry, rate, *, n_modes=64, steps=512, quantity="velocity"):
    """Table and pulse, compiled separately: the program of a strike serves every table of its size."""
    modes = table(string, geometry, rate=rate, n_modes=n_modes, quantity=quantity)
    return modes, strike(modes, hammer, steps=steps)


def felt(u: float, du: float, hammer: Hammer) -> float:
    """Paper eq. 8 with the correct sign of the compression."""
    return max(hammer.K_H * u**hammer.p * (1 + hammer.mu * du), 0.0) if u > 0 else 0.0


class Steps(NamedTuple):
    """One row per step."""

    q: np.ndarray  # displacements [steps, modes or points]
    v: np.ndarray
    force: np.ndarray  # [steps]
    compression: np.ndarray
    hammer: np.ndarray  # y_H and v_H [steps, 2]


def modal_steps(omega2, alpha, phi, gamma, hammer: Hammer, dt: float, steps: int, q0=None, v0=None) -> Steps:
    """Crank-Nicolson mode by mode (design §2), with a bracketing solver for the felt and an explicit hammer state."""
    a = dt / 2
    D = 1 + 2 * a * alpha + a**2 * omega2
    q = np.zeros_like(omega2) if q0 is None else np.array(q0, float)
    v = np.zeros_like(omega2) if v0 is None else np.array(v0, float)
    y_H, v_H, F = float(phi @ q), float(hammer.v_H0), 0.0
    rows = [(q, v, F, 0.0, y_H, v_H)]

    def moved(T):
        v1 = ((1 - 2 * a * alpha - a**2 * omega2) * v - 2 * a * omega2 * q + a * gamma * T) / D
        v_H1 = v_H - a * T / hammer.M_H
        return q + a * (v + v1), v1, y_H + a * (v_H + v_H1), v_H1

    def excess(F1):
        q1, v1, y_H1, v_H1 = moved(F + F1)
        return F1 - felt(y_H1 - phi @ q1, v_H1 - phi @ v1, hammer)

    for _ in range(steps - 1):
        top = 1e-6
        if excess(0.0) >= 0:
            F1 = 0.0
        else:
            while excess(top) < 0:
                top *= 4
            F1 = scipy.optimize.brentq(excess, 0.0, top, xtol=1e-300, rtol=8.9e-16)
        q, v, y_H, v_H = moved(F + F1)
        F = F1
        rows.append((q, v, F, float(y_H - phi @ q), y_H, v_H))
    return _rows(rows)


def _rows(rows: list) -> Steps:
    q, v, force, u, y_H, v_H = (np.array(column) for column in zip(*rows, strict=True))
    return Steps(q, v, force, u, np.stack([y_H, v_H], axis=1))


class GridMatrices(NamedTuple):
    """The paper's grid of N inner points, virtual nodes y_-1 = -y_1 and y_(N+2) = -y_N for the hinges."""

    second: np.ndarray
    fourth: np.ndarray
    window: np.ndarray  # sums to 1
    h: float


def grid_matrices(geometry: Geometry, N: int) -> GridMatrices:
    h = geometry.length / (N + 1)
    second = (np.diag(np.full(N, -2.0)) + np.diag(np.ones(N - 1), 1) + np.diag(np.ones(N - 1), -1)) / h**2
    fourth = sum(np.diag(np.full(N - abs(o), w), o) for o, w in [(0, 6.0), (1, -4.0), (-1, -4.0), (2, 1.0), (-2, 1.0)])
    fourth[0, 0] = fourth[-1, -1] = 5.0
    x = h * np.arange(1, N + 1)
    inside = np.abs(x - geometry.strike_position) < geometry.width / 2
    g = np.where(inside, 1 + np.cos(2 * np.pi * (x - geometry.strike_position) / geometry.width), 0.0)
    return GridMatrices(second, fourth / h**4, g / g.sum(), h)


def matrix_steps(
    string: String, hammer: Hammer, geometry: Geometry, N: int, dt: float, steps: int, y0=None, v0=None
) -> Steps:
    """The unchanged scheme of the paper: all points, hammer and felt in one dense Newton iteration per step."""
    grid = grid_matrices(geometry, N)
    density = geometry.mass / geometry.length
    one, zero = np.eye(N), np.zeros((N, N))
    stiff = string.c**2 * grid.second - string.kappa**2 * grid.fourth
    lossy = -2 * string.b1 * one + 2 * string.b2 * grid.second
    # state: y, v, y_H, v_H
    A = np.zeros((2 * N + 2, 2 * N + 2))
    A[: 2 * N, : 2 * N] = np.block([[zero, one], [stiff, lossy]])
    A[2 * N, 2 * N + 1] = 1.0
    push = np.concatenate([np.zeros(N), grid.window / (grid.h * density), [0.0, -1 / hammer.M_H]])
    press = np.concatenate([-grid.window, np.zeros(N), [1.0, 0.0]])  # u = press · state
    speed = np.concatenate([np.zeros(N), -grid.window, [0.0, 1.0]])
    left, right = np.eye(2 * N + 2) - dt / 2 * A, np.eye(2 * N + 2) + dt / 2 * A
    start = np.zeros(N) if y0 is None else y0
    state = np.concatenate([start, np.zeros(N) if v0 is None else v0, [grid.window @ start, hammer.v_H0]])
    F, rows = 0.0, []
    rows.append((state[:N], state[N : 2 * N], F, press @ state, state[-2], state[-1]))
    for _ in range(steps - 1):
        known = right @ state + dt / 2 * push * F
        new = state + dt * (A @ state + push * F)
        for _ in range(50):
            u, du = press @ new, speed @ new
            F1 = felt(u, du, hammer)
            residual = left @ new - dt / 2 * push * F1 - known
            if F1 > 0:
                elastic = hammer.K_H * u ** (hammer.p - 1)
                tangent = elastic * (hammer.p * (1 + hammer.mu * du) * press + u * hammer.mu * speed)
            else:
                tangent = np.zeros_like(press)
            change = np.linalg.solve(left - dt / 2 * np.outer(push, tangent), residual)
            new = new - change
            if np.abs(change).max() <= 1e-15 * max(np.abs(new).max(), 1e-300):
                break
        state, F = new, felt(press @ new, speed @ new, hammer)
        rows.append((state[:N], state[N : 2 * N], F, press @ state, state[-2], state[-1]))
    return _rows(rows)


def exact_contact(omega2, alpha, phi, gamma, hammer: Hammer, times: np.ndarray) -> Steps:
    """Solve the modal equations of motion, q¨ + 2αq˙ + ω²q = γF, to 1e-12 by DOP853."""
    n = len(omega2)

    def rates(_, s):
        q, v = s[:n], s[n : 2 * n]
        F = felt(s[-2] - phi @ q, s[-1] - phi @ v, hammer)
        return np.concatenate([v, gamma * F - omega2 * q - 2 * alpha * v, [s[-1], -F / hammer.M_H]])

    start = np.zeros(2 * n + 2)
    start[-1] = hammer.v_H0
    size = np.concatenate([np.full(n, 1e-4 / n), np.full(n, 0.1), [1e-4, 1.0]])
    solved = scipy.integrate.solve_ivp(
        rates, (0, times[-1]), start, method="DOP853", t_eval=times, rtol=1e-12, atol=1e-12 * size
    )
    s = solved.y.T
    u = s[:, -2] - s[:, :n] @ phi
    du = s[:, -1] - s[:, n : 2 * n] @ phi
    force = np.array([felt(a, b, hammer) for a, b in zip(u, du, strict=True)])
    return Steps(s[:, :n], s[:, n : 2 * n], force, u, s[:, -2:])
