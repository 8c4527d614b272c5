"""The knock: the energy below the lowest partial, in a recording, in the model, in the table and in a prediction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from observed_cases import PRESSURE, analysis
from scipy import signal

import pianofit
from pianofit.analysis.measure_knock import measure_knock
from pianofit.dsp.knock_band import centre, nodes
from pianofit.inference import build_problem, priors
from pianofit.inference.batched_model import LevelModel, level_slopes
from pianofit.inference.observation_tables import KNOCK, RecordingStructure, observe
from pianofit.model import mode_table, strike
from pianofit.model.contact import strike_final_state
from pianofit.model.knock_force import add_probes
from pianofit.model.output_path import OutputPath
from pianofit.result.prediction import predict_recording

RATE = 44_100
SECONDS = 1.5


def note_of(midi: int, gain: float = 0.01) -> pianofit.Note:
    it = pianofit.typical(midi)
    return pianofit.Note(it.string, it.hammer, it.geometry, "bridge-force", gain=gain)


def recording(midi: int, velocity: float, *, silence: float = 0.01, noise_db: float = -110.0, scale: float = 1.0):
    sound = note_of(midi).render(velocity, seconds=SECONDS)
    sound = np.concatenate([np.zeros(round(silence * RATE)), scale * sound])
    noise = np.random.default_rng(midi).normal(0, 10 ** (noise_db / 20), len(sound))
    return pianofit.recording_from_samples(sound + noise, RATE)


@pytest.mark.parametrize("midi", [74, 84, 96])
@pytest.mark.parametrize("velocity", [0.7, 2.0, 5.0])
def test_the_model_computes_what_a_recording_of_it_holds(midi, velocity):
    """A rendered waveform against the force's spectrum times the share that a string passes on, in absolute units."""
    note = note_of(midi)
    level, error = measure_knock(recording(midi, velocity), float(note.f0))
    assert level == pytest.approx(float(note.levels_of_strokes(velocity)[1]), abs=1.0)
    assert error < 0.3


def test_differences_between_velocities_are_those_of_the_force():
    note = note_of(93)
    velocities = np.array([0.7, 1.5, 4.0])
    measured = [measure_knock(recording(93, v), float(note.f0))[0] for v in velocities]
    np.testing.assert_allclose(np.diff(measured), np.diff(note.levels_of_strokes(velocities)[1]), atol=0.15)


def test_a_knock_follows_gain_and_not_silence_or_rate():
    f0 = float(note_of(88).f0)
    level = measure_knock(recording(88, 2.0), f0)[0]
    louder = recording(88, 2.0, scale=3.0, silence=0.3)
    assert measure_knock(louder, f0)[0] == pytest.approx(level + 20 * np.log10(3), abs=0.05)
    at_once = replace(louder, samples=louder.samples[louder.onset :], onset=0)
    assert measure_knock(at_once, f0)[0] == pytest.approx(level + 20 * np.log10(3), abs=0.05)
    finer = pianofit.recording_from_samples(signal.resample_poly(louder.samples, 160, 147), 48_000)
    assert measure_knock(finer, f0)[0] == pytest.approx(level + 20 * np.log10(3), abs=0.1)


def test_no_knock_is_measured_in_noise_below_the_treble_or_without_an_end():
    f0 = float(note_of(88).f0)
    assert np.isfinite(pianofit.analyse(recording(88, 2.0)).knock)
    hum = 10 ** (-65 / 20) * np.sin(2 * np.pi * 0.4 * f0 * np.arange(round((SECONDS + 0.01) * RATE)) / RATE)
    covered = pianofit.recording_from_samples(recording(88, 0.5).samples + hum, RATE)
    for sound, hz in ((covered, f0), (recording(88, 2.0), 450.0)):
        assert np.isnan(measure_knock(sound, hz)[0])
    short = recording(88, 2.0).samples[: round(0.6 * RATE)]
    assert np.isnan(measure_knock(pianofit.recording_from_samples(short, RATE), f0)[0])


def test_its_standard_error_is_that_of_noise():
    f0, clean = float(note_of(88).f0), measure_knock(recording(88, 2.0), float(note_of(88).f0))[0]
    samples, rng = recording(88, 2.0).samples, np.random.default_rng(1)
    found = []
    for _ in range(40):
        noisy = samples + rng.normal(0, 10 ** (-62 / 20), len(samples))
        found.append(measure_knock(pianofit.recording_from_samples(noisy, RATE), f0))
    level, error = np.array(found).T
    assert np.isfinite(level).all()
    assert np.std(level - clean) == pytest.approx(error.mean(), rel=0.5)


def test_probes_read_the_force_and_do_not_touch_the_contact():
    """Modes without strike weight, against the transform of the pulse itself."""
    it = pianofit.typical(90)
    modes = mode_table(it.string, it.geometry, rate=176_400.0, n_modes=48, quantity="bridge-force")
    f0 = float(it.string.c / (2 * it.geometry.length))
    with_probes = add_probes(modes, f0)
    plain, found = (strike_final_state(m, it.hammer, steps=2048)[0] for m in (modes, with_probes))
    # The contact is solved to a tolerance.
    np.testing.assert_allclose(found[:48], plain, atol=1e-6 * np.abs(plain).max())
    force = np.asarray(strike(modes, it.hammer, steps=2048).force)
    time = np.arange(len(force)) * float(modes.step)
    spectrum = np.exp(-2j * np.pi * f0 * nodes()[:, None] * time) @ force * float(modes.step)
    np.testing.assert_allclose(np.abs(with_probes.pickup * found)[48:], np.abs(spectrum), rtol=1e-3)


LOUD = replace(analysis([1, 2, 3], [0.0, -10.0, -20.0]), knock=-25.0, knock_error=0.2)
SOFT = replace(analysis([1, 2], [-12.0, -25.0], absent=[3], bound=[-61.0]), knock=-33.0, knock_error=0.1)
TWO = RecordingStructure((0, 1), (0, 0), (0, 1))


def test_the_knock_is_a_column_with_a_path_and_an_error_of_its_own():
    quiet = tuple(replace(own, knock=np.nan) for own in (LOUD, SOFT))
    table, without = (observe(pair, TWO, 0, PRESSURE) for pair in ((LOUD, SOFT), quiet))
    assert without.number.tolist() == [1, 2, 3]
    assert table.number.tolist() == [1, 2, 3, KNOCK]
    level, other = table.level, without.level
    np.testing.assert_allclose(level.value[:, -1], [-25.0, -33.0])
    np.testing.assert_allclose(level.variance[:, -1], priors.KNOCK_SD**2 + np.array([0.2, 0.1]) ** 2)
    np.testing.assert_array_equal(level.censored, other.censored)
    np.testing.assert_allclose(level.columns[:3, :, -1], other.columns[:3, :, 0])  # gains
    assert not level.columns[3:, :, -1].any()  # onsets
    assert level.systematic[-1, -1] == priors.KNOCK_PATH_SD**2
    assert level.excess_profile[-1] == level.smooth_profile[-1] == 0
    one = observe((LOUD, replace(SOFT, knock=np.nan)), TWO, 0, PRESSURE).level
    np.testing.assert_array_equal(one.detected[:, -1], [1, 0])
    # A known pickup has no path that the knock could take.
    assert KNOCK not in observe((LOUD, SOFT), TWO, 0, replace(PRESSURE, scale=1.0)).number


@pytest.fixture(scope="module")
def levelled():
    """Three layers of a treble key, each with the same peak."""
    sounds = [recording(91, v) for v in (0.6, 1.4, 3.2)]
    sounds = [pianofit.recording_from_samples(0.5 * x.samples / np.abs(x.samples).max(), RATE) for x in sounds]
    return sounds, [pianofit.analyse(sound, note=91) for sound in sounds]


def test_a_fit_computes_the_knock_that_the_note_has(levelled):
    """The batched model against `Note.levels_of_strokes`, whose contact has shorter steps."""
    sounds, analyses = levelled
    problem = build_problem(sounds, analyses, pianofit.Setup())
    theta = problem.parametrisation.mean
    level = LevelModel(problem).level_jacobians(theta[None])[0][0]
    u = problem.parametrisation
    for stroke, own in enumerate(level):
        note = pianofit.Note(u.string(theta), u.hammer(theta, stroke), u.geometry_at(theta), "pressure", 1.0)
        assert own[-1] == pytest.approx(float(note.levels_of_strokes(note.stroke_value)[1]), abs=0.3)


def test_velocities_of_levelled_layers_are_those_of_their_knocks(levelled):
    sounds, analyses = levelled
    fit = pianofit.fit(*sounds, analyses=analyses, progress=False)
    found = np.log([own.stroke_value for own in fit.fit.recordings])
    np.testing.assert_allclose(np.diff(found), np.diff(np.log([0.6, 1.4, 3.2])), atol=0.15)


def test_a_prediction_uses_the_knock():
    """Partials that are off by 1.5 dB agree with another lobe of the force's spectrum; the knock does not."""
    note, number = note_of(93), np.arange(1, 4)
    f0 = float(note.f0)
    frequency = np.append(centre(f0), note.frequencies(3))
    note = note._replace(path=OutputPath(frequency, np.zeros(4)))
    away = {False: [], True: []}
    for seed, velocity in enumerate((0.8, 1.3, 2.0, 3.2)):
        level, knock = note.levels_of_strokes(velocity, 3)
        level = level + np.random.default_rng(seed).normal(0, 1.5, 3)
        for used in away:
            own = analysis(number, level, f0=f0)
            own = replace(own, knock=float(knock) if used else np.nan, knock_error=0.1)
            away[used].append(np.log(predict_recording(note, own, gains=(0.0, 15.0, -9.0)).velocity / velocity))
    assert np.abs(away[True]).max() < 0.35
    assert np.sqrt(np.mean(np.square(away[True]))) < np.sqrt(np.mean(np.square(away[False])))


def test_an_uncertain_pickup_moves_the_partials_and_not_the_knock():
    sounds = [recording(84, velocity) for velocity in (1.0, 3.0)]
    analyses = [pianofit.analyse(sound, note="C6") for sound in sounds]
    length = pianofit.typical(84).geometry.length
    place = pianofit.Measured(0.3 * length, sd=0.003 * length)
    setup = pianofit.Setup(length=length, pickup_quantity="magnetic-pickup", pickup_position=place)
    problem = build_problem(sounds, analyses, setup)
    slopes = level_slopes(problem)
    is_knock = problem.observed.number == KNOCK
    assert is_knock.sum() == 1
    assert (slopes[:, is_knock] == 0).all()
    assert (slopes[:, ~is_knock] != 0).any(axis=1).all()
