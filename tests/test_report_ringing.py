"""Curves of the modal response, for sounds with known envelopes and levels."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pianofit.model.modal_response import ModalResponse, decays_and_beats
from pianofit.report.modal_response import (
    decay_rows,
    draw_envelopes,
    draw_spectrograms,
    envelopes_of,
    spectrograms_of,
)

RATE, ONSET, F0 = 16_000, 800, 200.0
NUMBER = np.arange(1, 9)
DECAY, LEVEL = 0.5 + 0.3 * NUMBER, -20.0 - 4.0 * NUMBER


def sound(seconds: float, decay: np.ndarray, gain: float = 1.0) -> np.ndarray:
    """Return damped partials from the onset on."""
    t = np.arange(round(seconds * RATE)) / RATE
    shape = np.exp(-np.outer(decay, t)) * np.cos(2 * np.pi * F0 * np.outer(NUMBER, t))
    return np.pad(gain * 10 ** (LEVEL / 20) @ shape, (ONSET, 0))


def fake_result(seconds: float = 4.0, rings: bool = True) -> Any:
    """Return a fit whose string decays twice as fast as the recording, and whose modes are 6 dB too loud."""
    recorded, string = sound(seconds, DECAY), SimpleNamespace(samples=sound(seconds, 2 * DECAY))
    played = SimpleNamespace(samples=sound(seconds, DECAY, 2.0)) if rings else None
    fitted = SimpleNamespace(
        recording=SimpleNamespace(samples=recorded, rate=RATE, onset=ONSET), fitted=string, with_modes=played,
        final=played or string, partials=SimpleNamespace(number=NUMBER, frequency=F0 * NUMBER, level=LEVEL),
    )  # fmt: skip
    pole = -DECAY + 2j * np.pi * F0 * NUMBER
    ringing = ModalResponse(NUMBER, pole, np.full(8, 0.1), np.ones((1, 8), complex), np.zeros((1, 0)), RATE)
    result = SimpleNamespace(
        reference=fitted, note=SimpleNamespace(modal_response=ringing if rings else None),
        analysis=SimpleNamespace(f0=F0, B=0.0),
    )  # fmt: skip
    result.with_recordings = lambda: result
    return result


def test_envelopes_are_those_of_the_strongest_partials():
    titles = [panel.figure().axes[0].get_title() for panel in draw_envelopes(fake_result())]
    assert [title.split(",")[0] for title in titles] == [f"partial {k}" for k in range(1, 7)]
    for one in envelopes_of(fake_result(), [1, 2, 3, 4, 5, 6]):
        assert (one.time[0], one.time[-1]) == pytest.approx((0.0, 3.0), abs=0.02)
        after = one.time > 0.05  # so that no kernel extends before the onset
        expected_db = LEVEL[one.number - 1] - 20 / np.log(10) * np.outer(
            [1.0, 2.0], DECAY[one.number - 1] * one.time[after]
        )
        for shown, expected in (
            (one.levels["measured"], expected_db[0]),
            (one.levels["string model"], expected_db[1]),
            (one.levels["fitted"], expected_db[0] + 20 * np.log10(2)),
        ):
            loud = expected > -80  # side lobes of the kernel are below
            np.testing.assert_allclose(shown[after][loud], expected[loud], atol=0.05)


def test_levels_over_time_and_frequency_are_where_the_partials_are():
    time, frequency, measured, fitted = spectrograms_of(fake_result())
    assert measured.shape == fitted.shape == (len(frequency), len(time))
    assert 2.9 < time[-1] <= 3.0
    loud = np.argmax(measured, axis=0)
    assert np.ptp(frequency[loud]) == 0
    assert frequency[loud[0]] == pytest.approx(F0, rel=0.1)
    difference = (fitted - measured)[loud[0]]
    np.testing.assert_allclose(difference, 20 * np.log10(2), atol=0.05)
    assert np.all(measured >= measured.max() - 60.1)


def test_decays_are_those_of_the_modes():
    decays = decays_and_beats(fake_result().note.modal_response)
    np.testing.assert_allclose([one.early for one in decays], np.log(1e3) / DECAY)
    assert [row[0] for row in decay_rows(decays)] == [str(k) for k in NUMBER]
    assert [float(row[3]) for row in decay_rows(decays)] == pytest.approx(np.log(1e3) / DECAY, rel=0.05)


def test_a_key_by_its_law_has_two_envelopes():
    result = fake_result(rings=False)
    assert [[*one.levels] for one in envelopes_of(result, [1, 2])] == 2 * [["measured", "string model"]]
    *_, measured, fitted = spectrograms_of(result)
    assert (fitted - measured)[:, -1].min() < -3


@pytest.mark.parametrize("seconds", [0.1, 0.5])
def test_a_short_recording_is_drawn(seconds):
    result = fake_result(seconds)
    panels = draw_envelopes(result), draw_spectrograms(result)
    assert [len([panel.figure() for panel in own]) for own in panels] == [6, 3]
