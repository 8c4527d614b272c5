"""The paper's own scheme, grid and matrices and all: the independent witness for the table of modes.

The state (y_s, v_s, y_H, v_H) of a string on N inner points and of a hammer (paper eq. 9-14) is stepped by eq. 16, with
the differences of eq. 17 and 18. Written for string and hammer together (M, K, R and b: see `grid`), with a = δt/2 and
primes for the values one step later, that is

    y' = y + a (v' + v)        M (v' - v) = -a [K (y' + y) + R (v' + v) + b (F' + F)]        u = b·y    u̇ = b·v
    F = K_H u^p (1 + μ u̇)  where u > 0, and never below 0;  F = 0 elsewhere

The compression is y_H - y_s, where the paper prints y_s - y_H, and y_s under the hammer is read through the window
through which the felt pushes. Where the felt is pressed, Newton-Raphson solves the whole nonlinear system for v', and
with it for y'. Its matrix

    J = M + aR + a²K + a (a ∂F/∂u + ∂F/∂u̇) b bᵀ

is symmetric, positive definite and banded; it is assembled and factored anew in each iteration. Where nothing is
pressed, J is its constant part, whose Cholesky factor is made once. Whether the felt is pressed is asked at every
step, so a hammer may come back at any time. No modes, no kernel, no reduction to one equation: nothing is shared with
the rest of the model but the parameters' names.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from ..errors import FitError, ParameterError
from ..felt import MemoryHammer
from ..parameters import FIT_NAMES, Geometry, Hammer, String
from .appendix import Sensitivity, advance_derivatives, initial_derivatives
from .grid import Scheme, Shape, State, assemble, elastic_pull, grid_points, grid_window

__all__ = ["Reference", "Signals", "solve"]

FEWEST_POINTS = 3
# Newton's iterations; into a light touch each takes only 1/p off the error until it turns quadratic.
MOST_ITERATIONS = 500
# Solved: what is left of every line, over the sum of the sizes of its terms.
ROUNDING = 8 * float(np.finfo(float).eps)


class Signals(NamedTuple):
    """What is read at every step, or its derivatives by one parameter. Units: SI."""

    velocity: np.ndarray  # v_s at the pickup [steps], m/s
    displacement: np.ndarray  # y_s at the pickup [steps], m
    under_hammer: np.ndarray  # y_s through the window [steps], m
    force: np.ndarray  # F^n [steps], N
    compression: np.ndarray  # u^n [steps], m; negative when apart
    hammer: np.ndarray  # y_H, m, and v_H, m/s [steps, 2]


class Reference(NamedTuple):
    """A struck string, step by step from the first touch at n = 0."""

    time: np.ndarray  # n δt [steps], s
    signals: Signals
    string_energy: np.ndarray  # ½ Σ m v² + ½ y·K y [steps], J
    iterations: np.ndarray  # of Newton-Raphson [steps]; 0 where nothing is pressed
    window: np.ndarray  # weights of the contact at the inner points [N], of sum 1
    derivatives: dict[str, Signals]  # by each of the nine parameters, if asked for: the signal's unit over its own


def solve(
    string: String,
    hammer: Hammer,
    geometry: Geometry,
    *,
    step: float,
    steps: int,
    points: int = 100,
    window: Shape = None,
    displacement: Shape = None,
    velocity: Shape = None,
    derivatives: bool = False,
) -> Reference:
    """Follow string and hammer for `steps` steps from t = 0, when the felt touches the string uncompressed (eq. 14).

    Parameters
    ----------
    string, hammer : also outside the box of `PARAMETERS`, such as without losses; K_H = 0 is a string left alone.
    step : δt, s.
    points : N, the inner points of the grid, h = L/(N + 1).
    window : of the contact, see `grid.grid_window`.
    displacement, velocity : y_s0, m, and v_s0, m/s: values at the inner points [points] or functions of x, m.
    derivatives : solve the appendix's system too (A7-A13), see `appendix`.

    Raises
    ------
    ParameterError
        Naming the argument, its value and its range.
    FitError
        If Newton-Raphson does not converge.
    """
    _check(string, hammer, geometry, step, steps, points)
    weights = grid_window(geometry, points, window)
    scheme = assemble(string, hammer, geometry, step, weights)
    y_s = _on_grid("displacement", displacement, geometry, points)
    v_s = _on_grid("velocity", velocity, geometry, points)
    y, v = np.insert(y_s, scheme.hammer, weights @ y_s), np.insert(v_s, scheme.hammer, float(hammer.v_H0))
    state = State(y, v, 0.0, scheme.second @ y, scheme.fourth @ y)
    slopes = initial_derivatives(y.size, scheme.hammer) if derivatives else None
    rows = [(_read(scheme, state), _energy(scheme, string, state), 0)]
    slope_rows = [] if slopes is None else [_read(scheme, slopes)]
    for _ in range(steps - 1):
        old = state
        state, count = _advance(scheme, string, hammer, old)
        rows.append((_read(scheme, state), _energy(scheme, string, state), count))
        if slopes is not None:
            slopes = _differentiate(scheme, string, hammer, old, state, slopes)
            slope_rows.append(_read(scheme, slopes))
    signals, energy, iterations = zip(*rows, strict=True)
    return Reference(
        step * np.arange(steps), _columns(signals), np.array(energy), np.array(iterations), weights, _named(slope_rows)
    )


def felt(u: float, du: float, hammer: Hammer) -> tuple[float, float, float]:
    """F, N, and its slopes by u, N/m, and by u̇, N s/m (eq. 8)."""
    loss = 1 + hammer.mu * du
    if u <= 0 or loss <= 0:
        return 0.0, 0.0, 0.0
    elastic = hammer.K_H * u ** (hammer.p - 1)
    return elastic * u * loss, hammer.p * elastic * loss, elastic * u * hammer.mu


# --- one step ---------------------------------------------------------------------------------------------------------


def _advance(scheme: Scheme, string: String, hammer: Hammer, old: State) -> tuple[State, int]:
    """The state one step later (eq. 16), and how many iterations it took."""
    a, b = scheme.half_step, scheme.press
    known = scheme.explicit @ old.velocity - 2 * a * elastic_pull(scheme, string, old) - a * old.force * b
    velocity = cho_solve_banded((scheme.free_factor, True), known, check_finite=False)
    force, count = 0.0, 0
    # The force only ever parts the two: what does not touch without one does not touch.
    if b @ (old.displacement + a * (velocity + old.velocity)) > 0:
        velocity, force, count = _newton_raphson(scheme, hammer, old, known)
    moved = a * (velocity + old.velocity)
    # Carried along: a fourth difference of y would magnify its rounding by (N + 1)⁴ and hide κ's derivative.
    second, fourth = old.second + scheme.second @ moved, old.fourth + scheme.fourth @ moved
    return State(old.displacement + moved, velocity, force, second, fourth), count


def _newton_raphson(scheme: Scheme, hammer: Hammer, old: State, known: np.ndarray) -> tuple[np.ndarray, float, int]:
    """The velocities [size] that solve the whole system to rounding, the force, and the iterations it took.

    The force is convex and rising along b: from the first iterate on the far side the rest fall onto the solution.
    """
    a, b = scheme.half_step, scheme.press
    velocity = old.velocity
    for count in range(1, MOST_ITERATIONS + 1):
        displacement = old.displacement + a * (velocity + old.velocity)
        force, by_u, by_du = felt(float(b @ displacement), float(b @ velocity), hammer)
        residual = known - scheme.implicit @ velocity - a * force * b
        step = cho_solve_banded((_factor(scheme, by_u, by_du), True), residual, check_finite=False)
        velocity = velocity + step
        pressed = force + np.abs(b) @ (by_u * np.abs(displacement) + by_du * np.abs(velocity))
        size = np.abs(known) + abs(scheme.implicit) @ np.abs(velocity) + a * pressed * np.abs(b)
        if np.all(np.abs(residual) <= ROUNDING * size):
            # The force that goes with these velocities; anew from u, a felt of 1e12 N/m would magnify u's rounding.
            return velocity, max(force + (a * by_u + by_du) * float(b @ step), 0.0), count
    raise FitError(f"K_H={hammer.K_H:g} N/m^p, p={hammer.p:g}: Newton-Raphson does not converge; use a shorter step")


def _factor(scheme: Scheme, by_u: float, by_du: float) -> np.ndarray:
    """Cholesky's factor of J for a felt of these slopes."""
    stiff = scheme.half_step * (scheme.half_step * by_u + by_du)
    if stiff == 0:
        return scheme.free_factor
    return cholesky_banded(scheme.free_bands + stiff * scheme.contact_bands, lower=True, check_finite=False)


def _differentiate(
    scheme: Scheme, string: String, hammer: Hammer, old: State, new: State, last: Sensitivity
) -> Sensitivity:
    _, *by = felt(float(scheme.press @ new.displacement), float(scheme.press @ new.velocity), hammer)
    return advance_derivatives(scheme, string, hammer, old, new, last, by, _factor(scheme, *by))


# --- what goes in and what comes out ----------------------------------------------------------------------------------


def _read(scheme: Scheme, state: State | Sensitivity) -> Signals:
    """One step's signals, or their derivatives [9]."""
    y, v = state.displacement, state.velocity
    u = scheme.press @ y
    hammer = np.stack([y[scheme.hammer], v[scheme.hammer]], axis=-1)
    return Signals(scheme.pickup @ v, scheme.pickup @ y, hammer[..., 0] - u, np.asarray(state.force), u, hammer)


def _energy(scheme: Scheme, string: String, state: State) -> float:
    """Of the string, J."""
    return 0.5 * float(
        scheme.string_mass @ state.velocity**2 + state.displacement @ elastic_pull(scheme, string, state)
    )


def _columns(rows) -> Signals:
    return Signals(*(np.array(column) for column in zip(*rows, strict=True)))


def _named(rows: list[Signals]) -> dict[str, Signals]:
    every = _columns(rows) if rows else ()
    return {name: Signals(*(x[:, j] for x in every)) for j, name in enumerate(FIT_NAMES) if every}


def _on_grid(name: str, shape: Shape, geometry: Geometry, points: int) -> np.ndarray:
    """Initial values at the inner points [points]."""
    at_rest = np.zeros(points)
    values = at_rest if shape is None else shape(grid_points(geometry, points)) if callable(shape) else shape
    values = np.array(values, float)
    if values.shape != (points,) or not np.all(np.isfinite(values)):
        raise ParameterError(f"{name} of shape {values.shape} must be {points} finite values, one for each inner point")
    return values


def _check(string: String, hammer: Hammer, geometry: Geometry, step: float, steps: int, points: int) -> None:
    if isinstance(hammer, MemoryHammer):
        raise ParameterError("hammer remembers; the paper's scheme has its own felt, give a Hammer")
    values = {**string._asdict(), **hammer._asdict(), **geometry._asdict(), "step": step}
    for name, value in values.items():
        lowest, allowed = {"p": (1.0, "1 or more"), "v_H0": (-math.inf, "a number")}.get(name, (0.0, "0 or more"))
        above = name in ("c", "M_H", "length", "mass", "width", "pickup", "step")
        if not (math.isfinite(value) and value >= lowest) or (above and value == 0):
            raise ParameterError(f"{name}={value!r} must be {'more than 0' if above else allowed}")
    for name, count, fewest in (("points", points, FEWEST_POINTS), ("steps", steps, 1)):
        if not (count >= fewest and count == int(count)):
            raise ParameterError(f"{name}={count!r} must be a whole number, {fewest} or more")
    length, at, width = geometry.length, geometry.strike, geometry.width
    if at - width / 2 < 0 or at + width / 2 > length:
        raise ParameterError(f"strike={at} m with width={width} m must lie within the string, 0 to {length} m")
    if geometry.pickup >= length:
        raise ParameterError(f"pickup={geometry.pickup} m must lie within the string, 0 to {length} m")
