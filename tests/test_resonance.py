"""Strings that excite each other over the bridge, against strings by finite differences and against invariants."""

from __future__ import annotations

import numpy as np
import pytest
from coupled_strings import StringsOnBridge
from hypothesis import given
from hypothesis import strategies as st

from pianofit.playback.coupled_modes import MOST_BRIDGE_SHARE, TAPER, CoupledModes, bridge_drive
from pianofit.playback.resonance import HOP_SECONDS as HOP

RESISTANCE = 2000.0  # kg/s
PARTIALS = 4
PLACE = 5 / 41
CENT = 2 ** (1 / 1200)


def tuned(ratio: tuple[int, int], cents: float) -> tuple[float, float]:
    """f0 of two strings of which partial `ratio[0]` of the first meets partial `ratio[1]` of the second."""
    first = 220.0
    met = StringsOnBridge((first,), RESISTANCE).pole(0, ratio[0]).imag
    second = first * ratio[0] / ratio[1]
    second *= met / StringsOnBridge((second,), RESISTANCE).pole(0, ratio[1]).imag
    return first, second * CENT**cents


def modes_of(strings: StringsOnBridge) -> tuple[CoupledModes, np.ndarray, np.ndarray, np.ndarray]:
    """Modes of the strings, with the strike weight, line and number of each."""
    line, k = (x.ravel() for x in np.indices((len(strings.f0), PARTIALS)))
    k = k + 1
    pole = np.array([strings.pole(i, n) for i, n in zip(line, k, strict=True)])
    rate = np.array([strings.tension(strings.f0[i]) for i in line]) / strings.LENGTH / RESISTANCE
    drive = (-1.0) ** (k + 1) * np.sqrt(rate)
    strength = -1j * np.sqrt(2 / (strings.DENSITY * strings.LENGTH)) * np.sin(np.pi * k * PLACE)
    order = np.argsort(pole.imag)
    pole, drive, strength, line, k = (x[order] for x in (pole, drive, strength, line, k))
    return CoupledModes(pole, drive, line), strength, line, k


def played(coupled: CoupledModes, strength: np.ndarray, struck: np.ndarray, hops: int) -> np.ndarray:
    """Amplitudes of all modes at each hop after an impulse on the struck modes [hops, modes]."""
    alone = np.where(struck, strength, 0.0)
    added = coupled.far_response(np.flatnonzero(struck), strength[struck])
    half, lift = np.exp(0.5 * HOP * coupled.pole), np.ones(len(alone))
    found = []
    for _ in range(hops):
        found.append(alone + added)
        alone, added = coupled.step(alone, added, half, lift, HOP)
    return np.array(found)


CASES = {
    "unison": tuned((1, 1), 0.0), "unison, 2 cents off": tuned((1, 1), 2.0), "20 cents off": tuned((1, 1), 20.0),
    "octave": tuned((2, 1), 0.0), "octave, 3 cents off": tuned((2, 1), 3.0), "fifth": tuned((3, 2), 0.0),
    "three strings": (*tuned((1, 1), 1.0), tuned((2, 1), 1.0)[1]),
}  # fmt: skip


BEAT = round(0.4 / HOP)  # hops: the period of the beats 20 cents off
HEARD = round(3.0 / HOP)


@pytest.mark.parametrize("case", CASES)
def test_coupled_strings_move_as_by_finite_differences(case):
    """Energy of each string, struck and free, within 0.5 dB over 3 s. Minima of beats are averaged with the rest."""
    strings, hops = StringsOnBridge(CASES[case], RESISTANCE), HEARD + BEAT
    coupled, strength, line, k = modes_of(strings)
    found = np.abs(played(coupled, strength, line == 0, hops)) ** 2
    states = strings.motion(strings.impulse(0, PLACE), HOP, hops)
    true = np.array([
        np.abs(strings.amplitude(states, i, n, p.imag)) ** 2 for i, n, p in zip(line, k, coupled.pole, strict=True)
    ]).T  # fmt: skip
    for i in range(len(strings.f0)):
        mine, theirs = (np.convolve(x[:, line == i].sum(axis=1), np.ones(BEAT), "valid") for x in (found, true))
        assert np.abs(10 * np.log10(mine / theirs)).max() < 0.5
    # The pulls of free strings on the struck one are heard, not only computed: alone it would decay otherwise.
    if case == "unison":
        first = np.flatnonzero((line == 0) & (k == 1))[0]
        alone = np.abs(strength[first] * np.exp(coupled.pole[first] * HEARD * HOP)) ** 2
        assert 10 * np.log10(found[HEARD, first] / alone) > 1.0


def test_an_impulse_excites_far_modes_by_their_transforms():
    """Mode by mode: the transform of every struck vibration at the pole of another mode, less by the taper if near."""
    random, count, common = np.random.default_rng(5), 24, 0.3
    pole = -random.exponential(3.0, count) + 2j * np.pi * np.sort(random.uniform(20.0, 150.0, count))
    drive, source = random.normal(size=count), np.array([2, 3, 9, 10, 11, 12, 13, 14, 15, 20])
    strength = random.normal(size=10) + 1j * random.normal(size=10)
    pole[21] = pole[20]  # equal poles exchange energy later, in steps
    expected = np.zeros(count, complex)
    for i in np.delete(np.arange(count), source):
        for j, a in zip(source, drive[source] * strength, strict=True):
            if pole[i] != pole[j]:
                vibration = a / (pole[i] - pole[j]) + np.conj(a) / (pole[i] - np.conj(pole[j]))
                expected[i] -= common * drive[i] * min(abs(pole[i].imag - pole[j].imag) / TAPER, 1.0) * vibration
    coupled = CoupledModes(pole, drive, np.arange(count), common)
    assert coupled.far_response(source, strength) == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_two_equal_strings_are_weinreichs():
    """Struck together they decay twice as fast by the bridge, and struck against each other by their own losses."""
    own, rate = 0.3, 2.0
    coupled = CoupledModes(np.full(2, -own - rate + 1000j), np.full(2, np.sqrt(rate)), np.arange(2))
    half = np.exp(0.5 * HOP * coupled.pole)
    for sign, decay in ((1.0, own + 2 * rate), (-1.0, own)):
        alone, added = np.array([1.0 + 0j, sign]), np.zeros(2, complex)
        for _ in range(200):
            alone, added = coupled.step(alone, added, half, np.ones(2), HOP)
        assert np.abs(alone + added) == pytest.approx(np.exp(-decay * 200 * HOP), rel=2e-3)


@given(st.integers(0, 10_000), st.integers(2, 40), st.floats(0.1, 40.0))
def test_energy_never_rises(seed, count, bridge):
    """Any strings, losses, unisons with several modes, half-lifted dampers, strings that receive nothing, any state."""
    random = np.random.default_rng(seed)
    decay, omega = random.exponential(3.0, count) + 0.01, 2 * np.pi * np.sort(random.uniform(20, 120, count))
    partial, share = random.integers(0, count, count), random.uniform(0.01, 1.0, count)
    _, index = np.unique(partial, return_inverse=True)
    share /= np.bincount(index, share)[index]
    size = bridge_drive(bridge * random.uniform(0.1, 1.0, count)[index], decay, share, partial)
    drive = size * random.choice([-1.0, 1.0], len(index))[index]
    receives = random.choice([0.0, 1.0, 1.0], count)[index]
    coupled = CoupledModes(-decay + 1j * omega, drive, partial, receives=receives)
    lift = random.choice([0.0, 0.3, 1.0], count)[index]
    half = np.exp(0.5 * HOP * coupled.pole)
    added = receives * (random.normal(size=count) + 1j * random.normal(size=count))
    alone, energy = np.zeros(count, complex), np.sum(np.abs(added) ** 2)
    for _ in range(50):
        alone, added = coupled.step(alone, added, half, lift, HOP)
        now = np.sum(np.abs(added) ** 2)
        assert now <= energy * (1 + 1e-12)
        assert not added[receives == 0].any()
        energy = now


@given(st.integers(0, 10_000))
def test_running_sums_are_the_sum_over_all_pairs(seed):
    random, count = np.random.default_rng(seed), 30
    omega, partial = 2 * np.pi * np.sort(random.uniform(20, 100, count)), random.integers(0, 20, count)
    drive, lift = random.normal(size=count), random.uniform(size=count)
    coupled = CoupledModes(-1 + 1j * omega, drive, partial)
    amplitude = random.normal(size=count) + 1j * random.normal(size=count)
    taper = np.maximum(1 - np.abs(np.subtract.outer(omega, omega)) / TAPER, 0) * (partial[:, None] != partial)
    pairs = (drive * lift)[:, None] * taper * (drive * lift)
    assert coupled.exchange(amplitude, lift) == pytest.approx(pairs @ amplitude, rel=1e-9, abs=1e-9)


def test_a_partial_gives_the_bridge_no_more_than_it_loses():
    partial, share = np.array([0, 0, 1]), np.array([0.7, 0.3, 1.0])
    decay, rate = np.array([5.0, 0.5, 2.0]), np.array([4.0, 4.0, 1.0])
    taken = bridge_drive(rate, decay, share, partial) ** 2 / decay
    assert taken[:2].sum() == pytest.approx(MOST_BRIDGE_SHARE)
    assert taken[2] == pytest.approx(0.5)
