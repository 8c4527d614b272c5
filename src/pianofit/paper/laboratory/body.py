"""The string with all it hangs on, as one linear system of second order.

Each polarisation is a field `y(x, t) = Σ q_k sin(β_k x) + w x/L`: the hinged string's sines, and a ramp that follows
the bridge's displacement `w` at x = L. Kinetic, elastic and dissipated energy of these fields and of the bridge's
resonators are quadratic forms; Lagrange's equations then read

    M ẍ + C ẋ + K x = b F,      M, K positive definite, C positive semidefinite

with the same `b` for pushing and for reading what is under the hammer. In coordinates ξ = (Gᵀx, Lᵀẋ) with K = G Gᵀ and
M = L Lᵀ the energy is ½|ξ|², and d/dt ½|ξ|² = F bᵀẋ - ẋᵀC ẋ: passive, whatever the numbers. Its eigenvectors turn the
system into damped exponentials.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag, cholesky, solve_triangular

from ...parameters import Geometry, String
from .chosen import ANGLE, CENTS, SLOWER, Resonator

__all__ = ["Axis", "Body", "make_axes", "make_body", "window_weights"]


class Axis(NamedTuple):
    """One polarisation: a string, and how much of the hammer's direction lies along it."""

    string: String
    share: float


class Body(NamedTuple):
    """Damped exponentials ż = λ z + β F, one a row, and the energy coordinates ξ = Re(vectors z) behind them."""

    poles: np.ndarray  # λ, complex [rows], 1/s; Im ≥ 0
    drive: np.ndarray  # β, complex [rows], √J/(N s)
    vectors: np.ndarray  # complex [2 dof, rows]; conjugate rows are counted in
    under: np.ndarray  # real [2 dof]: displacement under the hammer = under · ξ, m
    pickup: np.ndarray  # real [2 dof]: velocity at the pickup along the hammer's direction = pickup · ξ, m/s
    force: np.ndarray  # real [2 dof]: ξ̇ = matrix ξ + force F
    matrix: np.ndarray  # real [2 dof, 2 dof], whose symmetric part is not positive


class _Forms(NamedTuple):
    """The matrices M, C, K [dof, dof]."""

    mass: np.ndarray
    loss: np.ndarray
    stiffness: np.ndarray


def make_axes(string: String, polarisation: bool) -> tuple[Axis, ...]:
    """The string alone, or turned by `ANGLE` and with its second axis."""
    if not polarisation:
        return (Axis(string, 1.0),)
    turn, sharp = math.radians(ANGLE), 2 ** (CENTS / 1200)
    second = String(string.c * sharp, string.kappa * sharp, string.b1 * SLOWER, string.b2 * SLOWER)
    return Axis(string, math.cos(turn)), Axis(second, -math.sin(turn))


@lru_cache(maxsize=8)
def make_body(axes: tuple[Axis, ...], geometry: Geometry, modes: int, resonators: tuple[Resonator, ...]) -> Body:
    """The whole system; without `resonators` the string's end is at rest."""
    forms = _forms(axes, geometry, modes, resonators)
    beta = np.arange(1, modes + 1) * (math.pi / geometry.length)
    push = _across(axes, window_weights(geometry, modes), geometry.strike / geometry.length, resonators)
    read = _across(axes, np.sin(beta * geometry.pickup), geometry.pickup / geometry.length, resonators)
    return _exponentials(forms, push, read)


def window_weights(geometry: Geometry, modes: int) -> np.ndarray:
    """∫ ĝ sin(β_k x) dx [modes] of the window ĝ = (1 + cos(2π(x - x0)/width))/width, by Gauss-Legendre quadrature."""
    nodes, weights = np.polynomial.legendre.leggauss(96)
    beta = np.arange(1, modes + 1) * (math.pi / geometry.length)
    return np.sin(np.outer(beta, geometry.strike + nodes * geometry.width / 2)) @ (
        weights * (1 + np.cos(math.pi * nodes)) / 2
    )


def _directions(axes: tuple[Axis, ...], resonators: tuple[Resonator, ...]) -> np.ndarray:
    """How far a unit motion of each resonator moves the bridge along each axis [axes, resonators]."""
    angle = np.radians([r.direction for r in resonators])
    return np.stack([np.cos(angle), np.sin(angle)])[: len(axes)]


def _across(axes: tuple[Axis, ...], sines: np.ndarray, ramp: float, resonators: tuple[Resonator, ...]) -> np.ndarray:
    """The vector that weighs the motion along the hammer's direction at one position [dof]."""
    bridge = np.zeros(len(resonators))
    if resonators:
        bridge = ramp * np.array([axis.share for axis in axes]) @ _directions(axes, resonators)
    return np.concatenate([*(axis.share * sines for axis in axes), bridge])


def _forms(axes: tuple[Axis, ...], geometry: Geometry, modes: int, resonators: tuple[Resonator, ...]) -> _Forms:
    blocks = [_field_forms(axis.string, geometry, modes) for axis in axes]
    # The last column of each block is the ramp; the bridge's resonators move it.
    toward = np.asarray(block_diag(*(np.eye(modes + 1)[:, :modes] for _ in axes)))
    if resonators:
        ramps = np.zeros((len(axes) * (modes + 1), len(resonators)))
        ramps[modes :: modes + 1] = _directions(axes, resonators)
        toward = np.hstack([toward, ramps])
    own = _resonator_forms(resonators, len(axes) * modes)
    return _Forms(
        *(toward.T @ np.asarray(block_diag(*parts)) @ toward + o for *parts, o in zip(*blocks, own, strict=True))
    )


def _field_forms(string: String, geometry: Geometry, modes: int) -> _Forms:
    """M, C, K of one polarisation, for (q_1 ... q_modes, w): ρ∫ẏ², 2 b1 ρ∫ẏ² + 2 b2 ρ∫ẏ'², ρ∫(c² y'² + κ² y''²)."""
    k = np.arange(1, modes + 1)
    beta2 = (k * (math.pi / geometry.length)) ** 2
    half = geometry.mass / 2  # ρ ∫ sin² dx
    mass = np.diag([*np.full(modes, half), geometry.mass / 3])
    mass[:-1, -1] = mass[-1, :-1] = geometry.mass * np.where(k % 2, 1, -1) / (k * math.pi)  # ρ ∫ sin(β x) x/L dx
    slope = np.diag([*(half * beta2), geometry.mass / geometry.length**2])
    bend = np.diag([*(half * beta2**2), 0.0])
    return _Forms(mass, 2 * string.b1 * mass + 2 * string.b2 * slope, string.c**2 * slope + string.kappa**2 * bend)


def _resonator_forms(resonators: tuple[Resonator, ...], before: int) -> _Forms:
    """M, C, K of the bridge by itself, after `before` rows of zeros."""
    mass = np.array([r.mass for r in resonators])
    omega = 2 * math.pi * np.array([r.frequency for r in resonators])
    loss = mass * omega / np.array([r.quality for r in resonators])
    return _Forms(*(np.diag([*np.zeros(before), *own]) for own in (mass, loss, mass * omega**2)))


def _exponentials(forms: _Forms, push: np.ndarray, read: np.ndarray) -> Body:
    """The system in energy coordinates, and its eigenvectors."""
    low, stiff = cholesky(forms.mass, lower=True), cholesky(forms.stiffness, lower=True)
    turn = solve_triangular(low, stiff, lower=True)  # L⁻¹ G
    loss = solve_triangular(low, solve_triangular(low, forms.loss, lower=True).T, lower=True)
    none = np.zeros(push.size)
    matrix = np.block([[np.zeros_like(loss), turn.T], [-turn, -(loss + loss.T) / 2]])
    force = np.concatenate([none, solve_triangular(low, push, lower=True)])
    poles, vectors = np.linalg.eig(matrix)
    drive = np.linalg.solve(vectors, force)
    upper = np.imag(poles) >= 0
    twice = np.where(np.imag(poles[upper]) > 0, 2.0, 1.0)
    return Body(
        poles=poles[upper],
        drive=drive[upper],
        vectors=vectors[:, upper] * twice,
        under=np.concatenate([solve_triangular(stiff, push, lower=True), none]),
        pickup=np.concatenate([none, solve_triangular(low, read, lower=True)]),
        force=force,
        matrix=matrix,
    )
