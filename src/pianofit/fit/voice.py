"""A strike as it sounds in a file: through gain and path, aligned to the recording's onset."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..criterion import WIDEST_SIGMA, OutputPath
from ..model import Simulation, simulate
from ..parameters import Geometry, Hammer, MemoryHammer, String

__all__ = ["Voice", "arrival", "lag", "placed", "strike_voice", "through"]


class Voice(NamedTuple):
    """Everything between a set of parameters and a file's samples."""

    string: String
    hammer: Hammer | MemoryHammer
    geometry: Geometry
    quantity: str
    gain: float  # file units (full scale = 1) per unit of the pickup
    path: OutputPath | None  # dB over frequency, beside the gain

    def play(self, rate: float, samples: int, touch: int | None = None) -> tuple[np.ndarray, Simulation]:
        """The sound [samples] in file units, and the strike behind it.

        The hammer touches the string at index `touch`, which may lie before the first sample; by default the sound
        arrives at the first sample.
        """
        simulation = strike_voice(self, rate)
        factor, pole = through(self.path, np.asarray(simulation.modes.pole))
        factor = self.gain * factor
        heard = simulation.modes._replace(pickup=np.asarray(simulation.modes.pickup) * factor, pole=pole)
        first = -round(arrival(self.string, self.geometry, self.quantity) * rate) if touch is None else touch
        sound = simulation._replace(modes=heard).waveform(rate, samples - min(first, 0) - max(first, 0))
        return np.pad(sound[max(-first, 0) :], (max(first, 0), 0)), simulation


def through(path: OutputPath | None, pole: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What a path makes of modes of complex `pole`, 1/s [modes]: factors on their amplitudes, and their poles.

    Every partial has a level of its own, which goes into the pickup's weights, and a decay of its own, at which its
    energy on the damped circle, where the criterion hears it, stays what it was.
    """
    if path is None:
        return np.ones(len(pole)), pole
    frequency, law = np.abs(np.imag(pole)) / (2 * np.pi), -np.real(pole)
    own = law * path.decay_at(frequency)
    held = 10 * np.log10((WIDEST_SIGMA + own) / (WIDEST_SIGMA + law))
    return 10 ** ((path.at(frequency) + held) / 20), -own + 1j * np.imag(pole)


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
