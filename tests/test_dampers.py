"""Dampers, release noise and noise floor: known truths, invariants, and files."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile
from damper_cases import RATE, released
from instrument_cases import piano_of, rung, true_note

import pianofit
from pianofit.analysis.damper import fit_damper
from pianofit.analysis.noise import FREQUENCIES, noise_density
from pianofit.analysis.release import release_sound
from pianofit.batch.extras import measure_extras
from pianofit.batch.manifest import Role
from pianofit.conversions import hertz_of
from pianofit.instrument.dampers import LAST_DAMPER, Dampers, damper_law
from pianofit.instrument.noise_floor import NoiseFloor, noise_floor
from pianofit.instrument.release_noise import ReleaseNoise
from pianofit.schema.extras import DamperEntry, KeyExtras, SoundEntry

RELEASES = sorted((Path(__file__).parents[2] / "shared" / "keyboard").glob("salamander-*-release.flac"))


def measured(midi: int, dampers: Dampers, sd: float = 0.01) -> KeyExtras:
    """A key that was measured to follow a law."""
    log_rate = float(np.log(dampers.rates(midi, np.array([hertz_of(midi)]))[0]))
    none = np.zeros(0)
    entry = DamperEntry(
        file="a.wav", sha256="", release_s=1.0, log_rate=log_rate, slope=dampers.slope,
        covariance=sd**2 * np.eye(2), frequency=none, rate=none, rate_error=none,
    )  # fmt: skip
    return KeyExtras(midi=midi, dampers=(entry,))


def test_rates_rise_with_key_and_frequency_and_end_above_the_last_damper():
    law, ratio = Dampers(), np.array([1.0, 2.0, 16.0])
    rates = np.array([law.rates(midi, hertz_of(midi) * ratio) for midi in range(21, LAST_DAMPER + 1)])
    assert (np.diff(rates, axis=0) > 0).all()
    assert (np.diff(rates, axis=1) > 0).all()
    assert rates[:, 2] / rates[:, 0] == pytest.approx(2.0)
    assert not law.rates(LAST_DAMPER + 1, np.array([2000.0, 4000.0])).any()
    low, high = law.interval(60, hertz_of(60) * ratio)
    assert (low < law.rates(60, hertz_of(60) * ratio)).all()
    assert (law.rates(60, hertz_of(60) * ratio) < high).all()


def test_the_law_goes_from_the_literature_to_the_recordings():
    assert damper_law([]) == Dampers()
    truth = Dampers(bass=15.0, treble=80.0, slope=0.1)
    spread = []
    for count in (2, 8, 60):
        law = damper_law([measured(midi, truth) for midi in np.linspace(24, 88, count).round().astype(int).tolist()])
        hz = np.array([hertz_of(60), 8 * hertz_of(60)])
        low, high = law.interval(60, hz)
        assert (low < truth.rates(60, hz)).all()
        assert (truth.rates(60, hz) < high).all()
        spread.append(high[0] / low[0])
    assert spread[0] > spread[1] > spread[2]
    assert law.source == "recordings"
    assert len(law.keys) == 60
    assert (law.bass, law.treble, law.slope) == pytest.approx((15.0, 80.0, 0.1), rel=0.05)


@pytest.mark.slow
def test_intervals_of_a_damper_hold_the_truth():
    """`benchmarks/damper_coverage.py` has 100 cases."""
    z = []
    for seed in range(12):
        case = released(seed)
        try:
            fit = fit_damper((case.samples, RATE), case.note)
        except pianofit.AnalysisError:
            continue
        sd = np.sqrt(np.diag(fit.covariance))
        z.append([fit.log_rate - np.log(case.rate), fit.slope - case.slope] / sd)
        assert fit.release_s == pytest.approx(case.release_s, abs=0.005)
    assert len(z) >= 10
    assert np.mean(np.abs(z) < 1.96) > 0.8
    assert np.abs(z).max() < 4


def test_a_damper_is_the_same_at_another_gain_and_with_leading_silence():
    case = released(19)
    one = fit_damper((case.samples, RATE), case.note)
    other = fit_damper((np.append(np.zeros(RATE // 4), 0.1 * case.samples), RATE), case.note)
    assert np.exp(one.log_rate) == pytest.approx(case.rate, rel=0.03)
    assert other.log_rate == pytest.approx(one.log_rate, abs=0.5 * np.sqrt(one.covariance[0, 0]))
    assert other.slope == pytest.approx(one.slope, abs=0.5 * np.sqrt(one.covariance[1, 1]))


def test_a_recording_of_few_periods_is_too_short():
    it = pianofit.typical("C2")
    sound = pianofit.Note(it.string, it.hammer, it.geometry, "bridge-force", 1.0).render(seconds=0.14)
    with pytest.raises(pianofit.AnalysisError, match=r"too short for a note of 65\.\d Hz"):
        fit_damper((sound, RATE), "C2")


def test_a_note_that_rings_on_has_no_damper():
    preset = pianofit.typical(60)
    wave = pianofit.simulate(preset.string, preset.hammer, preset.geometry, quantity="bridge-force").waveform(
        RATE, RATE
    )
    noise = 1e-4 * np.random.default_rng(0).normal(size=len(wave))
    with pytest.raises(pianofit.AnalysisError, match="role note"):
        fit_damper((0.5 * wave / np.abs(wave).max() + noise, RATE), "C4")


def test_noise_has_the_spectrum_and_level_of_its_recording():
    """White noise of a known density is measured, and played again at another rate."""
    random = np.random.default_rng(0)
    note = np.exp(-3 * np.arange(2 * RATE) / RATE) * np.sin(2 * np.pi * 261.6 * np.arange(2 * RATE) / RATE)
    x = 1e-3 * random.normal(size=3 * RATE)
    x[RATE:] += 0.5 * note
    density = noise_density(pianofit.recording_from_samples(x, RATE))
    inside = FREQUENCIES < 0.45 * RATE
    assert density[0, inside] == pytest.approx(2e-6 / RATE, rel=0.35)
    floor = NoiseFloor(FREQUENCIES, density)
    played = floor.sound(RATE, 48_000, seed=1)
    power = 2 * np.abs(np.fft.rfft(played[0])) ** 2 / (48_000 * RATE)
    hz = np.fft.rfftfreq(RATE, 1 / 48_000)
    band = (hz > 500) & (hz < 15_000)
    assert np.mean(power[band]) == pytest.approx(2e-6 / RATE, rel=0.1)
    assert np.array_equal(floor.sound(RATE, 48_000, 1), played)
    assert not np.array_equal(floor.sound(RATE, 48_000, 2), played)
    assert floor.sound(RATE // 2, 48_000, 1) == pytest.approx(played[:, : RATE // 2])
    assert noise_floor([KeyExtras(midi=60)], 1) is None


@pytest.mark.parametrize("f0", [27.5, 46.2, 92.5, 261.6])
def test_partials_that_ring_are_no_noise(f0):
    """Without silence before the onset, the noise is measured between partials."""
    random = np.random.default_rng(1)
    time = np.arange(4 * RATE) / RATE
    tone = sum(np.exp(-0.3 * time) * np.sin(2 * np.pi * k * f0 * time + k) / k for k in range(1, 40))
    density = noise_density(pianofit.recording_from_samples(0.1 * tone + 1e-4 * random.normal(size=len(time)), RATE))
    above = 10 * np.log10(density[0, FREQUENCIES < 0.45 * RATE] / (2e-8 / RATE))
    assert np.median(np.abs(above)) < 2.0
    assert np.abs(above).max() < 6.0


def test_the_shortest_recording_has_a_noise_floor():
    x = np.random.default_rng(3).normal(size=round(0.09 * RATE))
    density = noise_density(pianofit.recording_from_samples(1e-3 * x, RATE))
    assert np.median(density[0, FREQUENCIES < 0.45 * RATE]) == pytest.approx(2e-6 / RATE, rel=0.5)


def test_a_release_is_louder_when_faster_and_after_a_longer_note():
    sounds = {60: np.ones((2, 100)), 64: 0.1 * np.ones((2, 100))}
    release = ReleaseNoise(sounds, 48_000)
    peaks = [np.abs(release.sound(60, v, 10.0, 48_000)).max() for v in (0, 30, 64, 127)]
    assert peaks == sorted(peaks)
    assert peaks[2] == pytest.approx(1.0)
    held = [np.abs(release.sound(60, 64, t, 48_000)).max() for t in (0.0, 0.05, 0.5, 10.0)]
    assert held == sorted(held)
    assert held[0] == 0
    energy = [float(np.sum(release.sound(midi, 64, 10.0, 48_000) ** 2)) for midi in range(58, 67)]
    steps = np.diff(10 * np.log10(energy))
    assert steps == pytest.approx([0, 0, -5, -5, -5, -5, 0, 0])
    assert release.sound(60, 64, 10.0, 24_000).shape == (2, 50)


@pytest.mark.skipif(not RELEASES, reason="../shared/keyboard is missing")
def test_recorded_releases_begin_at_their_onset_and_keep_their_energy():
    for file in RELEASES[::6]:
        recording = pianofit.load_recording(file)
        sound = release_sound(recording)
        kept = np.sum(sound**2) / np.sum(recording.frames[:, recording.onset :] ** 2)
        assert 0.98 < kept < 1.02, file
        assert np.abs(sound[:, -1]).max() < 1e-3 * np.abs(sound).max()


def test_extras_survive_a_file(tmp_path):
    """Dampers, releases and noise of a written and read instrument are those of the built one, to 16 bits."""
    random = np.random.default_rng(0)
    sounds = {40: 0.3 * random.normal(size=(2, 900)), 70: 0.1 * random.normal(size=(2, 800))}
    piano = replace(
        piano_of({60: rung(60), 64: true_note(64)}),
        dampers=damper_law([measured(60, Dampers(slope=0.1))]),
        release=ReleaseNoise(sounds, RATE),
        noise=NoiseFloor(FREQUENCIES, np.full((2, len(FREQUENCIES)), 1e-12)),
    )
    pianofit.write_instrument(tmp_path / "instrument.json", piano)
    read = pianofit.load_instrument(tmp_path)
    assert read.dampers == piano.dampers
    assert read.release is not None
    assert read.noise is not None
    for midi, sound in sounds.items():
        assert read.release.sounds[midi] == pytest.approx(sound, abs=2**-14 * np.abs(sound).max())
    assert read.noise.density == pytest.approx(np.full((2, len(FREQUENCIES)), 1e-12))
    content = json.loads((tmp_path / "instrument.json").read_text())
    content["releases"][0]["sound"]["flac"] = "AAAA"
    (tmp_path / "instrument.json").write_text(json.dumps(content))
    with pytest.raises(pianofit.FitError, match=r"releases\[0\]"):
        pianofit.load_instrument(tmp_path)


def test_a_recording_that_cannot_be_used_is_named(tmp_path):
    case = released(19)
    soundfile.write(tmp_path / "damped.wav", case.samples, RATE, subtype="FLOAT")
    (tmp_path / "bad.wav").write_bytes(b"no sound")
    files: dict[Path, Role] = {tmp_path / "damped.wav": "damped", tmp_path / "bad.wav": "release"}
    extras, unusable = measure_extras(files, {str(file): file.name for file in files}, case.note, "average")
    assert [*unusable] == [tmp_path / "bad.wav"]
    assert np.exp(extras.dampers[0].log_rate) == pytest.approx(case.rate, rel=0.03)
    assert extras.noise is not None
    assert not extras.releases
    assert SoundEntry.of(np.ones((1, 10)), RATE).samples("x")[0] == pytest.approx(1.0, abs=1e-4)
