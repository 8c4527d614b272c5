"""Tables from analyses: every number in its place, and padding without effect."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from observed_cases import B1, D2, F0, PRESSURE, B, analysis, frequency

import pianofit.model  # noqa: F401  (float64)
from pianofit import Recording, Setup, analyse, recording_from_samples
from pianofit.inference import build_problem, observation_tables, priors
from pianofit.inference.batched_model import string_law
from pianofit.inference.likelihood import solve_nodes
from pianofit.inference.observation_tables import RecordingStructure, observe
from pianofit.inference.pipeline import fit_string

LOUD = analysis([1, 2, 3, 5], [0.0, -10.0, -20.0, -40.0], absent=[4], bound=[-70.0], systematic=0.3)
SOFT = analysis([1, 2, 4], [-12.0, -25.0, -50.0], absent=[3, 5], bound=[-61.0, -62.0], f0=F0 * 2 ** (2 / 1200))
ALONE = RecordingStructure((0,), (0,), (0,))
TWO = RecordingStructure((0, 1), (0, 0), (0, 1))
MICROPHONES = RecordingStructure((0, 0), (0, 1), (0, 1))


def observed(layout: RecordingStructure = TWO, scale: float | None = None):
    analyses = [LOUD, SOFT] if len(layout.stroke) > 1 else [LOUD]
    return observe(analyses, layout, 0, replace(PRESSURE, scale=scale))


def bounds(table) -> dict[tuple[int, int], float]:
    """Bounds of the censored entries, by recording and column."""
    return {(r, k): table.value[r, k] for r, k in map(tuple, table.censored)}


def test_levels_stand_in_their_columns():
    o = observed(scale=10 ** (6 / 20))
    assert o.number.tolist() == [1, 2, 3, 4, 5]
    np.testing.assert_array_equal(o.level.detected, [[1, 1, 1, 0, 1], [1, 1, 0, 1, 0]])
    np.testing.assert_allclose(o.level.value[0, [0, 1, 2, 4]], [6.0, -4.0, -14.0, -34.0])
    np.testing.assert_allclose(o.level.value[1, [0, 1, 3]], [-6.0, -19.0, -44.0])
    np.testing.assert_allclose(o.level.variance[o.level.detected > 0], 0.01)
    # The loudest of the same recording over each.
    np.testing.assert_allclose(20 * np.log10(o.level.ratio[1, [0, 1, 3]]), [0.0, 13.0, 38.0])


def test_what_is_absent_stands_at_its_bound():
    assert bounds(observed().level) == {(0, 3): -70.0, (1, 2): -61.0, (1, 4): -62.0}
    nowhere = analysis([1, 3], [0.0, -5.0], absent=[2, 4], bound=[-50.0, -51.0])
    # A partial that no recording shows counts only without an unknown path.
    assert bounds(observe([nowhere], ALONE, 0, PRESSURE).level) == {}
    calibrated = observe([nowhere], ALONE, 0, replace(PRESSURE, scale=1.0))
    assert calibrated.number.tolist() == [1, 2, 3]
    assert bounds(calibrated.level) == {(0, 1): -50.0}
    assert calibrated.level.variance[0, 1] == priors.CENSORED_MARGIN**2


def test_columns_are_gains_and_onsets():
    alpha = B1 + D2 * np.arange(1, 6.0) ** 2
    table = observed().level
    path, gain, onset = np.split(table.columns, [1, 3])
    np.testing.assert_allclose(path, np.ones((1, 2, 5)))
    np.testing.assert_allclose(gain, np.eye(2)[:, :, None] * np.ones(5))
    # With an onset that is late by 1 s, every partial has decayed by its own α.
    np.testing.assert_allclose(onset, np.eye(2)[:, :, None] * 20 * np.log10(np.exp(alpha)))
    late = np.hypot(priors.ONSET, priors.ONSET_PERIODS / F0)
    apart = [[priors.GAIN, x, x, late, late] for x in priors.GAIN_DEVIATION]
    np.testing.assert_allclose(table.scale, apart)
    shared = observed(RecordingStructure((0, 1), (0, 0), (0, 0))).level
    np.testing.assert_allclose(shared.scale, [[priors.GAIN, late, late]])
    np.testing.assert_allclose(shared.columns[0], 1.0)
    calibrated = observed(scale=1.0).level
    np.testing.assert_allclose(calibrated.columns[:, :, :5], onset)
    np.testing.assert_allclose(calibrated.scale, [[late, late]])


def test_nodes_are_of_paths_and_of_gains():
    """Every τ with shared and with separate gains, equally likely; prescreening uses the middle τ."""
    table = observed().level
    nodes, weight = priors.path_nodes()
    np.testing.assert_allclose(np.exp(table.log_weight), weight[:, None] / 2 * np.ones(2))
    np.testing.assert_allclose(table.log_tau[:, 0], nodes)
    assert (table.log_tau[len(nodes) // 2, 0], table.scale[-1, 1]) == (nodes[1], priors.GAIN_DEVIATION[1])
    assert observed(MICROPHONES).level.scale.shape == (1, 2 + 2)  # two paths without a shared gain


def test_two_microphones_share_a_stroke_and_no_path():
    assert MICROPHONES.strokes == 1
    assert MICROPHONES.groups == 2
    np.testing.assert_array_equal(observed(MICROPHONES).level.group, np.eye(2))
    np.testing.assert_array_equal(observed().level.group, np.ones((2, 1)))


def test_the_residual_of_every_path_is_integrated_over():
    x, weight = priors.path_nodes()
    assert weight @ x == pytest.approx(np.log(priors.PATH[0]))
    assert weight @ (x - np.log(priors.PATH[0])) ** 2 == pytest.approx(priors.PATH[1] ** 2)
    for layout in (ALONE, TWO):
        level = observed(layout).level
        regimes = len(layout.stroke)  # one recording, or shared and separate gains
        np.testing.assert_allclose(level.log_tau, x[:, None])
        np.testing.assert_allclose(np.exp(level.log_weight), weight[:, None] / regimes * np.ones(regimes))
    both = observe([LOUD, SOFT, LOUD], RecordingStructure((0, 1, 0), (0, 0, 1), (0, 1, 2)), 0, PRESSURE).level
    np.testing.assert_allclose(both.log_tau, x[:, None] * np.ones(2))
    calibrated = observed(scale=1.0).level
    assert not calibrated.has_unknown_path.any()
    assert (calibrated.log_tau <= observation_tables.NONE).all()


def test_a_systematic_error_is_the_mean_over_recordings():
    systematic = observed().level.systematic
    assert systematic[0, 0] == pytest.approx(0.09 / 2)  # only one of the two recordings has it
    assert systematic[2, 2] == pytest.approx(0.09)  # a partial of one recording only
    assert np.linalg.eigvalsh(systematic)[0] > -1e-12


def test_an_absent_partial_beats_like_its_neighbour():
    """A second polarisation lowers all high partials by 2 dB. Bounds on absent ones must not deny it."""
    shown = analysis([1, 2, 5], [0.0, -10.0, -40.0], absent=[3, 4, 6], bound=[-60.0] * 3, systematic=1.0)
    later = analysis([1, 2, 7], [0.0, -10.0, -55.0], absent=[3, 4, 5, 6], bound=[-60.0] * 4, systematic=1.0)
    table = observe([shown, later], RecordingStructure((0, 1), (0, 0), (0, 0)), 0, replace(PRESSURE, scale=1.0)).level
    systematic = table.systematic
    for absent, nearest in ((3, 2), (4, 5), (6, 5)):  # the first of two that are equally near
        np.testing.assert_allclose(systematic[absent - 1], systematic[nearest - 1])
    point = np.zeros_like(table.value), table.prior[0], np.ones_like(table.value), np.zeros(0)
    residual = np.where(table.detected > 0, -2.0, -2.0 + 1.0)  # levels 2 dB below the model, bounds 1 dB above these
    solved = solve_nodes(table._replace(velocity=np.zeros((2, 0))), residual[None], *(x[None] for x in point[1:]))
    assert solved.censored.mean.max() < -1.0


def test_strokes_of_different_pitch_meet_the_path_at_different_frequencies():
    two = observed()
    # Sharper by 2 cents, partial 5 of a string without stiffness is 5 (2^(2/1200) - 1) spacings nearer to its
    # neighbour. The paths at the two partials differ by √2 times the median residual. A tension moves stiff partials
    # less.
    number = np.arange(1, 6)
    expected = np.sqrt(2) * priors.PATH[0] * np.log(2) / 600 * number / (1 + B * number**2)
    np.testing.assert_allclose(two.level.pitch[:, :5], [0 * expected, expected], rtol=1e-4)
    assert not observed(scale=1.0).level.pitch.any()
    assert not two.frequency.pitch.any()
    assert not two.decay.pitch.any()


def test_levels_that_only_pitch_changes_do_not_look_like_a_velocity():
    """Two strokes 4 cents apart through a path with slopes of 4 dB a spacing: F counts them as what they are."""
    number, slope = np.arange(1, 31), np.random.default_rng(0).normal(0.0, 4.0, 30)
    sharp = 2 ** (4 / 1200)
    loud = analysis(number, -number.astype(float), f0=F0, level_error=0.001)
    soft = analysis(number, -number + slope * number * (sharp - 1), f0=F0 * sharp, level_error=0.001)
    table = observe([loud, soft], TWO, 0, PRESSURE).level._replace(velocity=np.eye(2))
    phi = np.log([0.001, 8.0, 0.7, 1e-6, 1e-3])  # nothing else that differs between two strokes

    def level_of(t) -> np.ndarray:
        at = phi[None], np.ones((1, *t.value.shape)), np.array([[0.0, 0.5]])
        return solve_nodes(t, t.value[None], *at).nll_per_node.min()

    assert level_of(table) < level_of(table._replace(pitch=0 * table.pitch)) - 1000


def test_recordings_are_laid_on_one_law():
    o = observed()
    assert o.cents == pytest.approx([0.0, 2.0], rel=1e-4)
    np.testing.assert_allclose(o.frequency.value[0], 0.0, atol=1e-4)
    np.testing.assert_allclose(o.decay.value[0], 0.0, atol=1e-12)
    # Two recordings halve the variance of the noise; each partial counts once.
    assert o.frequency.variance[0, 0] == pytest.approx(0.5 * o.frequency.variance[0, 2])
    sharp = analysis([1, 2], [0.0, -10.0], f0=F0, glide_start=1.5)
    assert observe([sharp], ALONE, 0, PRESSURE).cents == pytest.approx([1.5])


def beating(seed: int, f0: float = 110.0, rate: int = 44_100) -> Recording:
    """Thirty partials of two components each, whose decays scatter by factors about one model."""
    random, t = np.random.default_rng(seed), np.arange(4 * rate) / rate
    sound = 1e-6 * random.normal(size=len(t))
    for k in range(1, 31):
        f, law = k * f0 * np.sqrt(1 + 2e-4 * k**2), B1 + D2 * k**2
        for share in (0.1, 0.1 * random.uniform(0.2, 0.9)):
            decay, hz = law * np.exp(0.5 * random.normal()), f + 0.4 * random.normal()
            sound += share * 10 ** (-k / 20) * np.exp(-decay * t) * np.cos(2 * np.pi * hz * t + random.uniform(0, 6))
    return recording_from_samples(np.append(np.zeros(2_000), sound), rate)


def test_a_law_of_decays_goes_through_the_cloud_of_partials_that_beat():
    """Shared errors that grow with their value would bias the model below all values."""
    above, over = [], []
    for seed in range(6):
        recording = beating(seed)
        found = analyse(recording, f0=110.0)
        problem = build_problem([recording], [found], Setup())
        law = string_law(
            fit_string(problem).theta[0, :4], found.partials.number, problem.initial_values.geometry.length
        )[0][1]
        above.append(np.mean(found.partials.decay > law))
        over.append(np.median(found.partials.decay / law))
    assert np.mean(above) == pytest.approx(0.5, abs=0.15)
    np.testing.assert_allclose(over, 1.0, atol=0.25)


def test_the_strings_law_has_the_derivatives_it_says():
    string, number, step = np.log([330.0, 1.2, 0.5, 4e-5]), np.array([1, 2, 5, 9]), 1e-6
    value, slope = string_law(string, number, 0.63)
    s = (number * np.pi / 0.63) ** 2
    alpha = 0.5 + 4e-5 * s
    np.testing.assert_allclose(value[1], alpha)
    np.testing.assert_allclose((2 * np.pi * value[0]) ** 2, 330.0**2 * s + 1.2**2 * s**2 - alpha**2)
    for i in range(4):
        e = step * np.eye(4)[i]
        up, down = string_law(string + e, number, 0.63)[0], string_law(string - e, number, 0.63)[0]
        # The effect of losses on the pitch is neglected: parts in 1e8.
        np.testing.assert_allclose(slope[0][:, i], np.log(up[0] / down[0]) / (2 * step), atol=1e-6)
        np.testing.assert_allclose(slope[1][:, i], (up[1] - down[1]) / (2 * step), rtol=1e-6, atol=1e-9)


def test_partials_above_the_top_stand_in_no_table():
    high = analysis([1, 20, 40], [0.0, -20.0, -30.0])
    assert frequency(np.array([40]))[0] > observation_tables.HIGHEST_HZ
    assert observe([high], ALONE, 0, PRESSURE).number.max() == 20
