"""The response after the contact is in closed form.

A pulse `T` leaves each mode with a complex amplitude: the transform of the pulse at the pole of the mode, times the
response of the mode to a unit pulse. The waveform is the sum of these damped exponentials. On the damped circle
`ζ = exp(-(σ + jω)δt)` the spectrum is `Y = T̂(ζ) H(ζ)`, the transform of the pulse times the mobility from strike to
pickup. H depends on the string alone. Evaluation at σ > 0 is the same as multiplication of the signal by exp(-σt).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Complex, Float

from ..dsp.damped_sums import sum_damped_modes
from ..dsp.level import level_energy
from ..errors import ParameterError
from ..x64 import AnyArray, float64
from .contact import impulse_amplitude
from .differentiable_sums import sum_damped_exponentials, z_transform
from .free_motion import FreeMotion
from .modes import ComplexModes, ComplexModesLike, Modes, RealModesLike
from .program_cache import persistent_jit

# Largest exponent: exp of this, and its square, are finite.
MAX_EXPONENT = 300.0

# Values at frequencies, and values of the steps of a contact.
Frequencies = Float[AnyArray, " bins"]
ComplexBins = Complex[Array, " bins"]
Steps = Float[AnyArray, " steps"]


@float64
def damped_circle(frequency: Frequencies, sigma: float | AnyArray, step: AnyArray) -> ComplexBins:
    """ζ at frequencies in Hz [bins] and σ in 1/s."""
    return jnp.exp(-(sigma + 2j * jnp.pi * frequency) * step)


@float64
def mobility(modes: Modes, zeta: Complex[AnyArray, " bins"], amplitude: ComplexModesLike | None = None) -> ComplexBins:
    """H(ζ) = Σ_n h_n ζ^n of the response h to a unit `T` (or of free motion with modal `amplitude`), per step."""
    residue = modes.pickup * impulse_amplitude(modes) if amplitude is None else modes.free_pickup * amplitude
    return modal_transform(residue, modes.pole * modes.step, jnp.log(zeta))


@float64
def modal_transform(residue: AnyArray, log_z: AnyArray, log_zeta: AnyArray) -> Array:
    """Sum over modes of the transforms of Re(R_k z_k^n) at ζ; the last axis of `residue` and `log_z` is the modes.

    The transform of a mode is (Re R - Re(R z̄) ζ)/(1 - 2 Re z ζ + |z|² ζ²).
    """
    upper = jnp.real(residue) - jnp.real(residue * jnp.exp(log_z).conj()) * jnp.exp(log_zeta)[..., None]
    # (1 - zζ)(1 - z̄ζ) from z - 1 and ζ - 1, without cancellation.
    z_1, zeta_1 = jnp.expm1(log_z), jnp.expm1(log_zeta)[..., None]
    lower = (z_1 + zeta_1 + z_1 * zeta_1) * (z_1.conj() + zeta_1 + z_1.conj() * zeta_1)
    return (upper / lower).sum(axis=-1)


@float64
def spectrum(
    modes: Modes, drive: Steps, frequency: Frequencies, sigma: float | AnyArray, free: FreeMotion | None = None
) -> ComplexBins:
    """Y at `frequency`, Hz [bins], on the damped circle of `sigma`, 1/s: ∫ y exp(-(σ + jω)t) dt, signal unit · s.

    The width of every peak is σ/2π Hz: 30 1/s is broad and smooth, 3 1/s resolves partials that beat.

    Parameters
    ----------
    modes : the table, see `mode_table`.
    drive : of a pulse, N [steps], see `strike`.
    frequency : Hz [bins].
    sigma : 1/s.
    free : motion of the string itself, see `pluck`.

    Returns
    -------
    Y, complex, signal unit · s [bins].

    Raises
    ------
    ParameterError
        If it is traced in float32.

    Examples
    --------
    >>> import numpy as np, pianofit
    >>> it = pianofit.preset("bensa-final")
    >>> modes = pianofit.mode_table(it.string, it.geometry, rate=88_200.0, n_modes=64)
    >>> pulse = pianofit.strike(modes, it.hammer, steps=1024)
    >>> pianofit.spectrum(modes, pulse.drive, np.array([152.1, 228.0]), 30.0).shape
    (2,)
    """
    zeta = damped_circle(frequency, sigma, modes.step)
    total = z_transform(drive, jnp.log(zeta)) * mobility(modes, zeta)
    if free is not None:
        total = total + mobility(modes, zeta, free.amplitude)
    return total * modes.step


@float64
def modal_amplitudes(modes: Modes, drive: Steps, free: FreeMotion | None = None) -> ComplexModes:
    """A_k: after the contact the signal is Σ_k Re(A_k exp(p_k t)), t from the first touch."""
    total = modes.pickup * impulse_amplitude(modes) * z_transform(drive, _log_growth(modes, len(drive)))
    return total if free is None else total + modes.free_pickup * free.amplitude


def _log_growth(modes: Modes, steps: int) -> Array:
    """-p δt [modes], limited for modes that decay so fast that exp(-p t) would overflow within the contact."""
    log_zeta = -modes.pole * modes.step
    return jnp.minimum(log_zeta.real, MAX_EXPONENT / steps) + 1j * log_zeta.imag


@float64
def levels(modes: Modes, drive: Steps | None = None, *, free: FreeMotion | None = None) -> RealModesLike:
    """Levels of all partials after the contact, dB re (signal unit)² · s [modes], from pulse, free motion or both.

    A level is the energy in the first 0.35 s under exp(-8t), extrapolated to the first contact. Modes without weight
    have the smallest level, -3077 dB.

    Parameters
    ----------
    modes : the table, see `mode_table`.
    drive : of a pulse, N [steps], see `strike`.
    free : motion of the string itself, see `pluck`.

    Returns
    -------
    Levels, dB [modes].

    Raises
    ------
    ParameterError
        If it is traced in float32.

    Examples
    --------
    >>> import pianofit
    >>> it = pianofit.preset("bensa-final")
    >>> modes = pianofit.mode_table(it.string, it.geometry, rate=88_200.0, n_modes=64)
    >>> pianofit.levels(modes, pianofit.strike(modes, it.hammer, steps=1024).drive)[:3].round()
    array([-21., -24., -41.])
    """
    drive = jnp.zeros(1) if drive is None else jnp.asarray(drive)
    return level_db(modal_amplitudes(modes, drive, free), -modes.pole.real)


@float64
def level_db(amplitude: ComplexModesLike, decay: RealModesLike, xp=jnp) -> RealModesLike:
    """Energy of each damped partial Re(A exp(-αt + jωt)) in the first 0.35 s under exp(-8t), dB re unit² · s.

    `xp` is the array library: with NumPy nothing is compiled, and the result is an array of NumPy.
    """
    energy = 0.5 * xp.abs(amplitude) ** 2 * level_energy(2 * decay, xp)
    silent = energy <= (tiny := np.finfo(float).tiny)
    # The logarithm of 1 at silent modes: the derivative of log 0, times 0, would be NaN in reverse mode.
    return xp.where(silent, 10 * np.log10(tiny), 10 * xp.log10(xp.where(silent, 1.0, energy)))


@float64
def waveform(
    modes: Modes,
    drive: Steps | None = None,
    *,
    rate: float,
    samples: int,
    free: FreeMotion | None = None,
    oversampling: int | None = None,
) -> AnyArray:
    """The signal [samples] at `rate`, Hz, from the first contact on, in the pickup's unit.

    During the contact the pulse is convolved with the response of the string at the contact rate. The contact rate
    must be a whole multiple of `rate`. Afterwards the modes below half of `rate` ring freely. The function works under
    `jit`, `vmap` and `grad`.

    Parameters
    ----------
    modes : the table, see `mode_table`.
    drive : of a pulse, N [steps], see `strike`.
    rate : sample rate, Hz.
    samples : number of samples.
    free : motion of the string itself, see `pluck`.
    oversampling : steps of the contact per sample. The default is computed from `modes`; a traced table needs a value.

    Returns
    -------
    The signal [samples], in the pickup's unit: m/s, m or N.

    Raises
    ------
    ParameterError
        If the contact rate is not a whole multiple of `rate`, or the table is traced and `oversampling` not given.

    Examples
    --------
    >>> import pianofit
    >>> it = pianofit.preset("bensa-final")
    >>> modes = pianofit.mode_table(it.string, it.geometry, rate=88_200.0, n_modes=64)
    >>> pulse = pianofit.strike(modes, it.hammer, steps=1024)
    >>> pianofit.waveform(modes, pulse.drive, rate=44_100.0, samples=1000).shape
    (1000,)
    """
    ratio = _ratio(modes, rate, oversampling)
    drive = np.zeros(1) if drive is None else drive
    return sounding(modes.pole, drive, _pickup_amplitudes(modes, drive, free, None), ratio, rate, samples)


def sounding(pole: AnyArray, drive: AnyArray, amplitudes: Sequence[AnyArray], ratio: int, rate: float, samples: int):
    """The signal [samples] at `rate`, Hz, of modes with these poles, 1/s.

    Parameters
    ----------
    drive : of a pulse, N [steps], at the contact rate.
    amplitudes : as `pickup_amplitudes` returns them.
    ratio : steps of the contact per sample.
    """
    arrays = (pole, drive, *amplitudes)
    xp = jnp if any(isinstance(x, Tracer) for x in arrays) else np
    pole, drive, *amplitudes = map(xp.asarray, arrays)
    unit, amplitude, *release = (x * (xp.abs(xp.imag(pole)) < xp.pi * rate) for x in amplitudes)

    steps, log_z = len(drive), pole / (ratio * rate)
    convolved = xp.fft.rfft(_ring(unit, log_z, steps, xp), 2 * steps) * xp.fft.rfft(drive, 2 * steps)
    head = xp.fft.irfft(convolved, 2 * steps)[:steps]
    if release:
        head = head + _ring(release[0], log_z, steps, xp)
    head = head[::ratio][:samples]
    tail = _ring(amplitude * xp.exp(pole * (len(head) / rate)), pole / rate, samples - len(head), xp)
    return xp.concatenate([head, tail])


def _ratio(modes: Modes, rate: float, oversampling: int | None) -> int:
    """Steps of the contact per sample, from the table; from the argument if the table is traced."""
    if isinstance(modes.step, Tracer):
        if oversampling is None or oversampling < 1:
            raise ParameterError(
                f"oversampling={oversampling}: inside jax.jit the rate of the mode table is unknown; give the steps of "
                "the contact per sample, which are the rate of mode_table divided by the rate of waveform"
            )
        return oversampling
    contact = 1.0 / float(modes.step)
    ratio = round(contact / rate) if 0 < rate < math.inf else 0
    if ratio < 1 or abs(contact / rate - ratio) > 1e-6:
        raise ParameterError(f"rate={rate} Hz: the contact rate, {contact:g} Hz, must be a whole multiple of it")
    if oversampling not in (None, ratio):
        raise ParameterError(f"oversampling={oversampling}: the table has {ratio} steps per sample at rate={rate} Hz")
    return ratio


@persistent_jit
def _pickup_amplitudes(modes: Modes, drive: AnyArray, free: FreeMotion | None, _: None) -> tuple[Array, ...]:
    return pickup_amplitudes(modes, drive, free)


def pickup_amplitudes(modes: Modes, drive: AnyArray, free: FreeMotion | None = None) -> tuple[Array, ...]:
    """Amplitudes at the pickup after a unit `T` at step 0, after the whole pulse, and of `free` alone [modes]."""
    amplitudes = (modes.pickup * impulse_amplitude(modes), modal_amplitudes(modes, drive, free))
    return amplitudes if free is None else (*amplitudes, modes.free_pickup * free.amplitude)


def _ring(amplitude: AnyArray, log_z: AnyArray, samples: int, xp: Any) -> Any:
    """Σ_k Re(A_k z_k^n), n < samples."""
    samples = max(samples, 0)
    if xp is jnp:
        return sum_damped_exponentials(amplitude, log_z, samples)
    pole, pattern = np.asarray(log_z), np.asarray(amplitude)[None]
    return sum_damped_modes(pole, pattern, 1.0, samples, np.zeros(len(pole)))[0]
