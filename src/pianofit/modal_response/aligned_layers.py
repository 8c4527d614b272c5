"""Layers of a key with common onset, sample rate and length, and without glide, so that they can share poles.

Their pitches still differ a little, and so do those of single partials. Both are measured from the coherence of phases.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..analysis import Analysis, tension_share
from ..dsp.bands import Bands, hann_band
from ..dsp.damped_sums import powers
from ..dsp.filters import resample
from ..model.modal_response import PRE_ONSET_S
from ..recording.recording import Recording

# Modes are estimated from this time after the onset, s. Most aftersounds have shown their decay by then.
SPAN = 3.3
# A glide is removed only if it exceeds so many of its standard errors.
SIGNIFICANT_GLIDE = 3.0
# Length of a band's window in periods of the spacing of partials. Its main lobe then ends half-way to the neighbours.
KERNEL = 4.0
# Shortest and longest window, s. With a shorter one the bands of the treble would be wider than their modes need. A
# longer one would smooth the attack of bass notes.
KERNEL_RANGE = 0.03, 0.16
# Number of lowest partials that determine a layer's pitch. Partials below this coherence have almost no weight.
PITCH_PARTIALS = 16
LEAST_PITCH_COHERENCE = 0.5
# Largest relative detuning of a layer from the last layer that is searched: five cents.
LARGEST_DETUNING = 3e-3
# Largest deviation of a partial from its layer's pitch: a constant, Hz, and a relative part of a third of a cent.
# Beats change each partial differently.
LARGEST_DEVIATION = 0.03, 2e-4
# Phases are compared between these times after the onset, s: past the attack and above the noise.
COMPARED = 0.08, 2.5
# The offset of a partial is measured only if its phase relative to the loudest layer has this coherence.
LEAST_COHERENCE = 0.6


@dataclass(frozen=True)
class AlignedLayers:
    """The layers of a key, cut at their onsets, at one rate and of one length."""

    samples: np.ndarray  # full scale = 1 [layers, channels, samples]
    before: np.ndarray  # the `PRE_ONSET_S` seconds before the onsets [layers, channels, samples]
    rate: int  # Hz
    seconds: np.ndarray  # of each layer, before silence was appended [layers]


def align_layers(recordings: Sequence[Recording], analyses: Sequence[Analysis]) -> AlignedLayers:
    """Cut recordings at their onsets, bring them to one rate and length, and remove their glides.

    The rate is the highest of all recordings. The length is at most a little over `SPAN`. Channels are kept separate if
    all recordings have the same number of channels, and averaged otherwise.
    """
    rate = max(recording.rate for recording in recordings)
    keep_channels = len({len(recording.frames) for recording in recordings}) == 1
    lead, longest_allowed = round(PRE_ONSET_S * rate), round((SPAN + 0.2) * rate)
    layers = []
    for recording, analysis in zip(recordings, analyses, strict=True):
        x = resample(recording.frames if keep_channels else recording.samples[None], recording.rate, rate)
        onset = round(recording.onset * rate / recording.rate)
        x = np.pad(x, ((0, 0), (max(lead - onset, 0), 0)))
        x = x[:, max(onset - lead, 0) :][:, : lead + longest_allowed]
        layers.append(_without_glide(x, rate, lead, analysis))
    longest = max(x.shape[-1] for x in layers)
    padded = np.stack([np.pad(x, ((0, 0), (0, longest - x.shape[-1]))) for x in layers])
    seconds = np.array([(x.shape[-1] - lead) / rate for x in layers])
    return AlignedLayers(padded[..., lead:], padded[..., :lead], rate, seconds)


def _without_glide(x: np.ndarray, rate: int, lead: int, analysis: Analysis) -> np.ndarray:
    """Resample a sound in time so that its pitch is constant [channels, samples].

    A resampling moves all partials alike, and a tension moves stiff ones less. The median partial is straightened. A
    rising pitch comes from beating and is left unchanged, as is a glide that is not significant.
    """
    if analysis.glide_start <= SIGNIFICANT_GLIDE * analysis.glide_error:
        return x
    from scipy.interpolate import CubicSpline

    time = (np.arange(x.shape[-1]) - lead) / rate
    fine = CubicSpline(time[0] + np.arange(2 * len(time)) / (2 * rate), resample(x, rate, 2 * rate), axis=-1)
    share = float(np.median(tension_share(analysis.B, analysis.partials.number)))
    # A given phase is reached later when the pitch does not fall.
    return fine(np.interp(time, time + share * analysis.glide_model.phase_advance_s(np.maximum(time, 0.0)), time))


def partial_band(spectrum: np.ndarray, samples: int, rate: float, frequency: float, spacing: float) -> Bands:
    """The band about `frequency`, Hz, of signals of this length with half spectra [..., bins].

    Its width suits partials `spacing` Hz apart.
    """
    return hann_band(spectrum, samples, rate, frequency, band_window(spacing))


def band_window(spacing: float) -> float:
    """Length of the window, s, for partials `spacing` Hz apart."""
    return float(np.clip(KERNEL / spacing, *KERNEL_RANGE))


def relative_pitches(
    spectrum: np.ndarray,
    layers: AlignedLayers,
    partials: Sequence[tuple[int, float, float]],
    share: Mapping[int, float],
) -> np.ndarray:
    """Relative detuning of f0 of each layer from the last [layers]: the weighted median over its partials.

    The f0 of each layer's analysis is not used. Partials beat, which changes the f0 of a layer by a cent. `partials`
    has number, frequency and spacing of each, Hz, and `share` the share of the tension in their restoring forces.
    """
    offset, weight = [], []
    for number, frequency, spacing in partials[:PITCH_PARTIALS]:
        b = partial_band(spectrum, layers.samples.shape[-1], layers.rate, frequency, spacing)
        detuning, coherence = _offsets(b, np.zeros(len(b.z)), LARGEST_DETUNING * frequency)
        offset.append(detuning / (share[number] * frequency))
        weight.append(np.where(coherence > LEAST_PITCH_COHERENCE, coherence**2, 1e-9))
    return np.quantile(np.array(offset), 0.5, axis=0, weights=np.array(weight), method="inverted_cdf")


def track_offsets(b: Bands, pitch: np.ndarray) -> np.ndarray:
    """Frequency of a partial in each layer minus that in the last layer, Hz [layers].

    It is measured from the phase if that is coherent. Otherwise it follows from the relative `pitch` of this partial
    in the layers.
    """
    frequency = float(b.centre)
    expected = frequency * pitch
    offset, coherence = _offsets(b, expected, LARGEST_DEVIATION[0] + LARGEST_DEVIATION[1] * frequency)
    return np.where(coherence > LEAST_COHERENCE, offset, expected)


def _offsets(b: Bands, expected: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Offset of each layer's partial from the last layer's, Hz, within `reach` of `expected`, and its coherence."""
    frames = (b.time > COMPARED[0]) & (b.time < COMPARED[1])
    z, time = b.z[..., frames], b.time[frames]
    turn = z * z[-1].conj() * np.exp(-2j * np.pi * expected[:, None] * time)[:, None]
    turn = turn / np.sqrt(np.abs(turn) + 1e-30)
    trial = np.linspace(-1, 1, 121) * reach
    # A common phase of all frames does not change a magnitude.
    sums = np.abs(turn @ powers(-2j * np.pi * b.step * trial, len(time)).T).sum(axis=1)
    best = np.argmax(sums, axis=1)
    return expected + trial[best], sums.max(axis=1) / np.maximum(np.abs(turn).sum(axis=(1, 2)), 1e-30)
