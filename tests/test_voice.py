"""A fitted attack is laid on the recorded one where it belongs, not a period beside it."""

from __future__ import annotations

import numpy as np
import pytest

from pianofit.fit.voice import lag, placed

RATE, PERIOD = 10_000, 270  # of A♯1, 27 ms: an attack of 50 ms holds not two


@pytest.mark.parametrize("touch", [120, 300, 500, 770])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_attack_is_found_among_its_periods(touch, sign):
    t = np.arange(1500) / RATE
    # Grows for two periods, so that its correlation with a later piece of itself is the larger one.
    note = np.minimum(np.arange(1500) / (2 * PERIOD), 1.0) * sum(
        np.sin(2 * np.pi * k * t * RATE / PERIOD) for k in (1, 2)
    )
    sound = np.zeros(1500)
    sound[touch:] = note[: 1500 - touch]
    sound = sign * sound + 1e-3 * np.random.default_rng(1).normal(size=1500)
    at, found = placed(note[:500], sound)
    assert (at, found) == (touch, sign)
    assert abs(lag(note[:500], found * sound[at:][:500])) < 0.1
