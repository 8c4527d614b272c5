"""A strike as it sounds in a file: through gain and path, and where in the file it was."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from .criterion import WIDEST_SIGMA, OutputPath
from .model import Simulation, simulate
from .parameters import Geometry, Hammer, MemoryHammer, String
from .recording import Recording, find_onset

__all__ = ["Voice", "arrival", "convolved", "impulse", "lag", "placed", "strike_voice", "through", "touched"]

# How much of an attack, s, is played to see where it begins, with how much noise before it, of which the recording
# should have at least so much.
ATTACK, BEFORE, HEARD = 0.15, 0.05, 0.02
# A path's response is computed for at least this long, s, and its first half kept: some periods of the lowest note,
# since its neighbours may differ in level.
RESPONSE = 1.0
# A long sound goes through a filter in blocks of about so many times the filter's length.
MOST_BLOCKS = 7


class Voice(NamedTuple):
    """Everything between a set of parameters and a file's samples."""

    string: String
    hammer: Hammer | MemoryHammer
    geometry: Geometry
    quantity: str
    gain: float  # file units (full scale = 1) per unit of the pickup
    path: OutputPath | None  # dB over frequency, beside the gain

    def play(self, rate: float, samples: int, touch: int = 0) -> tuple[np.ndarray, Simulation]:
        """The sound [samples] in file units, and the strike behind it; the hammer touches the string at `touch`."""
        simulation = strike_voice(self, rate)
        return self.heard(simulation, rate, samples, touch), simulation

    def heard(self, strike: Simulation, rate: float, samples: int, touch: int = 0) -> np.ndarray:
        """A strike of this voice in file units [samples].

        The index `touch` may lie before the first sample: then the sound is cut. A stiff string is heard long before
        its main wave arrives, so only what begins at the touch begins with silence.
        """
        path, pole = through(self.path, np.asarray(strike.modes.pole))
        own = strike.modes._replace(pickup=np.asarray(strike.modes.pickup) * self.gain, pole=pole)
        sound = strike._replace(modes=own).waveform(rate, max(samples - touch, 0))
        sound = convolved(sound, impulse(path, rate))[: len(sound)]
        return np.pad(sound[max(-touch, 0) :], (max(touch, 0), 0))[:samples]


def touched(voice: Voice, strike: Simulation, recording: Recording) -> int:
    """The index at which the hammer touched, if the strike, in the recording's noise, is first seen at its onset.

    High partials run ahead of a stiff string's main wave, and how much of that is seen is a matter of the noise: the
    recording's own before the onset, or else white noise of one seed.
    """
    rate, onset = recording.rate, recording.onset
    attack, before = recording.samples[onset:][: round(ATTACK * rate)], round(BEFORE * rate)
    sound = voice.heard(strike, rate, len(attack))
    sound = np.pad(sound * np.abs(attack).max() / max(np.abs(sound).max(), 1e-300), (before, 0))
    noise = recording.samples[: max(onset - round(0.001 * rate), 0)]
    if len(noise) < HEARD * rate or noise.std() < 0.5 * recording.noise_rms:
        noise = np.random.default_rng(0).normal(0.0, recording.noise_rms, len(sound))
    seen = find_onset(np.resize(np.append(noise, noise[::-1]), len(sound)) + sound, rate, 0.0)
    return onset - max(seen - before, 0)


def through(path: OutputPath | None, pole: np.ndarray) -> tuple[OutputPath | None, np.ndarray]:
    """What a path makes of modes of complex `pole`, 1/s [modes]: the filter they go through, and their poles.

    Every partial has a level of its own, which is the filter's, and a decay of its own, at which its energy on the
    damped circle, where the criterion hears it, stays what it was.
    """
    if path is None:
        return None, pole
    frequency, law = np.abs(pole) / (2 * np.pi), -np.real(pole)  # ascending, however damped
    own = law * path.decay_at(frequency)
    held = 10 * np.log10((WIDEST_SIGMA + own) / (WIDEST_SIGMA + law))
    return OutputPath(frequency, path.at(frequency) + held), -own + 1j * np.imag(pole)


def impulse(path: OutputPath | None, rate: float) -> np.ndarray | None:
    """A path's response to an impulse [samples] at `rate`, of the least phase that its levels allow.

    Levels tell no phases, but a path hears nothing before it sounds. While the hammer holds the string down, modes
    follow it far below their own frequencies, so no factor on each mode can stand for this filter. From one of the
    path's partials to the next it leads by a smooth step: about each it is level, as a partial's line has a width. So
    it is below the lowest and above the highest, where nothing is known.
    """
    if path is None:
        return None
    size = 2 ** math.ceil(math.log2(RESPONSE * rate))
    order, frequency = np.arange(len(path.frequency)), np.fft.rfftfreq(size, 1 / rate)
    before, between = np.divmod(np.interp(frequency, path.frequency, order), 1.0)
    step = before + between**2 * (3 - 2 * between)
    level = math.log(10) / 20 * np.interp(step, order, path.db)
    # The cepstrum of a causal response with a causal inverse is causal (Oppenheim and Schafer).
    cepstrum = np.fft.irfft(level, size)
    cepstrum[1 : size // 2] *= 2
    cepstrum[size // 2 + 1 :] = 0
    return np.fft.irfft(np.exp(np.fft.rfft(cepstrum)), size)[: size // 2]


def convolved(sound: np.ndarray, response: np.ndarray | None) -> np.ndarray:
    """The sound [samples] through a filter, and what the filter rings on; block by block, so that memory is bounded."""
    if response is None or not len(sound):
        return sound
    size = 2 ** math.ceil(math.log2(len(response) + min(len(sound), MOST_BLOCKS * len(response))))
    spectrum, step = np.fft.rfft(response, size), size - len(response) + 1
    out = np.zeros(len(sound) + len(response) - 1)
    for at in range(0, len(sound), step):
        piece = np.fft.irfft(np.fft.rfft(sound[at : at + step], size) * spectrum, size)
        out[at : at + size] += piece[: len(out) - at]
    return out


def strike_voice(voice: Voice, rate: float) -> Simulation:
    """The strike, with the contact at a multiple of `rate`."""
    return simulate(voice.string, voice.hammer, voice.geometry, rate=rate, quantity=voice.quantity)


def lag(model: np.ndarray, sound: np.ndarray) -> float:
    """By how many samples, to a hundredth, `sound` has to be shifted back to lie on `model`; both [samples]."""
    size = 2 ** int(np.ceil(np.log2(2 * len(model))))
    fine = 16
    cross = np.fft.rfft(sound, size) * np.fft.rfft(model, size).conj()
    peaks = np.fft.irfft(cross, fine * size)
    at = int(np.argmax(peaks))
    before, top, after = peaks[at - 1], peaks[at], peaks[(at + 1) % len(peaks)]
    place = at + 0.5 * (before - after) / (before - 2 * top + after)
    return float((place if place < len(peaks) / 2 else place - len(peaks)) / fine)


def placed(model: np.ndarray, sound: np.ndarray) -> tuple[int, float]:
    """Where in the longer `sound` the `model` leaves the least behind, both [samples] in one unit, and its sign there.

    Unlike the peak of a correlation this counts the silence before an attack: a note that lies one period late leaves
    its first period behind. The sign is -1 for a pickup of the other polarity.
    """
    energy = np.concatenate([[0.0], np.cumsum(sound**2)])
    size = 2 ** int(np.ceil(np.log2(len(sound))))
    cross = np.fft.irfft(np.fft.rfft(sound, size) * np.fft.rfft(model, size).conj(), size)
    cross = cross[: len(sound) - len(model) + 1]
    at = int(np.argmin(energy[len(model) :] - energy[: -len(model)] - 2 * np.abs(cross)))
    return at, float(np.sign(cross[at]))


def arrival(string: String, geometry: Geometry, quantity: str) -> float:
    """When the wave from the nearest edge of the contact window reaches the pickup, s after the first touch."""
    end = geometry.length if quantity in ("bridge-force", "pressure") else geometry.pickup
    return float(max(abs(end - geometry.strike) - geometry.width / 2, 0.0) / string.c)
