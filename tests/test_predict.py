"""Which velocity suits a recording's levels."""

from __future__ import annotations

import numpy as np
import pytest
from observed_cases import analysis

import pianofit
from pianofit.inference.predict import predict_recording


@pytest.mark.parametrize("velocity", [0.4, 1.3])
def test_a_treble_note_is_played_at_its_velocity(velocity):
    """Levels of its few partials rise and fall with the velocity: others suit nearly as well, at another gain."""
    it = pianofit.typical(91)
    note = pianofit.Note(it.string, it.hammer, it.geometry, "bridge-force", gain=0.01)
    number = np.arange(1, 5)
    level = note.levels(velocity, len(number))
    found = predict_recording(note, analysis(number, level, f0=it.string.c / (2 * it.geometry.length)))
    assert found.velocity == pytest.approx(velocity, rel=0.01)
    assert found.gain_db == pytest.approx(0.0, abs=0.5)
