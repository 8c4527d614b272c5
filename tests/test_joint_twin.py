"""A synthetic keyboard with one recorded layer a key: fits with the prior of the other keys are nearer to the truth."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from instrument_cases import record_key, true_note

from pianofit import Result, Setup, fit, load_keys, prior_of_key
from pianofit.analysis.note_names import midi_to_note
from pianofit.instrument.key_quantities import LAW_QUANTITIES, at_scale, key_quantities
from pianofit.instrument.predicted_key import NAMES
from pianofit.model.note import Note

# Few partials in the treble leave much to the prior.
KEYS = (60, 64, 68, 72, 76, 80)
VELOCITY = 2.0  # m/s
COMPARED = ("M_H/M_S", "F/M_S", "local_exponent", "mu")


def quantities(note: Note, midi: int, velocity: float) -> dict[str, float]:
    """Quantities of a note on the scales of their laws, on the true scale of the velocities."""
    values = key_quantities(note, midi) | {"level": 0.0}
    scaled = np.array([LAW_QUANTITIES[name].scaled(values[name]) for name in NAMES])
    return dict(zip(NAMES, at_scale(scaled, midi, VELOCITY / velocity), strict=True))


def errors(results: dict[int, Result]) -> np.ndarray:
    """Errors of logarithms [keys, compared quantities]."""
    rows = []
    for midi, result in results.items():
        true = quantities(true_note(midi), midi, VELOCITY)
        found = quantities(result.note, midi, result.fit.reference.stroke_value)
        rows.append([found[name] - true[name] for name in COMPARED])
    return np.array(rows)


@pytest.mark.slow
def test_one_layer_of_each_key_tells_more_together(tmp_path):
    random, alone, joint = np.random.default_rng(2), {}, {}
    files = {midi: record_key(tmp_path, midi, random, noise_db=-45.0, layers=(VELOCITY,)) for midi in KEYS}
    for midi in KEYS:
        alone[midi] = fit(*files[midi], note=midi_to_note(midi), progress=False)
        alone[midi].save(tmp_path / f"twin-{midi_to_note(midi).replace('#', 's')}", page=False)
    loaded = load_keys(sorted(Path(tmp_path).glob("twin-*/fit.json")))
    for midi in KEYS:
        setup = Setup(prior=prior_of_key(loaded, midi))
        joint[midi] = fit(*files[midi], note=midi_to_note(midi), setup=setup, progress=False)
    rms = [np.sqrt(np.mean(errors(results) ** 2, axis=0)) for results in (alone, joint)]
    assert (rms[1] < rms[0]).all()
    assert math.prod(rms[1] / rms[0]) < 0.8 ** len(COMPARED)
