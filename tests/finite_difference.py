"""The paper's own finite-difference scheme and its appendix: an independent check of the modal model.

The string is N inner points x_i = i h, h = L/(N + 1); the hammer is one more, the last. The state (y_s, v_s, y_H, v_H)
(paper eq. 9-14) is stepped by eq. 16, with the differences of eq. 17 and 18. Each equation of motion is multiplied by
its mass, which makes the matrices symmetric. With a = δt/2 and primes for the values one step later:

    M = m on the string, M_H for the hammer     K = m (κ² D₄ - c² D₂)     R = 2m (b₁ - b₂ D₂)     m = M_S/(N + 1)
    y' = y + a (v' + v)        M (v' - v) = -a [K (y' + y) + R (v' + v) + b (F' + F)]        u = b·y    u̇ = b·v
    F = K_H u^p (1 + μ u̇)  where u > 0, and never below 0;  F = 0 elsewhere

The row b reads the compression y_H - y_s, where the paper prints y_s - y_H. It is +1 for the hammer and minus the
window's weights for the string. The force acts through the same row, so that the scheme conserves the exchanged power.
While the felt is compressed, Newton-Raphson solves the whole nonlinear system for v', and with it for y', by

    J = M + aR + a²K + a (a ∂F/∂u + ∂F/∂u̇) b bᵀ

assembled and factored again in each iteration. Without contact, J is its constant part. Contact is tested at every
step, so a recontact may occur at any time. The scheme uses no modes, no kernel and no reduction to one equation. It
shares only the parameters' names with the rest of the model.

**The appendix.** Differentiating eq. 9-14 by a parameter z gives a linear system for the derivatives of the state
(A7-A13), driven by the state itself. The same scheme steps both, so that the result is the exact derivative of the
discrete solution. With dots for derivatives by z, and ∂ for those of a coefficient alone:

    ẏ' = ẏ + a (v̇' + v̇)                                                                            (A7, A9)
    M (v̇' - v̇) = -a [K (ẏ' + ẏ) + R (v̇' + v̇) + ∂K (y' + y) + ∂R (v' + v) + b (Ḟ' + Ḟ) + M ∂(1/M) b (F' + F)]
                                                                                                    (A8, A10)
    Ḟ' = ∂F/∂u b·ẏ' + ∂F/∂u̇ b·v̇' + ∂F,    all at u', u̇'

The string's masses are given, and ∂(1/M) is -1/M_H² in the hammer's row for z = M_H. Solved for the unknown v̇',

    J v̇' = (M - aR - a²K) v̇ - 2aK ẏ - a b [Ḟ + ∂F/∂u b·(ẏ + a v̇) + ∂F] - a [∂K (y' + y) + ... + M ∂(1/M) b (F' + F)]

with J at the solution of the step: one factorisation, and one solve with it for each parameter. At t = 0 all
derivatives vanish except that of v_H by v_H0, which is 1 (A11, A13). Initial shapes do not depend on the parameters.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve, toeplitz

from pianofit.errors import FitError, ParameterError
from pianofit.parameters import FIT_NAMES, Geometry, Hammer, String

__all__ = ["Reference", "Signals", "solve"]

# Newton iterations. At a very small compression each removes only 1/p of the error until convergence is quadratic.
MOST_ITERATIONS = 500
# Converged: residual of every equation, relative to the sum of the magnitudes of its terms.
ROUNDING = 8 * float(np.finfo(float).eps)


class Signals(NamedTuple):
    """Outputs of every step, or their derivatives by one parameter. Units: SI."""

    velocity: np.ndarray  # v_s at the pickup [steps], m/s
    displacement: np.ndarray  # y_s at the pickup [steps], m
    under_hammer: np.ndarray  # y_s through the window [steps], m
    force: np.ndarray  # F^n [steps], N
    compression: np.ndarray  # u^n [steps], m; negative without contact
    hammer: np.ndarray  # y_H, m, and v_H, m/s [steps, 2]


class Reference(NamedTuple):
    """A struck string, step by step from the first touch at n = 0."""

    time: np.ndarray  # n δt [steps], s
    signals: Signals
    string_energy: np.ndarray  # ½ Σ m v² + ½ y·K y [steps], J
    iterations: np.ndarray  # of Newton-Raphson [steps]; 0 without contact
    window: np.ndarray  # weights of the contact at the inner points [N], of sum 1
    derivatives: dict[str, Signals]  # by each of the nine parameters, if asked for: the signal's unit over its own


class State(NamedTuple):
    """String and hammer at one step, the hammer last, size = N + 1; or the derivatives, one column per parameter.

    The state includes the differences, because a fourth difference of y would magnify its rounding by (N + 1)⁴ and hide
    the derivative by κ.
    """

    displacement: np.ndarray  # y [size], m, or ẏ [size, 9]
    velocity: np.ndarray  # v [size], m/s, or v̇ [size, 9]
    force: np.ndarray | float  # F, N, or Ḟ [9]
    second: np.ndarray  # D₂ y, 1/m
    fourth: np.ndarray  # D₄ y, 1/m³


class Scheme(NamedTuple):
    """One string and hammer, and their matrices [size, size] on a grid and at a step."""

    string: String
    hammer: Hammer
    half_step: float  # a = δt/2, s
    string_mass: np.ndarray  # m on the string's rows, 0 on the hammer's [size], kg
    second: np.ndarray  # D₂ (eq. 17), 1/m²
    fourth: np.ndarray  # D₄ (eq. 18), 1/m⁴
    explicit: np.ndarray  # M - aR - a²K, kg
    implicit: np.ndarray  # M + aR + a²K, kg
    press: np.ndarray  # b [size]
    pickup: np.ndarray  # reads x_m [size]
    factor: Any  # Cholesky's, of `implicit`


def solve(
    string: String, hammer: Hammer, geometry: Geometry, *, step: float, steps: int, points: int = 100,
    window: np.ndarray | None = None, displacement: np.ndarray | None = None, velocity: np.ndarray | None = None,
    derivatives: bool = False,
) -> Reference:  # fmt: skip
    """Follow string and hammer for `steps` steps from t = 0, when the felt touches the string uncompressed (eq. 14).

    Parameters
    ----------
    string, hammer : also outside the box of `PARAMETERS`, such as without losses; K_H = 0 is a string without hammer.
    step : δt, s.
    points : N, the inner points of the grid.
    window : weights of the contact window at the inner points [points], which need not be normalised; a raised cosine
        of the geometry's width if None.
    displacement, velocity : y_s0, m, and v_s0, m/s, at the inner points [points]; at rest if None.
    derivatives : solve the appendix's system too (A7-A13).

    Raises
    ------
    ParameterError
        If no point lies under the window.
    FitError
        If Newton-Raphson does not converge.
    """
    weights = raised_cosine(geometry, points) if window is None else window / window.sum()
    scheme = assemble(string, hammer, geometry, step, weights)
    y_s, v_s = (np.zeros(points) if given is None else given for given in (displacement, velocity))
    y, v = np.append(y_s, weights @ y_s), np.append(v_s, float(hammer.v_H0))
    state = State(y, v, 0.0, scheme.second @ y, scheme.fourth @ y)
    zeros = np.zeros((points + 1, len(FIT_NAMES)))
    slopes = State(zeros, zeros.copy(), zeros[0], zeros, zeros)
    slopes.velocity[-1, FIT_NAMES.index("v_H0")] = 1.0  # A11, A13
    states, tangents, iterations = [state], [slopes], [0]
    for _ in range(steps - 1):
        state, count = _advance(scheme, states[-1])
        if derivatives:
            tangents.append(differentiated(scheme, states[-1], state, tangents[-1]))
        states.append(state)
        iterations.append(count)
    slope = _read(scheme, tangents)
    by_name = {name: Signals(*(x[..., j] for x in slope)) for j, name in enumerate(FIT_NAMES) if derivatives}
    energy = np.array([_energy(scheme, state) for state in states])
    return Reference(step * np.arange(steps), _read(scheme, states), energy, np.array(iterations), weights, by_name)


# --- the grid ---------------------------------------------------------------------------------------------------------


def raised_cosine(geometry: Geometry, points: int) -> np.ndarray:
    """Weights h ĝ(x - x0) of the contact window at the inner points [points], of sum 1."""
    from_middle = np.arange(1, points + 1) * (geometry.length / (points + 1)) - geometry.strike_position
    inside = np.abs(from_middle) < geometry.width / 2
    if not inside.any():
        raise ParameterError(
            f"points={points}: no point lies in the contact window, {geometry.width} m wide around "
            f"{geometry.strike_position} m; use more points or a wider window"
        )
    weights = np.where(inside, 1 + np.cos(2 * np.pi * from_middle / geometry.width), 0.0)
    return weights / weights.sum()


def second_difference(points: int, h: float) -> np.ndarray:
    """D₂ [points, points] (eq. 17); the ends are at rest."""
    return toeplitz(np.append([-2.0, 1.0], np.zeros(points - 2))) / h**2


def fourth_difference(points: int, h: float) -> np.ndarray:
    """D₄ [points, points] (eq. 18); the virtual nodes y₋₁ = -y₁ and y_(N+2) = -y_N model hinged ends."""
    inner = toeplitz(np.append([6.0, -4.0, 1.0], np.zeros(points - 3)))
    inner[[0, -1], [0, -1]] -= 1.0
    return inner / h**4


def stiffness(string: String, second, fourth):
    """K/m, 1/s²: minus the factor of the displacements in eq. 10."""
    return string.kappa**2 * fourth - string.c**2 * second


def losses(string: String, second, one):
    """R/m, 1/s: minus the factor of the velocities in eq. 10."""
    return 2 * string.b1 * one - 2 * string.b2 * second


def compression_row(weights: np.ndarray) -> np.ndarray:
    """b [size]: y_H - y_s, where the paper prints y_s - y_H."""
    return np.append(-weights, 1.0)


def pickup_row(geometry: Geometry, points: int) -> np.ndarray:
    """Row [points] that reads the displacement at x_m: exact at grid points, sine interpolation between them."""
    k = np.pi * np.arange(1, points + 1)
    sines = np.sin(np.outer(k, np.arange(1, points + 1)) / (points + 1))
    return np.sin(k * (geometry.pickup / geometry.length)) @ sines * (2 / (points + 1))


def assemble(string: String, hammer: Hammer, geometry: Geometry, step: float, weights: np.ndarray) -> Scheme:
    """Return the scheme for contact weights [points]."""
    points, a = weights.size, step / 2
    h, m = geometry.length / (points + 1), geometry.mass / (points + 1)
    # The differences do not act on the hammer.
    second, fourth, one = (
        np.pad(x, (0, 1)) for x in (second_difference(points, h), fourth_difference(points, h), np.eye(points))
    )
    string_mass = m * one.diagonal()
    mass = np.diag([*string_mass[:-1], hammer.M_H])
    K, R = m * stiffness(string, second, fourth), m * losses(string, second, one)
    implicit, b = mass + a * R + a**2 * K, compression_row(weights)
    pickup = np.append(pickup_row(geometry, points), 0.0)
    explicit = mass - a * R - a**2 * K
    return Scheme(string, hammer, a, string_mass, second, fourth, explicit, implicit, b, pickup, cho_factor(implicit))


# --- one step ---------------------------------------------------------------------------------------------------------


def felt(u: float, du: float, hammer: Hammer) -> tuple[float, float, float]:
    """F, N, and its slopes by u, N/m, and by u̇, N s/m (eq. 8)."""
    loss = 1 + hammer.mu * du
    if u <= 0 or loss <= 0:
        return 0.0, 0.0, 0.0
    elastic = hammer.K_H * u ** (hammer.p - 1)
    return elastic * u * loss, hammer.p * elastic * loss, elastic * u * hammer.mu


def elastic_pull(scheme: Scheme, state: State) -> np.ndarray:
    """K y, N, from the differences that the state carries."""
    return (scheme.string_mass * stiffness(scheme.string, state.second, state.fourth).T).T


def _explicit_terms(scheme: Scheme, old: State) -> np.ndarray:
    """Terms of y, v and F at the start of the step."""
    pushed = np.multiply.outer(scheme.press, old.force)
    return scheme.explicit @ old.velocity - scheme.half_step * (2 * elastic_pull(scheme, old) + pushed)


def _stepped(scheme: Scheme, old: State, velocity: np.ndarray, force: np.ndarray | float) -> State:
    """Return the state one step later, given its velocities and force."""
    moved = scheme.half_step * (velocity + old.velocity)
    second, fourth = old.second + scheme.second @ moved, old.fourth + scheme.fourth @ moved
    return State(old.displacement + moved, velocity, force, second, fourth)


def _advance(scheme: Scheme, old: State) -> tuple[State, int]:
    """Return the state one step later (eq. 16) and the number of iterations."""
    known = _explicit_terms(scheme, old)
    free = _stepped(scheme, old, cho_solve(scheme.factor, known, check_finite=False), 0.0)
    # The force is repulsive: without compression at zero force the felt does not touch.
    if scheme.press @ free.displacement <= 0:
        return free, 0
    velocity, force, count = _newton_raphson(scheme, old, known)
    return _stepped(scheme, old, velocity, force), count


def _newton_raphson(scheme: Scheme, old: State, known: np.ndarray) -> tuple[np.ndarray, float, int]:
    """Return the velocities [size] that solve the whole system to rounding, the force, and the number of iterations.

    The force is convex and rising along b, so the iterates converge monotonically after the first overshoot.
    """
    a, b, hammer = scheme.half_step, scheme.press, scheme.hammer
    velocity = old.velocity
    for count in range(1, MOST_ITERATIONS + 1):
        displacement = old.displacement + a * (velocity + old.velocity)
        force, by_u, by_du = felt(float(b @ displacement), float(b @ velocity), hammer)
        residual = known - scheme.implicit @ velocity - a * force * b
        step = cho_solve(_factor(scheme, by_u, by_du), residual, check_finite=False)
        velocity = velocity + step
        pressed = force + np.abs(b) @ (by_u * np.abs(displacement) + by_du * np.abs(velocity))
        size = np.abs(known) + np.abs(scheme.implicit) @ np.abs(velocity) + a * pressed * np.abs(b)
        if np.all(np.abs(residual) <= ROUNDING * size):
            # Force by linearisation: computed from u, a felt of 1e12 N/m would magnify the rounding of u.
            return velocity, max(force + (a * by_u + by_du) * float(b @ step), 0.0), count
    raise FitError(f"K_H={hammer.K_H:g} N/m^p, p={hammer.p:g}: Newton-Raphson does not converge; use a shorter step")


def _factor(scheme: Scheme, by_u: float, by_du: float) -> Any:
    """Cholesky factor of J for the slopes of the force by u and by u̇."""
    stiff = scheme.half_step * (scheme.half_step * by_u + by_du)
    if stiff == 0:
        return scheme.factor
    return cho_factor(scheme.implicit + stiff * np.outer(scheme.press, scheme.press), check_finite=False)


# --- the appendix -----------------------------------------------------------------------------------------------------


def differentiated(scheme: Scheme, old: State, new: State, last: State) -> State:
    """Return the derivatives one step after `last`, for the step from `old` to `new`."""
    a, b = scheme.half_step, scheme.press
    u, du = float(b @ new.displacement), float(b @ new.velocity)
    _, by_u, by_du = felt(u, du, scheme.hammer)
    by_felt = felt_derivatives(u, du, float(new.force), scheme.hammer)
    pushed = by_u * (b @ (last.displacement + a * last.velocity)) + by_felt
    known = _explicit_terms(scheme, last) - a * np.outer(b, pushed)
    known += coefficient_terms(scheme, old, new)
    velocity = cho_solve(_factor(scheme, by_u, by_du), known, check_finite=False)
    moved = _stepped(scheme, last, velocity, last.force)
    return moved._replace(force=by_u * (b @ moved.displacement) + by_du * (b @ velocity) + by_felt)


def felt_derivatives(u: float, du: float, force: float, hammer: Hammer) -> np.ndarray:
    """∂F [9], F^(j) of A8 and A10: derivatives of F = K_H u^p (1 + μ u̇) by K_H, μ and p at fixed u and u̇."""
    by = dict.fromkeys(FIT_NAMES, 0.0)
    if u > 0 and force > 0:
        by["K_H"] = force / hammer.K_H
        by["mu"] = hammer.K_H * u**hammer.p * du
        by["p"] = force * np.log(u)
    return np.array(list(by.values()))


def coefficient_terms(scheme: Scheme, old: State, new: State) -> np.ndarray:
    """-a [∂K (y' + y) + ∂R (v' + v) + M ∂(1/M) b (F' + F)] [size, 9].

    These are the terms in (c²)^(j), (κ²)^(j), b₁^(j) and b₂^(j) of A8 and in (1/M_H)^(j) of A10.
    """
    a, m, string, v = scheme.half_step, scheme.string_mass, scheme.string, new.velocity + old.velocity
    by = dict.fromkeys(FIT_NAMES, np.zeros_like(v))
    by["c"] = a * m * 2 * string.c * (new.second + old.second)
    by["kappa"] = -a * m * 2 * string.kappa * (new.fourth + old.fourth)
    by["b1"] = -a * m * 2 * v
    by["b2"] = a * m * 2 * (scheme.second @ v)
    by["M_H"] = np.zeros_like(v)
    by["M_H"][-1] = a * (new.force + old.force) / scheme.hammer.M_H
    return np.stack(list(by.values()), axis=1)


# --- outputs ----------------------------------------------------------------------------------------------------------


def _read(scheme: Scheme, states: list[State]) -> Signals:
    """The signals [steps], or their derivatives [steps, 9]."""
    y, v, force = (np.array(column) for column in list(zip(*states, strict=True))[:3])
    u = np.tensordot(y, scheme.press, (1, 0))
    velocity, displacement = (np.tensordot(x, scheme.pickup, (1, 0)) for x in (v, y))
    return Signals(velocity, displacement, y[:, -1] - u, force, u, np.stack([y[:, -1], v[:, -1]], axis=1))


def _energy(scheme: Scheme, state: State) -> float:
    """Energy of the string, J."""
    return 0.5 * float(scheme.string_mass @ state.velocity**2 + state.displacement @ elastic_pull(scheme, state))
