"""Several recordings of one key through an irregular output path: shared and individual parameters."""

from __future__ import annotations

import functools
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits
from twin_cases import (
    ALONE,
    FIRST,
    MICROPHONES,
    SEVERAL,
    VELOCITIES,
    fit_recordings,
    path_fit,
    record,
    setup_of,
    strokes_of,
    through,
)

from pianofit.analysis import Partials, analyse
from pianofit.errors import FitError
from pianofit.inference import build_problem
from pianofit.model.output_path import VelocityDiscrepancy
from pianofit.result import Result
from pianofit.result.cross_validation import cross_validate
from pianofit.result.prediction import predict_recording
from pianofit.result.warnings import velocity_assignment_warning
from pianofit.schema.fit import Minimum, VelocityDiscrepancyEntry, read_fit
from pianofit.schema.notes import notes_of_fit
from pianofit.setup import RecordingInfo, Setup
from pianofit.threads import numerical_settings

FILES = [f"{stroke}-{microphone}.wav" for stroke, microphone in SEVERAL]


BLAS_THREADS: list[int] = []  # during the fit below


def blas_threads() -> list[int]:
    return [library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"]


@functools.cache
def without_the_middle() -> Result:
    recordings, analyses = through(SEVERAL)
    return fit_recordings(
        [recordings[0], recordings[2]], [analyses[0], analyses[2]], strokes_of(SEVERAL),
        progress=lambda *_: BLAS_THREADS.extend(blas_threads()),
    )  # fmt: skip


def test_a_fit_keeps_blas_to_one_thread_and_gives_back_what_the_caller_had():
    with threadpool_limits(limits=2, user_api="blas"):
        before = blas_threads()
        without_the_middle()
        assert set(BLAS_THREADS) == {1}
        assert blas_threads() == before
        assert 1 not in before


def test_overlapping_computations_in_threads_give_back_the_threads_of_blas():
    other = numerical_settings()
    with threadpool_limits(limits=2, user_api="blas"), ThreadPoolExecutor(1) as pool:
        before = blas_threads()
        with numerical_settings():
            pool.submit(other.__enter__).result()
        assert set(blas_threads()) == {1}
        pool.submit(other.__exit__, None, None, None).result()
        assert blas_threads() == before


def test_every_recording_is_shown_with_its_own():
    found = path_fit(SEVERAL).fit
    assert [row.file for row in found.recordings] == FILES
    assert [row.is_reference for row in found.recordings] == [False, False, True]
    assert [row.stroke_status for row in found.recordings] == ["fitted", "fitted", "given"]
    assert (found.parameters["v_H0"].value, found.parameters["v_H0"].status) == (3.2, "given")
    assert found.identifiability_statement.startswith("3 uncalibrated recordings of one key")
    for row in found.recordings:
        assert row.criterion.bands["global"].final < min(0.05, row.criterion.bands["global"].initial)
        assert row.levels.fitted_db < 0.2
        assert row.gain_status == "fitted"
    assert {found.parameters[n].status for n in ("K_H", "mu", "p", "M_H")} == {"fitted"}


@pytest.mark.slow  # test_equivariance.py has the order of two files
def test_the_order_of_files_changes_nothing():
    recordings, analyses = through(SEVERAL)
    first = path_fit(SEVERAL).fit
    other = fit_recordings(recordings[::-1], analyses[::-1], strokes_of(SEVERAL)).fit
    velocities = [[row.stroke_value for row in found.recordings] for found in (first, other)]
    assert [t.file for t in other.recordings] == FILES[::-1]
    # The order of strokes changes the random samples of the search, which stops when F gains less than a thousandth.
    assert velocities[1] == pytest.approx(velocities[0][::-1], rel=2e-3)
    for name, p in first.parameters.items():
        assert other.parameters[name].value == pytest.approx(p.value, rel=2e-2 if name == "K_H" else 2e-3), name
    assert other.diagnostics.negative_log_posterior == pytest.approx(first.diagnostics.negative_log_posterior, abs=0.1)


def test_known_velocities_are_kept():
    known = [RecordingInfo(file=name, v_H0=v) for name, v in zip(FILES, VELOCITIES, strict=True)]
    problem = build_problem(*through(SEVERAL), strokes_of(SEVERAL, *known))
    assert problem.measured_velocity == VELOCITIES
    np.testing.assert_allclose(np.exp(problem.parametrisation.mean[-3:]), VELOCITIES, rtol=1e-12)
    assert not problem.parametrisation.free[-3:].any()


def test_a_velocity_that_names_no_recording_is_the_brightest_ones_and_said_so():
    problem = build_problem(*through(SEVERAL), Setup(fixed={"v_H0": 3.0}))
    assert problem.measured_velocity == (None, None, 3.0)
    (warning,) = velocity_assignment_warning(problem)
    assert "v_H0 = 3 m/s" in warning
    assert FILES[2] in warning
    assert not velocity_assignment_warning(build_problem(*through(SEVERAL), strokes_of(SEVERAL)))


def test_groups_and_gain_groups_are_the_setups():
    entries = [
        RecordingInfo(FILES[0], None, "a", "same", None),
        RecordingInfo(FILES[1], None, "b", "same", None),
        RecordingInfo(FILES[2]),
    ]
    problem = build_problem(*through(SEVERAL), strokes_of(SEVERAL, *entries))
    layout = problem.structure
    assert layout.stroke == (0, 1, 2)
    assert len(set(layout.group)) == 3
    assert layout.gain[0] == layout.gain[1] != layout.gain[2]
    # Three paths, each with a gain, and three onsets. No path has several gains.
    assert len(problem.observed.level.columns) == 3 + 3


def test_a_recording_that_was_left_out_is_predicted():
    result = without_the_middle()
    notes = list(zip(result.weights, (minimum[0] for minimum in result.minima_notes), strict=True))
    found = predict_recording(notes, through(SEVERAL)[1][1])
    assert found.velocity == pytest.approx(VELOCITIES[1], rel=0.02)
    assert found.error_db < 0.3


def test_what_alike_strokes_leave_alike_is_known_of_a_path():
    """A synthetic recording has almost no discrepancy. One that is added, different at each partial, is recovered."""
    assert np.abs(path_fit(SEVERAL).note.path.velocity_discrepancy.db).max() < 0.2
    recordings, analyses = through(SEVERAL)
    slope, random = {}, np.random.default_rng(4)
    altered = []
    for analysis, velocity in zip(analyses, VELOCITIES, strict=True):
        p = analysis.partials
        own = np.array([slope.setdefault(int(k), random.normal(0, 2.0)) for k in p.number])
        altered.append(replace(analysis, partials=replace(p, level=p.level + own * np.log(velocity / VELOCITIES[1]))))
    note = fit_recordings(recordings, altered, strokes_of(SEVERAL)).note
    path = note.path
    assert path.velocity_discrepancy.velocity == pytest.approx(VELOCITIES, rel=0.1)
    number = 1 + np.abs(note.frequencies(64) - path.frequency[:, None]).argmin(axis=1)
    common = np.isin(number, functools.reduce(np.intersect1d, [a.partials.number for a in altered]))
    drawn = np.array([slope[k] for k in number[common]]) * np.log(VELOCITIES[2] / VELOCITIES[0])
    found = (path.velocity_discrepancy.db[2] - path.velocity_discrepancy.db[0])[common]
    assert np.std(found - drawn) < 0.6 * np.std(drawn)


def test_a_file_predicts_what_its_fit_predicts(tmp_path):
    result, analysis = without_the_middle(), through(SEVERAL)[1][1]
    folder = result.save(tmp_path / "fit", page=False)
    read, whole = Result.load(folder).predict(analysis), result.predict(analysis)
    assert (read.velocity, read.error_db) == pytest.approx((whole.velocity, whole.error_db), rel=1e-6)

    def discrepancies(*minima: Minimum) -> list[VelocityDiscrepancy | None]:
        notes = notes_of_fit(replace(fit, minima=minima), folder, "fit.json")
        return [own[fit.reference_index].path.velocity_discrepancy for own in notes]

    fit = read_fit(folder / "fit.json")
    (one, *_), path = fit.minima, fit.pickup.path
    own = one.path_velocity_discrepancy
    np.testing.assert_array_equal(path.velocity_discrepancy.db, own.db)
    # Each minimum has its own discrepancy, or none.
    first, second = discrepancies(one, replace(one, path_velocity_discrepancy=replace(own, db=np.full_like(own.db, 2))))
    assert (first.db[0, 0], second.db[0, 0]) == (own.db[0, 0], 2.0)
    without = replace(one, path_velocity_discrepancy=None)
    assert discrepancies(without, without) == [None, None]
    one_partial = replace(one, path_velocity_discrepancy=VelocityDiscrepancyEntry(np.ones(1), np.zeros((1, 1))))
    with pytest.raises(FitError, match=r"minima\[0\].*a level for every partial"):
        discrepancies(one_partial, one_partial)


def test_one_velocity_has_no_velocity_discrepancy():
    assert path_fit(ALONE).note.path.velocity_discrepancy is None
    close, room = (path_fit(MICROPHONES).minima_notes[0][i].path for i in (0, 3))
    assert len(close.velocity_discrepancy.velocity) == len(SEVERAL)
    assert room.velocity_discrepancy is None


@pytest.mark.slow
def test_cross_validation_beats_the_nearest_layer():
    found = cross_validate(*through(SEVERAL)[0], setup=strokes_of(SEVERAL), f0=FIRST.f0)
    assert found.result.fit.recordings[0].stroke_value == pytest.approx(found.recordings[0].stroke_value)
    assert [row.has_neighbours for row in found.recordings] == [False, True, False]
    middle = found.recordings[1]
    assert middle.predicted_db == found.median_inner_db == found.worst_inner_db
    assert middle.predicted_db < 0.5 * middle.nearest_db
    assert found.recordings[0].blend_db is None


@pytest.mark.parametrize(("number", "named"), [(1, "1 recording"), (2, "2 recordings")])
def test_too_few_recordings_to_leave_one_out(number, named):
    recordings, analyses = through(SEVERAL)
    with pytest.raises(FitError, match=named):
        cross_validate(*recordings[:number], analyses=analyses[:number])


@pytest.mark.slow
def test_a_string_that_was_tenser_when_it_was_struck():
    """Calibrated, with a glide of 6 cents in the harder stroke. Without its tension, velocities are wrong by 1 %."""
    hard = FIRST._replace(hammer=FIRST.hammer._replace(v_H0=4.0))
    recordings = [
        replace(record(FIRST, seed=1), path="soft"),
        replace(record(hard, seed=2, glide_cents=6.0, glide_seconds=0.5), path="hard"),
    ]
    found = fit_recordings(recordings, [analyse(r, f0=FIRST.f0) for r in recordings], setup_of(FIRST)).fit
    np.testing.assert_allclose([row.stroke_value for row in found.recordings], [1.4, 4.0], rtol=3e-3)
    assert found.parameters["M_H"].value == pytest.approx(FIRST.hammer.M_H, rel=2e-3)
    assert found.diagnostics.excess_sd.level_db < 0.05


def test_recordings_that_do_not_belong_are_named():
    recordings, analyses = through(SEVERAL)
    with pytest.raises(FitError, match=r"0-close\.wav and 0-close\.wav are the same recording"):
        fit_recordings([recordings[0]] * 2, [analyses[0]] * 2)
    other_file = replace(recordings[0], path="copy.flac", sha256="0" * 64)
    with pytest.raises(FitError, match=r"copy\.flac and 0-close\.wav are the same recording"):
        fit_recordings([recordings[0], other_file], [analyses[0]] * 2)
    sharp = replace(analyses[1], f0=analyses[1].f0 * 2 ** (1 / 12))
    with pytest.raises(FitError, match=r"1-close\.wav: its pitch.* cents from that of the other recordings"):
        fit_recordings(recordings, [analyses[0], sharp, analyses[2]])
    p = analyses[1].partials
    cut = {f.name: getattr(p, f.name) for f in fields(Partials)}
    cut = {n: x[:2, :2] if x.ndim == 2 else x if n.startswith("absent") else x[:2] for n, x in cut.items()}
    thin = replace(analyses[1], partials=Partials(**cut))
    with pytest.raises(FitError, match=r"1-close\.wav: only 2 partials"):
        fit_recordings(recordings, [analyses[0], thin, analyses[2]])
