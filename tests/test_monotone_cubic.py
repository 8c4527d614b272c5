"""The monotone cubic against SciPy's PCHIP with the same slopes at its ends."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator

from pianofit.monotone_cubic import MonotoneCubic


@pytest.mark.parametrize("seed", range(3))
def test_a_monotone_cubic_is_that_of_scipy(seed):
    random = np.random.default_rng(seed)
    x, y = np.cumsum(random.uniform(0.5, 3.0, 9)), random.normal(size=9)
    slopes = PchipInterpolator(x, y).derivative()(x)
    slopes[[0, -1]] = (np.diff(y) / np.diff(x))[[0, -1]]
    expected, own = CubicHermiteSpline(x, y, slopes), MonotoneCubic.through(x, y)
    at = np.append(x, random.uniform(x[0], x[-1], 100))
    np.testing.assert_allclose([own(value) for value in at], expected(at), atol=1e-13)


def test_a_monotone_cubic_through_two_points_is_a_line():
    line = MonotoneCubic.through(np.array([1.0, 3.0]), np.array([2.0, 8.0]))
    assert [line(value) for value in (1.0, 2.0, 3.0)] == pytest.approx([2.0, 5.0, 8.0], abs=1e-14)
