"""Powers by doubling equal those by the exponential."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pianofit.dsp.damped_sums import powers


@given(st.integers(1, 5000), st.floats(-0.1, 0.001), st.floats(-3.2, 3.2))
def test_powers_are_exponentials(count, real, imag):
    log_z = np.array([[real + 1j * imag], [1j * real]])
    expected = np.exp(log_z[..., None] * np.arange(count))
    # The exponential of a phase of n radians has an error of n roundings.
    assert np.abs(powers(log_z, count) / expected - 1).max() < 1e-15 * (20 + 4 * count)


@pytest.mark.parametrize("count", [0, 1])
def test_the_first_power_is_one(count):
    assert powers(np.array([2j]), count).tolist() == [[1.0][:count]]
