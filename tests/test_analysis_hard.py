"""Sounds that mislead an analysis: overloaded recorders, harmonic tones, faint notes, squeaks, beats, other keys."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pianofit
from pianofit.analysis import Analysis, analyse, law_frequency
from pianofit.analysis.baseband_fit import fit_bands
from pianofit.analysis.inharmonicity import B_RANGE, frequency_law
from pianofit.analysis.note_names import note_to_hz
from pianofit.analysis.second_stroke import detect_second_stroke
from pianofit.dsp.bands import Bands
from pianofit.errors import AnalysisError, WrongNoteError
from pianofit.recording.recording import recording_from_samples
from pianofit.result.prediction import predict_recording

RATE, SECONDS, LEAD = 44_100, 1.5, 0.1
CASES = Path(os.environ.get("PIANOFIT_CASES", Path(__file__).parents[2] / "shared" / "cases"))
T = np.arange(int(SECONDS * RATE)) / RATE
# f0, Hz, B, and decay of the first partial, 1/s
TREBLE = {"B6": (1975.0, 5.4e-3, 4.0), "D7": (2349.0, 6.6e-3, 4.6), "F#7": (2960.0, 8.7e-3, 5.5)}


def tone(f0: float, B: float, b1: float, *, partials: int = 40, seed: int = 0, tilt: float = 9.0) -> np.ndarray:
    """Decaying partials below 19 kHz [samples], peak 0.5; levels fall by `tilt` dB a kHz, decays rise with k²."""
    rng = np.random.default_rng(seed)
    k = np.arange(1, partials + 1)
    frequency = law_frequency(f0, B, k)
    k, frequency = k[frequency < 19_000], frequency[frequency < 19_000]
    amplitude = 10 ** (-tilt * (frequency - f0) / 20_000) / k * rng.uniform(0.5, 1.0, len(k))
    phase = rng.uniform(0, 2 * np.pi, len(k))
    x = np.zeros(len(T))
    for a, f, p, decay in zip(amplitude, frequency, phase, b1 * (1 + 0.05 * k**2 * f0 / 262), strict=True):
        x += a * np.exp(-decay * T) * np.sin(2 * np.pi * f * T + p)
    return 0.5 * x / np.abs(x).max()


def recorded(x: np.ndarray, noise: float = 1e-4, seed: int = 0) -> tuple[np.ndarray, int]:
    """`x` [samples] after silence, with white noise of this rms, and its rate; the peak stays below 1."""
    x = np.concatenate([np.zeros(int(LEAD * RATE)), x])
    x = x + noise * np.random.default_rng(seed + 100).standard_normal(len(x))
    return x / max(1.0, 1.01 * np.abs(x).max()), RATE


def overloaded(x: np.ndarray, strength: float) -> np.ndarray:
    """`x` with second to fifth order distortion, peak 0.5 [samples]."""
    x = x + strength * (x**2 + x**3 + 0.5 * x**4 + 0.5 * x**5)
    return 0.5 * x / np.abs(x).max()


def case(name: str) -> Path:
    """A file of `../shared/cases`; the test is skipped if it is absent."""
    path = CASES / name
    if not path.is_file():
        pytest.skip(f"no {path}; set PIANOFIT_CASES")
    return path


def warned(analysis: Analysis, word: str) -> bool:
    return any(word in warning for warning in analysis.warnings)


@pytest.mark.parametrize("name", TREBLE)
@pytest.mark.parametrize("strength", [0.0, 0.1])
def test_distortion_is_not_taken_for_partials(name, strength):
    """B is that of the string with any distortion at multiples and sums of its partials."""
    f0, B, b1 = TREBLE[name]
    analysis = analyse(recorded(overloaded(tone(f0, B, b1), strength)), note=name)
    assert pytest.approx(B, rel=0.05) == analysis.B
    assert analysis.f0 == pytest.approx(f0, rel=2e-3)
    assert np.abs(analysis.partials.frequency / law_frequency(f0, B, analysis.partials.number) - 1).max() < 2e-3


@pytest.mark.parametrize("name", ["D4", "B6"])
def test_a_harmonic_tone_has_b_at_its_bound_and_an_interval_that_holds_0(name):
    f0 = note_to_hz(name)
    analysis = analyse(recorded(tone(f0, 0.0, 1.0)), note=name)
    assert B_RANGE[0] == analysis.B
    assert warned(analysis, "harmonic")
    assert analysis.B - 1.96 * analysis.B_error < 0 < analysis.B + 1.96 * analysis.B_error < 1e-4
    assert abs(analysis.f0 - f0) < 1.96 * analysis.f0_error


def test_a_string_within_the_range_of_b_is_not_said_to_be_at_its_bound():
    analysis = analyse(recorded(tone(294.0, 1e-4, 1.0)), note="D4")
    assert pytest.approx(1e-4, rel=0.02) == analysis.B
    assert not warned(analysis, "bound")


@pytest.mark.parametrize(("B", "low"), [(-1e-4, True), (3e-2, False)])
def test_the_error_of_a_bound_reaches_what_lies_beyond_it(B, low):
    k = np.arange(1, 7)
    frequency = 300 * k * np.sqrt(1 + B * k**2)
    law = frequency_law(k, frequency, 1e-6 * frequency)
    assert B_RANGE[0 if low else 1] == law.B
    assert law.B_error >= abs(B - law.B) * 0.9


def colour(kind: str, count: int, seed: int) -> np.ndarray:
    """Noise of rms 1 [samples]: white, or falling by 6 dB an octave above 20 Hz."""
    noise = np.random.default_rng(seed).standard_normal(count)
    if kind == "brown":
        frequency = np.fft.rfftfreq(count, 1 / RATE)
        noise = np.fft.irfft(np.fft.rfft(noise) * (frequency > 20) / np.maximum(frequency, 1), count)
    return noise / noise.std()


@pytest.mark.parametrize(("name", "kind", "faint"), [("C8", "brown", 50.0), ("C7", "brown", 50.0), ("C8", "white", 2.0),
                                                     ("C4", "brown", 1000.0)])  # fmt: skip
def test_a_faint_note_is_called_faint_and_not_another(name, kind, faint):
    x = tone(note_to_hz(name), 1e-3, 30.0)
    noisy = x / faint + 0.1 * colour(kind, len(x), 0)
    with pytest.raises(AnalysisError, match="noise") as caught:
        analyse(replace(recording_from_samples(*recorded(x)), samples=noisy, onset=0), note=name)
    assert "sounds like" not in str(caught.value)


@pytest.mark.parametrize(("name", "wrong"), [("A1", "C8"), ("C4", "C2"), ("C7", "A3"), ("A7", "C3")])
def test_another_note_that_is_there_is_named(name, wrong):
    with pytest.raises(WrongNoteError, match=f"sounds like {name} "):
        analyse(recorded(tone(note_to_hz(name), 1e-3 if name != "A1" else 1e-4, 2.0, tilt=3.0)), note=wrong)


@pytest.mark.parametrize(("rises_to", "again"), [(-66.0, False), (-45.0, False), (-35.0, True), (-20.0, True)])
def test_a_noise_far_below_the_note_is_not_a_second_stroke(rises_to, again):
    """All partials decay into the noise. At 2 s they rise to a level relative to the initial one."""
    time = np.arange(400) / 100
    level = np.maximum(-60.0 * time, -100.0)
    level = np.where(time < 2, level, np.maximum(rises_to - 60.0 * (time - 2), -100.0))
    z = np.tile(10 ** (level / 20), (12, 1)).astype(complex)
    bands = Bands(z, time, 100.0 * np.arange(1, 13), 97.0, 0.05, 100.0, 50.0)
    time_s = detect_second_stroke(replace(fit_bands(bands, np.full(12, 1e-14)), z=z))
    assert time_s == (pytest.approx(2.0, abs=0.1) if again else None)


@pytest.mark.parametrize("partials", [4, 5, 12])
def test_beats_are_not_a_second_stroke(partials):
    """Three strings at random detunings, as in an old piano; with few partials most may rise together."""
    for seed in range(6):
        cents = np.random.default_rng(seed).uniform(-12, 12, 3)
        x = np.sum([tone(1000 * 2 ** (c / 1200), 3e-3, 2.0, partials=partials, seed=seed) for c in cents], axis=0)
        assert not warned(analyse(recorded(0.3 * x)), "second stroke"), seed


def test_a_second_stroke_of_a_tenth_is_noticed_with_few_partials():
    x = tone(1000.0, 3e-3, 6.0, partials=4)
    late = int(0.8 * RATE)
    x[late:] += 0.1 * x[:-late].copy()
    assert warned(analyse(recorded(x, noise=1e-6)), "second stroke")


def test_a_pitch_that_hardly_moves_is_not_said_to_fall():
    assert not warned(analyse(recorded(tone(110.0, 1e-4, 2.0))), "0.0 cents")


def test_the_pitch_of_noise_is_not_found():
    noise = 0.1 * colour("brown", len(T), 0)
    with pytest.raises(WrongNoteError, match="no pitch"):
        analyse(replace(recording_from_samples(*recorded(noise)), samples=noise, onset=0))


def test_one_tone_has_a_pitch():
    assert analyse(recorded(tone(440.0, 0.0, 2.0, partials=1))).f0 == pytest.approx(440.0, rel=3e-3)


def test_predict_says_that_a_faint_recording_is_faint():
    it = pianofit.typical(108)
    note = pianofit.Note(it.string, it.hammer, it.geometry, "bridge-force", gain=0.01)
    noise = 0.1 * colour("brown", len(T), 0)
    recording = replace(recording_from_samples(*recorded(noise)), samples=noise, onset=0)
    with pytest.raises(AnalysisError, match="faint") as caught:
        predict_recording(note, recording)
    assert not isinstance(caught.value, WrongNoteError)


RELEASES = CASES.parent / "keyboard"


@pytest.mark.recordings
@pytest.mark.parametrize("name", ["C8", "A5", "C4"])
def test_the_noise_of_a_key_let_go_is_not_another_note(name):
    file = RELEASES / f"salamander-{name}-release.flac"
    if not file.is_file():
        pytest.skip(f"no {file}; set PIANOFIT_CASES")
    with pytest.raises(AnalysisError, match="faint"):
        analyse(file, note=name)


def test_predict_refuses_a_neighbouring_key_in_any_form():
    it = pianofit.typical(65)
    note = pianofit.Note(it.string, it.hammer, it.geometry, "bridge-force", gain=0.01)
    for cents, accepted in ((10.0, True), (100.0, False), (-100.0, False)):
        samples = note.with_cents(cents).render(2.0, seconds=1.0)
        analysis = analyse((samples, RATE), f0=note.with_cents(cents).f0)
        for source in ((samples, RATE), analysis):
            if accepted:
                assert predict_recording(note, source).error_db < 0.5
                continue
            with pytest.raises(WrongNoteError, match=f"F4.*{'F#4' if cents > 0 else 'E4'}"):
                predict_recording(note, source)


def test_partials_of_an_overloaded_recorder():
    analysis = analyse(case("pianoFB-B6.flac"), note="B6")
    assert pytest.approx(9e-3, rel=0.15) == analysis.B
    assert analysis.partials.frequency[:4] == pytest.approx([1971, 4007, 6128, 8450], rel=0.01)


def test_the_harmonic_tone():
    analysis = analyse(case("harmonic-tone-D4.flac"), note="D4")
    assert warned(analysis, "harmonic")
    assert analysis.B - 1.96 * analysis.B_error < 0


def test_one_pluck_is_one_stroke():
    analysis = analyse(case("guitar-E2.flac"), note="E2")
    assert not warned(analysis, "stroke")
    assert not warned(analysis, "0.0 cents")


def test_neighbouring_key():
    (soft, loud), other = (case(f"neighbour-key/F3-{v}.flac") for v in (6, 16)), case("neighbour-key/F#3.flac")
    own = analyse(soft, note="F3")
    it = pianofit.typical(53)
    note = pianofit.Note(it.string, it.hammer, it.geometry, "bridge-force", gain=0.01)
    note = note.with_cents(1200 * np.log2(own.f0 / note.f0))
    predict_recording(note, loud)
    with pytest.raises(WrongNoteError, match=r"F#3\.flac.*F#3 \(185"):
        predict_recording(note, other)
