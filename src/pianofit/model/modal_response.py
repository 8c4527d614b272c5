"""The modal response of a key: the measured transfer from the hammer force to the file, and its decays and beats.

    sound(t) = g F(t) ∗ (Re Σ_m a_m(v) P_m e^{p_m t} + knock(t))

Poles p, patterns P (one complex number per mode and channel) and the knock belong to the key and do not depend on
velocity. The knock is a short kernel with all that is not a mode: the thump of soundboard and key, and the sound below
the lowest partial. F is the force of a stroke, from string, hammer and felt. The velocity gain a, one complex number
per mode, is the change with velocity v beyond the change that the force explains. It is 1 where the force explains all.
A pluck is an impulse of the size of its static force, so its response is that to the release of 1 N: units of N s below
are then N.

The energy of a partial's modes without their interference, Σ |P_m|² exp(2 Re p_m t) over modes and channels, falls
smoothly, first at the rate of the fast modes and then at that of the slow ones. Interference adds the beats.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import numpy as np

from ..conversions import BEATING_DB, DB
from ..dsp.damped_sums import sum_damped_modes, z_transform_at_poles
from ..dsp.filters import convolve, resample
from ..felt import law_of
from ..io.number_format import summary
from .output_path import at_velocity
from .simulate import Simulation

# The knock may begin this long before the contact, s: onsets are detected a little late.
PRE_ONSET_S = 0.012
# Longest knock after the contact, s. With 0.4, 0.6 and 0.8 s, the mean distance of 13 left-out layers is 2.41, 2.18 and
# 2.10 dB (`benchmarks/realism.py`), and the speed of a dense piece 1, 0.97 and 0.87 (`benchmarks/resonance.py`).
KNOCK_SECONDS = 0.6
# Samples before and after a force that a band-limited force extends over: the reach of the resampling filter.
FILTER_REACH = 10
# Steps per sample to which a force is interpolated if its own step does not divide a sample.
INTERPOLATION_STEPS = 8
# Keys whose static corrections stay cached.
CACHED_KEYS = 88
# The correction of a mode ends where it has decayed by exp of this.
MAX_DECAY_EXPONENT = 35.0
# Intervals of the two decay times, s after the contact: before and after the bend of most decays.
EARLY, LATE = (0.05, 0.5), (1.0, 3.0)
# Beats are evaluated while a partial is within this many dB of its level at the start of `EARLY`.
BEAT_RANGE = 60.0
# Step of the envelope, s: modes of one partial lie closer together than 100 Hz.
ENVELOPE_STEP = 0.002


class ForcePulse(NamedTuple):
    """Force of a stroke from the first touch on. A pluck has the impulse of its release, see `excitation.pluck`."""

    force: np.ndarray  # N; of a pluck N/s [steps]
    step: float  # s
    velocity: float  # size of the stroke: hammer velocity, m/s, or static force, N

    def __repr__(self) -> str:
        return summary(self)

    def drive(self, pole: np.ndarray) -> np.ndarray:
        """∫ F e^{-pole t} dt, N s, complex [modes]: the excitation of the modes."""
        return np.exp(-np.outer(pole, self.step * np.arange(len(self.force)))) @ self.force * self.step

    def samples(self, rate: int) -> int:
        """Duration in whole samples at `rate`, Hz."""
        return max(int(np.ceil(len(self.force) * self.step * rate - 1e-6)), 1)

    def at(self, rate: int) -> np.ndarray:
        """Band-limited impulse per sample at `rate`, N s [samples], from `FILTER_REACH` samples before the touch."""
        ratio = round(1 / (self.step * rate))
        if ratio < 1 or abs(ratio * self.step * rate - 1) > 1e-6:
            step = 1 / (INTERPOLATION_STEPS * rate)
            fine = np.arange(0, len(self.force) * self.step, step)
            newton = np.interp(fine, self.step * np.arange(len(self.force)), self.force)
            # Interpolation changes the area of a pulse of one step, as of a pluck.
            newton *= self.force.sum() * self.step / (newton.sum() * step) if newton.sum() else 1.0
            return ForcePulse(newton, step, self.velocity).at(rate)
        edge = FILTER_REACH * ratio
        return resample(np.pad(self.force, (edge, edge)), ratio, 1) / rate


def force_pulse(stroke: Simulation, hammer: Any) -> ForcePulse:
    """Return the force of a simulated stroke by this hammer, or of a pluck."""
    law, step = law_of(hammer), float(stroke.modes.step)
    size = float(getattr(hammer, law.size))
    if not law.has_contact:
        return release_pulse(size, step)
    return ForcePulse(trim_trailing_zeros(np.asarray(stroke.pulse.force)), step, size)


def release_pulse(force: float, step: float) -> ForcePulse:
    """Return the pulse of a pluck with this static force, N: an impulse of that size, in one step, s."""
    return ForcePulse(np.array([force / step]), step, force)


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

    partial: np.ndarray  # partial of each mode, int [modes]
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

    def scale_partials(self, factor: np.ndarray) -> ModalResponse:
        """Return the response with the amplitudes of partial k times `factor[k - 1]` [partials]."""
        return self._replace(pattern=self.pattern * factor[np.maximum(self.partial, 1) - 1])

    def without_knock(self) -> ModalResponse:
        """Return the response with an empty knock."""
        return self._replace(knock=self.knock[:, :0])

    def at(self, rate: int) -> ModalResponse:
        """Return the response for files of another rate: a resampled knock, and the modes below half of `rate`."""
        if rate == self.rate:
            return self
        below, part = np.imag(self.pole) < np.pi * rate, self.velocity_gain
        columns = (self.partial[below], self.pole[below], self.pole_error[below], self.pattern[:, below])
        knock = self.knock
        if knock.shape[-1]:
            knock = resample(self.continuous_knock(), self.rate, rate)
            knock[:, round(PRE_ONSET_S * rate) :][:, :1] -= 0.5 * np.real(columns[3].sum(axis=1, keepdims=True))
        return ModalResponse(
            *columns, knock, rate, None if part is None else part._replace(factor=part.factor[:, below])
        )

    def continuous_knock(self) -> np.ndarray:
        """Return the knock as a part of a response that is continuous in time, for other rates [channels, samples].

        A sum of modes jumps at the touch. Its first sample is the value after the jump, half of the jump more than the
        mean of both sides, which represents a jump. The knock cancels this excess at its own rate.
        """
        knock = self.knock.copy()
        knock[:, round(PRE_ONSET_S * self.rate) :][:, :1] += 0.5 * np.real(self.pattern.sum(axis=1, keepdims=True))
        return knock

    def attack_noise(self, velocity: float) -> np.ndarray:
        """Return the knock of a stroke, per unit of its force [channels, samples]."""
        lead, part, changes = round(PRE_ONSET_S * self.rate), self.velocity_gain, self.knock_changes()
        if part is None or not changes.size:
            return self.knock
        out = self.knock.copy()
        out[:, lead : lead + changes.shape[-1]] += at_velocity(part.velocity, changes, velocity)
        return out

    def knock_changes(self) -> np.ndarray:
        """Return what the strokes of the velocity gain add to the knock, from the touch [strokes, channels, samples].

        The knock cancels the static deflection of the modes at a velocity gain of 1. At another gain this deflection
        changes, and so does its cancellation.
        """
        lead, part = round(PRE_ONSET_S * self.rate), self.velocity_gain
        if part is None or self.knock.shape[-1] <= lead:
            return np.zeros((0, self.channels, 0))
        excess = self.pattern * (part.factor[:, None] - 1)
        size = min(int(np.ceil(MAX_DECAY_EXPONENT * self.rate / np.abs(self.pole).min())), self.knock.shape[-1] - lead)
        return _static_corrections(self.pole.tobytes(), excess.tobytes(), excess.shape, self.rate, size)

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
        rate, pulse = self.rate, force.at(self.rate)
        begin = round(PRE_ONSET_S * rate) - FILTER_REACH  # of the pulse in the sound
        until = end + FILTER_REACH  # samples from the begin of the pulse to `end`
        size, log_z = max(len(pulse), until), self.pole / rate
        part = 1.0 if self.velocity_gain is None else self.velocity_gain.at(force.velocity)
        state = part * np.exp(log_z * (until - (len(pulse) - 1))) * z_transform_at_poles(log_z, pulse[::-1])
        onset = np.zeros((self.channels, max(begin + size, self.knock.shape[-1] + len(pulse) - 1 - FILTER_REACH)))
        head = onset[:, begin : begin + size]
        driven = sum_damped_modes(self.pole, self.pattern * part, rate, size)
        head += convolve(driven, pulse)[:, :size]
        # A band-limited force extends past `end`, where the free decay is added separately.
        head[:, until:] -= sum_damped_modes(self.pole, self.pattern * state, rate, size - until)
        if self.knock.shape[-1]:
            knock = convolve(self.attack_noise(force.velocity), pulse)[:, FILTER_REACH:]
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


class PartialDecay(NamedTuple):
    """Decay and beating of one partial of a key."""

    number: int  # k
    frequency: float  # of its strongest mode, Hz
    modes: int  # number of its modes
    early: float  # T60 of its energy over `EARLY`, s; NaN where its modes' errors exceed the decay
    late: float  # the same over `LATE`, s
    beat_frequency: float  # of the two modes that interfere most, Hz; NaN if none beat by 1.5 dB before `LATE` ends
    beat_depth: float  # from the lowest to the highest effect of interference, dB; NaN without beats
    error: tuple[float, float]  # smallest and largest standard error of its poles (real or imaginary part), 1/s


def decays_and_beats(response: ModalResponse) -> list[PartialDecay]:
    """Compute decay and beating of each partial, in order, after an impulse that drives all its modes alike."""
    return [_decay(response, int(number)) for number in np.unique(response.partial)]


def _decay(response: ModalResponse, number: int) -> PartialDecay:
    chosen = response.partial == number
    pole, pattern, error = response.pole[chosen], response.pattern[:, chosen], response.pole_error[chosen]
    rate, power = -np.real(pole), np.sum(np.abs(pattern) ** 2, axis=0)
    strongest = np.argmax(power * -np.expm1(-2 * rate * LATE[1]) / rate)  # by energy up to the end of `LATE`
    centre = float(np.imag(pole[strongest]))
    early, late = (_t60(rate, error, power, *interval) for interval in (EARLY, LATE))
    errors = (float(error.min()), float(error.max()))
    return PartialDecay(
        number, centre / (2 * np.pi), len(pole), early, late, *_beats(pole - 1j * centre, pattern), errors
    )


def _energy(rate: np.ndarray, power: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Energy without interference, dB [time]."""
    exponent = np.log(power) - 2 * np.outer(time, rate)
    return DB / 2 * np.logaddexp.reduce(exponent, axis=1)


def _t60(rate: np.ndarray, error: np.ndarray, power: np.ndarray, start: float, stop: float) -> float:
    """T60 of the least-squares line through the energy, s; NaN if the decay is within one standard error of zero."""
    time = np.arange(start, stop, ENVELOPE_STEP)
    share = power * np.exp(-(start + stop) * rate)
    share = share / share.sum()
    if np.hypot.reduce(share * error) >= share @ rate:
        return float("nan")
    return -60 / float(np.polyfit(time, _energy(rate, power, time), 1)[0])


def _beats(pole: np.ndarray, pattern: np.ndarray) -> tuple[float, float]:
    """Frequency, Hz, and depth, dB, of the beats of modes with these poles [modes] and patterns [channels, modes]."""
    spacing = np.abs(np.subtract.outer(np.imag(pole), np.imag(pole))) / (2 * np.pi)
    if spacing.max() < 1 / LATE[1]:
        return np.nan, np.nan
    time = np.arange(EARLY[0], LATE[1], ENVELOPE_STEP)
    smooth = _energy(-np.real(pole), np.sum(np.abs(pattern) ** 2, axis=0), time)
    shape = np.exp(np.outer(pole, time))
    whole = 10 * np.log10(np.maximum(np.sum(np.abs(pattern @ shape) ** 2, axis=0), 1e-300))
    depth = np.ptp((whole - smooth)[smooth > smooth[0] - BEAT_RANGE])
    if depth < BEATING_DB:
        return np.nan, np.nan
    # Interference of each two modes relative to the energy of all, averaged over time.
    share = np.abs(shape) @ (np.abs(shape) / 10 ** (smooth / 10)).T
    common = np.abs(pattern.conj().T @ pattern) * share * (spacing >= 1 / LATE[1])
    return float(spacing.flat[np.argmax(common)]), float(depth)
