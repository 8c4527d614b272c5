"""The onset in recordings that hold more than the note: clicks, key noises, coughs, offsets, drifts and rumble."""

import os
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pianofit.analysis import analyse
from pianofit.dsp.filters import LOWEST_HZ, without_drift
from pianofit.errors import RecordingError, WrongNoteError
from pianofit.recording import onset as module
from pianofit.recording.onset import find_onset, find_sounds
from pianofit.recording.recording import load_recording, recording_from_samples

RATE = 44_100
SHARED = Path(os.environ.get("PIANOFIT_RECORDINGS", Path(__file__).parents[2] / "shared" / "recordings")).parent
CASES = SHARED / "cases"
needs_cases = pytest.mark.skipif(not CASES.is_dir(), reason=f"no case files at {CASES}; set PIANOFIT_RECORDINGS")


def struck(f0: float = 220.0, seconds: float = 1.5, decay: float = 2.0, rate: int = RATE) -> np.ndarray:
    """Damped partials that begin at their first sample, peak 0.5 [samples]."""
    t = np.arange(round(seconds * rate)) / rate
    k = np.arange(1, max(2, min(20, int(0.4 * rate / f0) + 1)))[:, None]
    sound = (np.cos(2 * np.pi * f0 * k * t + k) * np.exp(-(decay + 0.01 * k * k) * t) / k).sum(axis=0)
    return 0.5 * sound / np.abs(sound).max()


def led(sound: np.ndarray, lead: int, noise: float = 1e-4) -> np.ndarray:
    """The sound after `lead` samples, all of it in white noise of that rms."""
    return np.append(np.zeros(lead), sound) + noise * np.random.default_rng(2).normal(size=lead + len(sound))


def unwanted(kind: str) -> np.ndarray:
    """A sound of another source than the string, of at most 0.3 s, peak 1 [samples]."""
    t, rng = np.arange(round(0.3 * RATE)) / RATE, np.random.default_rng(3)
    sound = {
        "click": np.where(t < 1e-4, 1.0, 0.0),
        "key noise": rng.normal(size=len(t)) * np.exp(-t / 0.02),
        "thump": np.sin(2 * np.pi * 70 * t) * np.exp(-t / 0.05),
        "cough": rng.normal(size=len(t)) * np.hanning(len(t)),
    }[kind]
    return sound / np.abs(sound).max()


@pytest.mark.parametrize("kind", ["click", "key noise", "thump", "cough"])
@pytest.mark.parametrize("level", [0.02, 0.1, 0.5])
@pytest.mark.parametrize("before", [0.35, 0.9])
def test_a_sound_before_the_note_is_not_its_onset(kind, level, before):
    x = led(struck(), RATE)
    begin = round((1.0 - before) * RATE)
    noise = level * unwanted(kind)
    x[begin : begin + len(noise)] += noise
    recording = recording_from_samples(x, RATE)
    assert abs(recording.onset - RATE) <= 0.0005 * RATE
    times = [float(match[1]) for w in recording.warnings if (match := re.search(r"([\d.]+) s before the note", w))]
    assert times == pytest.approx([before] * len(times), abs=0.03)


@pytest.mark.parametrize("kind", ["key noise", "thump", "cough"])
def test_a_sound_before_the_note_is_reported_with_its_time(kind):
    x = led(struck(), RATE)
    noise = 0.2 * unwanted(kind)
    x[22_050 : 22_050 + len(noise)] += noise
    earlier, onset = find_sounds(x, RATE, 0.0)
    assert onset == pytest.approx(RATE, abs=20)
    assert earlier == pytest.approx(22_050, abs=0.03 * RATE)
    (warning,) = recording_from_samples(x, RATE).warnings
    assert "before the note" in warning


@pytest.mark.parametrize("f0", [27.5, 110.0, 1760.0, 4186.0])
def test_a_note_of_any_key_outlasts_a_key_noise(f0):
    x = led(struck(f0, decay=0.3 * (f0 / 100) ** 0.8 + 0.2), RATE)
    noise = 0.1 * unwanted("key noise")
    x[30_000 : 30_000 + len(noise)] += noise
    assert abs(find_onset(x, RATE, 0.0) - RATE) <= 0.0005 * RATE


def test_a_note_that_beats_deeply_is_one_sound():
    """Two strings that nearly cancel every half second; later beats are as long as the first."""
    t = np.arange(3 * RATE) / RATE
    beat = np.abs(np.cos(2 * np.pi * t)) + 0.02
    assert find_sounds(led(struck(1568.0, 3.0, 1.0) * beat, 4_410), RATE, 0.0) == pytest.approx([4_410], abs=20)


def test_the_pulses_of_a_bass_note_are_not_sounds():
    """A sum of cosines in phase: the level falls by far more than `DEPTH` within each period."""
    t = np.arange(2 * RATE) / RATE
    pulses = np.cos(2 * np.pi * 27.5 * np.arange(1, 60)[:, None] * t).sum(axis=0) * np.exp(-0.5 * t) / 120
    assert find_sounds(led(pulses, 8_820), RATE, 0.0) == pytest.approx([8_820], abs=5)


def test_the_first_of_two_equal_strokes_is_the_note():
    """The first one is damped, so that silence separates them."""
    stroke = struck(seconds=0.6, decay=8.0)
    x = led(np.concatenate([stroke, np.zeros(RATE // 2), stroke]), 4_410)
    assert abs(find_onset(x, RATE, 0.0) - 4_410) <= 5


@settings(max_examples=15, deadline=None)
@given(st.floats(0.0, 0.2), st.floats(0.1, 8.0), st.floats(0.0, 6.3))
def test_a_slow_drift_does_not_move_the_onset(size, frequency, phase):
    x = led(struck(), 13_230)
    drift = size * np.sin(2 * np.pi * frequency * np.arange(len(x)) / RATE + phase)
    recording = recording_from_samples(x + drift, RATE)
    assert abs(recording.onset - 13_230) <= 0.0005 * RATE
    assert recording.noise_rms < 1.2e-4 + 1.5 * size * (frequency / LOWEST_HZ) ** 4
    assert not any("before the note" in warning for warning in recording.warnings)


@pytest.mark.parametrize("offset", [-0.2, 0.02])
@pytest.mark.parametrize("fade", [0.05, 0.2])
def test_an_offset_that_is_faded_with_the_file_is_neither_onset_nor_noise(offset, fade):
    x = led(struck(seconds=2.0), 13_230)
    t = np.arange(len(x)) / RATE
    ramp = np.clip(np.minimum(t, t[-1] - t) / fade, 0, 1)
    plain, faded = (recording_from_samples(ramp * (x + part), RATE) for part in (0.0, offset))
    assert faded.onset == plain.onset == pytest.approx(13_230, abs=5)
    assert not any("begins inside" in warning for warning in faded.warnings)
    expected, analysis = (analyse(recording, note="A3") for recording in (plain, faded))
    assert analysis.f0 == pytest.approx(expected.f0, rel=1e-6)
    assert len(analysis.partials) == len(expected.partials)


def test_no_lowest_partial_counts_as_drift():
    t = np.arange(RATE) / RATE
    for frequency, kept in ((27.5, 0.85), (1.0, 0.0), (5.0, 0.01)):
        x = np.sin(2 * np.pi * frequency * t)
        assert without_drift(x, RATE)[RATE // 2 :].std() / x.std() == pytest.approx(
            kept, abs=0.12 if kept > 0.5 else 0.01
        )


def test_a_level_is_taken_over_at_least_a_period_of_the_lowest_key():
    assert module.PERIOD >= 1 / 27.5
    assert LOWEST_HZ < 27.5


@needs_cases
@pytest.mark.parametrize(("name", "onset"), [("dc-faded", 0.3), ("click-before", 1.0)])
def test_the_case_files_are_analysed_as_the_plain_note(name, onset):
    recording = load_recording(CASES / f"{name}.flac")
    assert recording.onset / recording.rate == pytest.approx(onset, abs=0.002)
    analysis = analyse(recording, note="F3")
    assert analysis.f0 == pytest.approx(175.008, abs=5e-4)
    assert abs(analysis.B / 1.662e-4 - 1) < 3e-4
    assert abs(len(analysis.partials) - 54) <= 2


def test_an_analysis_that_fails_repeats_what_was_odd_about_the_recording():
    x = led(struck(), RATE)
    noise = 0.2 * unwanted("cough")
    x[10_000 : 10_000 + len(noise)] += noise
    with pytest.raises(WrongNoteError, match="before the note"):
        analyse((x, RATE), note="C4")


@pytest.mark.parametrize("at", [0, 1, 2])
def test_a_click_at_the_first_samples_is_not_a_note(at):
    with pytest.raises(RecordingError, match="onset"):
        recording_from_samples(np.eye(1, RATE, at)[0], RATE)
