"""Sobol points are those of SciPy, whose import takes longer."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import qmc

from pianofit.sobol import sobol_points


@pytest.mark.parametrize("dimensions", [1, 2, 9, 63, 64, 70])
@pytest.mark.parametrize("count", [1, 2, 1024])
def test_points_are_those_of_scipy(dimensions, count):
    expected = qmc.Sobol(dimensions, rng=np.random.default_rng(7)).random(count)
    np.testing.assert_array_equal(sobol_points(dimensions, count, 7), expected)
