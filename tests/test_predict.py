"""Prediction of a recording: velocity, gains and velocity discrepancy."""

from __future__ import annotations

import copy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from observed_cases import analysis

import pianofit
from pianofit.inference.priors import log_gain
from pianofit.model.output_path import OutputPath, VelocityDiscrepancy
from pianofit.result.prediction import predict_recording
from pianofit.schema.fit import Fit


@pytest.mark.parametrize("velocity", [0.4, 1.3])
def test_a_treble_note_is_played_at_its_velocity(velocity):
    """Levels of its few partials oscillate with velocity, so other velocities fit nearly as well at another gain."""
    it = pianofit.typical(91)
    note = pianofit.Note(it.string, it.hammer, it.geometry, "bridge-force", gain=0.01)
    number = np.arange(1, 5)
    level = note.levels(velocity, len(number))
    found = predict_recording(note, analysis(number, level, f0=it.string.c / (2 * it.geometry.length)))
    assert found.velocity == pytest.approx(velocity, rel=0.01)
    assert found.gain_db == pytest.approx(0.0, abs=0.5)
    assert found != copy.deepcopy(found)  # it holds arrays, so it is equal only to itself


def test_a_recording_comes_in_any_form(tmp_path):
    it = pianofit.typical(53)
    note = pianofit.Note(it.string, it.hammer, it.geometry, "bridge-force", gain=0.01)
    samples = note.render(3.0, seconds=1.0).astype(np.float32).astype(float)
    file = tmp_path / "a.wav"
    file.write_bytes(pianofit.encode_wav(samples, 44_100))
    found = [
        predict_recording(note, one).velocity for one in (file, (samples, 44_100), pianofit.load_recording(str(file)))
    ]
    assert found[0] == found[1] == found[2] == pytest.approx(3.0, rel=0.05)


def test_what_strokes_leave_is_taken_along():
    """The velocity discrepancy is interpolated between fitted velocities and constant beyond them."""
    it, count = pianofit.typical(53), 20
    note = pianofit.Note(it.string, it.hammer, it.geometry, "bridge-force", gain=0.01)
    velocities, discrepancy = np.array([0.5, 1.0, 3.0]), np.random.default_rng(1).normal(0, 3, (3, count))
    path = OutputPath(note.frequencies(count), np.zeros(count), VelocityDiscrepancy(velocities, discrepancy))
    for velocity, over in ((1.0, discrepancy[1]), (np.sqrt(3.0), discrepancy[1:].mean(axis=0)), (5.0, discrepancy[2])):
        level = note.levels(velocity, count) + over
        recorded = analysis(np.arange(1, count + 1), level, f0=it.string.c / (2 * it.geometry.length))
        found = predict_recording(note._replace(path=path), recorded)
        assert found.error_db < 0.05
        assert found.velocity == pytest.approx(velocity, rel=0.01)
        assert predict_recording(note._replace(path=path._replace(velocity_discrepancy=None)), recorded).error_db > 1.0


def test_its_pitch_is_the_tension_that_explains_the_partials():
    """The f0 of a recording depends on its B: with a wrong one it says 3 cents where every partial says 5."""
    it, count = pianofit.typical(30), 30
    note = pianofit.Note(it.string, it.hammer, it.geometry, "bridge-force", gain=0.01)
    recorded = analysis(np.arange(1, count + 1), note.levels(2.0, count), f0=float(note.f0))
    tense = note.with_cents(5.0).frequencies(count)
    partials = replace(recorded.partials, frequency=tense, frequency_error=1e-6 * tense)
    found = predict_recording(note, replace(recorded, f0=recorded.f0 * 2 ** (3 / 1200), partials=partials))
    assert found.pitch_offset_cents == pytest.approx(5.0, abs=0.01)


def test_gains_that_agree_answer_for_the_next():
    """`log_gain` is a density of the next gain, and is narrow if the others agree."""
    grid = np.linspace(-200, 200, 4001)
    for others in ((0.0,), (0.0, 0.4, -0.3, 0.1), (0.0, -14.0, 9.0)):
        density = np.exp([log_gain(gain, others) for gain in grid])
        assert np.trapezoid(density, grid) == pytest.approx(1.0, abs=1e-6)
    away = [log_gain(15.0, others) for others in ((0.0, 0.4, -0.3, 0.1), (0.0,), (0.0, -14.0, 9.0))]
    assert away[0] < away[1] - 5
    assert away[1] < away[2]
    # By Bayes p(a, b, c) does not depend on the order of the gains.
    one = log_gain(3.0, (0.0,)) + log_gain(-1.0, (0.0, 3.0))
    assert one == pytest.approx(log_gain(-1.0, (0.0,)) + log_gain(3.0, (0.0, -1.0)), abs=1e-9)


def test_gains_are_those_of_one_path():
    table = [(0.1, 0, False), (-1.0, 0, True), (5.0, 1, False), (0.0, 0, False), (50.0, 1, False)]
    rows = [SimpleNamespace(gain=gain, path_group=group, is_reference=first) for gain, group, first in table]
    fit = SimpleNamespace(recordings=rows, reference_index=1)
    assert Fit.relative_gains(fit) == pytest.approx((-20.0, 0.0))
    assert Fit.relative_gains(fit, 2) == pytest.approx((0.0, 20.0))
    assert Fit.relative_gains(fit, 3) == (0.0,)
