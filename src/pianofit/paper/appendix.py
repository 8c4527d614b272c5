"""The paper's appendix: the derivatives of string and hammer by the nine parameters, written out by hand.

Differentiating eq. 9-14 by a parameter z gives a linear system for the derivatives of the state (A7-A13), driven by the
state itself. It is stepped by the scheme that steps the state (eq. 16), so that the result is the exact derivative of
what `reference` computes, and no approximation to it. With the symbols of `reference`, primes for the values one step
later, dots for derivatives by z, and ∂ for those of a coefficient alone:

    ẏ' = ẏ + a (v̇' + v̇)                                                                            (A7, A9)
    M (v̇' - v̇) = -a [K (ẏ' + ẏ) + R (v̇' + v̇) + ∂K (y' + y) + ∂R (v' + v) + b (Ḟ' + Ḟ) + M ∂(1/M) b (F' + F)]
                                                                                                    (A8, A10)
    Ḟ' = ∂F/∂u b·ẏ' + ∂F/∂u̇ b·v̇' + ∂F,    all at u', u̇'

The string's masses are known, and ∂(1/M) is -1/M_H² in the hammer's row for z = M_H. Sorted by what is not yet known,

    J v̇' = (M - aR - a²K) v̇ - 2aK ẏ - a b [Ḟ + ∂F/∂u b·(ẏ + a v̇) + ∂F] - a [∂K (y' + y) + ... + M ∂(1/M) b (F' + F)]

with J = M + aR + a²K + a (a ∂F/∂u + ∂F/∂u̇) b bᵀ, the matrix of Newton-Raphson at the step's solution: one factor, and
one solve with it for each parameter. At t = 0 all derivatives vanish but that of v_H by v_H0, which is 1 (A11, A13);
initial shapes do not depend on the parameters.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve_banded

from ..parameters import FIT_NAMES, Hammer, String
from .grid import Scheme, State

__all__ = ["Sensitivity", "advance_derivatives", "initial_derivatives"]


class Sensitivity(NamedTuple):
    """The derivatives of a state by c, kappa, b1, b2, K_H, mu, p, M_H and v_H0, a column each; size = N + 1."""

    displacement: np.ndarray  # ẏ [size, 9]
    velocity: np.ndarray  # v̇ [size, 9]
    force: np.ndarray  # Ḟ [9]
    pull: np.ndarray  # K ẏ [size, 9], carried along as `State.fourth` is


def initial_derivatives(size: int, hammer: int) -> Sensitivity:
    """At t = 0 (A11, A13); `hammer` is the hammer's row."""
    zero = np.zeros((size, len(FIT_NAMES)))
    velocity = zero.copy()
    velocity[hammer, FIT_NAMES.index("v_H0")] = 1.0
    return Sensitivity(zero, velocity, zero[0], zero)


def advance_derivatives(
    scheme: Scheme,
    string: String,
    hammer: Hammer,
    old: State,
    new: State,
    last: Sensitivity,
    felt_slopes: list[float],
    factor: np.ndarray,
) -> Sensitivity:
    """The derivatives one step later, of the step from `old` to `new`.

    Parameters
    ----------
    felt_slopes : ∂F/∂u, N/m, and ∂F/∂u̇, N s/m, at the new state.
    factor : Cholesky's, of J at the new state.
    """
    a, b = scheme.half_step, scheme.press
    by_u, by_du = felt_slopes
    by_felt = felt_derivatives(float(b @ new.displacement), float(b @ new.velocity), new.force, hammer)
    pushed = last.force + by_u * (b @ (last.displacement + a * last.velocity)) + by_felt
    known = scheme.explicit @ last.velocity - 2 * a * last.pull - a * np.outer(b, pushed)
    known += coefficient_terms(scheme, string, hammer, old, new)
    velocity = cho_solve_banded((factor, True), known, check_finite=False)
    moved = a * (velocity + last.velocity)
    displacement = last.displacement + moved
    force = by_u * (b @ displacement) + by_du * (b @ velocity) + by_felt
    return Sensitivity(displacement, velocity, force, last.pull + scheme.pull @ moved)


def felt_derivatives(u: float, du: float, force: float, hammer: Hammer) -> np.ndarray:
    """∂F [9], F^(j) of A8 and A10: F = K_H u^p (1 + μ u̇) by K_H, μ and p at a fixed u and u̇."""
    by = dict.fromkeys(FIT_NAMES, 0.0)
    if u > 0 and force > 0:
        by["K_H"] = force / hammer.K_H
        by["mu"] = hammer.K_H * u**hammer.p * du
        by["p"] = force * np.log(u)
    return np.array(list(by.values()))


def coefficient_terms(scheme: Scheme, string: String, hammer: Hammer, old: State, new: State) -> np.ndarray:
    """-a [∂K (y' + y) + ∂R (v' + v) + M ∂(1/M) b (F' + F)] [size, 9].

    These are the terms in (c²)^(j), (κ²)^(j), b₁^(j) and b₂^(j) of A8 and in (1/M_H)^(j) of A10.
    """
    a, m = scheme.half_step, scheme.string_mass
    v = new.velocity + old.velocity
    by = dict.fromkeys(FIT_NAMES, np.zeros_like(v))
    by["c"] = a * m * 2 * string.c * (new.second + old.second)
    by["kappa"] = -a * m * 2 * string.kappa * (new.fourth + old.fourth)
    by["b1"] = -a * m * 2 * v
    by["b2"] = a * m * 2 * (scheme.second @ v)
    by["M_H"] = np.zeros_like(v)
    by["M_H"][scheme.hammer] = a * (new.force + old.force) / hammer.M_H
    return np.stack(list(by.values()), axis=1)
