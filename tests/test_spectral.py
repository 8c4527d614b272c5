"""Eq. 19 of the struck string: spectra against sums over samples, derivatives against differences and the paper."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pianofit import preset
from pianofit.bensa2005.spectral_criterion import (
    SearchConstants,
    StaticConfig,
    criterion_gradients,
    damped_spectrum,
    fix_string,
    residuals,
    spectral_goal,
)
from pianofit.model import mode_table, simulate
from pianofit.model.contact import strike as contact
from pianofit.model.free_response import spectrum
from pianofit.parameters import Geometry, Hammer, String

pytestmark = pytest.mark.usefixtures("float64")

RATE, MODES, STEPS = 88_200, 64, 512
TRUE, OTHER = preset("bensa-final"), preset("bensa-initial")
F0 = TRUE.string.c / 2
B = (TRUE.string.kappa * np.pi / TRUE.string.c) ** 2
LAST = 20
CFG = StaticConfig(MODES, STEPS, "velocity")
LOG_U = float(np.log(1e-4))
WIDE = np.full(5, -99.0), np.full(5, 99.0)
SCENE = SearchConstants(
    Geometry(*map(np.float64, TRUE.geometry)), *map(np.asarray, (float(RATE), LOG_U, [-99.0, 99.0]))
)


@functools.cache
def strike(which: str = "true"):
    """A strike at the rate of the contact, at which the model's sum is the waveform."""
    it = TRUE if which == "true" else OTHER
    return simulate(it.string, it.hammer, TRUE.geometry, rate=RATE, oversampling=1, n_modes=MODES)


@functools.cache
def wave(seconds: float = 1.0, which: str = "true") -> np.ndarray:
    return strike(which).waveform(RATE, round(seconds * RATE))


def goal(sigma: float = 30.0, bands=(0, 1, 2), **more):
    return spectral_goal(wave(more.pop("seconds", 1.0)), RATE, F0, B, LAST, sigma, bands=bands, **more)


def searched(it) -> np.ndarray:
    """Coordinates of `struck_gradients`: the felt by its force at 0.1 mm."""
    z = np.log([*it.string, *it.hammer])
    z[4] += it.hammer.p * LOG_U
    return z


@jax.jit
def plain(z, frequency, sigma):
    """Y at the coordinates of `struck_gradients`, mode by mode at every frequency, complex [bins]."""
    values = jnp.exp(z.at[4].add(-jnp.exp(z[6]) * LOG_U))
    modes = mode_table(String(*values[:4]), TRUE.geometry, rate=RATE, n_modes=MODES, quantity="velocity")
    return spectrum(modes, contact(modes, Hammer(*values[4:]), steps=STEPS).drive, frequency, sigma)


def plain_energy(it, g):
    """|Y|² on the cells of a goal."""
    y = plain(jnp.asarray(searched(it)), g.frequency.ravel(), g.sigma)
    return jnp.abs(y.reshape(g.frequency.shape)) ** 2


def cost_of(energy, g) -> float:
    return 0.5 * float((residuals(jnp.asarray(energy), g) ** 2).sum())


# --- the spectrum -----------------------------------------------------------------------------------------------------


def test_a_damped_spectrum_is_that_of_the_fft():
    samples, sigma, size = wave()[:5000], 12.0, 8192
    direct = np.fft.rfft(samples * np.exp(-sigma * np.arange(5000) / RATE), size) / RATE
    bins = np.array([0, 7, 500, 4096])
    np.testing.assert_allclose(
        damped_spectrum(samples, RATE, bins * RATE / size, sigma), direct[bins], atol=1e-12 * abs(direct).max()
    )


def test_the_models_energy_is_that_of_its_damped_waveform():
    sigma = 30.0
    g = goal(sigma)
    direct = np.abs(damped_spectrum(wave(), RATE, np.asarray(g.frequency), sigma)) ** 2
    for energy in (plain_energy(TRUE, g), g.energy):
        np.testing.assert_allclose(np.asarray(energy)[:LAST], direct[:LAST], rtol=0, atol=2e-6 * direct.max())
    assert np.asarray(g.weight)[LAST:].max(initial=0.0) == 0.0


@pytest.mark.parametrize("sigma", [30.0, 3.0, 1.0])
@pytest.mark.parametrize("which", ["true", "other"])
def test_the_fast_path_meets_the_sum_over_samples_also_where_the_recording_is_cut(sigma, which):
    """One second is far too short for σ = 1: a third of the amplitude is cut off, and the model includes this."""
    it = TRUE if which == "true" else OTHER
    g = goal(sigma)
    n = min(RATE, int(np.ceil(14 / sigma * RATE)))
    mine = damped_spectrum(wave(which=which)[:n], RATE, np.asarray(g.frequency), sigma)
    expected = cost_of(np.abs(mine) ** 2, g)
    cost, _ = criterion_gradients(searched(it)[None], g, SCENE, CFG)
    # The window of a whole stroke ends where it ends for the middle of the stroke.
    assert float(cost[0]) == pytest.approx(expected, rel=2e-4, abs=2e-6)
    held = fix_string(jnp.asarray(searched(it)), *WIDE, g, SCENE, CFG)
    assert float(held.costs(searched(it)[None, 4:])[0]) == pytest.approx(float(cost[0]), rel=1e-9, abs=1e-13)


def test_the_fast_path_is_the_plain_one():
    g = goal(30.0)
    for it in (TRUE, OTHER):
        fast = float(criterion_gradients(searched(it)[None], g, SCENE, CFG)[0][0])
        assert fast == pytest.approx(cost_of(plain_energy(it, g), g), rel=1e-5, abs=1e-10)


# --- eq. 19 -----------------------------------------------------------------------------------------------------------


def test_silence_costs_1_and_the_recording_itself_nothing():
    g = goal()
    assert cost_of(jnp.zeros_like(g.energy), g) == pytest.approx(1.0, abs=1e-12)
    assert float((residuals(g.energy, g) ** 2).sum()) == 0.0


def test_each_band_holds_its_own_partials_and_they_add_up():
    wrong = np.asarray(goal().energy)[:LAST].copy()
    wrong[4] *= 1.3  # the fifth partial: band 2
    parts, full = {}, {}
    for bands in ((0,), (1,), (2,), (0, 1, 2)):
        g = goal(bands=bands)
        rows = {(0,): slice(0, 1), (1,): slice(1, 8), (2,): slice(8, LAST), (0, 1, 2): slice(0, LAST)}[bands]
        mine = np.zeros(g.energy.shape)
        mine[: rows.stop - rows.start] = wrong[rows]
        parts[bands] = cost_of(mine, g)
        spacing = np.diff(np.asarray(g.frequency), axis=1)[:, :1]
        energy = np.where(np.asarray(g.weight) > 0, np.asarray(g.energy), 0.0)
        full[bands] = (spacing * energy**2).sum()
    assert max(parts[(0,)], parts[(2,)]) < 1e-30  # a gain in closed form, to rounding
    assert parts[(1,)] > 1e-6
    together = sum(parts[b] * full[b] for b in ((0,), (1,), (2,)))
    assert parts[(0, 1, 2)] * full[(0, 1, 2)] == pytest.approx(together, rel=1e-9)


def test_a_free_gain_is_the_best_one_and_a_known_one_counts():
    louder = 3.0 * wave()
    free = spectral_goal(louder, RATE, F0, B, LAST, 30.0, calibrated=False)
    known = spectral_goal(louder, RATE, F0, B, LAST, 30.0)
    energy = plain_energy(OTHER, free)

    weight, model, measured = (np.asarray(x) for x in (known.weight, energy, known.energy))

    def cost(gain2: float) -> float:
        return float((weight**2 * (gain2 * model - measured) ** 2).sum())

    best = min(cost(g) for g in np.geomspace(0.1, 1000, 10_001))
    assert cost_of(energy, free) == pytest.approx(best, rel=1e-6)
    assert cost_of(energy, known) == pytest.approx(cost(1.0), rel=1e-12)
    assert cost(1.0) > best
    assert spectral_goal(wave(), RATE, F0, B, LAST, 30.0, unit=3.0).energy == pytest.approx(np.asarray(known.energy))


def test_a_sound_that_began_earlier_has_decayed_further():
    """The wave takes half a millisecond from the hammer to the pickup; a recording begins at its arrival."""
    late = round(0.0005 * RATE)
    aware, unaware = (spectral_goal(wave()[late:], RATE, F0, B, LAST, 30.0, delay=d) for d in (late / RATE, 0.0))
    energy = plain_energy(TRUE, aware)
    costs = [cost_of(energy, g) for g in (aware, unaware)]
    assert costs[0] < 1e-6
    assert costs[1] == pytest.approx((1 - np.exp(-2 * 30.0 * late / RATE)) ** 2, rel=0.01)


# --- derivatives ------------------------------------------------------------------------------------------------------


def central(function, z: np.ndarray, step: float = 1e-5) -> np.ndarray:
    return np.array([(function(z + e) - function(z - e)) / (2 * step) for e in step * np.eye(len(z))])


def test_the_gradient_is_the_papers_formula():
    """∇C = 2 ∫ (|Y|² - |S|²) Re(Ȳ ∇Y) dω over ½ ∫ |S|⁴ dω, with ∇Y by differences."""
    g, z = goal(), searched(OTHER) + 0.02

    def y(at: np.ndarray) -> np.ndarray:
        return np.asarray(plain(jnp.asarray(at), g.frequency.ravel(), g.sigma))

    here, moved, weight = y(z), central(y, z), np.asarray(g.weight).ravel()
    apart = weight**2 * (np.abs(here) ** 2 - np.asarray(g.energy).ravel())
    formula = 4 * (apart * (here.conj() * moved).real).sum(axis=1)
    slope = np.asarray(criterion_gradients(z[None], g, SCENE, CFG)[1])[0]
    np.testing.assert_allclose(slope, formula, rtol=1e-4, atol=1e-6)


def test_the_fast_paths_derivatives_agree_with_differences():
    g = goal(3.0)
    z = searched(TRUE) + 0.003 * np.arange(9)

    def nine(at: np.ndarray) -> float:
        return float(criterion_gradients(at[None], g, SCENE, CFG)[0][0])

    slope = np.asarray(criterion_gradients(z[None], g, SCENE, CFG)[1])[0]
    np.testing.assert_allclose(slope, central(nine, z, 1e-6), rtol=1e-5, atol=1e-7)
    held = fix_string(jnp.asarray(z), *WIDE, g, SCENE, CFG)
    np.testing.assert_allclose(held.value_and_gradient(z[4:])[1], slope[4:], rtol=1e-8, atol=1e-10)
    many = z[4:] + 0.01 * np.random.default_rng(0).normal(size=(40, 5))
    np.testing.assert_allclose(held.costs(many), 0.5 * (held.residuals(many)[0] ** 2).sum(axis=1), rtol=1e-9)
    assert held.value_and_gradient(many[7])[0] == pytest.approx(held.costs(many)[7], rel=1e-9)


def test_a_contact_that_does_not_end_and_a_felt_out_of_bounds_are_infinitely_bad():
    g = goal()
    z = searched(TRUE)
    held = fix_string(jnp.asarray(z), *WIDE, g, SCENE, CFG)
    heavy = z[4:] + np.array([0.0, 0.0, 0.0, np.log(100.0), 0.0])
    narrow = SCENE._replace(log_stiffness_bounds=np.log([1e3, 1e9]))
    assert np.isinf(held.costs(heavy[None])[0])
    assert np.isinf(fix_string(jnp.asarray(z), *WIDE, g, narrow, CFG).costs(z[None, 4:])[0])
    assert np.isfinite(held.costs(z[None, 4:])[0])
