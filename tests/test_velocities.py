"""Measured velocities that contradict the sound give a warning, and true ones do not."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from batch_cases import struck

from pianofit import fit
from pianofit.analysis import analyse
from pianofit.inference import build_problem
from pianofit.recording.recording import load_recording
from pianofit.result.warnings import brightening, contradictory_velocities
from pianofit.setup import RecordingInfo, Setup

SPEEDS = (1.0, 1.3, 4.0)  # m/s


@pytest.fixture(scope="module")
def strokes(tmp_path_factory):
    """Recordings of one string at three velocities, each scaled to the same peak, and their analyses."""
    folder = tmp_path_factory.mktemp("strokes")
    for v in SPEEDS:
        struck(folder / f"{v}.wav", 60, v, seconds=1.2)
    recordings = [load_recording(folder / f"{v}.wav") for v in SPEEDS]
    return recordings, [analyse(recording, note="C4") for recording in recordings]


def warnings_of(strokes, speeds, p: float = 0.0, groups=(None, None, None), analyses=None) -> list[str]:
    """Warnings for velocities, m/s or None, with the exponent `p` prior deviations from its prior mean."""
    recordings = strokes[0]
    layers = tuple(
        RecordingInfo(file=f"{true}.wav", v_H0=v, group=group)
        for true, v, group in zip(SPEEDS, speeds, groups, strict=True)
    )
    problem = build_problem(recordings, analyses or strokes[1], Setup(recordings=layers))
    z = problem.parametrisation.mean.copy()
    at = problem.parametrisation.index_of("p")
    z[at] += p * problem.parametrisation.sd[at]
    return contradictory_velocities(SimpleNamespace(problem=problem, estimate=SimpleNamespace(theta=z)))


@pytest.mark.parametrize("slow", [0, 1])
def test_a_faster_stroke_is_brighter(strokes, slow):
    slope, error, _ = brightening(strokes[1][slow], strokes[1][slow + 1])
    assert slope > 3 * error
    back, same, _ = brightening(strokes[1][slow + 1], strokes[1][slow])
    assert (back, same) == pytest.approx((-slope, error))


def test_a_gain_does_not_change_how_bright_a_stroke_is(strokes):
    a, b = strokes[1][:2]
    louder = replace(b, partials=replace(b.partials, level=b.partials.level + 20.0))
    assert brightening(a, louder)[:2] == pytest.approx(brightening(a, b)[:2])
    assert brightening(a, louder)[2] == pytest.approx(brightening(a, b)[2] + 20.0)


def test_few_common_partials_decide_nothing(strokes):
    a = strokes[1][0]
    few = replace(a, partials=replace(a.partials, number=a.partials.number + 1000))
    assert brightening(a, few)[1] == np.inf


@pytest.mark.parametrize(
    "speeds",
    [
        SPEEDS,
        (0.5, 0.65, 2.0),
        (1.0, None, 4.0),
        (1.0, 1.0, 4.0),
        (None, None, None),
        (None, None, 4.0),
        (0.9, 1.4, 5.0),
    ],
)
def test_velocities_in_the_order_of_the_sound_are_not_questioned(strokes, speeds):
    assert warnings_of(strokes, speeds) == []


@pytest.mark.parametrize(
    ("speeds", "named"),
    [
        ((4.0, 1.3, 1.0), ("1.3.wav (1.3 m/s)", "duller", "4.0.wav (1 m/s)")),
        ((4.0, None, 1.0), ("1.0.wav (4 m/s)", "4.0.wav (1 m/s)")),
        ((1.3, 1.0, 4.0), ("1.0.wav (1.3 m/s)", "1.3.wav (1 m/s)")),
        ((1.0, 4.0, 1.3), ("1.3.wav (4 m/s)", "4.0.wav (1.3 m/s)")),
    ],
)
def test_velocities_in_another_order_than_the_sound_are_questioned(strokes, speeds, named):
    (sentence,) = warnings_of(strokes, speeds)
    assert all(word in sentence for word in named)


def test_recordings_of_different_paths_are_not_compared(strokes):
    assert warnings_of(strokes, (4.0, 1.3, 1.0), groups=("a", "b", "c")) == []


def test_a_faster_stroke_that_is_fainter_is_questioned(strokes):
    a, b, c = strokes[1]
    faint = replace(c, partials=replace(c.partials, level=c.partials.level - 30.0))
    (sentence,) = warnings_of(strokes, SPEEDS, analyses=[a, b, faint])
    assert "4.0.wav (4 m/s) is fainter" in sentence


@pytest.mark.parametrize(("slope", "mean", "word"), [
    (-0.45, 0.0, ""), (-0.55, 0.0, "duller"), (0.0, -2.9, ""), (0.0, -3.1, "fainter"), (1.0, -3.1, "fainter"),
])  # fmt: skip
def test_how_much_duller_or_fainter_is_questioned(strokes, slope, mean, word):
    """Exact changes of the level, without scatter, so only the thresholds decide."""
    a = strokes[1][0]
    octaves = np.log2(a.partials.number)
    weight = 1 / (2 * a.partials.level_error**2 + 1)
    level = a.partials.level + mean + slope * (octaves - np.average(octaves, weights=weight))
    b = replace(a, partials=replace(a.partials, level=level))
    assert brightening(a, b) == pytest.approx((slope, 0.0, mean), abs=1e-9)
    sentences = warnings_of(strokes, (1.0, 2.0, None), analyses=[a, b, strokes[1][2]])
    assert len(sentences) == bool(word)
    assert all(word in sentence for sentence in sentences)


@pytest.mark.parametrize(("slowest", "count"), [(0.51, 0), (0.49, 1)])
def test_velocities_that_no_pianist_spans_are_questioned(strokes, slowest, count):
    sentences = warnings_of(strokes, (slowest, 0.6, 10.0))
    assert len(sentences) == count
    assert all("10 m/s" in sentence and "unit" in sentence for sentence in sentences)


@pytest.mark.parametrize(("p", "word"), [(2.6, "less"), (-2.6, "more"), (2.4, ""), (-2.4, "")])
def test_an_exponent_that_no_felt_has_questions_the_ratio(strokes, p, word):
    sentences = warnings_of(strokes, SPEEDS, p)
    assert len(sentences) == bool(word)
    assert all("exponent" in sentence and word in sentence for sentence in sentences)
    assert warnings_of(strokes, (None, None, 4.0), p) == []
    assert warnings_of(strokes, SPEEDS, p, groups=("a", "b", "c")) == []


def test_a_fit_says_so_in_its_warnings(strokes):
    recordings, analyses = strokes
    layers = (RecordingInfo(file="1.0.wav", v_H0=4.0), RecordingInfo(file="4.0.wav", v_H0=1.0))
    result = fit(recordings[0], recordings[2], setup=Setup(recordings=layers), note="C4", progress=False,
                 analyses=[analyses[0], analyses[2]])  # fmt: skip
    assert any("duller" in message and "1.0.wav (4 m/s)" in message for message in result.warnings)
