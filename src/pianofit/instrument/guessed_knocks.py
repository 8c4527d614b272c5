"""Knocks of keys that were never recorded: their energy over frequency and time is interpolated between recorded keys.

The knock of a recorded key contains the part that cancels the static deflection of its modes. The rest is what
soundboard, frame and key sound like when the string is struck. Its energy in bands of frequency and frames of time,
per unit of the force of the hammer of the laws, is a smooth function of the key. The waveform is noise with this
energy in every cell, from the contact on. The waveform of a recorded knock would not do: it holds traces of the
partials of its own key, which would sound on every other key.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.signal import ShortTimeFFT

from ..model.modal_response import KNOCK_SECONDS, PRE_ONSET_S, ModalResponse, cancel_static_deflection
from .fields import Field, FieldPoints, FieldShape, field_shape

# Window of the frames and their distance, s: a knock changes within some ten milliseconds.
WINDOW_S, HOP_S = 0.02, 0.005
# Edges of the bands, Hz: half octaves.
EDGES = 20.0 * 2 ** (np.arange(21) / 2)
# Bands with fewer bins have the mean of their energy. Others have the median, which traces of partials do not raise.
FEW_BINS = 6
# Median of the power of a Gaussian noise over its mean.
MEDIAN_OVER_MEAN = math.log(2)
# Duration of the beginning of a knock before the contact, s: its frames are longer, and would spread it.
BEGINNING_S = 0.001
# Seed of the noise. All keys have the same, so neighbours sound alike.
SEED = 0
# Range of the energies, dB below the loudest cell of the knock. Fainter cells are rounding.
RANGE = 80.0


class KnockFields(NamedTuple):
    """Knocks of the recorded keys."""

    keys: np.ndarray  # MIDI numbers [keys]
    correlation: float  # of the waveforms of two channels
    samples: int  # of a knock, from `PRE_ONSET_S` before the contact
    energy: np.ndarray  # dB [keys, channels, bands, frames]
    shape: FieldShape  # of the energy over frequency and key
    rate: int  # Hz

    def energy_of(self, midi: int) -> np.ndarray:
        """Predict the energy of a key, dB [channels, bands, frames]."""
        points = FieldPoints(np.zeros(len(self.keys)), self.keys, np.ones(len(self.keys)))
        weights = Field(points, self.shape).weights(FieldPoints.of_key(np.zeros(1), midi))[0]
        return points.predict(weights, self.energy)


def static_part(response: ModalResponse) -> np.ndarray:
    """Return the knock that cancels the static deflection of the modes, and has no other sound [channels, samples]."""
    lead, count = round(PRE_ONSET_S * response.rate), round(KNOCK_SECONDS * response.rate)
    return np.pad(cancel_static_deflection(response.pole, response.pattern, response.rate, count), ((0, 0), (lead, 0)))


def measure_knocks(
    keys: np.ndarray, responses: list[ModalResponse], gains: np.ndarray, channels: int
) -> KnockFields | None:
    """Measure the knocks of the recorded keys that have one; None if none has.

    Parameters
    ----------
    gains : gain of each key times the force of its own hammer over that of the laws [keys].
    channels : number of channels of the instrument.
    """
    with_knock = [i for i, response in enumerate(responses) if response.knock.shape[-1]]
    if not with_knock:
        return None
    keys, gains, responses = keys[with_knock], gains[with_knock], [responses[i] for i in with_knock]
    rate = max(response.rate for response in responses)
    rest = []
    for response, gain in zip(responses, gains, strict=True):
        own = response.at(rate)
        static = static_part(own)
        knock = np.pad(own.knock, ((0, 0), (0, max(static.shape[1] - own.knock.shape[1], 0))))[:, : static.shape[1]]
        rest.append(gain * np.resize(knock - static, (channels, static.shape[1])))
    waves = np.array(rest)
    energy = np.array([_energy(wave, rate) for wave in waves])
    return KnockFields(keys, _correlation(waves), waves.shape[-1], energy, _shape(keys, energy), rate)


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
    """Typical energy of the bins in bands and frames, dB [channels, bands, frames]."""
    transform = _transform(rate)
    power, band = np.abs(transform.stft(wave)) ** 2, _bands(transform)
    energy = np.zeros((len(wave), len(EDGES) - 1, power.shape[-1]))
    for b in np.unique(band):
        inside = power[:, band == b]
        few = inside.shape[1] < FEW_BINS
        energy[:, b] = inside.mean(axis=1) if few else np.median(inside, axis=1) / MEDIAN_OVER_MEAN
    return 10 * np.log10(np.maximum(energy, energy.max() * 10 ** (-RANGE / 10)))


def _correlation(waves: np.ndarray) -> float:
    """Mean correlation of the channels with their mean, squared; 1 for one channel."""
    mono = waves.mean(axis=1, keepdims=True)
    power = np.sum(waves**2, axis=-1) * np.sum(mono**2, axis=-1)
    return float(np.mean(np.sum(waves * mono, axis=-1) ** 2 / np.maximum(power, 1e-300)))


def guess_knock(knocks: KnockFields, midi: int) -> np.ndarray:
    """Return the knock of a key without its static part [channels, samples]."""
    wanted = knocks.energy_of(midi)
    noise = _noise(knocks, len(wanted))
    transform = _transform(knocks.rate)
    band = _bands(transform)
    shaped = transform.stft(noise) * 10 ** (wanted[:, band] / 20) / math.sqrt(np.sum(transform.win**2))
    wave = np.real(transform.istft(shaped, k1=knocks.samples))
    before = (np.arange(knocks.samples) - round(PRE_ONSET_S * knocks.rate)) / (BEGINNING_S * knocks.rate)
    return wave * np.clip(1 + before, 0.0, 1.0)


def _noise(knocks: KnockFields, channels: int) -> np.ndarray:
    """White noise of power 1, with the correlation of the recorded channels [channels, samples]."""
    random = np.random.default_rng(SEED)
    common, own = random.normal(size=knocks.samples), random.normal(size=(channels, knocks.samples))
    return math.sqrt(knocks.correlation) * common + math.sqrt(max(1 - knocks.correlation, 0.0)) * own
