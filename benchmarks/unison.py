"""Fit the strings of a unison on one bridge to the bands of a note: their number and their mistunings.

N strings of a key with one polarisation are mistuned by δ_1 .. δ_N cents, with mean 0 and equal for all partials. At
partial k a bridge couples them. The poles of the partial are the eigenvalues of

    A_k = diag(p_k + 2πi f_k (2^(δ_n/1200) - 1)) - g_k 1 1ᵀ            Re p_k < 0, Re g_k ≥ 0

(p_k and g_k are complex parameters of this partial). All strings start alike and the recording measures the bridge, so
every layer and channel contains 1ᵀ exp(A_k t) 1 times one complex number. The model is fitted to the bands and with the
weights of `pianofit.modal_response`, to all partials together. n frames with a residual share S of the weighted power
have the log likelihood -n log S (with unknown variance). Amplitudes are projected out. The steps are
Levenberg-Marquardt steps, with p and g of each partial eliminated from the step of δ. N is chosen by the evidence
(Schwarz 1978). The errors of δ come from a sandwich estimator with partials as clusters, because the residual of a band
is not white noise.

Two modes do not distinguish two strings from more: (1ᵀ A² 1)/N - (1ᵀ A 1)²/N² is -(2πf log 2 / 1200)² times the
variance of δ for every g. Any two modes that satisfy this are those of two strings, and of three strings of which two
are in tune.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import helmert

from pianofit import Recording, analyse
from pianofit.dsp.common_poles import Signals, fit_amplitudes
from pianofit.modal_response import partial_band
from pianofit.modal_response.aligned_layers import align_layers
from pianofit.modal_response.modes import SLOWEST, PartialModes, common_pattern, modes_of, synthesise
from pianofit.modal_response.valid_frames import select_valid_frames
from pianofit.threads import numerical_settings

# Number of partials to fit, those with the highest signal-to-noise ratio. More add time and little information.
MOST = 16
# Number of starts of the mistunings, and the range of their standard deviations, cents.
STARTS = 8
DRAWN = 0.1, 4.0
# Range of the starts of N g, relative to the fastest decay rate of the partial's modes.
COUPLED = 0.1, 3.0
# Number of rounds; draws per partial in a round; steps of each partial alone; steps of all partials together.
ROUNDS = 3
TRIES = 5
ALONE = 10
TOGETHER = 20
# Difference of log likelihoods that is not significant.
ALIKE = 3.0
# Points of a Hann kernel for its integral: error 1e-5 for decays of several kernels.
TAPS = 12
# Largest matrix norm for the Taylor series of exp, and its number of terms: error 1e-15.
SMALL = 0.5
TERMS = 12
# Steps of difference quotients: 1/s, cents.
STEP_RATE = 1e-5
STEP_CENTS = 1e-5


class Bands(NamedTuple):
    """Independent frames of every partial for the fit, padded with frames and signals of weight 0."""

    frequency: np.ndarray  # Hz [partials]
    start: np.ndarray  # s from the onset to the first frame [partials]
    step: np.ndarray  # s between frames [partials]
    kernel: np.ndarray  # s, length of the Hann kernel around a frame [partials]
    values: np.ndarray  # complex [partials, signals, frames]
    weight: np.ndarray  # same shape; total power 1, equal for all signals
    free: np.ndarray  # residual share of free modes, with one pattern and with own amplitudes [partials, 2]
    modes: list[PartialModes]

    @property
    def samples(self) -> np.ndarray:
        """Number of complex samples [partials]."""
        return (self.weight > 0).sum(axis=(1, 2))

    def some(self, which: np.ndarray) -> Bands:
        """Return the partials selected by `which`, bool [partials]."""
        return Bands(
            self.frequency[which], self.start[which], self.step[which], self.kernel[which], self.values[which],
            self.weight[which], self.free[which], [m for m, on in zip(self.modes, which, strict=True) if on],
        )  # fmt: skip


@dataclass(frozen=True)
class Unison:
    """The best fit of N strings."""

    evidence: float  # log
    gap: np.ndarray  # cents between neighbours [N - 1]
    error: np.ndarray  # standard errors of `gap` [N - 1]
    agree: int  # number of starts within `ALIKE` of the best
    left: float  # residual share of the power, median over partials


def bands_of(recordings: Sequence[Recording], note: float | str) -> Bands:
    """Return the bands of the partials of a key with the highest SNR, without their neighbours, as in `modes_of`."""
    analyses = [analyse(x, note=note) if isinstance(note, str) else analyse(x, f0=note) for x in recordings]
    with numerical_settings():
        aligned = align_layers(recordings, analyses)
        modes = sorted(modes_of(aligned, analyses), key=lambda m: -m.snr.max())[:MOST]
    rows, samples = [], aligned.samples.shape[-1]
    rest = np.fft.rfft(aligned.samples - synthesise(modes, aligned))
    for m in sorted(modes, key=lambda m: m.number):
        b = partial_band(rest, samples, aligned.rate, m.frequency, m.spacing)
        noise = np.abs(partial_band(rest, samples, aligned.rate, m.frequency + m.spacing / 2, m.spacing).z)
        own = (m.amplitude * b.gain(m.pole) / 2) @ np.exp(np.outer(m.pole, b.time - m.start))
        b = replace(b, z=b.z * np.exp(-2j * np.pi * m.offset[:, None, None] * b.time) + own)
        frames = select_valid_frames(b, noise, aligned.seconds)
        if frames is not None:
            stride = max(1, int(1 / (b.noise_width * b.step)))
            values, weight = frames.signals.values[:, ::stride], frames.signals.weight[:, ::stride]
            weight = weight / np.linalg.norm(weight * values, axis=1)[:, None] / np.sqrt(len(weight))
            signals = Signals(values, weight, b.step * stride)
            free = left_by_modes(m.pole, signals, frames.noise[frames.above_noise])
            rows.append((m, signals, (m.frequency, frames.start, signals.step, b.window), free))
    size = np.max([row[1].values.shape for row in rows], axis=0)
    padded = np.zeros((2, len(rows), *size), complex)
    for k, (_, signals, *_) in enumerate(rows):
        padded[:, k, : len(signals.values), : signals.values.shape[1]] = signals.values, signals.weight
    frequency, start, step, kernel = np.array([row[2] for row in rows]).T
    return Bands(
        frequency,
        start,
        step,
        kernel,
        padded[0],
        padded[1].real,
        np.array([row[3] for row in rows]),
        [row[0] for row in rows],
    )


def left_by_modes(pole: np.ndarray, signals: Signals, noise: np.ndarray) -> tuple[float, float]:
    """Residual share of the power of free modes, with one pattern for all signals, and with own amplitudes."""
    shapes, own = np.exp(np.outer(pole, signals.time)), fit_amplitudes(pole, signals)
    pattern = common_pattern(own[:, None, :], noise[:, None])[0]
    u, common = signals.values * signals.weight, (pattern @ shapes) * signals.weight
    gain = (common.conj() * u).sum(axis=1, keepdims=True) / (np.abs(common) ** 2).sum(axis=1, keepdims=True)
    residuals = u - gain * common, u - (own @ shapes) * signals.weight
    return float((np.abs(residuals[0]) ** 2).sum()), float((np.abs(residuals[1]) ** 2).sum())


def matrices(p: np.ndarray, g: np.ndarray, cents: np.ndarray, frequency: np.ndarray) -> np.ndarray:
    """A_k of every partial, 1/s [..., partials, N, N]; `cents` is [..., 1, N]."""
    own = p[..., None] + 2j * np.pi * frequency[:, None] * np.expm1(np.log(2) / 1200 * cents)
    return own[..., None] * np.eye(cents.shape[-1]) - g[..., None, None]


def shape(a: np.ndarray, bands: Bands) -> np.ndarray:
    """1ᵀ exp(A t) 1 / N in the bands [..., partials, frames], without eigenvectors, which may coincide."""

    def propagator(seconds: np.ndarray) -> np.ndarray:
        return exponential(a * seconds[:, None, None])

    tap, ones = propagator(bands.kernel / TAPS), np.ones((*a.shape[:-1], 1), complex)
    states = np.zeros_like(ones)
    for weight in (1 - np.cos(2 * np.pi * np.arange(TAPS) / TAPS)) / TAPS:
        states = tap @ states + weight * ones
    # The first tap with a weight lies one step after the start of the kernel of the first frame.
    states, step = propagator(bands.start - bands.kernel / 2 + bands.kernel / TAPS) @ states, propagator(bands.step)
    while states.shape[-1] < bands.values.shape[-1]:
        states = np.concatenate([states, step @ states], axis=-1)
        step = step @ step
    return states[..., : bands.values.shape[-1]].mean(axis=-2)


def exponential(a: np.ndarray) -> np.ndarray:
    """exp(a) of a batch of small matrices [..., N, N], by scaling and squaring of the Taylor series."""
    size = float(np.abs(a).sum(axis=-1).max())
    squarings = max(0, int(np.ceil(np.log2(max(size, SMALL) / SMALL))))
    power, identity = a / 2**squarings, np.eye(a.shape[-1])
    out = identity + 0 * power
    for k in range(TERMS, 0, -1):
        out = identity + power @ out / k
    for _ in range(squarings):
        out = out @ out
    return out


class Point(NamedTuple):
    """State of a search for each partial: n log S, its normal matrix, and half its negative gradient."""

    cost: np.ndarray  # [starts, partials]
    matrix: np.ndarray  # by Re p, Im p, Re g, Im g and d [starts, partials, 3 + N, 3 + N]
    score: np.ndarray  # [starts, partials, 3 + N]


def at(bands: Bands, basis: np.ndarray, d: np.ndarray, p: np.ndarray, g: np.ndarray) -> Point:
    """Evaluate mistunings d times `basis`, whose rows [N - 1, N] have the mean 0."""

    def model(d: np.ndarray, p: np.ndarray, g: np.ndarray) -> np.ndarray:
        return shape(matrices(p, g, (d @ basis)[..., None, :], bands.frequency), bands)

    s = model(d, p, g)
    by_p, by_g = (model(d, p + STEP_RATE, g) - s) / STEP_RATE, (model(d, p, g + STEP_RATE) - s) / STEP_RATE
    by_d = [(model(d + STEP_CENTS * unit, p, g) - s) / STEP_CENTS for unit in np.eye(len(basis))]
    u, v = bands.values * bands.weight, bands.weight * s[..., None, :]
    power = np.maximum((np.abs(v) ** 2).sum(axis=-1, keepdims=True), 1e-300)
    gain = (v.conj() * u).sum(axis=-1, keepdims=True) / power
    columns = []
    for x in (by_p, 1j * by_p, by_g, 1j * by_g, *by_d):
        moved = gain * bands.weight * x[..., None, :]
        moved = moved - v * (v.conj() * moved).sum(axis=-1, keepdims=True) / power
        columns.append(moved.reshape(*moved.shape[:-2], -1))
    jacobian, left = np.stack(columns, axis=-2), (u - gain * v).reshape(*s.shape[:-1], 1, -1)
    share = (np.abs(left) ** 2).sum(axis=(-2, -1)) + 1e-12
    scale = bands.samples / share
    matrix = np.real(jacobian.conj() @ jacobian.swapaxes(-1, -2)) * scale[..., None, None]
    return Point(bands.samples * np.log(share), matrix, (jacobian.conj() * left).sum(axis=-1).real * scale[..., None])


def reduced(matrix: np.ndarray, score: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Steps of p and g [.., 4, N] (at fixed d, then per step of d); matrix and score of d with p and g eliminated."""
    cross = matrix[..., :4, 4:]
    own = np.linalg.solve(matrix[..., :4, :4], np.concatenate([score[..., :4, None], cross], axis=-1))
    schur = cross.swapaxes(-1, -2) @ own
    return own, matrix[..., 4:, 4:] - schur[..., 1:], score[..., 4:] - schur[..., 0]


def search(
    bands: Bands, basis: np.ndarray, d: np.ndarray, p: np.ndarray, g: np.ndarray, *, together: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray, Point]:
    """Return d [starts, N - 1], p and g [starts, partials] after steps of all, or of each partial with fixed d."""

    def total(point: Point) -> np.ndarray:
        return point.cost.sum(axis=1, keepdims=True) if together else point.cost

    point = at(bands, basis, d, p, g)
    damping = np.full_like(total(point), 1e-2)
    for _ in range(TOGETHER if together else ALONE):
        ridge = np.eye(point.matrix.shape[-1])
        own, inner, score = reduced(point.matrix * (1 + damping[..., None, None] * ridge) + 1e-9 * ridge, point.score)
        move = np.zeros_like(d)
        if together and d.size:
            move = np.linalg.solve(inner.sum(axis=1), score.sum(axis=1)[..., None])[..., 0]
        x = own[..., 0] - (own[..., 1:] @ move[:, None, :, None])[..., 0]
        p2, g2 = p + x[..., 0] + 1j * x[..., 1], g + x[..., 2] + 1j * x[..., 3]
        p2, g2 = np.minimum(p2.real, -SLOWEST) + 1j * p2.imag, np.maximum(g2.real, 0) + 1j * g2.imag
        trial = at(bands, basis, d + move, p2, g2)
        better = total(trial) < total(point)
        damping = np.clip(np.where(better, damping / 4, damping * 6), 1e-9, 1e9)
        p, g, d = np.where(better, p2, p), np.where(better, g2, g), np.where(better, d + move, d) if together else d
        point = Point(
            np.where(better, trial.cost, point.cost),
            np.where(better[..., None, None], trial.matrix, point.matrix),
            np.where(better[..., None], trial.score, point.score),
        )
    return d, p, g, point


def drawn(bands: Bands, strings: int, size: tuple[int, int], random: np.random.Generator) -> np.ndarray:
    """Draw starts of p, at one of the partial's modes, and of g, 1/s [2, *size, partials]."""
    fastest = np.array([-np.real(m.pole).min() for m in bands.modes])
    p = np.stack([random.choice(m.pole, size) for m in bands.modes], axis=-1)
    phase = np.exp(0.5j * np.pi * random.uniform(-1, 1, p.shape))
    return np.array([p, fastest / strings * log_uniform(random, COUPLED, p.shape) * phase])


def log_uniform(random: np.random.Generator, span: tuple[float, float], size: tuple[int, ...] = ()) -> np.ndarray:
    """Draw numbers with a uniform logarithm between two positive numbers."""
    return np.exp(random.uniform(np.log(span[0]), np.log(span[1]), size))


def unison(bands: Bands, strings: int, seed: int = 1) -> Unison:
    """Fit `strings` strings from many starts, and return the best fit."""
    random, basis, partials = np.random.default_rng(seed), helmert(strings), len(bands.step)
    starts = STARTS if strings > 1 else 1
    d = random.normal(size=(starts, strings - 1))
    d *= (
        log_uniform(random, DRAWN, (starts, 1))
        * np.sqrt(strings)
        / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-9)
    )
    x = drawn(bands, strings, (starts, 1), random)
    end = at(bands, basis, d, *x[:, :, 0])
    for _ in range(ROUNDS):
        x = np.concatenate([x, drawn(bands, strings, (starts, TRIES), random)], axis=2)
        flat = x.reshape(2, -1, partials)
        _, *tried, point = search(bands, basis, np.repeat(d, TRIES + 1, axis=0), *flat, together=False)
        best = point.cost.reshape(starts, -1, partials).argmin(axis=1)[:, None]
        p, g = (np.take_along_axis(y.reshape(starts, -1, partials), best, axis=1)[:, 0] for y in tried)
        d, p, g, end = search(bands, basis, d, p, g, together=True)
        x = np.array([p, g])[:, :, None]
    return best_fit(bands, basis, d, end)


def best_fit(bands: Bands, basis: np.ndarray, d: np.ndarray, end: Point) -> Unison:
    """Return evidence and mistunings of the best start."""
    total, strings, partials = end.cost.sum(axis=1), basis.shape[1], len(bands.step)
    best = int(total.argmin())
    numbers = (bands.weight > 0).any(axis=2).sum(axis=1) + (2 if strings > 1 else 1)
    penalty = (numbers * np.log(bands.samples)).sum() + 0.5 * (strings - 1) * np.log(bands.samples.sum())
    cents = d[best] @ basis
    contrast = np.diff(basis.T[np.argsort(cents)], axis=0)
    _, inner, score = reduced(end.matrix[best] + 1e-9 * np.eye(strings + 3), end.score[best])
    bread = np.linalg.inv(inner.sum(axis=0))
    covariance = contrast @ bread @ (score.T @ score) @ bread @ contrast.T * partials / (partials - len(basis))
    return Unison(
        float(-total[best] - penalty), np.diff(np.sort(cents)), np.sqrt(np.diag(covariance)),
        int((total < total[best] + ALIKE).sum()), float(np.median(np.exp(end.cost[best] / bands.samples))),
    )  # fmt: skip
