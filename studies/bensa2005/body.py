"""String, polarisations and bridge as one linear system of second order.

Each polarisation is a field `y(x, t) = Σ q_k sin(β_k x) + w x/L`: the sines of the hinged string, and a ramp that
follows the bridge displacement `w` at x = L. The kinetic, elastic and dissipated energies of these fields and of the
bridge resonators are quadratic forms. Lagrange's equations then read

    M ẍ + C ẋ + K x = b F,      M, K positive definite, C positive semidefinite

The same `b` applies the force and reads the displacement under the hammer. In coordinates ξ = (Gᵀx, Lᵀẋ) with K = G Gᵀ
and M = L Lᵀ the energy is ½|ξ|², and d/dt ½|ξ|² = F bᵀẋ - ẋᵀC ẋ. The system is therefore passive for all values. Its
eigenvectors transform it into damped exponentials.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag, cholesky, solve_triangular

from pianofit.parameters import Geometry, String

__all__ = [
    "ANGLE",
    "CENTS",
    "RESONATORS",
    "SLOWER",
    "Axis",
    "Body",
    "Resonator",
    "make_axes",
    "make_body",
    "window_weights",
]

# The second polarisation. The principal axes of the supports are turned by ANGLE against the hammer. The pickup
# measures along the hammer, so the second axis lies at tan² 20° = -17.6 dB relative to the first, a common level of the
# aftersound of piano notes (Weinreich 1977). Its losses are a quarter, because supports are stiffer along the
# soundboard. It is CENTS sharp: the fifth partial beats with a period of 1.1 s, the first with one of 5.7 s.
ANGLE = 20.0  # degrees
CENTS = 2.0
SLOWER = 0.25  # b1 and b2 of the second axis, over those of the first


class Resonator(NamedTuple):
    """One damped mode of the support at the end of the string."""

    frequency: float  # Hz
    mass: float  # effective, at the end of the string, kg
    quality: float  # Q = ω m / R
    direction: float  # of its motion, degrees from the string's first axis


# The paper's support is concrete with a piece of bridge on it, and "not totally uncoupled" from the string. A resonance
# adds 2 f0 (M_S c/L) Q/(m ω) to the decay rate of a partial: 0.7 to 1.1 1/s here, one to two times b1 of the string.
# The resonances are arbitrary: near partials 2, 7, 11 and 16, and between 4 and 5. Masses fall with frequency, because
# ever smaller parts of the support move.
RESONATORS = (
    Resonator(300.0, 8.0, 30.0, 10.0),
    Resonator(690.0, 5.0, 30.0, -25.0),
    Resonator(1085.0, 3.0, 30.0, 15.0),
    Resonator(1710.0, 2.0, 30.0, -10.0),
    Resonator(2560.0, 1.5, 30.0, 30.0),
)


class Axis(NamedTuple):
    """One polarisation: a string, and the component of the hammer's direction along it."""

    string: String
    share: float


class Body(NamedTuple):
    """Damped exponentials ż = λ z + β F, one per row, and their energy coordinates ξ = Re(vectors z)."""

    poles: np.ndarray  # λ, complex [rows], 1/s; Im ≥ 0
    drive: np.ndarray  # β, complex [rows], √J/(N s)
    vectors: np.ndarray  # complex [2 dof, rows]; they include the conjugate rows
    under: np.ndarray  # real [2 dof]: displacement under the hammer = under · ξ, m
    pickup: np.ndarray  # real [2 dof]: velocity at the pickup along the hammer's direction = pickup · ξ, m/s
    force: np.ndarray  # real [2 dof]: ξ̇ = matrix ξ + force F
    matrix: np.ndarray  # real [2 dof, 2 dof], whose symmetric part is not positive


def make_axes(string: String, polarisation: bool) -> tuple[Axis, ...]:
    """Return one polarisation along the hammer, or two that are turned by `ANGLE`."""
    if not polarisation:
        return (Axis(string, 1.0),)
    angle, ratio = math.radians(ANGLE), 2 ** (CENTS / 1200)
    second = String(string.c * ratio, string.kappa * ratio, string.b1 * SLOWER, string.b2 * SLOWER)
    return Axis(string, math.cos(angle)), Axis(second, -math.sin(angle))


@lru_cache(maxsize=8)
def make_body(axes: tuple[Axis, ...], geometry: Geometry, modes: int, resonators: tuple[Resonator, ...]) -> Body:
    """Return the whole system. Without `resonators` the end of the string is at rest."""
    angle, shares = np.radians([r.direction for r in resonators]), np.array([axis.share for axis in axes])
    # Bridge displacement along each axis for unit displacement of each resonator [axes, resonators].
    moved = np.stack([np.cos(angle), np.sin(angle)])[: len(axes)]

    def across(sines: np.ndarray, at: float) -> np.ndarray:
        """Weights of the coordinates in the displacement along the hammer's direction at one position [dof]."""
        return np.concatenate([*(share * sines for share in shares), at / geometry.length * shares @ moved])

    beta = np.arange(1, modes + 1) * (math.pi / geometry.length)
    push = across(window_weights(geometry, modes), geometry.strike_position)
    read = across(np.sin(beta * geometry.pickup), geometry.pickup)
    return _exponentials(_forms(axes, geometry, modes, resonators, moved), push, read)


def window_weights(geometry: Geometry, modes: int) -> np.ndarray:
    """∫ ĝ sin(β_k x) dx [modes] of the window ĝ = (1 + cos(2π(x - x0)/width))/width, by Gauss-Legendre quadrature."""
    nodes, weights = np.polynomial.legendre.leggauss(96)
    beta = np.arange(1, modes + 1) * (math.pi / geometry.length)
    return np.sin(np.outer(beta, geometry.strike_position + nodes * geometry.width / 2)) @ (
        weights * (1 + np.cos(math.pi * nodes)) / 2
    )


def _forms(
    axes: tuple[Axis, ...], geometry: Geometry, modes: int, resonators: tuple[Resonator, ...], moved: np.ndarray
) -> list[np.ndarray]:
    """M, C, K [dof, dof] of all modes, axis by axis, and of the resonators."""
    # Each field has its modes and a ramp. The resonators determine the ramps.
    inner = len(axes) * modes
    transform = np.zeros((len(axes) * (modes + 1), inner + len(resonators)))
    transform[:, :inner] = block_diag(*(np.eye(modes + 1)[:, :modes] for _ in axes))
    transform[modes :: modes + 1, inner:] = moved
    frequency, mass, quality, _ = np.array(resonators).reshape(-1, len(Resonator._fields)).T
    omega = 2 * math.pi * frequency
    bridge = (mass, mass * omega / quality, mass * omega**2)
    fields = zip(*(_field_forms(axis.string, geometry, modes) for axis in axes), strict=True)
    return [
        transform.T @ np.asarray(block_diag(*parts)) @ transform + np.diag([*np.zeros(inner), *own])
        for parts, own in zip(fields, bridge, strict=True)
    ]


def _field_forms(string: String, geometry: Geometry, modes: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """M, C, K of one polarisation, for (q_1 ... q_modes, w): ρ∫ẏ², 2 b1 ρ∫ẏ² + 2 b2 ρ∫ẏ'², ρ∫(c² y'² + κ² y''²)."""
    k = np.arange(1, modes + 1)
    beta2 = (k * (math.pi / geometry.length)) ** 2
    half = geometry.mass / 2  # ρ ∫ sin² dx
    mass = np.diag([*np.full(modes, half), geometry.mass / 3])
    mass[:-1, -1] = mass[-1, :-1] = geometry.mass * np.where(k % 2, 1, -1) / (k * math.pi)  # ρ ∫ sin(β x) x/L dx
    slope = np.diag([*(half * beta2), geometry.mass / geometry.length**2])
    bend = np.diag([*(half * beta2**2), 0.0])
    return mass, 2 * string.b1 * mass + 2 * string.b2 * slope, string.c**2 * slope + string.kappa**2 * bend


def _exponentials(forms: list[np.ndarray], push: np.ndarray, read: np.ndarray) -> Body:
    """Return the system in energy coordinates, with its eigenvectors."""
    mass, loss, stiffness = forms
    low, stiff = cholesky(mass, lower=True), cholesky(stiffness, lower=True)
    coupling = solve_triangular(low, stiff, lower=True)  # L⁻¹ G
    loss = solve_triangular(low, solve_triangular(low, loss, lower=True).T, lower=True)
    zeros = np.zeros(push.size)
    matrix = np.block([[np.zeros_like(loss), coupling.T], [-coupling, -(loss + loss.T) / 2]])
    force = np.concatenate([zeros, solve_triangular(low, push, lower=True)])
    poles, vectors = np.linalg.eig(matrix)
    drive = np.linalg.solve(vectors, force)
    upper = np.imag(poles) >= 0
    twice = np.where(np.imag(poles[upper]) > 0, 2.0, 1.0)
    under = np.concatenate([solve_triangular(stiff, push, lower=True), zeros])
    pickup = np.concatenate([zeros, solve_triangular(low, read, lower=True)])
    return Body(poles[upper], drive[upper], vectors[:, upper] * twice, under, pickup, force, matrix)
