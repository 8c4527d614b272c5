"""One stroke at two microphones: one velocity, one pitch and two output paths; it counts once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from twin_cases import MICROPHONES, VELOCITIES, fit_recordings, path_fit, strokes_of, through

from pianofit import Result
from pianofit.cli.fits import _left_out_table
from pianofit.errors import FitError
from pianofit.inference import build_problem
from pianofit.result.cross_validation import LeftOutRecording, cross_validate

# Both microphones recorded stroke 1, through different output paths. The velocity of the last stroke was measured.


def test_recordings_of_a_stroke_share_its_velocity_and_no_path():
    problem = build_problem(*through(MICROPHONES), strokes_of(MICROPHONES))
    layout = problem.structure
    assert layout.stroke == (0, 1, 2, 1)
    assert layout.group == (0, 0, 0, 1)
    assert problem.parametrisation.strokes == 3
    assert problem.measured_velocity == (None, None, VELOCITIES[2])
    assert problem.reference == 2


def test_a_velocity_measured_at_one_microphone_is_that_of_the_stroke():
    setup = strokes_of(MICROPHONES)
    entries = [replace(t, v_H0=1.5 if t.file == "1-room.wav" else t.v_H0) for t in setup.recordings]
    problem = build_problem(*through(MICROPHONES), replace(setup, recordings=tuple(entries)))
    assert problem.measured_velocity == (None, 1.5, VELOCITIES[2])
    assert not problem.parametrisation.free[-2:].any()


def test_the_shared_velocity_is_found_and_shown_alike():
    rows = path_fit(MICROPHONES).fit.recordings
    np.testing.assert_allclose([row.stroke_value for row in rows], [VELOCITIES[s] for s, _ in MICROPHONES], rtol=0.01)
    one, other = rows[1], rows[3]
    for name in ("stroke_value", "stroke_interval", "stroke_status", "stroke"):
        assert getattr(one, name) == getattr(other, name)
    assert one.stroke_interval[0] < one.stroke_value < one.stroke_interval[1]
    assert [row.stroke for row in rows].count(one.stroke) == 2
    assert one.path_group != other.path_group
    assert one.levels.fitted_db < 0.2 > other.levels.fitted_db


def test_every_microphone_has_a_path_of_its_own():
    result = path_fit(MICROPHONES)
    close, also, _, room = (recording.fitted.note.path for recording in result.recordings)
    np.testing.assert_array_equal(close.db, also.db)
    assert len(room.db) != len(close.db) or np.abs(room.db - close.db).max() > 3.0


@pytest.mark.slow
def test_every_microphone_is_read_back(tmp_path):
    """The file has the paths of all groups. Recordings that were arrays must be given again."""
    result, recordings = path_fit(MICROPHONES), through(MICROPHONES)[0]
    back = Result.load(result.save(tmp_path / "fit", page=False)).with_recordings(*recordings)
    assert back.reference_index == result.reference_index
    for one, other in zip(back.recordings, result.recordings, strict=True):
        note, theirs = one.fitted.note, other.fitted.note
        np.testing.assert_allclose(note.path.db, theirs.path.db, rtol=1e-12)
        np.testing.assert_allclose([*note.string, *note.hammer], [*theirs.string, *theirs.hammer], rtol=1e-12)
        _, here, there = np.intersect1d(one.partials.number, other.partials.number, return_indices=True)
        assert len(here) >= 0.9 * len(other.level)  # a partial at the noise may be detected in one analysis only
        np.testing.assert_allclose(one.level[here], other.level[there], atol=1e-6)
        for mine, sound in ((one.fitted, other.fitted), (one.initial, other.initial)):
            np.testing.assert_allclose(mine.samples, sound.samples, atol=1e-6 * np.abs(sound.samples).max())
            np.testing.assert_allclose(mine.level[here], sound.level[there], atol=1e-6)
    with pytest.raises(FitError, match="SHA-256"):
        back.with_recordings(*recordings[::-1])


def test_one_stroke_at_two_microphones_does_not_fix_the_felt():
    recordings, analyses = ([x[i] for i in (1, 3)] for x in through(MICROPHONES))
    found = fit_recordings(recordings, analyses, strokes_of(MICROPHONES)).fit
    assert found.identifiability_statement.startswith("2 uncalibrated recordings do not determine")
    assert {found.parameters[n].status for n in ("K_H", "p")} <= {"not-identifiable", "at-bound"}
    assert found.recordings[0].stroke_value == found.recordings[1].stroke_value


def some_of(result: Result, which: list[int]) -> Result:
    """A result with some of its recordings."""
    records = tuple(result.fit.recordings[i] for i in which)
    notes = tuple(tuple(own[i] for i in which) for own in result.minima_notes)
    return replace(result, fit=replace(result.fit, recordings=records), recordings=(), minima_notes=notes)


def with_fits(monkeypatch, of) -> None:
    """Replace the fits of a cross-validation by the results of `of`."""
    monkeypatch.setattr("pianofit.result.cross_validation.run_inference", of)
    monkeypatch.setattr("pianofit.result.cross_validation.build_result", lambda result: result)


def test_leaving_a_recording_out_leaves_out_its_stroke(monkeypatch):
    """With the notes of the fit of all instead of four more fits: recordings left out, and comparisons."""
    recordings, analyses = through(MICROPHONES)
    fits = []

    def instead(some, *_, **__):
        fits.append([r.path for r in some])
        return some_of(path_fit(MICROPHONES), [i for i, r in enumerate(recordings) if r.path in fits[-1]])

    with_fits(monkeypatch, instead)
    found = cross_validate(*recordings, analyses=analyses, setup=strokes_of(MICROPHONES))
    everything = {f"{b}-{m}.wav" for b, m in MICROPHONES}
    assert [everything - set(files) for files in fits] == [
        set(), {"0-close.wav"}, {"1-close.wav", "1-room.wav"}, {"2-close.wav"},
    ]  # fmt: skip
    rows = {row.file: row for row in found.recordings}
    assert len(rows) == 4
    middle, lone = rows["1-close.wav"], rows["1-room.wav"]
    assert [row.file for row in found.recordings if row.has_neighbours] == ["1-close.wav"]
    assert middle.predicted_db == found.median_inner_db < 0.5 * middle.nearest_db
    # The other microphone recorded no other stroke, so its path and its levels are unknown.
    assert lone == LeftOutRecording("1-room.wav", lone.stroke_value, None, None, None, None, None, False)
    (message,) = found.warnings
    assert "1-room.wav" in message
    assert message in (printed := _left_out_table(found))
    assert "  -        -      -" in printed


def test_without_an_inner_recording_there_is_no_median(monkeypatch):
    """Three strokes, each at its own microphone, as in a setup with one group for each recording."""
    recordings, analyses = ([x[i] for i in range(3)] for x in through(MICROPHONES))
    rows = tuple(replace(row, path_group=i) for i, row in enumerate(path_fit(MICROPHONES).fit.recordings[:3]))
    whole = replace(path_fit(MICROPHONES), fit=replace(path_fit(MICROPHONES).fit, recordings=rows))
    fits = iter([whole, *[some_of(whole, [0, 1])] * 3])
    with_fits(monkeypatch, lambda *_, **__: next(fits))
    found = cross_validate(*recordings, analyses=analyses, setup=strokes_of(MICROPHONES))
    assert (found.median_inner_db, found.worst_inner_db) == (None, None)
    assert len(found.warnings) == 3
    assert "median" not in _left_out_table(found)


def test_too_few_strokes_to_leave_one_out(monkeypatch):
    recordings, analyses = ([x[i] for i in (1, 2, 3)] for x in through(MICROPHONES))
    with_fits(monkeypatch, lambda *_, **__: some_of(path_fit(MICROPHONES), [1, 2, 3]))
    with pytest.raises(FitError, match="3 recordings of 2 strokes"):
        cross_validate(*recordings, analyses=analyses, setup=strokes_of(MICROPHONES))
