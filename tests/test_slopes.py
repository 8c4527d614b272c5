"""Slopes of the envelope: known decays, beats, and an independent measurement on real notes."""

from __future__ import annotations

import csv
from dataclasses import replace

import numpy as np
import pytest
import soundfile
from scipy.signal import butter, hilbert, sosfiltfilt
from test_analysis_recordings import FOLDER

from pianofit.analysis import Partials, analyse
from pianofit.conversions import DB, T60_NEPERS
from pianofit.recording.recording import recording_from_samples

RATE, LEAD, SECONDS = 44_100, 0.05, 6.0
F0, B, COUNT = 196.0, 3e-4, 16


def measured(components: list[tuple[np.ndarray, np.ndarray, np.ndarray]], noise: float = 1e-6) -> Partials:
    """Partials of a note: components of amplitude (complex), decay, 1/s, and detuning, Hz [partials]."""
    t, k = np.arange(int(SECONDS * RATE)) / RATE, np.arange(1, COUNT + 1)
    frequency = k * F0 * np.sqrt(1 + B * k**2)
    x = noise * np.random.default_rng(0).standard_normal(len(t))
    for amplitude, decay, detuning in components:
        for a, d, f in zip(amplitude, decay, frequency + detuning, strict=True):
            x += (a * np.exp((-d + 2j * np.pi * f) * t)).real
    x = np.concatenate([np.zeros(int(LEAD * RATE)), x])
    recording = replace(recording_from_samples(x, RATE), onset=int(LEAD * RATE))
    table = analyse(recording, f0=F0).partials
    assert table.number.tolist() == k.tolist()
    return table


def phases(seed: int) -> np.ndarray:
    return 0.03 * np.exp(2j * np.pi * np.random.default_rng(seed).random(COUNT))


def test_one_exponential_has_one_slope():
    decay = np.linspace(0.8, 9.0, COUNT)
    table = measured([(phases(0), decay, np.zeros(COUNT))])
    np.testing.assert_allclose(table.decay, decay, rtol=1e-3)
    np.testing.assert_allclose(table.late_decay, decay, rtol=1e-3)
    np.testing.assert_allclose(table.t60()[0], T60_NEPERS / np.stack([decay, decay]), rtol=1e-3)
    # The early part lasts until the envelope has fallen by 10 dB.
    duration = table.slope_times[:, 1] - table.slope_times[:, 0]
    np.testing.assert_allclose(duration * decay * DB, 10.0, atol=0.5)


def test_a_double_decay_has_two_slopes():
    fast, slow = np.full(COUNT, 9.0), np.full(COUNT, 0.6)
    a = phases(1)
    table = measured([(a, fast, np.zeros(COUNT)), (0.01 * a, slow, np.zeros(COUNT))])
    np.testing.assert_allclose(table.decay, fast, rtol=0.05)
    assert np.median(table.late_decay) < 1.2


def test_components_that_cancel_do_not_make_a_fast_decay():
    """Two strong components of nearly opposite phase have rates of 30 1/s; their sum decays slowly at first."""
    one = np.ones(COUNT)
    a = phases(2)
    table = measured([(a, 3.0 * one, 0 * one), (0.9 * a, 30.0 * one, 0.4 * one), (-0.9 * a, 28.0 * one, 0 * one)])
    assert np.max(table.decay) < 6.0


@pytest.mark.parametrize("deepest", [0.4, 0.9])
def test_errors_hold_for_partials_that_beat(deepest):
    """Both components of a partial have one rate, which is that of their energy."""
    z, late = [], []
    for seed in range(4):
        random = np.random.default_rng(seed)
        decay = np.exp(random.uniform(np.log(0.7), np.log(8.0), COUNT))
        share = random.uniform(0.1, deepest, COUNT) * np.exp(2j * np.pi * random.random(COUNT))
        detuning = np.exp(random.uniform(np.log(0.2), np.log(5.0), COUNT))
        table = measured([(a := phases(seed), decay, np.zeros(COUNT)), (share * a, decay, detuning)])
        z += ((table.decay - decay) / table.total_error("decay")).tolist()
        late += ((table.late_decay - decay) / table.late_decay_error).tolist()
    for standardised in (np.array(z), np.array(late)[np.isfinite(late)]):
        assert len(standardised) > 50
        assert np.mean(np.abs(standardised) < 1.96) > 0.9
        assert 0.4 < np.sqrt(np.mean(standardised**2)) < 1.2
        assert abs(np.mean(standardised)) < 0.35


def test_errors_hold_for_faint_partials_whose_beats_the_noise_hides():
    """One exponential describes them down to the noise, although they beat as the loud ones do."""
    z = []
    for seed in range(4):
        random = np.random.default_rng(seed)
        a = phases(seed) * 10 ** (-2.2 * np.arange(COUNT) / (COUNT - 1))
        decay = np.exp(random.uniform(np.log(1.5), np.log(3.0), COUNT))
        share = random.uniform(0.3, 0.5, COUNT) * np.exp(2j * np.pi * random.random(COUNT))
        detuning = np.exp(random.uniform(np.log(0.2), np.log(0.6), COUNT))
        table = measured([(a, decay, np.zeros(COUNT)), (share * a, decay, detuning)], noise=3e-4)
        faint = table.snr < 40
        z += ((table.decay - decay) / table.total_error("decay"))[faint].tolist()
    assert len(z) > 10
    assert np.sqrt(np.mean(np.square(z))) < 1.3


# --- real notes -------------------------------------------------------------------------------------------------------

NOTES = ("headroom-C4-L1-close.flac", "headroom-Ds1-L3-close.flac", "cp80-C5-F.flac", "headroom-A6-L4-close.flac")


def envelope(samples: np.ndarray, frequency: float, half: float) -> np.ndarray:
    """Envelope of a Butterworth band, dB."""
    band = butter(4, [frequency - half, frequency + half], "bandpass", fs=RATE, output="sos")
    return 20 * np.log10(np.abs(np.asarray(hilbert(sosfiltfilt(band, samples)))) + 1e-15)


def ratios(name: str) -> list[float]:
    """Reported over measured early decays of the loud partials of a recording that do not beat deeply."""
    with (FOLDER / "recordings.csv").open(encoding="utf-8") as lines:
        note = next(row["note"] for row in csv.DictReader(lines) if row["file"] == name)
    sound, rate = soundfile.read(FOLDER / name, always_2d=True)
    assert rate == RATE
    recording = recording_from_samples(samples := sound.mean(axis=1), rate)
    found = analyse(recording, note=note)
    table, ratio = found.partials, []
    for i in np.flatnonzero(table.snr > 45):
        level = envelope(samples, table.frequency[i], min(0.35 * found.f0, 35.0))[recording.onset :]
        first, last = (round(x * rate) for x in table.slope_times[i, :2])
        slope, start = np.polyfit(time := np.arange(last - first) / rate, part := level[first:last], 1)
        if np.std(part - start - slope * time) < 1.5:
            ratio.append(table.decay[i] / (-slope / DB))
    return ratio


@pytest.mark.recordings
@pytest.mark.skipif(not FOLDER.is_dir(), reason=f"no recordings at {FOLDER}; set PIANOFIT_RECORDINGS")
def test_reported_slopes_are_those_of_the_filtered_envelope():
    ratio = np.concatenate([ratios(name) for name in NOTES])
    assert len(ratio) > 30
    assert np.median(ratio) == pytest.approx(1.0, abs=0.02)
    assert np.mean((ratio > 0.8) & (ratio < 1.25)) > 0.9


@pytest.mark.recordings
@pytest.mark.skipif(not FOLDER.is_dir(), reason=f"no recordings at {FOLDER}; set PIANOFIT_RECORDINGS")
def test_a_partial_whose_components_cancel_decays_as_its_envelope():
    table = analyse(FOLDER / NOTES[0], note="C4").partials
    assert table.decay[0] == pytest.approx(2.9, rel=0.2)
