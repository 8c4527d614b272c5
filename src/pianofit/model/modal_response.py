"""The modal response of a key: the measured transfer from the hammer force to the file, one per key.

    sound(t) = g F(t) ∗ (Re Σ_m a_m(v) P_m e^{p_m t} + knock(t))

Poles p, patterns P (one complex number per mode and channel) and the knock belong to the key and do not depend on
velocity. The knock is a short kernel with all that is not a mode: the thump of soundboard and key, and the sound below
the lowest partial. F is the force of a stroke, from string, hammer and felt. The velocity gain a, one complex number
per mode, is the change with velocity v beyond the change that the force explains. It is 1 where the force explains all.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
from scipy.signal import oaconvolve, resample_poly

from ..dsp.damped_sums import sum_damped_modes, z_transform_at_poles
from ..dsp.filters import resample
from ..io.number_format import summary
from .output_path import at_velocity
from .simulate import Simulation

__all__ = [
    "FILTER_REACH",
    "PRE_ONSET_S",
    "ForcePulse",
    "VelocityGain",
    "ModalResponse",
    "force_pulse",
    "cancel_static_deflection",
    "trim_trailing_zeros",
]

# The knock may begin this long before the contact, s: onsets are detected a little late.
PRE_ONSET_S = 0.012
# Samples before and after a force that a band-limited force extends over: the reach of the resampling filter.
FILTER_REACH = 10
# Steps per sample to which a force is interpolated if its own step does not divide a sample.
INTERPOLATION_STEPS = 8
# Keys whose static corrections stay cached.
CACHED_KEYS = 88
# The correction of a mode ends where it has decayed by exp of this.
MAX_DECAY_EXPONENT = 35.0


class ForcePulse(NamedTuple):
    """Force of a stroke from the first touch on."""

    force: np.ndarray  # [steps]
    step: float  # s
    velocity: float  # hammer velocity, m/s

    def __repr__(self) -> str:
        return summary(self)

    def drive(self, pole: np.ndarray) -> np.ndarray:
        """∫ F e^{-pole t} dt, N s, complex [modes]: the excitation of the modes."""
        return np.exp(-np.outer(pole, self.step * np.arange(len(self.force)))) @ self.force * self.step

    def samples(self, rate: int) -> int:
        """Duration in whole samples at `rate`, Hz."""
        return max(int(np.ceil(len(self.force) * self.step * rate - 1e-6)), 1)

    def at(self, rate: int) -> np.ndarray:
        """Band-limited impulse per sample at `rate`, N s [samples], from `EDGE` samples before the touch."""
        ratio = round(1 / (self.step * rate))
        if ratio < 1 or abs(ratio * self.step * rate - 1) > 1e-6:
            step = 1 / (INTERPOLATION_STEPS * rate)
            fine = np.arange(0, len(self.force) * self.step, step)
            newton = np.interp(fine, self.step * np.arange(len(self.force)), self.force)
            return ForcePulse(newton, step, self.velocity).at(rate)
        edge = FILTER_REACH * ratio
        return resample_poly(np.pad(self.force, (edge, edge)), 1, ratio) / rate


def force_pulse(stroke: Simulation, velocity: float) -> ForcePulse:
    """Return the force of a simulated stroke with this hammer velocity, m/s."""
    return ForcePulse(trim_trailing_zeros(np.asarray(stroke.pulse.force)), float(stroke.modes.step), velocity)


def trim_trailing_zeros(pulse: np.ndarray) -> np.ndarray:
    """Return a pulse [steps] without the zeros at its end."""
    return pulse[: np.flatnonzero(pulse)[-1] + 1] if pulse.any() else pulse[:1]


class VelocityGain(NamedTuple):
    """Velocity gain of the modes of a key: measured excitation over the excitation that the force explains."""

    velocity: np.ndarray  # of the strokes, m/s, ascending [strokes]
    factor: np.ndarray  # a, complex [strokes, modes]

    def __repr__(self) -> str:
        return summary(self)

    def at(self, velocity: float) -> np.ndarray:
        """Interpolate the gain by `at_velocity`, complex [modes]."""
        return at_velocity(self.velocity, self.factor, velocity)

    def scale_velocity(self, ratio: float) -> VelocityGain:
        """Return the gain with all velocities times `ratio`, for another velocity scale."""
        return self._replace(velocity=ratio * self.velocity)


class ModalResponse(NamedTuple):
    """Response of a key from the force on its strings to the file: modes and knock."""

    number: np.ndarray  # partial of each mode, int [modes]
    pole: np.ndarray  # 1/s, complex [modes]
    pole_error: np.ndarray  # standard error of real and imaginary part, 1/s [modes]
    pattern: np.ndarray  # P, file units per N s, complex [channels, modes]
    knock: np.ndarray  # file units per N s [channels, samples], from `PRE_ONSET_S` before the contact; can be empty
    rate: int  # of the knock, Hz
    velocity_gain: VelocityGain | None = None  # velocity gain a; None is 1

    def __repr__(self) -> str:
        return summary(self)

    @property
    def channels(self) -> int:
        """Number of channels."""
        return len(self.pattern)

    def scale_gain(self, gain: float) -> ModalResponse:
        """Return the response times `gain`."""
        return self._replace(pattern=gain * self.pattern, knock=gain * self.knock)

    def scale_pitch(self, ratio: float) -> ModalResponse:
        """Return the response with all frequencies times `ratio`."""
        return self._replace(pole=np.real(self.pole) + 1j * ratio * np.imag(self.pole))

    def scale_velocity(self, ratio: float) -> ModalResponse:
        """Return the response with all velocities times `ratio`, for another velocity scale."""
        part = self.velocity_gain
        return self if part is None else self._replace(velocity_gain=part.scale_velocity(ratio))

    def without_knock(self) -> ModalResponse:
        """Return the response with an empty knock."""
        return self._replace(knock=self.knock[:, :0])

    def at(self, rate: int) -> ModalResponse:
        """Return the response for files of another rate: a resampled knock, and the modes below half of `rate`."""
        below = np.imag(self.pole) < np.pi * rate
        columns = (self.number[below], self.pole[below], self.pole_error[below], self.pattern[:, below])
        knock = self.knock
        if knock.shape[-1]:
            knock = resample(knock, self.rate, rate)
        part = self.velocity_gain
        part = None if part is None else part._replace(factor=part.factor[:, below])
        return ModalResponse(*columns, knock, rate, part)

    def attack_noise(self, velocity: float) -> np.ndarray:
        """Return the knock of a stroke, per unit of its force [channels, samples].

        The knock cancels the static deflection of the modes at a velocity gain of 1. At another gain this deflection
        changes, so its cancellation is corrected here.
        """
        lead, part = round(PRE_ONSET_S * self.rate), self.velocity_gain
        if part is None or self.knock.shape[-1] <= lead:
            return self.knock
        excess = self.pattern * (part.factor[:, None] - 1)
        size = min(int(np.ceil(MAX_DECAY_EXPONENT * self.rate / np.abs(self.pole).min())), self.knock.shape[-1] - lead)
        corrections = _static_corrections(self.pole.tobytes(), excess.tobytes(), excess.shape, self.rate, size)
        out = self.knock.copy()
        out[:, lead : lead + size] += at_velocity(part.velocity, corrections, velocity)
        return out

    def strike_response(self, force: ForcePulse, end: int) -> tuple[np.ndarray, np.ndarray]:
        """Compute the state of the modes after a stroke, and the sound up to then, at the `rate` of this response.

        Parameters
        ----------
        end : samples from the first touch to the free decay of the modes; at least the duration of the force.

        Returns
        -------
        Excitation of each mode at `end`, N s, complex [modes]; the amplitudes are `pattern` times it. And the sound
        [channels, samples] from `PRE_ONSET_S` before the touch: the knock, and the modes up to `end`.
        """
        rate, lead = self.rate, round(PRE_ONSET_S * self.rate)
        pulse = force.at(rate)
        size = max(len(pulse), end + FILTER_REACH)
        log_z, remaining = (
            self.pole / rate,
            end + FILTER_REACH - (len(pulse) - 1),
        )  # samples from the end of the pulse to `end`
        part = 1.0 if self.velocity_gain is None else self.velocity_gain.at(force.velocity)
        state = part * np.exp(log_z * remaining) * z_transform_at_poles(log_z, pulse[::-1])
        onset = np.zeros(
            (self.channels, max(lead - FILTER_REACH + size, self.knock.shape[-1] + len(pulse) - 1 - FILTER_REACH))
        )
        head = onset[:, lead - FILTER_REACH : lead - FILTER_REACH + size]
        driven = sum_damped_modes(self.pole, self.pattern * part, rate, size)
        head += oaconvolve(driven, pulse[None], axes=-1)[:, :size]
        # A band-limited force extends past `end`, where the free decay is added separately.
        head[:, end + FILTER_REACH :] -= sum_damped_modes(
            self.pole, self.pattern * state, rate, size - end - FILTER_REACH
        )
        if self.knock.shape[-1]:
            knock = oaconvolve(self.attack_noise(force.velocity), pulse[None], axes=-1)[:, FILTER_REACH:]
            onset[:, : knock.shape[-1]] += knock
        return state, onset

    def sound(self, force: ForcePulse, rate: int, count: int) -> np.ndarray:
        """Compute a stroke in file units [channels, count], from `PRE_ONSET_S` before the first touch.

        During the force the modes are convolved with it. Afterwards they decay in closed form.
        """
        response = self.at(rate)
        end = force.samples(rate)
        state, onset = response.strike_response(force, end)
        begin = round(PRE_ONSET_S * rate) + end
        out = np.pad(onset, ((0, 0), (0, max(count - onset.shape[-1], 0))))[:, :count]
        out[:, begin:] += sum_damped_modes(response.pole, response.pattern * state, rate, max(count - begin, 0))
        return out


def cancel_static_deflection(pole: np.ndarray, amplitude: np.ndarray, rate: float, count: int) -> np.ndarray:
    """Return the correction of Re Σ amplitude z^n that removes the static deflection [channels, count].

    A slow force displaces high modes quasi-statically. This part is inaudible and is removed: a mode radiates by its
    acceleration. The factor ((1 - ζ)/(1 - q ζ))², divided by its value at the pole, multiplies 1/(1 - z ζ). Then the
    response to a constant force is zero, the residue of the mode is unchanged, and a double real pole q, as fast as
    the mode, is added.
    """
    fast = -np.abs(pole)
    z, q = np.exp(pole / rate), np.exp(fast / rate)
    scale = ((1 - q / z) / (1 - 1 / z)) ** 2
    double = scale * (1 - 1 / q) ** 2 / (1 - z / q)
    single = sum_damped_modes(fast, amplitude * (scale - 1 - double), rate, count)
    return single + np.arange(1, count + 1) * sum_damped_modes(fast, amplitude * double, rate, count)


@functools.lru_cache(maxsize=CACHED_KEYS)
def _static_corrections(pole: bytes, amplitude: bytes, shape: tuple[int, ...], rate: int, count: int) -> np.ndarray:
    """`cancel_static_deflection` [strokes, channels, count] of amplitudes of `shape`, arrays given as bytes."""
    modes, rows = np.frombuffer(pole, complex), np.frombuffer(amplitude, complex).reshape(-1, shape[-1])
    corrections = cancel_static_deflection(modes, rows, rate, count).reshape(*shape[:-1], count)
    corrections.flags.writeable = False
    return corrections
