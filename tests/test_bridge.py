"""The admittance of the bridge from decays, against unisons whose strings are coupled by a known admittance."""

from __future__ import annotations

import numpy as np
import pytest
from instrument_cases import true_note

from pianofit.instrument.bridge import measure_bridge, prompt_excess, unison_bridge_rate
from pianofit.literature import typical_strings
from pianofit.model.modal_response import ModalResponse
from pianofit.model.modes import mode_frequencies
from pianofit.model.note import Note
from pianofit.schema.bridge import BridgeAdmittance

KEYS = range(40, 88, 4)


def unison(note: Note, midi: int, admittance: float, random: np.random.Generator) -> Note:
    """The key with two strings a partial that differ by some 0.2 Hz: eigenmodes of Weinreich's equations."""
    hz = mode_frequencies(note.string, note.geometry.length, 8)
    rate = typical_strings(midi) * note.geometry.mass * (note.string.c / note.geometry.length) ** 2 * admittance
    partial, pole, pattern = [], [], []
    for k, f in enumerate(hz, start=1):
        split = 2 * np.pi * random.normal(0.0, 0.2)
        own = -0.2 + 2j * np.pi * f + 0.5j * split * np.array([1, -1])
        values, vectors = np.linalg.eig(np.diag(own) - 0.5 * rate * np.ones((2, 2)))
        # Struck alike, and heard through the bridge, on which both push alike.
        weight = vectors.sum(axis=0) * np.linalg.solve(vectors, np.ones(2))
        partial += [k, k]
        pole += list(values)
        pattern += list(weight)
    response = ModalResponse(
        np.array(partial), np.array(pole), np.zeros(len(pole)), np.array(pattern)[None], np.zeros((1, 0)), 44_100
    )
    return note._replace(modal_response=response)


@pytest.mark.parametrize("admittance", [3e-4, 1e-3, 3e-3])
def test_decays_tell_the_admittance(admittance):
    """From 200 Hz to 2 kHz within a factor of 2.5, and not above. Mistuned strings share their loss."""
    random = np.random.default_rng(1)
    notes = [(midi, unison(true_note(midi), midi, admittance, random)) for midi in KEYS]
    found = measure_bridge(notes)
    at = np.geomspace(200, 2000, 10)
    ratio = found.at(at) / admittance
    assert ratio.max() < 1.1
    assert ratio.min() > 1 / 2.5
    low, high = found.interval(at)
    assert (low < found.at(at)).all()
    assert (high < 3 * low).all()
    assert found.source == "recordings"


def test_prompt_sound_and_aftersound_are_told_apart():
    """One partial of two modes: at first 4 1/s, in the end 0.5 1/s."""
    pole = np.array([-4.0, -0.5]) + 2j * np.pi * np.array([400.0, 400.5])
    pattern = np.array([[1.0, 0.03]], complex)
    response = ModalResponse(np.array([3, 3]), pole, np.zeros(2), pattern, np.zeros((1, 0)), 44_100)
    ((hz, excess),) = prompt_excess(response)
    assert hz == pytest.approx(400.0, abs=0.1)
    assert excess == pytest.approx(3.5, rel=0.15)


def test_without_double_decays_the_literature_stays():
    single = true_note(60)
    assert measure_bridge([(60, single)]) == BridgeAdmittance()
    one = ModalResponse(
        np.array([1]), np.array([-3 + 1600j]), np.zeros(1), np.ones((1, 1), complex), np.zeros((1, 0)), 44_100
    )
    assert measure_bridge([(60, single._replace(modal_response=one))]) == BridgeAdmittance()


def test_three_strings_lose_three_times_as_much_together():
    note, hz = true_note(72), np.array([500.0, 1000.0])
    geometry, tension = note.geometry, note.geometry.mass * note.string.c**2 / note.geometry.length
    assert unison_bridge_rate(note, 72, hz, BridgeAdmittance()) == pytest.approx(3 * tension / geometry.length * 1e-3)


def test_a_law_must_ascend():
    with pytest.raises(ValueError, match="ascending"):
        BridgeAdmittance((200.0, 100.0), (1e-3,) * 2, (1e-3,) * 2, (1e-3,) * 2)
    with pytest.raises(ValueError, match="one length"):
        BridgeAdmittance((200.0, 300.0))


def test_beats_are_no_decay():
    """Modes of equal decay, about 1 Hz apart and with random phases, lose nothing to the bridge."""
    random = np.random.default_rng(2)
    for _ in range(50):
        pole = -2.0 + 2j * np.pi * (400 + random.uniform(0, 1, 2))
        pattern = np.exp(2j * np.pi * random.uniform(size=(1, 2)))
        response = ModalResponse(np.array([3, 3]), pole, np.zeros(2), pattern, np.zeros((1, 0)), 44_100)
        assert prompt_excess(response) == []
