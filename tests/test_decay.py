"""Decays and beats of the partials of a key, against envelopes of the sound of its modes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import hilbert

from pianofit.dsp.damped_sums import sum_damped_modes
from pianofit.model.modal_response import EARLY, LATE, ModalResponse, decays_and_beats

LOG = np.log(1e3)  # T60 is this multiple of 1/α


def key(frequency, decay, pattern, number=None, error=None):
    pole = -np.asarray(decay, float) + 2j * np.pi * np.asarray(frequency, float)
    number = np.ones(len(pole), int) if number is None else np.asarray(number)
    error = np.full(len(pole), 0.1) if error is None else np.asarray(error)
    pattern = np.atleast_2d(np.asarray(pattern, complex))
    return ModalResponse(number, pole, error, pattern, np.zeros((len(pattern), 0)), 44_100)


def test_one_mode_has_one_decay_and_no_beat():
    (found,) = decays_and_beats(key([440.0], [2.0], [1.0 + 2.0j]))
    assert (found.number, found.modes, found.error) == (1, 1, (0.1, 0.1))
    assert found.frequency == pytest.approx(440.0)
    assert (found.early, found.late) == pytest.approx((LOG / 2.0, LOG / 2.0))
    assert np.isnan([found.beat_frequency, found.beat_depth]).all()


def test_a_fast_and_a_slow_mode_make_a_double_decay():
    (found,) = decays_and_beats(key([440.0, 440.1], [8.0, 0.5], [1.0, 0.01], error=[0.3, 0.02]))
    assert found.early == pytest.approx(LOG / 8.0, rel=0.02)
    assert found.late == pytest.approx(LOG / 0.5, rel=0.02)
    assert found.error == (0.02, 0.3)
    assert np.isnan(found.beat_frequency)  # one beat would last ten seconds


def test_a_decay_that_its_errors_exceed_is_not_given():
    """The late T60 depends on the slow mode, whose decay rate of 0.05 1/s is not significant."""
    (found,) = decays_and_beats(key([440.0, 440.1], [8.0, 0.05], [1.0, 0.01], error=[0.3, 0.2]))
    assert found.early == pytest.approx(LOG / 8.0, rel=0.05)
    assert np.isnan(found.late)


@pytest.mark.parametrize(("weaker", "reported"), [(0.08, False), (0.09, True)])
def test_a_beat_is_told_from_one_and_a_half_decibels_on(weaker, reported):
    (found,) = decays_and_beats(key([440.0, 442.5], [0.6, 0.6], [1.0, 1j * weaker]))
    assert np.isfinite([found.beat_frequency, found.beat_depth]).all() == reported


@pytest.mark.parametrize("weaker", [0.2, 0.5, 0.9])
def test_two_modes_that_decay_alike_beat_as_deep_as_their_levels_say(weaker):
    (found,) = decays_and_beats(key([440.0, 442.5], [0.6, 0.6], [1.0, 1j * weaker]))
    assert found.beat_frequency == pytest.approx(2.5)
    assert found.beat_depth == pytest.approx(20 * np.log10((1 + weaker) / (1 - weaker)), rel=1e-2)
    assert found.early == pytest.approx(found.late)


def test_decays_and_beats_are_those_of_the_sound():
    """Three modes in two channels; the third, alone in its channel, does not beat."""
    rate, k = 8000, key([500.0, 503.0, 490.0], [1.0, 1.5, 3.0], [[1.0, 0.6, 0.0], [0.0, 0.0, 0.5]])
    (found,) = decays_and_beats(k)
    time = np.arange(round(3.5 * rate)) / rate
    power = np.sum(np.abs(hilbert(sum_damped_modes(k.pole, k.pattern, rate, len(time)), axis=-1)) ** 2, axis=0)
    alone = [np.abs(hilbert(sum_damped_modes(k.pole[[m]], k.pattern[:, [m]], rate, len(time)))) ** 2 for m in range(3)]
    smooth = 10 * np.log10(np.sum(alone, axis=(0, 1)))
    assert found.frequency == pytest.approx(500.0)
    assert found.beat_frequency == pytest.approx(3.0)
    for t60, (start, stop) in ((found.early, EARLY), (found.late, LATE)):
        at = (time >= start) & (time < stop)
        assert t60 == pytest.approx(-60 / np.polyfit(time[at], smooth[at], 1)[0], rel=1e-3)
    at = (time >= EARLY[0]) & (time < LATE[1])
    assert found.beat_depth == pytest.approx(np.ptp((10 * np.log10(power) - smooth)[at]), rel=1e-2)


def test_partials_are_kept_apart_and_a_gain_changes_nothing():
    k = key([440.0, 882.0, 440.7, 883.0], [1.0, 2.0, 1.2, 2.5], [1.0, 0.5, 0.7, 0.4], number=[1, 2, 1, 2])
    one, two = decays_and_beats(k)
    assert [one.number, two.number] == [1, 2]
    assert (one.beat_frequency, two.beat_frequency) == pytest.approx((0.7, 1.0))
    np.testing.assert_allclose(decays_and_beats(k.scale_gain(100.0))[0][1:7], one[1:7], rtol=1e-9)
