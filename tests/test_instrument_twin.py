"""Keyboard laws of a synthetic library, fitted key by key, against the truth. Takes a minute.

`pytest -s -m slow tests/test_instrument_twin.py` prints the errors.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from instrument_cases import law_errors, record_key

from pianofit.analysis.note_names import midi_to_note
from pianofit.fitting import fit
from pianofit.instrument import Instrument, build_instrument, find_fits, load_keys

RECORDED = (29, 36, 43, 50, 57, 64, 71, 79)
BETWEEN = list(range(RECORDED[0], RECORDED[-1] + 1))
# Largest rms error of a law over all keys from the lowest to the highest recorded; logarithms, cents for the tuning.
ALLOWED = {"cents": 0.1, "B": 0.01, "b1": 0.02, "d2": 0.03, "M_H/M_S": 0.02, "F/M_S": 0.1, "local_exponent": 0.02,
           "mu": 0.1, "x0/L": 0.005}  # fmt: skip


def fit_library(folder: Path) -> Instrument:
    """Record and fit every key, and build the instrument."""
    random = np.random.default_rng(1)
    for midi in RECORDED:
        out = folder / "keys" / f"twin-{midi_to_note(midi).replace('#', 's')}"
        fit(*record_key(folder, midi, random), note=midi_to_note(midi)).save(out, page=False)
    return build_instrument(load_keys(find_fits([folder])), "twin")


@pytest.mark.slow
def test_the_laws_of_a_fitted_library_are_the_truth(tmp_path):
    for name, (law, literature) in law_errors(fit_library(tmp_path), ALLOWED, BETWEEN).items():
        print(f"{name}: {law:.2g}, without recordings {literature:.2g}")
        assert law < ALLOWED[name], name
        assert law < 0.2 * literature, name
