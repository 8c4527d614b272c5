"""Analysis of notes with known partials: precision, calibrated errors, robustness and rejections."""

from __future__ import annotations

import functools
import json
import re
from dataclasses import dataclass, replace

import numpy as np
import pytest
import scipy.stats

from pianofit.analysis import (
    Analysis,
    Partials,
    analyse,
    analysis_to_dict,
    hz_to_note,
    law_frequency,
    partial_rows,
)
from pianofit.analysis.baseband_fit import fit_bands, measure_levels
from pianofit.analysis.glide import PitchGlide, _fit_glide, glide_detected
from pianofit.analysis.inharmonicity import decay_law, frequency_law
from pianofit.analysis.note_names import midi_to_note, note_to_hz, note_to_midi
from pianofit.dsp.bands import kaiser_bands
from pianofit.dsp.level import energy_level
from pianofit.errors import AnalysisError, ParameterError, RecordingError
from pianofit.recording.recording import Recording, recording_from_samples

RATE, LEAD = 44100, 0.05


@dataclass(frozen=True, eq=False)
class Note:
    """A sum of damped cosines; complex amplitudes and poles [partials, components]."""

    number: np.ndarray
    amplitude: np.ndarray
    pole: np.ndarray

    def recording(self, *, seconds: float = 6.0, noise: float = 0.0, seed: int = 0, bend: float = 0.0) -> Recording:
        """The note after 50 ms of silence, with a rise of 3 ms; `bend` cents of glide decay with 1 s."""
        x = self._clean(seconds, bend)
        x = x + noise * np.random.default_rng(seed).standard_normal(len(x))
        return replace(recording_from_samples(x, RATE), onset=int(LEAD * RATE))

    @functools.lru_cache(maxsize=24)  # noqa: B019 - notes of a few seconds, used with different noise
    def _clean(self, seconds: float, bend: float) -> np.ndarray:
        count = int(seconds * RATE)
        x = self._gliding(np.arange(count) / RATE, bend) if bend else damped_cosines(self.amplitude, self.pole, count)
        rise = RATE * 3 // 1000
        x[:rise] *= np.sin(np.linspace(0, np.pi / 2, rise)) ** 2
        return np.concatenate([np.zeros(int(LEAD * RATE)), x])

    def _gliding(self, t: np.ndarray, bend: float) -> np.ndarray:
        late = bend * np.log(2) / 1200 * (1 - np.exp(-t))
        x = np.zeros(len(t))
        # Partials move by the share of the tension in their restoring force.
        harmonic = self.number * (self.frequency[0] / self.number[0])
        share = np.minimum((harmonic / self.frequency) ** 2, 1.0)
        for k in range(len(self.number)):
            for a, s in zip(self.amplitude[k], self.pole[k], strict=True):
                x += (a * np.exp(s.real * t + 1j * s.imag * (t + share[k] * late))).real
        return x

    @property
    def frequency(self) -> np.ndarray:
        """Hz, of the first component."""
        return self.pole[:, 0].imag / (2 * np.pi)

    @property
    def decay(self) -> np.ndarray:
        """Amplitude decay rate of the first component, 1/s."""
        return -self.pole[:, 0].real

    @property
    def level(self) -> np.ndarray:
        """Energies of the first 0.35 s under exp(−8 t), dB."""
        return energy_level(self.amplitude, self.pole)


def damped_cosines(amplitude: np.ndarray, pole: np.ndarray, count: int, block: int = 512) -> np.ndarray:
    """Sum of Re a exp(s t) at RATE: exp(s t) is the product of its values at a block's start and in the block."""
    a, s = amplitude.ravel(), pole.ravel() / RATE
    starts = np.exp(np.arange(0, count, block)[:, None] * s)
    return ((a * starts) @ np.exp(s[:, None] * np.arange(block))).real.ravel()[:count]


@functools.cache
def string(f0: float, B: float, partials: int, b1: float, d2: float, *, seed: int = 0, missing: int = 0) -> Note:
    """Random phases; levels of partials differ by up to 40 dB and fall by 20 dB towards the highest."""
    rng = np.random.default_rng(seed)
    k = np.arange(1, partials + 1)
    k = k[k % missing != 0] if missing else k
    frequency = k * f0 * np.sqrt(1 + B * k**2)
    size = 0.05 * 10 ** (-(rng.uniform(0, 40, len(k)) + 20 * k / partials) / 20)
    amplitude = size * np.exp(2j * np.pi * rng.random(len(k)))
    decay = np.minimum(b1 + d2 * k**2, 30.0)
    return Note(k, amplitude[:, None], (-decay + 2j * np.pi * frequency)[:, None])


STRINGS = {
    "A0": (27.5, 3e-4, 80, 0.3, 4.5e-3),
    "A2": (110.0, 1.5e-4, 60, 0.5, 5e-3),
    "C5": (523.25, 9e-4, 19, 1.5, 0.08),
    "A6": (1760.0, 6e-3, 5, 6.0, 0.8),
}


def test_note_names():
    assert note_to_midi("C4") == 60
    assert note_to_midi("Bb3") == 58
    assert note_to_midi("b#3") == 60  # one octave number up is C's
    assert [note_to_midi(name) for name in ("F#2", "Fs2", "fs2", "Gb2", "F♯2", "G♭2", " 42 ", "42")] == 8 * [42]
    assert (note_to_midi("0"), note_to_midi("127"), midi_to_note(42)) == (0, 127, "F#2")
    assert note_to_hz("A4") == 440.0
    assert note_to_hz("F#2") == pytest.approx(92.4986, abs=1e-4)
    assert hz_to_note(27.5) == "A0"
    assert hz_to_note(92.33) == "F#2"
    for nonsense in ("H4", "C", "4C", "C#", "F#2 ", "", "C44", "128", "-1", "4.2", "F##s2"):
        if nonsense.strip() != "F#2":
            with pytest.raises(AnalysisError, match="note"):
                note_to_midi(nonsense)


def test_levels_are_the_energy_of_the_first_third_of_a_second():
    rng = np.random.default_rng(1)
    c = rng.standard_normal((3, 2)) + 1j * rng.standard_normal((3, 2))
    p = -rng.uniform(0.2, 30, (3, 2)) + 2j * np.pi * rng.uniform(25, 60, (3, 2))
    t = np.linspace(0, 0.35, 400_001)
    wave = np.sum(c[..., None] * np.exp(p[..., None] * t), axis=1)
    energy = np.trapezoid(np.abs(wave) ** 2 / 2 * np.exp(-16 * t), t, axis=1)
    np.testing.assert_allclose(energy_level(c, p), 10 * np.log10(energy), atol=1e-6)


@pytest.mark.parametrize("name", STRINGS)
def test_precision_without_noise(name):
    truth = string(*STRINGS[name], seed=3)
    analysis = analyse(truth.recording(), note=name)
    table = analysis.partials
    audible = truth.level > truth.level.max() - 60
    assert np.all(np.isin(truth.number[audible], table.number))
    i = np.searchsorted(table.number, truth.number[audible])
    np.testing.assert_allclose(table.frequency[i], truth.frequency[audible], rtol=1e-6)
    np.testing.assert_allclose(table.decay[i], truth.decay[audible], rtol=1e-4)
    # The energy of the last one includes some of the next, which is too faint to be detected and subtracted.
    np.testing.assert_allclose(table.level[i][:-1], truth.level[audible][:-1], atol=5e-3)
    np.testing.assert_allclose(table.level[i][-1], truth.level[audible][-1], atol=0.15)
    f0, B, _, b1, d2 = STRINGS[name]
    assert analysis.f0 == pytest.approx(f0, rel=1e-7)
    assert pytest.approx(B, rel=1e-5) == analysis.B
    assert analysis.b1 == pytest.approx(b1, rel=1e-3)
    assert analysis.d2 == pytest.approx(d2, rel=1e-3)
    assert abs(analysis.glide_cents) < 1e-3
    assert analysis.scatter_cents < 1e-3


@pytest.mark.parametrize("name", ["A0", "A2", "A6"])
def test_errors_are_honest_and_near_the_bound(name):
    noise, standard, bound = 1e-5, [], []
    f0, B, partials, b1, d2 = STRINGS[name]
    truth = string(f0, B, min(partials, 40), b1, d2, seed=5)
    least = _cramer_rao(truth, noise)
    for seed in range(20 if name == "A6" else 6):
        table = analyse(truth.recording(noise=noise, seed=seed), note=name).partials
        i = np.searchsorted(truth.number, table.number)
        assert len(table) > 0.9 * len(truth.number)
        off = table.frequency - truth.frequency[i]
        standard.append(
            [
                off / table.frequency_error,
                (table.decay - truth.decay[i]) / table.decay_error,
                (table.level - truth.level[i]) / table.level_error,
            ]
        )
        bound.append(2 * np.pi * off / least[i])
    spread = np.std(np.hstack(standard), axis=1)
    assert np.all((spread > 0.8) & (spread < 1.25)), spread
    assert np.sqrt(np.mean(np.hstack(bound) ** 2)) < 1.7


def _cramer_rao(truth: Note, noise: float) -> np.ndarray:
    """Bound on the angular frequency of one damped cosine from 5 ms on, with all else known; 1/s."""
    t = np.arange(int(0.005 * RATE), 6 * RATE) / RATE
    out = []
    for a, s in zip(truth.amplitude[:, 0], truth.pole[:, 0], strict=True):
        weight = np.abs(a) ** 2 * np.exp(2 * s.real * t) / (2 * noise**2)
        zeroth, first, second = (np.sum(weight * t**n) for n in range(3))
        out.append(np.sqrt(zeroth / (zeroth * second - first**2)))
    return np.array(out)


def test_beating_partials_keep_their_level_and_dominant_frequency():
    rng = np.random.default_rng(7)
    one = string(261.6, 4e-4, 16, 1.0, 0.02, seed=7)
    weaker = 10 ** (-rng.uniform(2, 10, 16) / 20) * np.exp(2j * np.pi * rng.random(16))
    apart = rng.uniform(0.5, 4.0, 16)
    second = (one.pole[:, 0] + 2j * np.pi * apart)[:, None]
    truth = Note(
        one.number,
        np.hstack([one.amplitude, one.amplitude * weaker[:, None]]),
        np.hstack([one.pole, second]),
    )
    table = analyse(truth.recording(noise=1e-6), note="C4").partials
    i = np.searchsorted(truth.number, table.number)
    assert len(table) >= 15
    assert np.median(table.beating) > 1.5
    # The energy of two seconds is converted by the decay law, not by the apparent decay of a beating partial.
    off = table.level - truth.level[i]
    assert np.median(np.abs(off)) < 1.6
    assert np.sqrt(np.mean((off / _spread(table, "level")) ** 2)) < 2.0
    assert np.quantile(np.abs(table.frequency - truth.frequency[i]), 0.9) < 0.2
    clean = analyse(one.recording(noise=1e-6), note="C4").partials
    assert np.median(table.level_error) < 0.5
    assert np.median(_spread(table, "level")) > 0.1
    assert np.median(_spread(clean, "level")) < 1e-4  # the error of the decay law


def _spread(table: Partials, column: str) -> np.ndarray:
    """Standard deviations of systematic errors [partials]."""
    return np.sqrt(np.diag(getattr(table, f"{column}_systematic")))


def _two_axes(one: Note, cents: float, share: float) -> Note:
    """The stroke with an additional `share` on a second polarisation, `cents` higher."""
    detuning = 1j * one.pole.imag * (2 ** (cents / 1200) - 1)
    return Note(
        one.number, np.hstack([one.amplitude, share * one.amplitude]), np.hstack([one.pole, one.pole + detuning])
    )


def test_standard_errors_are_right_at_every_signal_to_noise_ratio():
    """Systematic errors are zero where none exist."""
    standard, seen, snr = [], [], []
    for name, down, partials in (("A0", 40.0, 40), ("A2", 55.0, 30), ("C5", 70.0, 12)):
        f0, B, _, b1, _ = STRINGS[name]
        truth = string(f0, B, partials, b1, 20.0 / partials**2, seed=9)
        silent = truth.recording(seconds=3.0)
        rms = np.sqrt(np.mean(silent.samples[silent.onset :][:RATE] ** 2))
        for seed in range(8):
            table = analyse(truth.recording(seconds=3.0, noise=rms * 10 ** (-down / 20), seed=seed), note=name).partials
            i = np.searchsorted(truth.number, table.number)
            for column in ("frequency", "decay", "level"):
                error, spread = getattr(table, f"{column}_error"), _spread(table, column)
                # The decay law that converts levels has only the error due to noise.
                whole = np.hypot(error, spread) if column == "level" else error
                standard.append((getattr(table, column) - getattr(truth, column)[i]) / whole)
                seen.append(spread / error if column != "level" else np.zeros(len(table)))
            snr.append(table.snr)
    snr = np.concatenate([np.concatenate(snr[n : n + 1] * 3) for n in range(len(snr))])
    standard, seen = np.concatenate(standard), np.concatenate(seen)
    for low, high in ((0, 40), (40, 55), (55, 75), (75, np.inf)):
        z = standard[(snr >= low) & (snr < high)]
        assert len(z) > 100
        assert np.sqrt(np.mean(z**2)) == pytest.approx(1.0, abs=0.13)
        assert abs(np.mean(z)) < 4 / np.sqrt(len(z))
    assert np.median(seen) == 0.0
    assert np.mean(seen > 0.3) < 0.07  # an error caused by noise alone also affects its four neighbours


@pytest.mark.parametrize(("name", "cents"), [("A0", 2.0), ("A2", 1.5), ("C5", 1.0)])
def test_systematic_covariances_cover_what_a_second_axis_does(name, cents):
    f0, B, _, b1, _ = STRINGS[name]
    one, share = string(f0, B, 12, b1, 20.0 / 30**2, seed=3), 0.2
    table = analyse(_two_axes(one, cents, share).recording(seconds=3.0, noise=1e-6), note=name).partials
    i = np.searchsorted(one.number, table.number)
    # The mean pitch of each recording is free.
    ratio = table.frequency / one.frequency[i]
    off = {
        "frequency": table.frequency * (1 - np.mean(ratio) / ratio),
        "decay": table.decay - one.decay[i],
        "level": table.level - one.level[i] - 20 * np.log10(1 + share),
    }
    for column, away in off.items():
        systematic = getattr(table, f"{column}_systematic")
        assert np.linalg.eigvalsh(systematic).min() > -1e-12 * np.trace(systematic)
        z = away / np.hypot(_spread(table, column), getattr(table, f"{column}_error"))
        assert np.sqrt(np.mean(z**2)) < 2.5, column
        assert np.median(np.abs(away) / getattr(table, f"{column}_error")) > 3, column


@pytest.mark.parametrize(("name", "cents", "share"), [("A0", 2.9, 0.35), ("A0", 4.0, 0.5), ("A2", 3.5, 0.5)])
def test_beats_of_one_stroke_change_all_levels_alike(name, cents, share):
    """They begin in phase: errors that only neighbours share explain their effect less well, and are not too small."""
    f0, B, _, b1, _ = STRINGS[name]
    one = string(f0, B, 30, b1, 20.0 / 30**2, seed=3)
    table = analyse(_two_axes(one, cents, share).recording(seconds=3.0, noise=1e-6), note=name).partials
    away = table.level - one.level[np.searchsorted(one.number, table.number)] - 20 * np.log10(1 + share)
    sd, noise = _spread(table, "level"), np.diag(table.level_error**2 + 0.1**2)
    near = np.outer(sd, sd) * np.exp(-np.abs(table.number[:, None] - table.number) / 10)
    assert away @ np.linalg.solve(table.level_systematic + noise, away) < len(away)
    ours, others = (
        scipy.stats.multivariate_normal(cov=covariance + noise).logpdf(away)
        for covariance in (table.level_systematic, near)
    )
    assert ours > others + 5


def test_unrelated_beats_do_not_bend_the_law_of_the_decay_rates():
    """Errors that neighbours shared would: a law by least squares would then follow their pattern over the partials."""
    off = []
    for seed in range(4):
        one = string(65.4, 1e-4, 45, 0.5, 1e-3, seed=seed)
        rng = np.random.default_rng(seed)
        share = rng.uniform(0.3, 0.7, 45) * np.exp(2j * np.pi * rng.random(45))
        apart = one.pole + 2j * np.pi * rng.uniform(0.2, 1.5, 45)[:, None]
        both = Note(one.number, one.amplitude * np.stack([np.ones(45), share], 1), np.hstack([one.pole, apart]))
        table = analyse(both.recording(noise=1e-6), note="C2").partials
        law = np.stack([np.ones(len(table)), table.number**2.0], 1)
        # Relative deviations of a string from its law, as in F.
        own = table.decay_error**2 + (0.1 * (law @ [0.5, 1e-3])) ** 2
        inverse = np.linalg.inv(table.decay_systematic + np.diag(own))
        off.append(np.linalg.solve(law.T @ inverse @ law, law.T @ inverse @ table.decay) / [0.5, 1e-3] - 1)
    assert np.sqrt(np.mean(np.square(off), axis=0)).max() < 0.5


def test_a_beat_does_the_same_to_loud_and_soft_recordings():
    both = _two_axes(string(220.0, 2e-4, 20, 1.0, 0.02, seed=5), 2.0, 0.3)
    loud, soft = (analyse(both.recording(noise=noise), note="A3") for noise in (1e-6, 3e-5))
    loud, soft = loud.partials, soft.with_decay_law(loud).partials
    _, i, j = np.intersect1d(loud.number, soft.number, return_indices=True)
    assert len(j) > 15
    z = (loud.level[i] - soft.level[j]) / np.hypot(loud.level_error[i], soft.level_error[j])
    assert np.sqrt(np.mean(z**2)) < 1.4


def test_windows_begin_at_one_time_however_long_the_recording_is():
    """The effect of a beat on a sum of frames depends on their start."""
    samples = string(*STRINGS["A0"], seed=4).recording().samples
    first = {kaiser_bands(samples[:n], RATE, np.array([27.5, 55.0]), 26.0, 0.005).time[0] for n in (88_200, 100_003)}
    assert len(first) == 1


def test_levels_by_another_law_of_decays_are_those_measured_by_it():
    """To third order: for laws that differ by half, the conversion leaves less than 2 % of the difference."""
    samples = string(*STRINGS["A2"], seed=4).recording(noise=1e-5).samples[int(LEAD * RATE) :]
    number, (f0, B, _, b1, d2) = np.arange(1, 13), STRINGS["A2"]
    bands = kaiser_bands(samples, RATE, law_frequency(f0, B, number), 0.97 * f0, 0.005)
    fitted = fit_bands(bands, np.full(len(number), 1e-14))

    def by(factor: float) -> Analysis:
        laws = replace(first, level_law=(factor * b1, factor * d2))
        decay = factor * (b1 + d2 * number**2.0)
        level, error, lag = measure_levels(fitted, law_frequency(f0, B, number), decay)
        table = replace(first.partials, number=number, level=level, level_error=error, level_decay_sensitivity_s=lag)
        return replace(laws, partials=table)

    first = analyse((samples, RATE), note="A2")
    one, other = by(0.8), by(1.2)
    before, after = (np.abs(x.partials.level - other.partials.level) for x in (one, one.with_decay_law(other)))
    assert before.max() > 0.1
    assert (after < before / 50).all()


def test_a_level_keeps_its_law_where_the_other_is_too_different():
    """A tone at a high number that no string has made: by the law of another recording it would be louder than all."""
    one = analyse((string(*STRINGS["A2"], seed=4).recording().samples, RATE), note="A2")
    number = one.partials.number.copy()
    number[-1] = 64
    stray = replace(one, partials=replace(one.partials, number=number))
    moved = stray.with_decay_law(replace(one, level_law=(one.level_law[0], one.level_law[1] + 0.1))).partials
    assert moved.level[-1] == one.partials.level[-1]
    lag = 0.5 * (moved.level_decay_sensitivity_s[-1] + one.partials.level_decay_sensitivity_s[-1])
    assert moved.level_error[-1] >= 20 / np.log(10) * lag * 0.1 * 64**2
    assert (moved.level_error[:5] == one.partials.level_error[:5]).all()


def test_a_weak_partial_that_beats_faintly_keeps_its_level_beside_loud_ones():
    k = np.arange(1, 25)
    amplitude = np.where(k % 4 == 0, 0.003, 0.3 / k)[:, None].astype(complex)
    pole = (-1.0 - 0.01 * k**2 + 2j * np.pi * 110.0 * k * np.sqrt(1 + 2e-4 * k**2))[:, None]
    truth = _two_axes(Note(k, amplitude, pole), 1.0, 0.05)
    table = analyse(truth.recording(noise=1e-6), note="A2").partials
    weak = table.number % 4 == 0
    assert weak.sum() >= 5
    assert np.abs(table.level - truth.level[table.number - 1])[weak].max() < 0.15


def test_absent_partials_are_bounded_by_the_energy_in_their_bands():
    one = string(220.0, 2e-4, 20, 1.0, 0.02, seed=5)
    size = np.where(one.number % 5 == 0, 1e-6, 1.0)[:, None] * one.amplitude
    hidden = Note(one.number, size, one.pole)
    analysis = analyse(hidden.recording(noise=1e-4), note="A3")
    table = analysis.partials
    assert {5, 10, 15, 20} <= set(table.absent)
    assert not set(table.absent) & set(table.number)
    frequency = law_frequency(analysis.f0, analysis.B, table.absent)
    assert np.all(np.diff(table.absent) > 0)
    assert 11000 < frequency.max() < 12000
    inside = table.absent <= 20
    assert np.all(table.absent_bound[inside] > hidden.level[table.absent[inside] - 1])
    # Noise in a band of 0.3 spacings to either side, under exp(-8t), without a partial.
    noise = 10 * np.log10(analysis.noise_density[0] * 0.6 * 220 / 16)
    assert np.median(table.absent_bound) == pytest.approx(noise, abs=4.0)
    loud = analyse(one.recording(noise=1e-4), note="A3").partials
    assert not {5, 10, 15, 20} & set(loud.absent)


def test_a_glide_tells_how_sharp_it_began():
    truth = string(55.0, 2e-4, 40, 0.3, 3e-3, seed=2)
    analysis = analyse(truth.recording(noise=1e-5, bend=6.0), note="A1")
    # It starts 6 cents sharp and falls as exp(-t). `glide_start` is relative to the mean from 0.2 to 1.0 s.
    mean = 6.0 * (1 - (np.exp(-0.2) - np.exp(-1.0)) / 0.8)
    assert analysis.glide_start == pytest.approx(mean, abs=0.2)
    assert analyse(truth.recording(noise=1e-5), note="A1").glide_start == 0.0


def test_a_fall_of_pitch_is_one_only_if_it_is_sure():
    at_rest = (0.2, 1.0, 0.0, 0.0)
    assert glide_detected([(0.0, 0.35, 1.0, 0.1), at_rest])
    assert not glide_detected([(0.0, 0.35, 1.0, 0.3), at_rest, (1.0, 2.0, -2.0, np.inf)])
    assert not glide_detected([(0.0, 0.35, 0.005, 0.001), at_rest])
    assert not glide_detected([at_rest])


def test_a_glide_too_small_to_hear_biases_no_level():
    """Otherwise, high partials of soft strokes are 0.03 dB too loud, while the glide of hard strokes is removed."""
    truth = string(185.0, 2.3e-4, 26, 0.4, 3e-3, seed=6)
    glides, stays = (analyse(truth.recording(noise=1e-7, bend=b), note="F#3").partials for b in (0.08, 0.0))
    np.testing.assert_allclose(glides.level, stays.level, atol=0.004)


def test_windows_that_no_glide_explains_do_not_become_one_of_the_first_50_ms():
    """Beats raise the pitch of the first window by 0.1 cents: two polarisations, 0.8 cents apart, of a bass string."""
    spans, errors = [(0.0, 0.35), (1.0, 2.0), (2.0, 3.0)], np.full(3, 0.002)
    beats = _fit_glide(spans, np.array([0.104, 0.010, 0.021]), errors)
    assert abs(beats.start_cents) < 0.1
    # One window says nothing of τ: it is that of most recorded strings.
    assert 0.4 < _fit_glide(spans[:1], np.array([0.3]), errors[:1]).tau < 1.6
    for start, tau in ((0.1, 0.4), (3.0, 0.2), (-1.0, 2.0)):
        true = PitchGlide(start, tau)
        falls = [1731.2 * np.mean(true.relative_deviation(np.linspace(*span, 1000))) for span in spans]
        found = _fit_glide(spans, np.array(falls), errors)
        assert found.start_cents == pytest.approx(start, rel=0.05)
        assert found.tau == pytest.approx(tau, rel=0.05)


def test_a_short_note_that_glides_says_how_little_is_known_of_it():
    """Only the first partial lasts into the third window, so the time constant is not determined."""
    truth = string(1046.5, 1e-3, 9, 4.0, 0.9, seed=6)
    analysis = analyse(truth.recording(seconds=3.0, noise=1e-5, bend=6.0), note="C6")
    mean = 6 * (np.exp(-0.2) - np.exp(-1.0)) / 0.8
    assert 1200 * np.log2(analysis.f0 / 1046.5) == pytest.approx(mean, abs=4 * analysis.glide_error)
    assert 0.1 < analysis.glide_error < 1.0


def test_missing_partials_are_not_invented():
    truth = string(110.0, 2e-4, 40, 0.5, 5e-3, seed=2, missing=8)
    table = analyse(truth.recording(noise=1e-6), note="A2").partials
    assert set(table.number) <= set(truth.number)
    assert len(table) >= len(truth.number) - 2


def test_bass_without_its_first_partials():
    whole = string(27.5, 3e-4, 60, 0.3, 3e-3, seed=4)
    truth = Note(whole.number[3:], whole.amplitude[3:], whole.pole[3:])
    analysis = analyse(truth.recording(noise=1e-6))
    assert analysis.f0 == pytest.approx(27.5, rel=1e-5)
    assert analysis.partials.number.min() == 4


@pytest.mark.parametrize("name", ["A0", "A2"])
def test_partials_keep_their_numbers_where_a_string_leaves_its_law(name):
    note = string(*STRINGS[name], seed=3)
    cents = -2.5 * (note.number / 20) ** 3  # as on an A0: more than a spacing from partial 60 on
    bent = replace(note, pole=note.pole.real + 1j * note.pole.imag * 2.0 ** (cents / 1200)[:, None])
    table = analyse(bent.recording(noise=1e-6), f0=STRINGS[name][0]).partials
    assert len(table) > 0.95 * len(note.number)
    true = bent.frequency[table.number - 1]
    assert 1200 * np.abs(np.log2(table.frequency / true)).max() < 1.0


def test_glide_is_measured_and_frequencies_come_from_the_second_window():
    truth = string(92.5, 2.3e-4, 40, 0.4, 3e-3, seed=6)
    analysis = analyse(truth.recording(noise=1e-6, bend=4.0), note="F#2")
    # the pitch is 4 exp(−t) cents above its end; means over a window of the phase's slope
    early, late = (4 * np.exp(-np.mean(analysis.glide[i][:2])) for i in (0, -1))
    assert analysis.glide_cents == pytest.approx(early - late, abs=0.3)
    middle = 4 * (np.exp(-0.2) - np.exp(-1.0)) / 0.8
    assert 1200 * np.log2(analysis.f0 / 92.5) == pytest.approx(middle, abs=0.25)
    assert any("cents" in line for line in analysis.warnings)


def test_a_glide_is_no_loss():
    truth = string(92.5, 2.3e-4, 40, 0.4, 3e-3, seed=6)
    analysis = analyse(truth.recording(noise=1e-6, bend=4.0), note="F#2")
    mean = 1 + 4 * (np.exp(-0.2) - np.exp(-1.0)) / 0.8 * np.log(2) / 1200
    own = np.searchsorted(truth.number, analysis.partials.number)
    # The tension is higher, and the stiffness is the same.
    higher = (mean**2 + 2.3e-4 * truth.number[own] ** 2) / (1 + 2.3e-4 * truth.number[own] ** 2)
    # Without removal of the glide, decay rates of high partials are up to a quarter too large, and b1 and d2 as well.
    np.testing.assert_allclose(analysis.partials.decay, truth.decay[own], rtol=0.03)
    assert analysis.d2 == pytest.approx(3e-3, rel=0.01)
    assert pytest.approx(2.3e-4 / mean**2, rel=1e-3) == analysis.B
    cents = 1200 * np.log2(analysis.partials.frequency / (truth.frequency[own] * np.sqrt(higher)))
    assert np.abs(cents).max() < 0.05
    assert 0.0 < analysis.glide_error < 0.05
    assert analyse(truth.recording(noise=1e-6), note="F#2").glide_error == 0.0


@pytest.mark.parametrize("name", STRINGS)
def test_the_pitch_is_found_without_a_hint(name):
    truth = string(*STRINGS[name], seed=8)
    analysis = analyse(truth.recording(seconds=2.0, noise=1e-5))
    assert analysis.f0 == pytest.approx(STRINGS[name][0], rel=1e-3)
    assert analysis.note is None


@pytest.mark.parametrize(
    ("name", "wrong"), [("A2", "C3"), ("A2", "G2"), ("A2", "A1"), ("A2", "A3"), ("C5", "F4"), ("A0", "D1")]
)
def test_a_note_that_is_not_there(name, wrong):
    recording = string(*STRINGS[name], seed=8).recording(seconds=2.0, noise=1e-5)
    with pytest.raises(AnalysisError, match=rf"{wrong}.*{name} .*--note.*--f0"):
        analyse(recording, note=wrong)


def test_rumble_beside_the_lowest_partial_is_none_of_them():
    """Low partials follow the law even if high ones deviate from it; their neighbours are not affected."""
    truth = string(*STRINGS["A0"], seed=8)
    low = truth.number > 1
    bent = truth.pole.real[low] + 1j * truth.pole.imag[low] * 2.0 ** (-0.0015 * truth.number[low, None] ** 3 / 1200)
    clean = Note(truth.number[low], truth.amplitude[low], bent)
    rumble = Note(np.array([1]), np.array([[0.002 + 0j]]), np.array([[-1.0 + 2j * np.pi * 1.1 * STRINGS["A0"][0]]]))
    both = Note(*(np.concatenate(pair) for pair in zip(vars(clean).values(), vars(rumble).values(), strict=True)))
    expected, analysis = (analyse(one.recording(noise=1e-5), note="A0") for one in (clean, both))
    assert 1 not in analysis.partials.number
    assert abs(1200 * np.log2(analysis.f0 / expected.f0)) < 0.5
    assert analysis.f0_error < 2 * expected.f0_error


@pytest.mark.parametrize(("name", "expected_text"), [("G#2", "above G#2"), ("A#2", "below A#2"), ("45", None)])
def test_a_note_a_semitone_off_its_name_says_so(name, expected_text):
    analysis = analyse(string(*STRINGS["A2"], seed=3).recording(noise=1e-5), note=name)
    assert analysis.note == name if expected_text else analysis.note == "A2"
    matching = [warning for warning in analysis.warnings if "check the note's name" in warning]
    assert len(matching) == bool(expected_text)
    assert expected_text is None or expected_text in matching[0]


@pytest.mark.parametrize("name", STRINGS)
@pytest.mark.parametrize(("gain", "detected"), [(1.0, True), (0.3, True), (0.0, False)])
def test_a_second_stroke_is_noticed(name, gain, detected):
    once = string(*STRINGS[name], seed=3).recording(noise=1e-5)
    later = round(1.5 * RATE)
    sound = once.samples + gain * np.pad(once.samples, (later, 0))[: len(once.samples)]
    analysis = analyse(recording_from_samples(sound, RATE), note=name)
    times = [float(re.findall(r"about ([\d.]+) s", text)[0]) for text in analysis.warnings if "second stroke" in text]
    assert times == ([pytest.approx(1.5, abs=0.1)] if detected else [])


def test_f0_in_place_of_a_note():
    recording = string(*STRINGS["A2"], seed=8).recording(seconds=2.0)
    assert analyse(recording, f0=108.0).f0 == pytest.approx(110.0, rel=1e-5)
    with pytest.raises(AnalysisError, match="f0=9 Hz"):
        analyse(recording, f0=9.0)
    assert analyse(recording, f0=108.0, note="A2").f0 == pytest.approx(110.0, rel=1e-5)
    with pytest.raises(ParameterError, match="f0=108 Hz is not note C4"):
        analyse(recording, f0=108.0, note="C4")


def test_errors_of_floats_are_those_of_numpy_whatever_the_caller_chose():
    recording = string(*STRINGS["A2"], seed=8).recording(seconds=2.0)
    with np.errstate(all="raise"):
        assert analyse(recording, note="A2").f0 == pytest.approx(110.0, rel=1e-5)
        assert np.geterr()["under"] == "raise"


def test_too_short_for_the_note():
    with pytest.raises(AnalysisError, match=r"too short for a note of 27\.\d Hz"):
        analyse(string(*STRINGS["A0"], seed=8).recording(seconds=0.3), note="A0")
    with pytest.raises(RecordingError, match="at least 80 ms are needed"):
        analyse(string(*STRINGS["C5"], seed=8).recording(seconds=0.07), note="C5")
    short = analyse(string(*STRINGS["C5"], seed=8).recording(seconds=0.12), note="C5")
    assert short.f0 == pytest.approx(523.25, rel=1e-3)


def test_noise_is_no_note():
    noise = 0.1 * np.random.default_rng(0).standard_normal(2 * RATE)
    recording = replace(string(*STRINGS["A2"]).recording(seconds=2.0), samples=noise, onset=0)
    with pytest.raises(AnalysisError, match=r"--note|--f0"):
        analyse(recording)
    with pytest.raises(AnalysisError, match=r"C4.*noise.*note"):
        analyse(recording, note="C4")


@pytest.mark.parametrize("rate", [8000, 96000])
def test_other_rates(rate):
    t = np.arange(2 * rate) / rate
    k = np.arange(1, 13)[:, None]
    f = k * 220 * np.sqrt(1 + 3e-4 * k**2)
    x = np.sum(0.05 / k * np.exp(-(1 + 0.02 * k**2) * t) * np.sin(2 * np.pi * f * t), axis=0)
    analysis = analyse(recording_from_samples(x, rate), note="A3")
    assert analysis.f0 == pytest.approx(220, rel=1e-6)
    assert pytest.approx(3e-4, rel=1e-3) == analysis.B


def test_laws_shrug_off_outliers():
    k = np.arange(1, 31)
    f = k * 92.33 * np.sqrt(1 + 2.3e-4 * k**2)
    f[[4, 11, 20]] *= 1.01
    law = frequency_law(k, f, np.full(30, 1e-4))
    assert law.f0 == pytest.approx(92.33, rel=2e-4)
    assert pytest.approx(2.3e-4, rel=0.02) == law.B
    decay = 0.4 + 3e-3 * k**2
    decay[[2, 17]] *= 4
    losses = decay_law(k, decay, 0.01 * decay)
    assert losses.b1 == pytest.approx(0.4, rel=0.1)
    assert losses.d2 == pytest.approx(3e-3, rel=0.1)


def test_losses_that_do_not_rise_stay_in_bounds():
    k = np.arange(1, 20)
    falling = decay_law(k, 2.0 - 0.05 * k, np.full(19, 0.1))
    assert falling.d2 == 0
    assert falling.b1 > 0
    steep = decay_law(k, 0.1 * k**2 - 0.5, np.full(19, 0.05))
    assert steep.b1 > 0
    single = decay_law(k[:1], np.array([3.0]), np.array([0.1]))
    assert (single.b1, single.d2, single.d2_error) == (3.0, 0.0, np.inf)


def test_as_data():
    analysis = analyse(string(*STRINGS["A6"], seed=1).recording(seconds=1.0), note="A6")
    data = json.loads(json.dumps(analysis_to_dict(analysis), allow_nan=False))
    assert data["partials"]["number"] == analysis.partials.number.tolist()
    assert data["f0"] == analysis.f0
    table = partial_rows(analysis)
    assert [row[0] for row in table] == analysis.partials.number.tolist()
    assert max(abs(row[2]) for row in table) < 0.01  # cents from the law
