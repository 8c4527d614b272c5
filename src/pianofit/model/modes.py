"""A string is a table of modes.

With hinged ends the sines `sin(β_k x)`, `β_k = kπ/L`, are exact eigenfunctions of every term of the string's equation.
This holds on the continuous string and on the paper's finite-difference grid. So a string is a table with one row per
mode, and the two differ only in the numbers of the rows. Each row is stepped by Crank-Nicolson (paper eq. 16); with
`a = δt/2` and `T^n = F^n + F^(n-1)`:

    D = 1 + 2aα + a²ω²     v ← [(1 - 2aα - a²ω²) v - 2aω² q]/D + (aγ/D) T     q ← q + a (v_old + v_new)

Crank-Nicolson flattens high partials. The `continuous` table corrects this by prewarping: with its frequencies and
decay rates the scheme has exactly the poles of the continuous string.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from ..errors import ParameterError
from ..io.number_format import summary
from ..parameters import Geometry, String
from ..x64 import AnyArray, derivative, float64

__all__ = ["QUANTITIES", "Modes", "mode_frequencies", "mode_table", "project", "window_weights"]

QUANTITIES = ("velocity", "displacement", "bridge-force", "pressure")

# A mode at or above this fraction of the contact rate has weight zero: prewarping would distort it too much.
MAX_RELATIVE_FREQUENCY = 0.4
# With α = b1 + b2 β² a high mode could be overdamped. Such a mode is inaudible, and its α/ω is limited to this.
MAX_DAMPING_RATIO = 0.9


class Modes(NamedTuple):
    """The table of modes, one row per mode. Rows above `HIGHEST` have weight zero. Units: SI."""

    omega2: Float[Array, " modes"]  # the scheme's ω̃², 1/s²
    alpha: Float[Array, " modes"]  # the scheme's α̃, 1/s
    strike: Float[Array, " modes"]  # Φ_k = ∫ ĝ sin(β_k x) dx
    modal_gain: Float[Array, " modes"]  # γ̃_k, 1/kg
    pickup: Complex[Array, " modes"]  # signal = Re(pickup · C z^n) for a displacement q = Re(C z^n)
    pole: Complex[Array, " modes"]  # p, where z = exp(p δt) is the pole of the scheme, 1/s
    free_rate: Complex[Array, " modes"]  # v = Re(free_rate · C z^n) in free motion, 1/s
    free_pickup: Complex[Array, " modes"]  # the pickup for free motion, without gain correction
    step: Float[Array, ""]  # δt, s

    def __repr__(self) -> str:
        return summary(self)


def mode_frequencies(string: String, length: float, n_modes: int) -> np.ndarray:
    """Undamped frequencies of the continuous string, Hz [modes]: k f0 √(1 + B k²)."""
    beta2 = (np.arange(1, n_modes + 1) * (np.pi / length)) ** 2
    return np.sqrt(string.c**2 * beta2 + string.kappa**2 * beta2**2) / (2 * np.pi)


def raised_cosine_weights(geometry: Geometry, n_modes: int, xp=jnp) -> Float[AnyArray, " modes"]:
    """Φ_k of the default window, ĝ = (1 + cos(2π(x - x0)/width))/width within ± width/2, in closed form.

    `xp` is the array library: with NumPy nothing is compiled.
    """
    k = xp.arange(1, n_modes + 1)
    return (_window_transform if xp is np else _weights)(
        xp.array([geometry.strike_position, geometry.width, geometry.length], float), k
    )


def _window_transform(at: AnyArray, k: AnyArray, xp=np) -> AnyArray:
    strike, width, length = at
    s = k * width / (2 * length)  # sinc(s) is sin(πs)/(πs)
    return xp.sin(k * (xp.pi / length) * strike) * (xp.sinc(s) + 0.5 * xp.sinc(s + 1) + 0.5 * xp.sinc(s - 1))


@jax.custom_jvp
def _weights(at: AnyArray, k: AnyArray) -> AnyArray:
    return _window_transform(at, k, jnp)


@_weights.defjvp
@derivative
def _weights_jvp(primal, tangents):
    # A matrix product with the Jacobian: in a sum XLA would compute all these sines again for every direction.
    at, k = primal
    jacobian = jax.vmap(lambda unit: jax.jvp(lambda x: _window_transform(x, k, jnp), (at,), (unit,))[1])(jnp.eye(3))
    return _weights(at, k), tangents[0] @ jacobian


@float64
def window_weights(window: Callable, geometry: Geometry, n_modes: int) -> Float[Array, " modes"]:
    """Φ_k of any contact window.

    Parameters
    ----------
    window : g(x - x0), not negative, within ± width/2, metres; neither normalised nor smooth is required.
    """
    # Composite Gauss-Legendre, 16 nodes on each of 64 cells: kinks and jumps fall within single cells.
    nodes, weights = np.polynomial.legendre.leggauss(16)
    edges = jnp.linspace(-0.5, 0.5, 65) * geometry.width
    half = (edges[1:] - edges[:-1]) / 2
    x = ((edges[1:] + edges[:-1])[:, None] / 2 + half[:, None] * nodes).ravel()
    g = jnp.asarray(window(x)) * (half[:, None] * weights).ravel()
    beta = jnp.arange(1, n_modes + 1) * (jnp.pi / geometry.length)
    return jnp.sin(beta[:, None] * (geometry.strike_position + x)) @ g / g.sum()


@float64
def project(shape: Callable | np.ndarray, length: float, n_modes: int) -> Float[Array, " modes"]:
    """Modal coordinates of an initial shape or velocity: y(x) = Σ q_k sin(β_k x).

    Parameters
    ----------
    shape : a function of x in metres, or its values [points] at the inner points x_i = i L/(points + 1).

    Raises
    ------
    ParameterError
        If there are fewer points than modes.
    """
    if callable(shape):
        points = max(4095, 8 * n_modes - 1)
        shape = np.asarray(shape(np.arange(1, points + 1) * (length / (points + 1))))
    values = jnp.asarray(shape)
    if values.shape[0] < n_modes:
        raise ParameterError(f"shape has {values.shape[0]} points; {n_modes} modes need at least as many")
    i = jnp.arange(1, values.shape[0] + 1) / (values.shape[0] + 1)
    return jnp.sin(jnp.pi * jnp.arange(1, n_modes + 1)[:, None] * i) @ values * (2 / (values.shape[0] + 1))


@float64
def mode_table(
    string: String,
    geometry: Geometry,
    *,
    rate: float | AnyArray,
    n_modes: int,
    quantity: str = "velocity",
    kind: str = "continuous",
    strike_weights: Float[AnyArray, " modes"] | None = None,
) -> Modes:
    """Compute the table of modes of a string with its strike and pickup positions, one row per mode.

    Parameters
    ----------
    string, geometry : in SI units; see `String` and `Geometry`.
    rate : steps per second of the contact, Hz.
    n_modes : rows; for `finite_difference` also the N points of the paper's grid, h = L/(N + 1).
    quantity : measured quantity: `velocity` or `displacement` at the pickup, or the `bridge-force` at x = L.
        `pressure` is the bridge force before an unknown output path.
    kind : `continuous` (prewarped) or `finite_difference` (paper eq. 16-18, unchanged).
    strike_weights : Φ_k [modes] of another contact window than the default, from `pianofit.model.window_weights`.

    Returns
    -------
    `Modes`, a pytree of arrays [modes]. Modes at or above 0.4 of `rate` have weight zero; a note needs some 30 below.

    Raises
    ------
    ParameterError
        For an unknown `quantity` or `kind`, and if traced in float32 (`x64`).

    Examples
    --------
    >>> import pianofit
    >>> it = pianofit.preset("bensa-final")
    >>> modes = pianofit.mode_table(it.string, it.geometry, rate=88_200.0, n_modes=64, quantity="bridge-force")
    >>> modes.pole.shape, str(modes.pole.dtype)
    ((64,), 'complex128')
    """
    if quantity not in QUANTITIES:
        raise ParameterError(f"quantity={quantity!r} must be one of {', '.join(QUANTITIES)}")
    if kind not in ("continuous", "finite_difference"):
        raise ParameterError(f"kind={kind!r} must be continuous or finite_difference")
    step = jnp.asarray(1.0 / rate)
    k = jnp.arange(1, n_modes + 1)
    beta = k * (jnp.pi / geometry.length)
    if kind == "continuous":
        eigen = beta**2
        weights = raised_cosine_weights(geometry, n_modes)
    else:
        h = geometry.length / (n_modes + 1)
        eigen = (2 / h * jnp.sin(beta * h / 2)) ** 2
        weights = _grid_weights(geometry, n_modes)
    weights = weights if strike_weights is None else strike_weights
    if weights.shape != (n_modes,):
        raise ParameterError(f"strike_weights has the shape {weights.shape} and must be [modes], ({n_modes},)")
    omega2 = string.c**2 * eigen + string.kappa**2 * eigen**2
    alpha = jnp.minimum(string.b1 + string.b2 * eigen, MAX_DAMPING_RATIO * jnp.sqrt(omega2))
    if kind == "continuous":
        weights = jnp.where(jnp.sqrt(omega2) * step < 2 * jnp.pi * MAX_RELATIVE_FREQUENCY, weights, 0.0)
    pickup, of_displacement = _pickup(string, geometry, beta, quantity)
    return _rows(omega2, alpha, weights, pickup, of_displacement, geometry.mass, step, prewarp=kind == "continuous")


def _grid_weights(geometry: Geometry, n: int) -> Float[Array, " modes"]:
    """Φ_k of the default window sampled on the paper's grid and normalised there."""
    x = jnp.arange(1, n + 1) * (geometry.length / (n + 1))
    inside = jnp.abs(x - geometry.strike_position) < geometry.width / 2
    g = jnp.where(inside, 1 + jnp.cos(2 * jnp.pi * (x - geometry.strike_position) / geometry.width), 0.0)
    return jnp.sin(jnp.arange(1, n + 1)[:, None] * (jnp.pi / geometry.length) * x) @ g / g.sum()


def _pickup(string: String, geometry: Geometry, beta: AnyArray, quantity: str) -> tuple[Array, bool]:
    """Return ψ_k, and true if it applies to the displacement, false if to the velocity."""
    if quantity in ("velocity", "displacement"):
        return jnp.sin(beta * geometry.pickup), quantity == "displacement"
    sign = jnp.where(jnp.arange(beta.shape[0]) % 2 == 0, 1.0, -1.0)
    tension = (string.c**2 * beta + string.kappa**2 * beta**3) * geometry.mass / geometry.length
    return tension * sign, True


def _rows(omega2, alpha, weights, pickup_weights, reads_displacement: bool, mass, step, *, prewarp: bool) -> Modes:
    """Compute the rows of the scheme for modes of ω², decay rate α, strike weight Φ and pickup weight ψ."""
    a = step / 2
    drive = 2 * weights / mass
    pole = -alpha + 1j * jnp.sqrt(omega2 - alpha**2)
    if prewarp:
        # Rows above HIGHEST have weight zero; the limit keeps their tangent finite.
        limit = MAX_RELATIVE_FREQUENCY * jnp.pi
        angle = jnp.minimum(jnp.sqrt(omega2) * a, limit)
        warped = jnp.tanh(pole * (a * angle / (jnp.sqrt(omega2) * a))) / a
        tilde2, alpha_tilde = jnp.abs(warped) ** 2, -warped.real
        drive = drive * tilde2 / omega2  # keeps the static compliance, on which the contact depends
        gain = angle / (jnp.sin(angle) * jnp.cos(angle)) if reads_displacement else (angle / jnp.sin(angle)) ** 2
        free_rate = pole
    else:
        tilde2, alpha_tilde, gain = omega2, alpha, jnp.ones_like(omega2)
        warped = free_rate = pole
        # log((1 + ap)/(1 - ap)), in a form whose real part is exactly zero without losses.
        below = (1 + a * alpha) ** 2 + a**2 * (omega2 - alpha**2)
        turn = jnp.arctan2(2 * a * warped.imag, 1 - a**2 * omega2)
        pole = (0.5 * jnp.log1p(-4 * a * alpha / below) + 1j * turn) / step
    pickup = pickup_weights * gain * (jnp.ones_like(warped) if reads_displacement else warped)
    free_pickup = pickup_weights * (jnp.ones_like(warped) if reads_displacement else free_rate)
    return Modes(tilde2, alpha_tilde, weights, drive, pickup, pole, free_rate, free_pickup, step)
