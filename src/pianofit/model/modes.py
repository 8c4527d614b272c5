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
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Complex, Float

from ..errors import ParameterError
from ..io.number_format import summary
from ..parameters import Geometry, String
from ..transducer import QUANTITIES, TRANSDUCERS
from ..x64 import AnyArray, derivative, float64

# One number per mode, in results and in arguments, which may be arrays of NumPy too.
RealModes = Float[Array, " modes"]
ComplexModes = Complex[Array, " modes"]
RealModesLike = Float[AnyArray, " modes"]
ComplexModesLike = Complex[AnyArray, " modes"]

# A mode at or above this fraction of the contact rate has weight zero: prewarping would distort it too much.
MAX_RELATIVE_FREQUENCY = 0.4
# With α = b1 + b2 β² a high mode could be overdamped. Such a mode is inaudible, and its α/ω is limited to this.
MAX_DAMPING_RATIO = 0.9


class Modes(NamedTuple):
    """The table of modes, one row per mode, from `mode_table`. Units: SI."""

    omega2: RealModes  # the scheme's ω̃², 1/s²
    alpha: RealModes  # the scheme's α̃, 1/s
    strike: RealModes  # Φ_k = ∫ ĝ sin(β_k x) dx; zero at and above 0.4 of the contact rate
    modal_gain: RealModes  # γ̃_k, 1/kg
    pickup: ComplexModes  # signal = Re(pickup · C z^n) for a displacement q = Re(C z^n)
    pole: ComplexModes  # p, where z = exp(p δt) is the pole of the scheme, 1/s
    free_rate: ComplexModes  # v = Re(free_rate · C z^n) in free motion, 1/s
    free_pickup: ComplexModes  # the pickup for free motion, without gain correction
    step: Float[Array, ""]  # δt, s

    def __repr__(self) -> str:
        return summary(self)


def mode_frequencies(string: String, length: float, n_modes: int) -> np.ndarray:
    """Undamped frequencies of the continuous string, Hz [modes]: k f0 √(1 + B k²)."""
    beta2 = (np.arange(1, n_modes + 1) * (np.pi / length)) ** 2
    return np.sqrt(string.c**2 * beta2 + string.kappa**2 * beta2**2) / (2 * np.pi)


def raised_cosine_weights(geometry: Geometry, n_modes: int, xp=jnp) -> RealModesLike:
    """Φ_k of the default window, ĝ = (1 + cos(2π(x - x0)/width))/width within ± width/2, in closed form.

    `xp` is the array library: with NumPy nothing is compiled.
    """
    at = xp.array([geometry.strike_position, geometry.width, geometry.length], float)
    k = xp.arange(1, n_modes + 1)
    return _window_transform(at, k, np) if xp is np else _weights(at, k)


def _window_transform(at: AnyArray, k: AnyArray, xp: Any) -> AnyArray:
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
    return _weights(at, k), tangents[0] @ jax.jacfwd(_window_transform)(at, k, jnp).T


@float64
def window_weights(window: Callable, geometry: Geometry, n_modes: int) -> RealModes:
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
def mode_table(
    string: String,
    geometry: Geometry,
    *,
    rate: float | AnyArray,
    n_modes: int,
    quantity: str = "velocity",
    kind: str = "continuous",
    strike_weights: RealModesLike | None = None,
) -> Modes:
    """Compute the table of modes of a string with its strike and pickup positions, one row per mode.

    Parameters
    ----------
    string, geometry : in SI units; see `String` and `Geometry`.
    rate : steps per second of the contact, Hz.
    n_modes : rows; for `finite_difference` also the N points of the paper's grid, h = L/(N + 1).
    quantity : measured quantity: `velocity` or `displacement` at the pickup, or the `bridge-force` at x = L.
        `pressure` is the bridge force before an unknown output path, and `magnetic-pickup` the velocity before one.
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
    if not isinstance(rate, Tracer) and not rate > 0:
        raise ParameterError(f"rate={rate} Hz must be above 0")
    if not isinstance(geometry.length, Tracer) and not geometry.length > 0:
        raise ParameterError(f"length={geometry.length} m must be above 0")
    prewarp = kind == "continuous"
    step = jnp.asarray(1.0 / rate)
    beta = jnp.arange(1, n_modes + 1) * (jnp.pi / geometry.length)
    if prewarp:
        eigen, weights = beta**2, raised_cosine_weights(geometry, n_modes)
    else:
        h = geometry.length / (n_modes + 1)
        eigen, weights = (2 / h * jnp.sin(beta * h / 2)) ** 2, _grid_weights(geometry, n_modes)
    weights = weights if strike_weights is None else strike_weights
    if weights.shape != (n_modes,):
        raise ParameterError(f"strike_weights has the shape {weights.shape} and must be [modes], ({n_modes},)")
    omega2 = string.c**2 * eigen + string.kappa**2 * eigen**2
    alpha = jnp.minimum(string.b1 + string.b2 * eigen, MAX_DAMPING_RATIO * jnp.sqrt(omega2))
    if prewarp:
        weights = jnp.where(jnp.sqrt(omega2) * step < 2 * jnp.pi * MAX_RELATIVE_FREQUENCY, weights, 0.0)
    transducer = TRANSDUCERS[quantity]
    if transducer.on_string:
        pickup = jnp.sin(beta * geometry.pickup)
    else:
        sign = jnp.where(jnp.arange(n_modes) % 2 == 0, 1.0, -1.0)
        pickup = (string.c**2 * beta + string.kappa**2 * beta**3) * geometry.mass / geometry.length * sign
    return _rows(omega2, alpha, weights, pickup, not transducer.reads_velocity, geometry.mass, step, prewarp)


def _grid_weights(geometry: Geometry, n: int) -> RealModes:
    """Φ_k of the default window sampled on the paper's grid and normalised there."""
    x = jnp.arange(1, n + 1) * (geometry.length / (n + 1))
    inside = jnp.abs(x - geometry.strike_position) < geometry.width / 2
    g = jnp.where(inside, 1 + jnp.cos(2 * jnp.pi * (x - geometry.strike_position) / geometry.width), 0.0)
    return jnp.sin(jnp.arange(1, n + 1)[:, None] * (jnp.pi / geometry.length) * x) @ g / g.sum()


def _rows(omega2, alpha, weights, pickup, reads_displacement: bool, mass, step, prewarp: bool) -> Modes:
    """Compute the rows of the scheme for modes of ω², decay rate α, strike weight Φ and pickup weight ψ."""
    a = step / 2
    modal_gain = 2 * weights / mass
    pole = free_rate = -alpha + 1j * jnp.sqrt(omega2 - alpha**2)
    if prewarp:
        # Rows at and above 0.4 of the rate have weight zero; the limit keeps their tangent finite.
        angle = jnp.minimum(jnp.sqrt(omega2) * a, MAX_RELATIVE_FREQUENCY * jnp.pi)
        scheme_rate = jnp.tanh(pole * (a * angle / (jnp.sqrt(omega2) * a))) / a
        scheme2, scheme_alpha = jnp.abs(scheme_rate) ** 2, -scheme_rate.real
        modal_gain = modal_gain * scheme2 / omega2  # keeps the static compliance, on which the contact depends
        gain = angle / (jnp.sin(angle) * jnp.cos(angle)) if reads_displacement else (angle / jnp.sin(angle)) ** 2
    else:
        scheme_rate, scheme2, scheme_alpha, gain = pole, omega2, alpha, 1.0
        # log((1 + ap)/(1 - ap)), in a form whose real part is exactly zero without losses.
        below = (1 + a * alpha) ** 2 + a**2 * (omega2 - alpha**2)
        turn = jnp.arctan2(2 * a * pole.imag, 1 - a**2 * omega2)
        pole = (0.5 * jnp.log1p(-4 * a * alpha / below) + 1j * turn) / step
    rates = (jnp.ones_like(pole),) * 2 if reads_displacement else (scheme_rate, free_rate)
    driven, free = pickup * gain * rates[0], pickup * rates[1]
    return Modes(scheme2, scheme_alpha, weights, modal_gain, driven, pole, free_rate, free, step)
