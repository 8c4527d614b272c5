"""The modes of every partial of a key, common to all its layers and channels.

A partial of a real note is not a single damped mode. Unison strings, two polarisations and the soundboard give it up to
four modes, which cause beating and an aftersound. The poles belong to the key, and a stroke only excites them. So all
layers are fitted together. Each is weighted relative to its own envelope, and evenly in the logarithm of time, so that
the aftersound has enough weight. The number of modes follows from two misfits of each layer: with its own amplitudes,
and with the pattern of the other layers.

Modes of almost the same frequency can cancel one another. Their amplitudes are then much larger than their sound, and
small errors of theirs are large in the sound. So layers are compared by the sound of a partial and not by amplitudes,
with the same weights over time (`PartialModes.basis`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..analysis import Analysis, law_frequency, tension_share
from ..dsp.bands import Bands
from ..dsp.common_poles import fit_amplitudes, poles_by_subspace, refine_poles, standard_errors
from ..dsp.damped_sums import powers, sum_damped_modes
from .aligned_layers import SPAN, AlignedLayers, band_window, partial_band, relative_pitches, track_offsets
from .valid_frames import LOG_TIME_START, RANGE, ValidFrames, select_valid_frames

# Numbers of modes that a partial can have.
ORDERS = (1, 2, 3, 4)
# Exponential weights of the subspace estimate besides 0, which favours the attack, in decay rates of the single mode;
# 1 favours the aftersound.
LIFTS = (0.4, 0.8)
# Partials whose modes lie this far below those of the strongest partial, dB, are discarded.
FAINTEST = -65.0
# Fastest decay of a mode: a constant, 1/s, or a multiple of the decay rate of a single-mode fit, whichever is larger.
FASTEST = 30.0
FASTEST_RATIO = 5.0
# Slowest decay of a mode, 1/s: T60 of two minutes.
SLOWEST = 0.05
# Largest signal-to-noise ratio by which a layer is weighted in the common pattern, dB.
LARGEST_LAYER_SNR = 30.0
# Largest deviation of a pole's frequency, as a share of the spacing of partials and of the inverse window length.
OF_SPACING = 0.4
OF_BAND = 0.7
# Times at which the sounds of layers are compared, s after the onset: evenly in log time, as valid frames are weighted.
# Half and twice as many give the same distances.
EVEN_TIMES = LOG_TIME_START * np.expm1(np.linspace(0, np.log1p(SPAN / LOG_TIME_START), 64))
# Smallest singular value of a basis relative to its largest. Below it, modes are equal to rounding.
LEAST_SINGULAR = 1e-6


@dataclass(frozen=True)
class PartialModes:
    """The modes of one partial, with amplitudes at `start`."""

    number: int  # k
    frequency: float  # Hz, reference of the poles
    spacing: float  # Hz, to the next partial
    start: float  # s after the onset
    pole: np.ndarray  # 1/s relative to the frequency, complex [modes]
    pole_error: np.ndarray  # standard error of real and imaginary part, 1/s [modes]
    amplitude: np.ndarray  # complex, full scale = 1 [layers, channels, modes]
    offset: np.ndarray  # Hz, of each layer relative to the loudest [layers]
    noise: np.ndarray  # amplitude in the band [layers, channels]
    snr: np.ndarray  # dB, of the band's largest value over its noise [layers]

    @property
    def poles(self) -> np.ndarray:
        """Absolute poles, 1/s, complex [modes]."""
        return self.pole + 2j * np.pi * self.frequency

    @property
    def at_onset(self) -> np.ndarray:
        """Amplitudes extrapolated to the onset [layers, channels, modes]."""
        return self.amplitude * np.exp(-self.pole * self.start)

    @cached_property
    def basis(self) -> np.ndarray:
        """R: the sound of amplitudes a at the onset is R a in orthonormal coordinates [modes, modes].

        The length of R a is the rms of the sound over the envelope of the partial, evenly over the logarithm of time.
        """
        shape = np.exp(np.outer(EVEN_TIMES, self.pole)) / np.sqrt(len(EVEN_TIMES))
        sound = np.abs(self.at_onset @ shape.T)
        relative = sound / np.maximum(sound.max(axis=(1, 2), keepdims=True), 1e-300)
        envelope = np.sqrt((relative**2).mean(axis=(0, 1)))
        # Without a layer that shows the partial, all times have one weight.
        envelope = envelope + 10 ** (-RANGE / 20) * envelope.max() if envelope.any() else np.ones(len(EVEN_TIMES))
        return np.asarray(np.linalg.qr(shape / envelope[:, None], mode="r"))

    def coordinates(self, amplitude: np.ndarray) -> np.ndarray:
        """Coordinates of the sound of amplitudes at the onset [..., modes]."""
        return amplitude @ self.basis.T

    def amplitudes(self, coordinates: np.ndarray) -> np.ndarray:
        """Amplitudes at the onset of a sound with these coordinates [..., modes]."""
        return coordinates @ np.linalg.pinv(self.basis, rcond=LEAST_SINGULAR).T


def fastest_beat(spacing: float) -> float:
    """Largest distance of a mode from the frequency of its partial, Hz, if partials lie `spacing` Hz apart.

    Beats of modes farther apart than that are not found.
    """
    return min(OF_SPACING * spacing, OF_BAND / band_window(spacing))


def modes_of(layers: AlignedLayers, analyses: Sequence[Analysis]) -> list[PartialModes]:
    """The modes of every partial that any analysis detected; the last layer is the loudest.

    The modes are estimated twice. The second pass removes the neighbouring partials of the first pass from each band.
    """
    spectrum = np.fft.rfft(layers.samples)
    partials = _partials(analyses, layers.rate)
    share = {number: float(tension_share(analyses[-1].B, number)) for number, *_ in partials}
    pitch = relative_pitches(spectrum, layers, partials, share)
    first = _strong([_fit(spectrum, layers, partial, share[partial[0]] * pitch) for partial in partials])
    if not first:
        return []
    residual = np.fft.rfft(layers.samples - synthesise(first, layers))
    again = [((m.number, m.frequency, m.spacing), share[m.number] * pitch, m) for m in first]
    return _strong([_fit(residual, layers, *partial) for partial in again])


def _partials(analyses: Sequence[Analysis], rate: int) -> list[tuple[int, float, float]]:
    """Number, frequency at the pitch of the last layer, and spacing of all partials detected in any layer."""
    last = analyses[-1]
    detected: dict[int, list[float]] = {}
    for a in analyses:
        for k, f in zip(a.partials.number, a.partials.frequency, strict=True):
            detected.setdefault(int(k), []).append(f * (last.f0 / a.f0) ** tension_share(last.B, k))
    rows = [
        (k, float(np.median(f)), float(np.diff(law_frequency(last.f0, last.B, np.array([k, k + 1])))[0]))
        for k, f in sorted(detected.items())
    ]
    return [row for row in rows if row[1] + row[2] < 0.45 * rate]


def _strong(fitted: Sequence[PartialModes | None]) -> list[PartialModes]:
    """The partials that exceed `FAINTEST`."""
    partials = [modes for modes in fitted if modes]
    level = [np.linalg.norm(m.coordinates(m.at_onset), axis=-1).max() for m in partials]
    return [m for m, x in zip(partials, level, strict=True) if x > max(level) * 10 ** (FAINTEST / 20)]


def synthesise(partials: Sequence[PartialModes], layers: AlignedLayers) -> np.ndarray:
    """Sum of the modes in every layer [layers, channels, samples]."""
    n_layers, channels, count = layers.samples.shape
    out = np.zeros((n_layers, channels, count))
    for i in range(n_layers):
        pole = np.concatenate([m.poles + 2j * np.pi * m.offset[i] for m in partials])
        amplitude = np.concatenate([m.at_onset[i] for m in partials], axis=-1)
        out[i] = sum_damped_modes(pole, amplitude, layers.rate, count)
    return out


def _fit(
    spectrum: np.ndarray,
    layers: AlignedLayers,
    partial: tuple[int, float, float],
    pitch: np.ndarray,
    first: PartialModes | None = None,
) -> PartialModes | None:
    """Modes of one partial (number, frequency and spacing, Hz) in all layers; None if no layer exceeds its noise.

    The modes of the `first` pass have been removed from `spectrum` with those of all other partials. The first pass
    itself takes one or three modes from the subspace without refinement.
    """
    number, frequency, spacing = partial
    count = layers.samples.shape[-1]
    b = partial_band(spectrum, count, layers.rate, frequency, spacing)
    if first is not None:
        b = replace(b, z=b.z + _in_band(first, b))
    between = np.abs(partial_band(spectrum, count, layers.rate, frequency + spacing / 2, spacing).z)
    offset = track_offsets(b, pitch)
    b = replace(b, z=b.z * np.exp(-2j * np.pi * np.outer(offset, b.time))[:, None])
    valid = select_valid_frames(b, between, layers.seconds)
    selected = None if valid is None else _select_order(valid, spacing, b, quick=first is None)
    if valid is None or selected is None:
        return None
    pole, amplitude = selected
    return PartialModes(
        number=number,
        frequency=frequency,
        spacing=spacing,
        start=valid.start,
        pole=pole,
        pole_error=standard_errors(pole, valid.signals, max(1.0, 1 / (b.noise_width * b.step))),
        amplitude=amplitude * 2 / b.gain(pole),
        offset=offset,
        noise=valid.noise,
        snr=valid.snr,
    )


def _in_band(modes: PartialModes, b: Bands) -> np.ndarray:
    """Signal of modes in their band, valid after the edge of the window [layers, channels, frames]."""
    amplitude = modes.amplitude * (b.gain(modes.pole) * np.exp(-modes.pole * modes.start) / 2)
    turn = np.exp(2j * np.pi * np.outer(modes.offset, b.time))
    return amplitude @ powers(modes.pole * b.step, len(b.time)) * turn[:, None]


def _select_order(valid: ValidFrames, spacing: float, b: Bands, quick: bool) -> tuple[np.ndarray, np.ndarray] | None:
    """Poles and amplitudes of the order with the highest evidence."""
    orders = ORDERS[::2] if quick else ORDERS
    unlifted = poles_by_subspace(valid.signals, valid.scale, ORDERS[:1] if quick else ORDERS, 0.0)
    if 1 not in unlifted:
        return None
    decay = -float(unlifted[1][0].real)
    fastest = max(FASTEST, FASTEST_RATIO * decay)
    widest = 2 * np.pi * fastest_beat(spacing)

    def box(pole: np.ndarray) -> np.ndarray:
        return np.clip(np.real(pole), -fastest, -SLOWEST) + 1j * np.clip(np.imag(pole), -widest, widest)

    lifted = [poles_by_subspace(valid.signals, valid.scale, orders, lift * max(decay, 0)) for lift in LIFTS]
    found = lifted if quick else [unlifted, *lifted]
    misfits, best = _Misfits(valid), None
    samples = valid.signals.length.sum() * min(1.0, b.noise_width * b.step)  # frames at a higher rate are correlated
    for order in (order for order in orders if order in found[0]):
        starts = box(np.stack([poles[order] for poles in found]))
        pole = starts[np.argmin(misfits.by_pattern(starts, misfits.amplitudes(starts)))]
        pole = pole if quick else refine_poles(pole, valid.signals, box)
        amplitude = misfits.amplitudes(pole)
        # Log evidence of the order (Schwarz 1978), the mean of those of both misfits. n samples with unknown variance
        # have the log likelihood -n log misfit. Each mode costs log n for its pole and for its amplitude in every
        # signal.
        score = -samples * np.log(misfits.by_own(pole, amplitude) * misfits.by_pattern(pole, amplitude)) / 2
        score -= order * (len(valid.signals.values) + 1) * np.log(samples)
        # A pole at the fastest decay belongs to the knock and is rejected, except with order 1, which comes first.
        if best is None or (score > best[0] and np.real(pole).min() > -fastest):
            best = score, (pole, amplitude)
    return None if best is None else best[1]


class _Misfits:
    """Geometric means over layers of two misfits of poles: with a layer's own amplitudes, and with a common pattern."""

    def __init__(self, valid: ValidFrames) -> None:
        self.valid = valid
        layer = np.nonzero(valid.above_noise)[0]  # of each signal
        self.layers, self.place = np.unique(layer, return_inverse=True)
        self.member = (layer[:, None] == self.layers).astype(float)  # [signals, layers above the noise]
        self.observed = valid.signals.values * valid.signals.weight
        self.power = np.real(self.observed) ** 2 + np.imag(self.observed) ** 2

    def amplitudes(self, pole: np.ndarray) -> np.ndarray:
        """Amplitudes [..., layers, channels, modes] of poles [..., modes]; zero where a channel is below the noise."""
        own = np.zeros((*pole.shape[:-1], *self.valid.above_noise.shape, pole.shape[-1]), complex)
        own[..., self.valid.above_noise, :] = fit_amplitudes(pole, self.valid.signals)
        return own

    def by_own(self, pole: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Misfit [...] of each layer with its own amplitudes."""
        return self._mean_misfit(self._signals(pole, own))

    def by_pattern(self, pole: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Misfit [...] of each layer with the pattern of the other layers and a complex gain."""
        layers, others = self.layers, own
        if len(layers) > 1:
            index = np.array([layers[layers != layer] for layer in layers])
            others = np.zeros_like(own)
            others[..., layers, :, :] = common_pattern(own[..., index, :, :], self.valid.noise[index])[0]
        model = self._signals(pole, others)
        product, power = np.vecdot(model, self.observed) @ self.member, np.vecdot(model, model).real @ self.member
        gain = product / np.maximum(power, 1e-300)
        return self._mean_misfit(gain[..., self.place, None] * model)

    def _signals(self, pole: np.ndarray, amplitude: np.ndarray) -> np.ndarray:
        """Weighted sums of modes in the signals above the noise [..., signals, frames]."""
        signals = self.valid.signals
        shape = powers(pole * signals.step, signals.values.shape[-1])
        return amplitude[..., self.valid.above_noise, :] @ shape * signals.weight

    def _mean_misfit(self, model: np.ndarray) -> np.ndarray:
        """Geometric mean over layers of the residual share of the power [...].

        A sample's residual is limited to four times its power. The resolution 10^(-RANGE/10) is added.
        """
        residual = self.observed - model
        limited = np.minimum(np.real(residual) ** 2 + np.imag(residual) ** 2, 4 * self.power).sum(axis=-1)
        share = limited @ self.member / np.maximum(self.power.sum(axis=-1) @ self.member, 1e-300)
        return np.exp(np.mean(np.log(share + 10 ** (-RANGE / 10)), axis=-1))


def common_pattern(amplitude: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pattern common to all layers [..., channels, modes], and each layer's complex factor on it [..., layers].

    The pattern is the first singular vector over [layers, (channels, modes)]. Layers are divided by their noise, which
    is taken as at least `LARGEST_LAYER_SNR` dB below the layer's own amplitude. The arguments are [..., layers,
    channels, modes] and [..., layers, channels].
    """
    rows = amplitude.reshape(*amplitude.shape[:-2], -1)
    weight = 1 / np.maximum(
        noise.mean(axis=-1), np.linalg.norm(rows, axis=-1) * 10 ** (-LARGEST_LAYER_SNR / 20) + 1e-12
    )
    u, s, v = np.linalg.svd(rows * weight[..., None], full_matrices=False)
    pattern = v[..., 0, :].reshape(*amplitude.shape[:-3], *amplitude.shape[-2:])
    return pattern, u[..., 0] * s[..., :1] / weight
