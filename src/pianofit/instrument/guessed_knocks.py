"""Knocks of keys that were never recorded: their energy over frequency and time is interpolated between recorded keys.

The knock of a recorded key contains the part that cancels the static deflection of its modes. The rest is what
soundboard, frame and key sound like when the string is struck. Its energy in bands of frequency and frames of time,
per unit of the force of the hammer of the laws, is a smooth function of the key. The waveform is noise, from the
contact on. The waveform of a recorded knock would not do: it holds traces of the partials of its own key, which would
sound on every other key.

The modes begin at once, where soundboard and room build up slowly. So a part of a recorded knock cancels the modes.
That part belongs to the modes of its own key: another key has them at other frequencies, or not at all. In every cell
of frequency and time the regression on the modes divides a knock into this part and an independent one. A guessed key
has the interpolated power of the independent part. Where it has modes of its own, it loses the interpolated share of
their power, because noise cannot cancel them.
"""

import functools
import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.signal import ShortTimeFFT

from ..conversions import DB
from ..dsp.damped_sums import sum_damped_modes
from ..model.modal_response import KNOCK_SECONDS, PRE_ONSET_S, ModalResponse, cancel_static_deflection
from .fields import NOTHING, Field, FieldPoints, FieldShape, field_shape

# Edges of the bands, Hz: half octaves.
EDGES = 20.0 * 2 ** (np.arange(21) / 2)
# Windows of the frames, s, and the first of the `EDGES` of their bands. A knock changes within some ten milliseconds,
# but a window must be long enough to separate the bands: soundboards radiate little below some 80 Hz.
WINDOWS = ((0.32, 0), (0.08, 5), (0.02, 9))
# Distance of the frames over their window.
HOP = 0.25
# Mean of the power of a Gaussian noise over its geometric mean: exp of Euler's constant.
MEAN_OVER_GEOMETRIC = math.exp(np.euler_gamma)
# Duration of the beginning of a knock before the contact, s: its frames are longer, and would spread it.
BEGINNING_S = 0.001
# Seed of the noise. All keys have the same, so neighbours sound alike.
SEED = 0
# Range of the energies, dB below the loudest cell of the knock. Fainter cells are rounding.
RANGE = 80.0


class KnockFields(NamedTuple):
    """Knocks of the recorded keys. `independent` and `cancelled` have one array for each of the `WINDOWS`."""

    keys: np.ndarray  # MIDI numbers [keys]
    correlation: float  # of the waveforms of two channels
    samples: int  # of a knock, from `PRE_ONSET_S` before the contact
    independent: tuple[np.ndarray, ...]  # energy that is independent of the modes, dB [keys, channels, bands, frames]
    cancelled: tuple[np.ndarray, ...]  # share of the modes' power that the knock cancels, in the same order
    shape: FieldShape  # of the independent energy over frequency and key
    rate: int  # Hz

    def noise_power(self, midi: int, modes: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Predict the power of the noise of a key from that of its modes, [channels, bands, frames] for each window."""
        points = FieldPoints(np.zeros(len(self.keys)), self.keys, np.ones(len(self.keys)))
        field, at = Field(points, self.shape), FieldPoints.of_key(np.zeros(1), midi)
        weights = field.weights(at)
        # The expected power, as of the partials (`guessed_responses`).
        surplus = field.variance(weights, at) / DB
        out = []
        for energy, cancelled, ringing in zip(self.independent, self.cancelled, modes, strict=True):
            power = 10 ** ((points.predict(weights, energy)[0] + surplus) / 10)
            share = np.clip(points.predict(weights, cancelled)[0], 0.0, 1.0)
            out.append(np.maximum(power - share * ringing, 0.0))
        return out


def static_part(response: ModalResponse) -> np.ndarray:
    """Return the knock that cancels the static deflection of the modes, and has no other sound [channels, samples]."""
    lead, count = round(PRE_ONSET_S * response.rate), round(KNOCK_SECONDS * response.rate)
    return np.pad(cancel_static_deflection(response.pole, response.pattern, response.rate, count), ((0, 0), (lead, 0)))


def measure_knocks(
    keys: np.ndarray, responses: list[ModalResponse], gains: np.ndarray, channels: int, rate: int
) -> KnockFields | None:
    """Measure the knocks of the recorded keys that have one; None if none has.

    Parameters
    ----------
    gains : gain of each key times the force of its own hammer over that of the laws [keys].
    channels, rate : number of channels of the instrument, and rate of its responses, Hz.
    """
    with_knock = [i for i, response in enumerate(responses) if response.knock.shape[-1]]
    if not with_knock:
        return None
    keys, gains, responses = keys[with_knock], gains[with_knock], [responses[i] for i in with_knock]
    waves, independent, cancelled = [], [], []
    for response, gain in zip(responses, gains, strict=True):
        own = response.at(rate)
        static = static_part(own)
        count = static.shape[1]
        knock = np.pad(own.knock, ((0, 0), (0, max(count - own.knock.shape[1], 0))))[:, :count]
        waves.append(gain * np.resize(knock - static, (channels, count)))
        energy, share = _parts(own, static, knock - static)
        independent.append([np.resize(20 * np.log10(gain) + of, (channels, *of.shape[1:])) for of in energy])
        cancelled.append([np.resize(of, (channels, *of.shape[1:])) for of in share])
    waves, energy = np.array(waves), _by_window(independent)
    common, shape = _correlation(waves), _shape(keys, energy)
    return KnockFields(keys, common, waves.shape[-1], energy, _by_window(cancelled), shape, rate)


def _by_window(keys: Iterable[Sequence[np.ndarray]]) -> tuple[np.ndarray, ...]:
    """Put arrays of several keys together for each of the `WINDOWS`."""
    return tuple(np.array(of_keys) for of_keys in zip(*keys, strict=True))


def _parts(response: ModalResponse, static: np.ndarray, knock: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Independent energy of a knock, dB, and the share of the modes' power that it cancels.

    Both are [channels, bands, frames] for each window. With the regression a of the knock on the modes, the share is
    1 - (1 + a)², -1 ≤ a ≤ 0. It follows from the power of both together and of each.

    Parameters
    ----------
    static, knock : knock that cancels the static deflection of the modes, and the rest of it [channels, samples].
    """
    modes = _ringing(response, static)
    together, ringing, alone = (_power_between(wave, response.rate) for wave in (modes + knock, modes, knock))
    least = max(power.max() for power in alone) * 10 ** (-RANGE / 10)
    energy, share = [], []
    for both, of_modes, of_knock in zip(together, ringing, alone, strict=True):
        size = np.maximum(np.sqrt(of_modes * of_knock), NOTHING)
        correlation = np.clip((both - of_modes - of_knock) / (2 * size), -1.0, 0.0)
        regression = np.clip(correlation * of_knock / size, -1.0, 0.0)
        energy.append(10 * np.log10(np.maximum(of_knock * (1 - correlation**2), least)))
        share.append(1 - (1 + regression) ** 2)
    return energy, share


def _ringing(response: ModalResponse, static: np.ndarray) -> np.ndarray:
    """Response of the modes to an impulse, without their static deflection [channels, samples]."""
    lead = round(PRE_ONSET_S * response.rate)
    modes = sum_damped_modes(response.pole, response.pattern, response.rate, static.shape[1] - lead)
    return static + np.pad(modes, ((0, 0), (lead, 0)))


def _power_between(wave: np.ndarray, rate: int) -> list[np.ndarray]:
    """Power of a waveform between its partials in bands and frames, [channels, bands, frames] for each window.

    It is the geometric mean over the bins, which the peaks of partials hardly raise, scaled to the mean of a noise.
    """
    out = []
    for window in _windows(rate):
        power = np.abs(window.transform.stft(wave)) ** 2 / np.sum(window.transform.win**2)
        logs = np.log(np.maximum(power, NOTHING))
        means = [logs[:, window.band == band].mean(axis=1) for band in range(window.band.max() + 1)]
        out.append(MEAN_OVER_GEOMETRIC * np.exp(np.stack(means, axis=1)))
    return out


class _Window(NamedTuple):
    """Frames of one length."""

    transform: ShortTimeFFT
    band: np.ndarray  # band of each bin, from 0; -1 for bins of other windows [bins]


@functools.cache
def _windows(rate: int) -> tuple[_Window, ...]:
    """Return the `WINDOWS` at a rate, Hz."""
    ends = (*(first for _, first in WINDOWS[1:]), len(EDGES) - 1)
    out = []
    for (seconds, first), end in zip(WINDOWS, ends, strict=True):
        size = round(seconds * rate)
        transform = ShortTimeFFT(np.hanning(size + 2)[1:-1], round(HOP * size), rate, fft_mode="onesided")
        band = np.clip(np.searchsorted(EDGES, transform.f) - 1, 0, len(EDGES) - 2)
        out.append(_Window(transform, np.where((band >= first) & (band < end), band - first, -1)))
    return tuple(out)


def _shape(keys: np.ndarray, energy: Sequence[np.ndarray]) -> FieldShape:
    """Estimate how the energy changes over frequency and key, from its mean over channels and frames."""
    octave = np.log2(EDGES[:-1] * EDGES[1:]) / 2
    points = FieldPoints(np.tile(octave, len(keys)), np.repeat(keys, len(octave)), np.ones(len(keys) * len(octave)))
    return field_shape(points, np.hstack([(of - of.mean(axis=0)).mean(axis=(1, 3)) for of in energy]).ravel())


def _correlation(waves: np.ndarray) -> float:
    """Mean correlation of the channels with their mean, squared; 1 for one channel."""
    mono = waves.mean(axis=1, keepdims=True)
    power = np.sum(waves**2, axis=-1) * np.sum(mono**2, axis=-1)
    return float(np.mean(np.sum(waves * mono, axis=-1) ** 2 / np.maximum(power, NOTHING)))


def guess_knock(knocks: KnockFields, midi: int, response: ModalResponse, static: np.ndarray) -> np.ndarray:
    """Return the knock of a key with these modes, without its `static` part [channels, samples]."""
    wanted = knocks.noise_power(midi, _power_between(_ringing(response, static), knocks.rate))
    noises = _noise(len(wanted[0]), knocks.samples, knocks.correlation, knocks.rate)
    wave = np.zeros((len(wanted[0]), knocks.samples))
    for (transform, band), noise, power in zip(_windows(knocks.rate), noises, wanted, strict=True):
        shares = np.where((band >= 0)[:, None], power[:, band], 0.0)
        wave += np.real(transform.istft(noise * np.sqrt(shares), k1=knocks.samples))
    before = np.arange(knocks.samples) / knocks.rate - PRE_ONSET_S
    return wave * np.clip(1 + before / BEGINNING_S, 0.0, 1.0)


@functools.lru_cache(maxsize=1)  # all keys of an instrument have the same
def _noise(channels: int, samples: int, correlation: float, rate: int) -> list[np.ndarray]:
    """White noise of power 1, with the correlation of the recorded channels, in the frames of all windows."""
    random = np.random.default_rng(SEED)
    common, own = random.normal(size=samples), random.normal(size=(channels, samples))
    noise = math.sqrt(correlation) * common + math.sqrt(max(1 - correlation, 0.0)) * own
    return [window.transform.stft(noise) for window in _windows(rate)]
