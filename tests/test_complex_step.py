"""Derivatives by a complex step against closed forms."""

from __future__ import annotations

import numpy as np

from pianofit.complex_step import slope_by_entry


def test_a_slope_is_exact_to_rounding():
    at = np.random.default_rng(0).uniform(0.2, 2.0, (50, 3))

    def function(x: np.ndarray) -> np.ndarray:
        return np.exp(x[..., 0]) * np.log(x[..., 1]) / x[..., 2]

    a, b, c = at.T
    exact = np.exp(a) * np.log(b) / c, np.exp(a) / (b * c), -np.exp(a) * np.log(b) / c**2
    for i, slope in enumerate(exact):
        np.testing.assert_allclose(slope_by_entry(function, at, i), slope, rtol=1e-14, atol=1e-14)
