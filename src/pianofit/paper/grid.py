"""The paper's grid: string and hammer as points, and eq. 16-18 as matrices between them.

The string is N inner points x_i = i h, h = L/(N + 1). The hammer is one more, numbered among those it strikes, so that
every matrix of the scheme is banded. Lines are multiplied by the mass they move, which makes the matrices symmetric:

    M = m on the string, M_H for the hammer     K = m (κ² D₄ - c² D₂)     R = 2m (b₁ - b₂ D₂)     m = M_S/(N + 1)

The row b reads the compression, u = b·y: +1 for the hammer and minus the window's weights for the string. The same row
pushes them apart, so that the felt takes from the string exactly the power it gives.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse
from scipy.linalg import cholesky_banded

from ..errors import ParameterError
from ..parameters import Geometry, Hammer, String

__all__ = ["Scheme", "Shape", "State", "assemble", "elastic_pull", "grid_points", "grid_window"]

# Values at the points [points], or a function of the position.
Shape = Callable[[np.ndarray], Any] | np.ndarray | None


class State(NamedTuple):
    """String and hammer at one step; size = N + 1."""

    displacement: np.ndarray  # y [size], m
    velocity: np.ndarray  # v [size], m/s
    force: float  # F, N
    second: np.ndarray  # D₂ y [size], 1/m
    fourth: np.ndarray  # D₄ y [size], 1/m³


class Scheme(NamedTuple):
    """The matrices of one string, hammer, grid and step; size = N + 1."""

    half_step: float  # a = δt/2, s
    hammer: int  # the hammer's row
    string_mass: np.ndarray  # m on the string's rows, 0 on the hammer's [size], kg
    second: Any  # D₂ (eq. 17), sparse [size, size], 1/m²
    fourth: Any  # D₄ (eq. 18), sparse [size, size], 1/m⁴
    pull: Any  # K, sparse [size, size], N/m
    explicit: Any  # M - aR - a²K, sparse [size, size], kg
    implicit: Any  # M + aR + a²K, sparse [size, size], kg
    press: np.ndarray  # b [size]
    pickup: np.ndarray  # reads x_m [size]
    free_bands: np.ndarray  # `implicit`, its lower diagonals as rows [bands, size]
    contact_bands: np.ndarray  # b bᵀ likewise
    free_factor: np.ndarray  # Cholesky's, of `free_bands`


def grid_points(geometry: Geometry, points: int) -> np.ndarray:
    """The inner points x_i [points], m."""
    return np.arange(1, points + 1) * (geometry.length / (points + 1))


def grid_window(geometry: Geometry, points: int, window: Shape = None) -> np.ndarray:
    """The contact's weights h ĝ(x_i - x0) at the inner points [points], of sum 1.

    Parameters
    ----------
    window : weights at the inner points [points], or a function of x - x0, m, which is cut off beyond ± width/2;
        neither need be normalised. A raised cosine by default.

    Raises
    ------
    ParameterError
        If no point lies in the window, or a weight is negative or not finite.
    """
    if window is None or callable(window):
        shape = window or (lambda x: 1 + np.cos(2 * np.pi * x / geometry.width))
        x = grid_points(geometry, points) - geometry.strike
        inside = np.abs(x) < geometry.width / 2
        weights = np.zeros(points)
        weights[inside] = shape(x[inside])
    else:
        weights = np.array(window, float)
    if weights.shape != (points,) or not np.all(np.isfinite(weights)) or weights.min() < 0:
        raise ParameterError(f"window of shape {weights.shape} must be {points} finite weights, none below 0")
    if weights.sum() == 0:
        raise ParameterError(
            f"points={points}: none lies under the window, {geometry.width} m wide around {geometry.strike} m; "
            "use more points or a wider window"
        )
    return weights / weights.sum()


def second_difference(points: int, h: float):
    """D₂, sparse [points, points] (eq. 17); the ends are at rest."""
    return _diagonals([1.0, -2.0, 1.0], points) / h**2


def fourth_difference(points: int, h: float):
    """D₄, sparse [points, points] (eq. 18); the virtual nodes y₋₁ = -y₁ and y_(N+2) = -y_N are the hinges."""
    virtual = np.zeros(points)
    virtual[[0, -1]] = -1.0
    return (_diagonals([1.0, -4.0, 6.0, -4.0, 1.0], points) + scipy.sparse.diags_array(virtual)) / h**4


def _diagonals(weights: list[float], points: int):
    half = len(weights) // 2
    # A range, like a list, is what SciPy takes; its annotation says int.
    offsets: Any = range(-half, half + 1)
    return scipy.sparse.diags_array(weights, offsets=offsets, shape=(points, points))


def stiffness(string: String, second, fourth):
    """K/m, 1/s²: minus what the displacements do in eq. 10."""
    return string.kappa**2 * fourth - string.c**2 * second


def losses(string: String, second, one):
    """R/m, 1/s: minus what the velocities do in eq. 10."""
    return 2 * string.b1 * one - 2 * string.b2 * second


def compression_row(weights: np.ndarray, hammer: int) -> np.ndarray:
    """b [size]: y_H - y_s, where the paper prints y_s - y_H."""
    return np.insert(-weights, hammer, 1.0)


def assemble(string: String, hammer: Hammer, geometry: Geometry, step: float, weights: np.ndarray) -> Scheme:
    """The scheme for a contact of these weights [points]."""
    points, a = weights.size, step / 2
    h, point_mass = geometry.length / (points + 1), geometry.mass / (points + 1)
    row = round(float(weights @ np.arange(1, points + 1)))
    second, fourth, one = (
        _beside_hammer(x, row)
        for x in (second_difference(points, h), fourth_difference(points, h), scipy.sparse.eye_array(points))
    )
    string_mass = point_mass * one.diagonal()
    mass = scipy.sparse.diags_array(np.where(string_mass > 0, string_mass, hammer.M_H))
    K, R = point_mass * stiffness(string, second, fourth), point_mass * losses(string, second, one)
    b = compression_row(weights, row)
    implicit = (mass + a * R + a**2 * K).tocsr()
    struck = np.flatnonzero(b)
    bands = 1 + max(3, int(struck[-1] - struck[0]))
    free = _bands(implicit.diagonal, bands, b.size)
    contact = _bands(lambda offset: b[-offset:] * b[: b.size + offset], bands, b.size)
    return Scheme(
        half_step=a,
        hammer=row,
        string_mass=string_mass,
        second=second,
        fourth=fourth,
        pull=K.tocsr(),
        explicit=(mass - a * R - a**2 * K).tocsr(),
        implicit=implicit,
        press=b,
        pickup=np.insert(_pickup(geometry, points), row, 0.0),
        free_bands=free,
        contact_bands=contact,
        free_factor=cholesky_banded(free, lower=True),
    )


def elastic_pull(scheme: Scheme, string: String, state: State) -> np.ndarray:
    """K y [size], N, from the differences that the state carries."""
    return scheme.string_mass * stiffness(string, state.second, state.fourth)


def _beside_hammer(matrix, row: int):
    """A matrix of the string [points, points] with an empty row and column for the hammer [size, size]."""
    points = matrix.shape[0]
    strung = np.delete(np.arange(points + 1), row)
    onto = scipy.sparse.csr_array((np.ones(points), (strung, np.arange(points))), shape=(points + 1, points))
    return (onto @ matrix @ onto.T).tocsr()


def _bands(diagonal: Callable[[int], np.ndarray], bands: int, size: int) -> np.ndarray:
    """SciPy's storage of a symmetric matrix of half-width `bands` - 1: `diagonal(-i)` [size - i] is row i."""
    stored = np.zeros((bands, size))
    for i in range(min(bands, size)):
        stored[i, : size - i] = diagonal(-i)
    return stored


def _pickup(geometry: Geometry, points: int) -> np.ndarray:
    """The row [points] that reads x_m: a point of the grid itself, and between points the sines through all of them."""
    k = np.pi * np.arange(1, points + 1)
    sines = np.sin(np.outer(k, np.arange(1, points + 1)) / (points + 1))
    return np.sin(k * (geometry.pickup / geometry.length)) @ sines * (2 / (points + 1))
