"""Knocks of keys that were never recorded: their energy over frequency and time is interpolated between recorded keys.

The knock of a recorded key contains the part that cancels the static deflection of its modes. The rest is what
soundboard, frame and key sound like when the string is struck. Its energy in bands of frequency and frames of time,
per unit of the force of the hammer of the laws, is a smooth function of the key. The waveform is a mixture of those of
the two nearest recorded keys, scaled to this energy in every cell. A noise with drawn phases would have no sharp
beginning.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.signal import ShortTimeFFT

from ..model.modal_response import PRE_ONSET_S, ModalResponse, cancel_static_deflection
from .fields import FieldPoints, FieldShape, field_shape

# Duration of a knock after the contact, s, as that of a recorded one.
KNOCK_S = 0.4
# Window of the frames and their distance, s: a knock changes within some ten milliseconds.
WINDOW_S, HOP_S = 0.02, 0.005
# Edges of the bands, Hz: half octaves.
EDGES = 20.0 * 2 ** (np.arange(21) / 2)
# Range of the energies, dB below the loudest cell of the knock. Fainter cells are rounding.
RANGE = 80.0


class KnockFields(NamedTuple):
    """Knocks of the recorded keys."""

    keys: np.ndarray  # MIDI numbers [keys]
    rest: np.ndarray  # waveforms, file units per N s, from `PRE_ONSET_S` before the contact [keys, channels, samples]
    energy: np.ndarray  # dB [keys, channels, bands, frames]
    shape: FieldShape  # of the energy over frequency and key
    rate: int  # Hz

    def weights(self, midi: int) -> np.ndarray:
        """Weights of the recorded keys, after their mean was subtracted, in the energies of a key [keys]."""
        points = FieldPoints(np.zeros(len(self.keys)), self.keys, np.ones(len(self.keys)))
        return self.shape.weights(points, FieldPoints(np.zeros(1), np.array([float(midi)]), np.ones(1)))[0]


def static_part(response: ModalResponse) -> np.ndarray:
    """Return the knock that cancels the static deflection of the modes, and has no other sound [channels, samples]."""
    lead, count = round(PRE_ONSET_S * response.rate), round(KNOCK_S * response.rate)
    return np.pad(cancel_static_deflection(response.pole, response.pattern, response.rate, count), ((0, 0), (lead, 0)))


def measure_knocks(
    keys: np.ndarray, responses: list[ModalResponse], gains: np.ndarray, channels: int
) -> KnockFields | None:
    """Measure the knocks of recorded keys; None if none has a knock.

    Parameters
    ----------
    gains : gain of each key times the force of its own hammer over that of the laws [keys].
    channels : number of channels of the instrument.
    """
    if not all(response.knock.shape[-1] for response in responses):
        return None
    rate = max(response.rate for response in responses)
    rest = []
    for response, gain in zip(responses, gains, strict=True):
        own = response.at(rate)
        static = static_part(own)
        knock = np.pad(own.knock, ((0, 0), (0, max(static.shape[1] - own.knock.shape[1], 0))))[:, : static.shape[1]]
        rest.append(gain * np.resize(knock - static, (channels, static.shape[1])))
    waves = np.array(rest)
    energy = np.array([_energy(wave, rate) for wave in waves])
    return KnockFields(keys, waves, energy, _shape(keys, energy), rate)


def _shape(keys: np.ndarray, energy: np.ndarray) -> FieldShape:
    """Estimate how the energy changes over frequency and key, from its mean over channels and frames."""
    octave = np.log2(EDGES[:-1] * EDGES[1:]) / 2
    points = FieldPoints(
        np.tile(octave, len(keys)), np.repeat(keys, len(octave)), np.ones(energy.shape[0] * len(octave))
    )
    return field_shape(points, (energy - energy.mean(axis=0)).mean(axis=(1, 3)).ravel())


def _transform(rate: int) -> ShortTimeFFT:
    size = round(WINDOW_S * rate)
    return ShortTimeFFT(np.hanning(size + 2)[1:-1], round(HOP_S * rate), rate, fft_mode="onesided")


def _bands(transform: ShortTimeFFT) -> np.ndarray:
    """Band of each bin [bins]."""
    return np.clip(np.searchsorted(EDGES, transform.f) - 1, 0, len(EDGES) - 2)


def _energy(wave: np.ndarray, rate: int) -> np.ndarray:
    """Mean energy of the bins in bands and frames, dB [channels, bands, frames]."""
    transform = _transform(rate)
    power = np.abs(transform.stft(wave)) ** 2
    band = _bands(transform)
    total = np.zeros((len(wave), len(EDGES) - 1, power.shape[-1]))
    for i, b in enumerate(band):
        total[:, b] += power[:, i]
    mean = total / np.maximum(np.bincount(band, minlength=len(EDGES) - 1), 1)[:, None]
    return 10 * np.log10(np.maximum(mean, mean.max() * 10 ** (-RANGE / 10)))


def guess_knock(knocks: KnockFields, midi: int) -> np.ndarray:
    """Return the knock of a key without its static part [channels, samples]."""
    mean = knocks.energy.mean(axis=0)
    wanted = mean + np.tensordot(knocks.weights(midi), knocks.energy - mean, 1)
    wave = _mixture(knocks, midi)
    transform = _transform(knocks.rate)
    factor = 10 ** ((wanted - _energy(wave, knocks.rate)) / 20)
    shaped = transform.stft(wave) * factor[:, _bands(transform)]
    return np.real(transform.istft(shaped, k1=wave.shape[-1]))


def _mixture(knocks: KnockFields, midi: int) -> np.ndarray:
    """Return a mixture of the knocks of the nearest keys on both sides [channels, samples]."""
    place = float(np.interp(midi, knocks.keys, np.arange(len(knocks.keys))))
    low, high, share = math.floor(place), math.ceil(place), place % 1
    one, other = (wave / max(float(np.sqrt(np.mean(wave**2))), 1e-300) for wave in knocks.rest[[low, high]])
    return math.sqrt(1 - share) * one + math.sqrt(share) * other
