"""Compare three methods to measure partials, on synthetic recordings.

    python benchmarks/partials_study.py [--notes N]
    python benchmarks/partials_study.py --errors [--notes N]

- pencil: ESPRIT (a matrix pencil) on the baseband of each partial, with one component
- peak: a damped peak, A²/((ω − ω_k)² + (α + σ)²), fitted by least squares to the power spectrum on the damped circle σ
- pianofit: `analyse`: least squares on the basebands with the neighbours subtracted, and ESPRIT for beating partials

The notes lie from A0 to A6, with level differences of up to 40 dB between partials. Errors are medians and 95 %
quantiles over all detected partials; `found` is the share of these. Beating partials have a second component 0.3 to
4 Hz away, up to 12 dB weaker. Their frequency is compared with that of the stronger component, their level with that of
the sum. The peak and the pencil have the true frequencies as input; `analyse` has only the note.

With `--errors` the study tests the standard errors. The notes are single exponentials from A0 to C6, 3 s, with decay
rates from 0.5 to 20 1/s, in white noise 40 and 70 dB below the rms of the first second. `z` is the rms of
(estimate - true value) over standard error, by the signal-to-noise ratio of the partials, and should be 1. `systematic`
is the median ratio of the systematic to the standard error, and should be 0.
"""

from __future__ import annotations

import argparse
import itertools
import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pianofit.analysis import analyse, hz_to_note
from pianofit.dsp.bands import kaiser_bands
from pianofit.dsp.level import energy_level
from pianofit.recording.recording import Recording, recording_from_samples

RATE, SECONDS, LEAD = 44100, 6.0, 0.05
STRINGS = (
    (27.5, 3e-4, 60, 0.3, 3e-3),
    (65.4, 1.5e-4, 50, 0.5, 4e-3),
    (261.6, 4e-4, 25, 1.0, 0.03),
    (1760.0, 6e-3, 6, 6.0, 0.6),
)
CASES = ("clean", "noise", "beating", "missing", "glide")
SIGMA = 8.0  # 1/s
SINGLE = ((27.5, 3e-4, 40), (87.3, 2e-4, 36), (261.6, 4e-4, 20), (1046.5, 1.5e-3, 8))  # f0 in Hz, B, partials
DOWN = (40.0, 70.0)  # dB
RATIOS = (0.0, 25.0, 35.0, 45.0, 60.0, 80.0, np.inf)  # dB, edges of the rows of the table of errors


@dataclass(frozen=True)
class Truth:
    """True partials of a synthetic recording; arrays are [partials]."""

    number: np.ndarray
    frequency: np.ndarray
    decay: np.ndarray
    level: np.ndarray


def amplitudes(count: int, rng: np.random.Generator) -> NDArray[np.complex128]:
    """Draw amplitudes over a range of 40 dB, with random phases [count]."""
    size = 0.05 * 10 ** (-rng.uniform(0, 40, count) / 20)
    phase: NDArray[np.complex128] = np.exp(2j * np.pi * rng.random(count))
    return size * phase


def synthesise(string: tuple[float, float, int, float, float], case: str, seed: int) -> tuple[Recording, Truth]:
    """Return one note and its true partials, which rise over 3 ms as with a hammer, with random phases and levels."""
    rng = np.random.default_rng(seed)
    f0, B, count, b1, d2 = string
    k = np.arange(1, count + 1)
    k = k[k % 8 != 0] if case == "missing" else k
    k = k[1:] if case == "missing" and f0 < 50 else k
    f, decay = k * f0 * np.sqrt(1 + B * k**2), b1 + d2 * k**2
    c = amplitudes(len(k), rng)[:, None]
    p = (-decay + 2j * np.pi * f)[:, None]
    if case == "beating":
        second = 10 ** (-rng.uniform(1, 12, len(k)) / 20) * np.exp(2j * np.pi * rng.random(len(k)))
        apart = rng.choice([-1, 1], len(k)) * rng.uniform(0.3, min(4.0, 0.1 * f0), len(k))
        c = np.hstack([c, c * second[:, None]])
        p = np.hstack([p, p + 2j * np.pi * apart[:, None]])
    t = np.arange(int(SECONDS * RATE)) / RATE
    # Glide of 3 cents with a time constant of 1 s, of each partial by the share of the tension.
    bend = 3 * np.log(2) / 1200 * (1 - np.exp(-t)) if case == "glide" else 0.0
    share = np.broadcast_to((1 / (1 + B * k**2))[:, None], p.shape)
    tones = (
        (a * np.exp(s.real * t + 1j * s.imag * (t + x * bend))).real
        for a, s, x in zip(c.flat, p.flat, share.flat, strict=True)
    )
    x = sum(tones, np.zeros(len(t)))
    x[: RATE * 3 // 1000] *= np.sin(np.linspace(0, np.pi / 2, RATE * 3 // 1000)) ** 2
    x = np.concatenate([np.zeros(int(LEAD * RATE)), x])
    if case != "clean":
        x = x + 1e-3 * np.sqrt(np.mean(x[: 2 * RATE] ** 2)) * rng.standard_normal(len(x))
    recording = replace(recording_from_samples(x, RATE), onset=int(LEAD * RATE))
    # Mean pitch over 0.2 to 1.0 s, the interval in which the analysis defines f0.
    sharp = 2 ** (3 / 1200 * share[:, 0] * (np.exp(-0.2) - np.exp(-1.0)) / 0.8) if case == "glide" else 1.0
    return recording, Truth(k, f * sharp, decay, energy_level(c, p))


def by_pencil(recording: Recording, truth: Truth) -> tuple[np.ndarray, ...]:
    """Measure by one-component ESPRIT on each baseband, over its first 2 s."""
    x, f0 = recording.samples[recording.onset :], float(np.min(np.diff(truth.frequency, prepend=0)))
    bands = kaiser_bands(x, RATE, truth.frequency, min(0.97 * f0, 100.0), 0.005)
    cut = bands.frames_within(0.0, 2.0)
    pole, amplitude = np.empty(len(truth.number), np.complex128), np.empty(len(truth.number), np.complex128)
    for i, z in enumerate(bands.z[:, cut]):
        hankel = np.lib.stride_tricks.sliding_window_view(z, len(z) // 3)
        vector = np.linalg.svd(hankel, full_matrices=False)[2][0].conj()
        pole[i] = np.log(np.vdot(vector[:-1], vector[1:]) / np.vdot(vector[:-1], vector[:-1])).conj() * bands.rate
        wave = np.exp(pole[i] * bands.time[cut])
        amplitude[i] = np.vdot(wave, z) / np.vdot(wave, wave).real
    level = energy_level((2 * amplitude / bands.gain(pole))[:, None], (pole + 2j * np.pi * bands.centre)[:, None])
    return truth.number, bands.centre + pole.imag / (2 * np.pi), -pole.real, level


def by_peak(recording: Recording, truth: Truth) -> tuple[np.ndarray, ...]:
    """Fit damped peaks to the power spectrum with exp(−8 t), each within a third of the distance to its neighbours."""
    from scipy.optimize import least_squares

    x = recording.samples[recording.onset :]
    t = np.arange(len(x)) / RATE
    power = np.abs(np.fft.rfft(x * np.exp(-SIGMA * t)) / RATE) ** 2
    step = RATE / len(x)
    reach = min(0.33 * float(np.min(np.diff(truth.frequency, prepend=0))), 30.0)
    out = []
    for f in truth.frequency:
        bins = np.arange(int((f - reach) / step), int((f + reach) / step) + 1)
        top = float(power[bins].max())

        def residual(v: np.ndarray, bins: np.ndarray = bins, top: float = top) -> np.ndarray:
            width = np.exp(v[1]) + SIGMA
            shape = width**2 / ((2 * np.pi * (bins * step - v[0])) ** 2 + width**2)
            return np.exp(v[2]) * shape - power[bins] / top

        box = ([f - reach, -7.0, -5.0], [f + reach, 5.0, 5.0])
        first = [np.clip(step * bins[np.argmax(power[bins])], f - 0.9 * reach, f + 0.9 * reach), 0.0, 0.0]
        v = least_squares(residual, first, bounds=box, x_scale=[0.1, 1.0, 1.0]).x
        decay = float(np.exp(v[1]))
        out.append((v[0], decay, 2 * np.sqrt(np.exp(v[2]) * top) * (decay + SIGMA)))
    frequency, decay, amplitude = np.array(out).T
    pole = (-decay + 2j * np.pi * frequency)[:, None]
    return truth.number, frequency, decay, energy_level(amplitude[:, None].astype(complex), pole)


def by_pianofit(recording: Recording, truth: Truth) -> tuple[np.ndarray, ...]:
    """Measure by `analyse`, with only the note as input."""
    f = truth.frequency / truth.number
    table = analyse(recording, note=hz_to_note(float(f[0]))).partials
    return table.number, table.frequency, table.decay, table.level


def errors(measured: tuple[np.ndarray, ...], truth: Truth) -> np.ndarray:
    """Return absolute errors [3, detected partials]: frequency in cents, decay rate in per cent, level in dB."""
    number, frequency, decay, level = measured
    exists = np.isin(number, truth.number)
    i = np.searchsorted(truth.number, number[exists])
    return np.abs(
        [
            1200 * np.log2(frequency[exists] / truth.frequency[i]),
            100 * (decay[exists] / truth.decay[i] - 1),
            level[exists] - truth.level[i],
        ]
    )


def single(f0: float, B: float, count: int, down: float, seed: int) -> tuple[Recording, Truth]:
    """Return one note of single exponentials in white noise `down` dB below it, and its true partials."""
    rng = np.random.default_rng([seed, count])
    k = np.arange(1, count + 1)
    f, decay = k * f0 * np.sqrt(1 + B * k**2), 0.5 * 40 ** (((k - 1) / (count - 1)) ** 1.5)
    c = amplitudes(count, rng)
    p = -decay + 2j * np.pi * f
    t = np.arange(3 * RATE) / RATE
    x = sum(((a * np.exp(s * t)).real for a, s in zip(c, p, strict=True)), np.zeros(len(t)))
    noise = 10 ** (-down / 20) * np.sqrt(np.mean(x[:RATE] ** 2))
    x = np.concatenate([np.zeros(int(LEAD * RATE)), x])
    x += noise * rng.standard_normal(len(x))
    recording = replace(recording_from_samples(x, RATE), onset=int(LEAD * RATE))
    return recording, Truth(k, f, decay, energy_level(c[:, None], p[:, None]))


def standardised(recording: Recording, truth: Truth) -> np.ndarray:
    """Return [7, partials]: SNR, dB; z of three quantities; their systematic over standard errors."""
    f = truth.frequency / truth.number
    table = analyse(recording, note=hz_to_note(float(f[0]))).partials
    i = np.searchsorted(truth.number, table.number)
    z, systematic = [], []
    for name in ("frequency", "decay", "level"):
        error = getattr(table, f"{name}_error")
        z.append((getattr(table, name) - getattr(truth, name)[i]) / error)
        systematic.append(np.sqrt(np.diag(getattr(table, f"{name}_systematic"))) / error)
    return np.stack([table.snr, *z, *systematic])


def print_errors(notes: int) -> None:
    """Print the test of the standard errors."""
    rows = np.hstack([standardised(*single(*n, d, seed)) for n in SINGLE for d in DOWN for seed in range(notes)])
    print("SNR, dB     partials   z: frequency  decay  level   systematic: frequency  decay  level")
    for low, high in itertools.pairwise(RATIOS):
        part = rows[:, (rows[0] >= low) & (rows[0] < high)]
        if not part.size:
            continue
        z, systematic = np.sqrt(np.mean(part[1:4] ** 2, axis=1)), np.median(part[4:], axis=1)
        print(f"{low:3.0f} to {high:4.0f} {part.shape[1]:10d}      {z[0]:10.2f} {z[1]:6.2f} {z[2]:6.2f}"
              f"  {systematic[0]:21.2f} {systematic[1]:6.2f} {systematic[2]:6.2f}")  # fmt: skip


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="compare methods to measure partials")
    parser.add_argument("--notes", type=int, default=3, help="random notes per string and case (3)")
    parser.add_argument("--errors", action="store_true", help="test the standard errors instead")
    arguments = parser.parse_args()
    notes = arguments.notes
    if arguments.errors:
        print_errors(notes)
        return
    methods = {"pencil": by_pencil, "peak": by_peak, "pianofit": by_pianofit}
    print(f"{'case':8} {'method':9} {'found':>6} {'cents: 50 %':>12} {'95 %':>9} {'decay, %':>9} {'95 %':>9} {'dB':>9} {'95 %':>9} {'s/note':>7}")  # fmt: skip  # noqa: E501
    for case in CASES:
        pairs = [synthesise(string, case, seed) for string in STRINGS for seed in range(notes)]
        total = sum(len(truth.number) for _, truth in pairs)
        for name, method in methods.items():
            start = time.process_time()
            error = np.hstack([errors(method(recording, truth), truth) for recording, truth in pairs])
            seconds = (time.process_time() - start) / len(pairs)
            numbers = " ".join(f"{x:9.2g}" for row in error for x in (np.median(row), np.quantile(row, 0.95)))
            print(f"{case:8} {name:9} {error.shape[1] / total:6.0%}    {numbers} {seconds:7.2f}")


if __name__ == "__main__":
    main()
