"""The paper's criterion compared with integrals of spectra that are computed independently here."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from pianofit.analysis import law_frequency
from pianofit.criterion import (
    BANDS,
    band_borders,
    band_of,
    band_values,
    cell_grid,
    closed_form_gain,
    level_error_db,
    measure,
)
from pianofit.model.output_path import OutputPath

RATE, F0, B, LAST, SIGMA = 16_000, 220.0, 4e-4, 14, 30.0
K = np.arange(1, LAST + 1)


def note(level: np.ndarray, detune: float = 0.0, decay: float = 1.0, seconds: float = 0.7) -> np.ndarray:
    """Damped partials of a stiff string, their amplitudes `level` [partials]."""
    t = np.arange(round(seconds * RATE)) / RATE
    f = law_frequency(F0, B, K) * (1 + detune)
    return (level[:, None] * np.exp(-decay * t) * np.sin(2 * np.pi * f[:, None] * t)).sum(axis=0)


def spectrum(samples: np.ndarray, frequency: np.ndarray) -> np.ndarray:
    """|S|² on the damped circle, term by term."""
    t = np.arange(len(samples)) / RATE
    damped = samples * np.exp(-SIGMA * t) / RATE
    return np.array([np.abs(damped @ np.exp(-2j * np.pi * f * t)) ** 2 for f in frequency])


def energy(samples: np.ndarray) -> np.ndarray:
    return measure(samples, RATE, F0, B, LAST, SIGMA)[1]


def values(model: np.ndarray, recorded: np.ndarray) -> dict[str, float]:
    cells, measured = measure(recorded, RATE, F0, B, LAST, SIGMA)
    return band_values(energy(model), measured, cells.spacing)


def test_measure_is_the_transform_of_the_damped_signal():
    samples = note(1.0 / K) + 1e-3 * np.random.default_rng(0).normal(size=round(0.7 * RATE))
    cells, found = measure(samples, RATE, F0, B, LAST, SIGMA)
    expected = spectrum(samples, cells.frequency[3])
    np.testing.assert_allclose(found[3], expected, rtol=1e-4, atol=1e-6 * expected.max())


def test_the_criterion_is_the_papers_integral():
    recorded, model = note(1.0 / K), note(1.1 / K, detune=4e-3, decay=2.0)
    found = values(model, recorded)
    edges = band_borders(F0, B, LAST)
    for index, name in enumerate(BANDS):
        frequency = np.arange(edges[index], edges[index + 1], 1.5)
        Y, S = spectrum(model, frequency), spectrum(recorded, frequency)
        assert found[name] == pytest.approx(((Y - S) ** 2).sum() / (S**2).sum(), rel=5e-3)


def test_equal_sounds_cost_nothing_and_silence_costs_one():
    sound = note(1.0 / K)
    assert set(values(sound, sound).values()) == {0.0}
    assert set(values(0 * sound, sound)) == {"global", *BANDS}
    assert set(values(0 * sound, sound).values()) == {1.0}


def test_the_criterion_has_no_unit():
    sound, other = note(1.0 / K), note(0.8 / K**1.5)
    for name, value in values(1e-3 * other, 1e-3 * sound).items():
        assert value == pytest.approx(values(other, sound)[name], rel=1e-9)


def test_a_band_depends_only_on_its_own_partials():
    louder = np.where(band_of(K) == 1, 2.0, 1.0) / K
    found = values(note(louder), note(1.0 / K))
    assert found["band1"] < 0.01  # from the lines of neighbouring partials
    assert found["band3"] < 0.01
    assert found["band2"] == pytest.approx(9.0, rel=0.01)  # (2² - 1)²


def test_bands_follow_the_paper():
    assert [BANDS[b] for b in band_of(np.array([1, 2, 8, 9, 50]))] == ["band1", "band2", "band2", "band3", "band3"]


@given(st.floats(27, 2000), st.floats(0, 5e-3), st.integers(1, 60))
def test_borders_lie_between_partials_and_cells_within_them(f0, inharmonicity, last):
    edges = band_borders(f0, inharmonicity, last)
    between = [law_frequency(f0, inharmonicity, np.array([k, k + 1])) for k in (1, 8)]
    assert edges == tuple(sorted(edges))
    assert all(low < edge < high for edge, (low, high) in zip(edges[1:3], between, strict=True))
    # "Midway": within the curvature of the frequency law between the two partials.
    assert edges[1] == pytest.approx(between[0].mean(), rel=0.02)
    assert edges[2] == pytest.approx(between[1].mean(), rel=0.02)
    resolution = 0.05
    cells = cell_grid(f0, inharmonicity, last, SIGMA, resolution)
    k = np.arange(1, last + 1)
    slack = (cells.spacing + resolution)[:, None] * 2
    assert (cells.frequency >= law_frequency(f0, inharmonicity, k - 0.5)[:, None] - slack).all()
    assert (cells.frequency <= law_frequency(f0, inharmonicity, k + 0.5)[:, None] + slack).all()
    nodes = cells.frequency / resolution
    np.testing.assert_allclose(nodes, np.round(nodes), atol=1e-6)


@given(st.integers(0, 2**32 - 1))
def test_the_gain_in_closed_form_is_the_best(seed):
    random = np.random.default_rng(seed)
    model, measured, weight = random.exponential(size=(3, 4, 7))
    gain = closed_form_gain(model, measured, weight)
    best = minimize_scalar(lambda g: (weight * (g * model - measured) ** 2).sum(), bracket=(0, 1)).x
    assert gain == pytest.approx(best, rel=1e-6)


def test_a_silent_model_has_a_gain_of_zero():
    assert closed_form_gain(np.zeros((2, 3)), np.ones((2, 3)), np.ones((2, 3))) == 0.0


def test_level_errors_leave_one_gain_out():
    level = np.array([-10.0, -20.0, -33.0, -47.0])
    assert level_error_db(level + 6.0, level) == pytest.approx(0.0, abs=1e-12)
    assert level_error_db(level + np.array([1.0, -1.0, 1.0, -1.0]), level) == pytest.approx(1.0)


def test_a_path_is_read_between_and_beyond_its_points():
    path = OutputPath(np.array([100.0, 400.0]), np.array([0.0, 12.0]))
    np.testing.assert_allclose(path.at(np.array([0.0, 50.0, 100.0, 200.0, 400.0, 9000.0])), [0, 0, 0, 6, 12, 12])
