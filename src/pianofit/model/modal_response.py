"""How a note rings: what lies between the hammer's force and the file, measured once a key.

    sound(t) = g F(t) ∗ (Re Σ_m a_m(v) P_m e^{p_m t} + knock(t))

Poles p, patterns P (one complex number a mode and channel) and the knock are the key's and the same at every velocity.
The knock is a short kernel that holds what no mode does: the soundboard's and the key's own thump, and what lies below
the lowest partial. F is the force of a stroke, from string, hammer and felt; the participation a, one complex number a
mode that is 1 where the force says all, is what strokes of velocity v show beyond it.
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np
from scipy.signal import oaconvolve, resample_poly

from ..dsp.damped_powers import powers
from ..io.number_format import summary
from .output_path import at_velocity
from .simulate import Simulation

__all__ = [
    "EDGE",
    "FAINT",
    "PRE_ONSET_S",
    "ForcePulse",
    "VelocityGain",
    "ModalResponse",
    "force_of",
    "resampled",
    "sum_damped_modes",
    "cancel_static_deflection",
    "z_transform_at_poles",
    "until_last",
]

# The knock may begin so long before the contact, s: an onset is found a little late.
PRE_ONSET_S = 0.012
# Samples before a force's touch and after its end that a band-limited one needs: so far the resampling filter reaches.
EDGE = 10
# Steps a sample of a force whose own step is no whole part of one.
FINE = 8
# Modes so far below the loudest at its begin, amplitude, are left out: -160 dB.
FAINT = 1e-8
# Blocks of time at once, between looks at what still sounds.
CHUNK = 32
# Samples of a block: more would not stay in a processor's cache.
LARGEST_BLOCK = 512
# Sets of modes whose powers are kept: a key that is played rings from event to event, free and damped, and its string
# is struck at the contact's rate.
KEPT = 4
# Keys of which is kept what silences their strokes.
KEYS = 88
# The push of a mode is followed until it has decayed by exp of this.
SILENT = 35.0


class ForcePulse(NamedTuple):
    """A stroke's force, from the first touch on."""

    newton: np.ndarray  # [steps]
    step: float  # s
    velocity: float  # of the hammer, m/s

    def __repr__(self) -> str:
        return summary(self)

    def drive(self, pole: np.ndarray) -> np.ndarray:
        """∫ F e^{-pole t} dt, N s, complex [modes]: how far a stroke sets modes ringing."""
        return np.exp(-np.outer(pole, self.step * np.arange(len(self.newton)))) @ self.newton * self.step

    def samples(self, rate: int) -> int:
        """How long it lasts at `rate`, in whole samples."""
        return max(int(np.ceil(len(self.newton) * self.step * rate - 1e-6)), 1)

    def at(self, rate: int) -> np.ndarray:
        """The impulse of every sample at `rate`, N s [samples], band-limited, from `EDGE` samples before the touch."""
        by = round(1 / (self.step * rate))
        if by < 1 or abs(by * self.step * rate - 1) > 1e-6:
            step = 1 / (FINE * rate)
            fine = np.arange(0, len(self.newton) * self.step, step)
            newton = np.interp(fine, self.step * np.arange(len(self.newton)), self.newton)
            return ForcePulse(newton, step, self.velocity).at(rate)
        edge = EDGE * by
        return resample_poly(np.pad(self.newton, (edge, edge)), 1, by) / rate


def force_of(stroke: Simulation, velocity: float) -> ForcePulse:
    """The force of a stroke on the string, by a hammer of this velocity, m/s."""
    return ForcePulse(until_last(np.asarray(stroke.pulse.force)), float(stroke.modes.step), velocity)


def until_last(pulse: np.ndarray) -> np.ndarray:
    """A pulse [steps] without the zeros at its end."""
    return pulse[: np.flatnonzero(pulse)[-1] + 1] if pulse.any() else pulse[:1]


class VelocityGain(NamedTuple):
    """How far strokes of known velocities set a key's modes ringing, over what their forces say."""

    velocity: np.ndarray  # of the strokes, m/s, rising [strokes]
    factor: np.ndarray  # a, complex [strokes, modes]

    def __repr__(self) -> str:
        return summary(self)

    def at(self, velocity: float) -> np.ndarray:
        """As `at_velocity` has it between strokes, complex [modes]."""
        return at_velocity(self.velocity, self.factor, velocity)

    def scale_velocity(self, ratio: float) -> VelocityGain:
        """The same strokes with velocities times `ratio`, where their scale is another."""
        return self._replace(velocity=ratio * self.velocity)


class ModalResponse(NamedTuple):
    """What lies between the force on a key's strings and the file."""

    number: np.ndarray  # int, partial of each mode [modes]
    pole: np.ndarray  # 1/s, complex [modes]
    pole_error: np.ndarray  # standard error of its real and imaginary part, 1/s [modes]
    pattern: np.ndarray  # P, file units over N s, complex [channels, modes]
    knock: np.ndarray  # file units over N s [channels, samples] at `rate`, from `LEAD` before the contact; can be empty
    rate: int  # of the knock, Hz
    participation: VelocityGain | None = None  # a; where there is none, the force says all

    def __repr__(self) -> str:
        return summary(self)

    @property
    def channels(self) -> int:
        """How many."""
        return len(self.pattern)

    def scale_gain(self, gain: float) -> ModalResponse:
        """The same key through another gain."""
        return self._replace(pattern=gain * self.pattern, knock=gain * self.knock)

    def scale_pitch(self, ratio: float) -> ModalResponse:
        """The same key with all frequencies times `ratio`."""
        return self._replace(pole=np.real(self.pole) + 1j * ratio * np.imag(self.pole))

    def scale_velocity(self, ratio: float) -> ModalResponse:
        """The same key with all velocities times `ratio`, where their scale is another."""
        part = self.participation
        return self if part is None else self._replace(participation=part.scale_velocity(ratio))

    def without_knock(self) -> ModalResponse:
        """The modes alone."""
        return self._replace(knock=self.knock[:, :0])

    def at(self, rate: int) -> ModalResponse:
        """The same for files of another rate: the knock sampled there, and the modes below half of it."""
        below = np.imag(self.pole) < np.pi * rate
        columns = (self.number[below], self.pole[below], self.pole_error[below], self.pattern[:, below])
        knock = self.knock
        if knock.shape[-1]:
            knock = resampled(knock, self.rate, rate)
        part = self.participation
        part = None if part is None else part._replace(factor=part.factor[:, below])
        return ModalResponse(*columns, knock, rate, part)

    def attack_noise(self, velocity: float) -> np.ndarray:
        """What a stroke makes heard beside its modes, over its force: the knock [channels, samples].

        The knock silences the push of the modes as the pattern has them. What a stroke has more of them, or less,
        pushes as much more or less.
        """
        lead, part = round(PRE_ONSET_S * self.rate), self.participation
        if part is None or self.knock.shape[-1] <= lead:
            return self.knock
        more = self.pattern * (part.factor[:, None] - 1)
        size = min(int(np.ceil(SILENT * self.rate / np.abs(self.pole).min())), self.knock.shape[-1] - lead)
        pushes = _pushes(self.pole.tobytes(), more.tobytes(), more.shape, self.rate, size)
        out = self.knock.copy()
        out[:, lead : lead + size] += at_velocity(part.velocity, pushes, velocity)
        return out

    def strike_response(self, force: ForcePulse, end: int) -> tuple[np.ndarray, np.ndarray]:
        """What a stroke leaves ringing, and what else of it is heard, at the own `rate`.

        Parameters
        ----------
        end : samples after the first touch, no fewer than the force lasts, from which on the modes ring by themselves.

        Returns
        -------
        How far the stroke has set each mode ringing at `end`, N s, complex [modes]: then `pattern` times it rings. And
        the sound [channels, samples], from `LEAD` before the touch, of knock and modes while the force lasts.
        """
        rate, lead = self.rate, round(PRE_ONSET_S * self.rate)
        pulse = force.at(rate)
        size = max(len(pulse), end + EDGE)
        log_z, last = self.pole / rate, end + EDGE - (len(pulse) - 1)  # samples from the pulse's last one to `end`
        part = 1.0 if self.participation is None else self.participation.at(force.velocity)
        state = part * np.exp(log_z * last) * z_transform_at_poles(log_z, pulse[::-1])
        onset = np.zeros((self.channels, max(lead - EDGE + size, self.knock.shape[-1] + len(pulse) - 1 - EDGE)))
        head = onset[:, lead - EDGE : lead - EDGE + size]
        driven = sum_damped_modes(self.pole, self.pattern * part, rate, size)
        head += oaconvolve(driven, pulse[None], axes=-1)[:, :size]
        # A band-limited force goes on for some samples, in which the modes already ring.
        head[:, end + EDGE :] -= sum_damped_modes(self.pole, self.pattern * state, rate, size - end - EDGE)
        if self.knock.shape[-1]:
            knock = oaconvolve(self.attack_noise(force.velocity), pulse[None], axes=-1)[:, EDGE:]
            onset[:, : knock.shape[-1]] += knock
        return state, onset

    def sound(self, force: ForcePulse, rate: int, count: int) -> np.ndarray:
        """A stroke in file units [channels, count], from `LEAD` before its first touch.

        While the force lasts, modes are convolved with it; afterwards they ring in closed form.
        """
        own = self.at(rate)
        end = force.samples(rate)
        state, onset = own.strike_response(force, end)
        begin = round(PRE_ONSET_S * rate) + end
        out = np.pad(onset, ((0, 0), (0, max(count - onset.shape[-1], 0))))[:, :count]
        out[:, begin:] += sum_damped_modes(own.pole, own.pattern * state, rate, max(count - begin, 0))
        return out


def resampled(x: np.ndarray, old: int, new: int) -> np.ndarray:
    """A sound of the rate `old` [..., samples] at the rate `new`, Hz."""
    by = math.gcd(old, new)
    return x if new == old else resample_poly(x, new // by, old // by, axis=-1)


def sum_damped_modes(
    pole: np.ndarray, amplitude: np.ndarray, rate: float, count: int, audibility_threshold: np.ndarray | None = None
) -> np.ndarray:
    """Re Σ amplitude exp(pole t), [channels, count], of amplitudes [channels, modes] that decay.

    Time is cut into blocks: a block's begin times the way through a block is one matrix product.

    Parameters
    ----------
    faint : amplitudes below which modes are left out [modes]; `FAINT` times the largest by default.
    """
    out = np.zeros((len(amplitude), count))
    if not (count and amplitude.size):
        return out
    block = min(1 << int(np.ceil(np.log2(np.sqrt(count)))), LARGEST_BLOCK)
    blocks = min(-(-count // block), CHUNK)
    audibility_threshold = (
        np.full(len(pole), FAINT * np.abs(amplitude).max()) if audibility_threshold is None else audibility_threshold
    )
    inside = _inside(np.asarray(pole / rate, complex).tobytes())
    begins = powers(pole * (block / rate), blocks + 1)  # [modes, blocks and the next chunk's first]
    for first in range(0, count, blocks * block):
        loud = (np.abs(amplitude) > audibility_threshold).any(axis=0)
        if not loud.any():
            break
        if not loud.all():
            pole, amplitude, audibility_threshold = pole[loud], amplitude[:, loud], audibility_threshold[loud]
            inside, begins = inside[loud, :, :block], begins[loud]
        here = out[:, first : first + blocks * block]
        starts = amplitude[:, None] * begins[:, :-1].T
        within = inside.reshape(-1, inside.shape[-1])[:, :block]
        rows = np.ascontiguousarray(starts).view(float) @ within
        here[:] = rows.reshape(len(amplitude), -1)[:, : here.shape[-1]]
        amplitude = amplitude * begins[:, -1]
    return out


def cancel_static_deflection(pole: np.ndarray, amplitude: np.ndarray, rate: float, count: int) -> np.ndarray:
    """What is added to Re Σ amplitude z^n, lest a push that holds modes aside be heard [channels, count].

    A slow force holds a mode of higher frequency aside by as much as it pushes. What is heard of a mode is its
    acceleration: with ((1 - ζ)/(1 - q ζ))², over its value at the pole, as a factor to 1/(1 - z ζ), a constant force is
    silent, the mode's residue stays, and a double real pole q, as fast as the mode, is added.
    """
    fast = -np.abs(pole)
    z, q = np.exp(pole / rate), np.exp(fast / rate)
    scale = ((1 - q / z) / (1 - 1 / z)) ** 2
    double = scale * (1 - 1 / q) ** 2 / (1 - z / q)
    once = sum_damped_modes(fast, amplitude * (scale - 1 - double), rate, count)
    return once + np.arange(1, count + 1) * sum_damped_modes(fast, amplitude * double, rate, count)


def z_transform_at_poles(log_z: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """Σ_n x_n z^n, complex [modes]."""
    rows = np.pad(samples, (0, -len(samples) % LARGEST_BLOCK)).reshape(-1, LARGEST_BLOCK)
    real, imag = np.moveaxis(_inside(np.asarray(log_z, complex).tobytes()) @ rows.T, 1, 0)  # [modes, blocks]
    return ((real - 1j * imag) * powers(log_z * LARGEST_BLOCK, len(rows))).sum(axis=1)


@functools.lru_cache(maxsize=KEYS)
def _pushes(pole: bytes, amplitude: bytes, shape: tuple[int, ...], rate: int, count: int) -> np.ndarray:
    """What silences amplitudes of this shape [strokes, channels, modes] [strokes, channels, count], of bytes."""
    modes, rows = np.frombuffer(pole, complex), np.frombuffer(amplitude, complex).reshape(-1, shape[-1])
    found = cancel_static_deflection(modes, rows, rate, count).reshape(*shape[:-1], count)
    found.flags.writeable = False
    return found


@functools.lru_cache(maxsize=KEPT)
def _inside(log_z: bytes) -> np.ndarray:
    """Real part and negative imaginary part of z^n, n < LARGEST_BLOCK [modes, 2, steps], of logarithms as bytes."""
    z = powers(np.frombuffer(log_z, complex), LARGEST_BLOCK)
    found = np.stack([np.real(z), -np.imag(z)], axis=1)
    found.flags.writeable = False
    return found
