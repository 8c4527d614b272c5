"""The modes that every partial of a key rings with, common to all its layers and channels.

A partial of a real note is no single damped mode: unison strings, two polarisations and the soundboard give it up to
four, which beat and leave an aftersound. The poles are the key's, not the stroke's; what a stroke does is excite them.
So all layers are fitted together, each relative to its own envelope and even in the logarithm of time, which is what
makes the aftersound count. How many modes a partial has is decided by what they explain in a layer whose pattern the
other layers gave, and by what they explain in that layer by itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ..analysis import Analysis, law_frequency
from ..model.modal_response import sum_damped_modes
from .aligned_layers import AlignedLayers
from .bands import Band, band, kernel_gain, kernel_seconds
from .esprit import amplitudes, poles_by_subspace, refined, standard_errors
from .relative_pitch import relative_pitches, track_offsets
from .valid_frames import RANGE, ValidFrames, select_valid_frames

__all__ = ["PartialModes", "common_pattern", "modes_of"]

# How many modes a partial can have.
ORDERS = (1, 2, 3, 4)
# Lifts of the subspace's start, in decay rates of the single mode: 0 favours the attack, 1 the aftersound.
LIFTS = (0.0, 0.4, 0.8)
# A partial whose modes lie so far below the strongest partial's, dB, is none.
FAINTEST = -65.0
# Fastest decay of a mode, 1/s, and over that of the one mode that a partial has at first sight, where that is more.
FASTEST = 30.0
FASTER = 5.0
# Slowest decay of a mode, 1/s: T60 of two minutes.
SLOWEST = 0.05
# In one pattern of layers weighed by their noise none goes further ahead of its own size than this, dB.
AHEAD = 30.0
# Poles keep within so much of the spacing of partials, and of the kernel's band.
OF_SPACING = 0.4
OF_BAND = 0.7
# Of a Hann kernel, over its length: frames that follow each other faster say the same.
NOISE_BANDWIDTH = 1.5


@dataclass(frozen=True)
class PartialModes:
    """One partial's modes; amplitudes are those at `start`."""

    number: int  # k
    frequency: float  # Hz, that poles are about
    spacing: float  # Hz, to the next partial
    start: float  # s after the onset
    pole: np.ndarray  # 1/s about the frequency, complex [modes]
    pole_error: np.ndarray  # standard error of real and imaginary part, 1/s [modes]
    amplitude: np.ndarray  # complex, full scale = 1 [layers, channels, modes]
    offset: np.ndarray  # Hz, of each layer over the loudest [layers]
    noise: np.ndarray  # of the band [layers, channels]
    snr: np.ndarray  # dB, of the band's largest over its noise [layers]

    @property
    def poles(self) -> np.ndarray:
        """Absolute, 1/s, complex [modes]."""
        return self.pole + 2j * np.pi * self.frequency

    @property
    def at_onset(self) -> np.ndarray:
        """Amplitudes carried back to the onset [layers, channels, modes]."""
        return self.amplitude * np.exp(-self.pole * self.start)


def modes_of(heard: AlignedLayers, analyses: Sequence[Analysis]) -> list[PartialModes]:
    """The modes of every partial that any analysis found, of the layers `heard`; louder layers last.

    A second pass takes out of each partial's band what the first found in its neighbours'.
    """
    count = heard.samples.shape[-1]
    spectrum = np.fft.rfft(heard.samples)
    partials = _partials(analyses, heard.rate)
    pitch = relative_pitches(spectrum, count, heard, partials)
    found: list[PartialModes] = []
    for number, frequency, spacing in partials:
        modes = _fit(spectrum, count, heard, (number, frequency, spacing), pitch)
        found += [modes] if modes else []
    found = _loud(found)
    if not found:
        return []
    rest = np.fft.rfft(heard.samples - synthesise(found, heard))
    again = [_fit(rest, count, heard, (modes.number, modes.frequency, modes.spacing), pitch, modes) for modes in found]
    return _loud([modes for modes in again if modes])


def _partials(analyses: Sequence[Analysis], rate: int) -> list[tuple[int, float, float]]:
    """Number, frequency in the last layer's pitch and spacing of the partials that any layer shows."""
    last = analyses[-1]
    seen: dict[int, list[float]] = {}
    for a in analyses:
        for k, f in zip(a.partials.number, a.partials.frequency, strict=True):
            seen.setdefault(int(k), []).append(f * last.f0 / a.f0)
    rows = [
        (k, float(np.median(f)), float(np.diff(law_frequency(last.f0, last.B, np.array([k, k + 1])))[0]))
        for k, f in sorted(seen.items())
    ]
    return [row for row in rows if row[1] + row[2] < 0.45 * rate]


def _loud(found: list[PartialModes]) -> list[PartialModes]:
    level = [np.abs(modes.amplitude).sum(-1).max() for modes in found]
    return [m for m, x in zip(found, level, strict=True) if x > max(level) * 10 ** (FAINTEST / 20)]


def synthesise(found: Sequence[PartialModes], heard: AlignedLayers) -> np.ndarray:
    """What the modes sound like in every layer [layers, channels, samples]."""
    layers, channels, count = heard.samples.shape
    out = np.zeros((layers, channels, count))
    for i in range(layers):
        pole = np.concatenate([m.poles + 2j * np.pi * m.offset[i] for m in found])
        out[i] = sum_damped_modes(pole, np.concatenate([m.at_onset[i] for m in found], axis=-1), heard.rate, count)
    return out


def _fit(
    spectrum: np.ndarray, count: int, heard: AlignedLayers, where: tuple[int, float, float], pitch: np.ndarray,
    own: PartialModes | None = None,
) -> PartialModes | None:  # fmt: skip
    """Modes of one partial of all layers; None where no layer shows it.

    Parameters
    ----------
    own : what an earlier pass found, and took out of `spectrum` with all others. That pass itself takes one or three
        modes from the subspace alone.
    """
    number, frequency, spacing = where
    b = band(spectrum, count, heard.rate, frequency, kernel_seconds(spacing))
    z = b.values
    if own is not None:
        z = z + np.stack([_within(own, i, b) for i in range(len(z))])
    beside = np.abs(band(spectrum, count, heard.rate, frequency + spacing / 2, b.kernel).values)
    offset = track_offsets(z, b.time, frequency, pitch)
    z = z * np.exp(-2j * np.pi * offset[:, None, None] * b.time)
    cut = select_valid_frames(b, z, beside, heard.seconds)
    if cut is None:
        return None
    chosen = _chosen(cut, spacing, b.kernel, quick=own is None)
    if chosen is None:
        return None
    pole, amplitude = chosen
    error = standard_errors(pole, cut.signals, max(1.0, b.kernel / (NOISE_BANDWIDTH * b.step)))
    return PartialModes(
        number, frequency, spacing, cut.start, pole, error, amplitude * 2 / kernel_gain(pole, b.kernel), offset,
        cut.noise, cut.snr,
    )  # fmt: skip


def _within(own: PartialModes, layer: int, b: Band) -> np.ndarray:
    """What modes are in their band, after the kernel's edge [channels, frames]."""
    each = own.amplitude[layer] * kernel_gain(own.pole, b.kernel) / 2
    turn = np.exp(2j * np.pi * own.offset[layer] * b.time)
    return each @ np.exp(np.outer(own.pole, b.time - own.start)) * turn


def _chosen(cut: ValidFrames, spacing: float, kernel: float, quick: bool) -> tuple[np.ndarray, np.ndarray] | None:
    """Poles and amplitudes of the order with the most evidence."""
    one = poles_by_subspace(cut.signals, cut.scale, [1], 0.0).get(1)
    if one is None:
        return None
    fastest = max(FASTEST, -FASTER * float(one[0].real))
    box = _box(fastest, 2 * np.pi * min(OF_SPACING * spacing, OF_BAND / kernel))
    starts: dict[int, tuple[float, np.ndarray]] = {}
    for lift in LIFTS[1:] if quick else LIFTS:
        orders = ORDERS[::2] if quick else ORDERS
        for order, pole in poles_by_subspace(
            cut.signals, cut.scale, orders, lift * max(-float(one[0].real), 0)
        ).items():
            pole = box(pole)
            carried = _score_poles(pole, cut)[2]
            if order not in starts or carried < starts[order][0]:
                starts[order] = carried, pole
    best = None
    for order, (_, start) in starts.items():
        pole = start if quick else refined(start, cut.signals, box)
        amplitude, misfit, carried = _score_poles(pole, cut)
        score = _evidence(misfit, carried, order, cut, kernel)
        # Of several modes none may decay faster still: that is the knock's. Order 1 comes first.
        if best is None or (score > best[0] and np.real(pole).min() > -fastest):
            best = score, (pole, amplitude)
    return None if best is None else best[1]


def _evidence(misfit: float, carried: float, order: int, cut: ValidFrames, kernel: float) -> float:
    """Log evidence of an order (Schwarz 1978), the mean of what a layer's own and the others' amplitudes leave.

    n samples whose variance is not known have the log likelihood -n log misfit; a mode more costs log n for its pole
    and for its amplitude in every signal.
    """
    samples = cut.signals.length.sum() * min(1.0, NOISE_BANDWIDTH * cut.signals.step / kernel)
    return -samples * np.log(misfit * carried) / 2 - order * (len(cut.signals.values) + 1) * np.log(samples)


def _box(fastest: float, widest: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda pole: np.clip(np.real(pole), -fastest, -SLOWEST) + 1j * np.clip(np.imag(pole), -widest, widest)


def _score_poles(pole: np.ndarray, cut: ValidFrames) -> tuple[np.ndarray, float, float]:
    """Amplitudes [layers, channels, modes], and the geometric means over layers of two misfits.

    The first is by a layer's own amplitudes, the second by the pattern of the others, with one complex gain.
    """
    full = np.zeros((*cut.above_noise.shape, len(pole)), complex)
    full[cut.above_noise] = amplitudes(pole, cut.signals)
    layers = np.flatnonzero(cut.above_noise.any(axis=1))
    theirs = full if len(layers) == 1 else np.zeros_like(full)
    if len(layers) > 1:
        others = np.array([layers[layers != layer] for layer in layers])
        theirs[layers] = common_pattern(full[others], cut.noise[others])[0]
    shape = np.exp(np.outer(cut.signals.time, pole)).T
    weight = cut.signals.weight
    seen, own, alike = (
        _by_layer(x * weight, cut.above_noise)
        for x in (cut.signals.values, full[cut.above_noise] @ shape, theirs[cut.above_noise] @ shape)
    )
    gain = (alike.conj() * seen).sum(axis=-1) / np.maximum((np.abs(alike) ** 2).sum(axis=-1), 1e-300)
    own, carried = (
        float(np.exp(np.mean(np.log(_misfit(seen - x, seen)[layers])))) for x in (own, gain[:, None] * alike)
    )
    return full, own, carried


def _by_layer(x: np.ndarray, live: np.ndarray) -> np.ndarray:
    """Live signals behind each other, those that are not silent [layers, channels times frames]."""
    out = np.zeros((*live.shape, x.shape[-1]), complex)
    out[live] = x
    return out.reshape(len(live), -1)


def _misfit(left: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Share of the power that is left, at most four times a sample's own, and no less than is told apart [layers]."""
    power = np.abs(seen) ** 2
    share = np.minimum(np.abs(left) ** 2, 4 * power).sum(axis=-1) / np.maximum(power.sum(axis=-1), 1e-300)
    return share + 10 ** (-RANGE / 10)


def common_pattern(amplitude: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The pattern [..., channels, modes] that all layers share, and each layer's complex factor on it [..., layers].

    The first singular vector over [layers, (channels, modes)], every layer over its noise, but none more than `AHEAD`
    of its own size.

    Parameters
    ----------
    amplitude, noise : [..., layers, channels, modes] and [..., layers, channels].
    """
    rows = amplitude.reshape(*amplitude.shape[:-2], -1)
    weight = 1 / np.maximum(noise.mean(axis=-1), np.linalg.norm(rows, axis=-1) * 10 ** (-AHEAD / 20) + 1e-12)
    u, s, v = np.linalg.svd(rows * weight[..., None], full_matrices=False)
    pattern = v[..., 0, :].reshape(*amplitude.shape[:-3], *amplitude.shape[-2:])
    return pattern, u[..., 0] * s[..., :1] / weight
