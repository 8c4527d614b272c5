"""Eq. 19 for any model: spectra against sums over samples, derivatives against differences, fits against the truth."""

from __future__ import annotations

import functools

import jax.numpy as jnp
import numpy as np
import pytest

from pianofit import ParameterError, SoundModel, analyse, fit_model, preset, recording_from_samples
from pianofit.fit.residuals import Cfg
from pianofit.fit.spectral import (
    damped_spectrum,
    gradient_batch,
    miss,
    model_energy,
    residual_batch,
    spectral_goal,
    struck_model,
)
from pianofit.fit.struck import Scene, hammer_costs, hammer_residuals, hold, struck_gradients
from pianofit.model import simulate
from pianofit.parameters import Geometry

RATE, MODES, STEPS = 88_200, 64, 512
TRUE, OTHER = preset("bensa-final"), preset("bensa-initial")
F0 = TRUE.string.c / 2
B = (TRUE.string.kappa * np.pi / TRUE.string.c) ** 2
LAST = 20
CFG = Cfg(MODES, STEPS, "velocity", True)
LOG_U = float(np.log(1e-4))
SCENE = Scene(Geometry(*map(np.float64, TRUE.geometry)), *map(np.asarray, (float(RATE), LOG_U, [-99.0, 99.0])))


@functools.cache
def strike(which: str = "true"):
    """A strike at the contact's own rate: what the model sums is then what is sounded."""
    it = TRUE if which == "true" else OTHER
    return simulate(it.string, it.hammer, TRUE.geometry, rate=RATE, oversampling=1, n_modes=MODES)


@functools.cache
def wave(seconds: float = 1.0, which: str = "true") -> np.ndarray:
    return strike(which).waveform(RATE, round(seconds * RATE))


def goal(sigma: float = 30.0, bands=(0, 1, 2), **more):
    return spectral_goal(wave(more.pop("seconds", 1.0)), RATE, F0, B, LAST, sigma, bands=bands, **more)


def logs(it) -> np.ndarray:
    return np.log([*it.string, *it.hammer])


def searched(it) -> np.ndarray:
    """Coordinates of `struck`: the felt by its force at 0.1 mm."""
    z = logs(it)
    z[4] += it.hammer.p * LOG_U
    return z


MODEL = struck_model(TRUE.geometry, rate=RATE, n_modes=MODES, steps=STEPS)


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
    for energy in (model_energy(MODEL, jnp.asarray(logs(TRUE)), g), g.energy):
        np.testing.assert_allclose(np.asarray(energy)[:LAST], direct[:LAST], rtol=0, atol=2e-6 * direct.max())
    assert np.asarray(g.weight)[LAST:].max(initial=0.0) == 0.0


@pytest.mark.parametrize("sigma", [30.0, 3.0, 1.0])
@pytest.mark.parametrize("which", ["true", "other"])
def test_the_fast_path_meets_the_sum_over_samples_also_where_the_recording_is_cut(sigma, which):
    """One second is far too short for σ = 1: a third of the amplitude is cut off, and the model knows."""
    it = TRUE if which == "true" else OTHER
    g = goal(sigma)
    n = min(RATE, int(np.ceil(14 / sigma * RATE)))
    mine = damped_spectrum(wave(which=which)[:n], RATE, np.asarray(g.frequency), sigma)
    expected = 0.5 * float((miss(jnp.asarray(np.abs(mine) ** 2), g) ** 2).sum())
    cost, _ = struck_gradients(searched(it)[None], g, SCENE, CFG)
    # The window ends for all of a blow where it ends for its middle.
    assert float(cost[0]) == pytest.approx(expected, rel=2e-4, abs=2e-6)
    held = hold(jnp.asarray(searched(it)), g, SCENE, CFG)
    (again,) = hammer_costs(searched(it)[None, 4:], held, g, SCENE, CFG)
    assert float(again[0]) == pytest.approx(float(cost[0]), rel=1e-9, abs=1e-13)


def test_the_fast_path_is_the_plain_one():
    g = goal(30.0)
    for it in (TRUE, OTHER):
        plain = 0.5 * float((miss(model_energy(MODEL, jnp.asarray(logs(it)), g), g) ** 2).sum())
        fast = float(struck_gradients(searched(it)[None], g, SCENE, CFG)[0][0])
        assert fast == pytest.approx(plain, rel=1e-5, abs=1e-10)


# --- eq. 19 -----------------------------------------------------------------------------------------------------------


def test_silence_costs_1_and_the_recording_itself_nothing():
    g = goal()
    assert 0.5 * float((miss(jnp.zeros_like(g.energy), g) ** 2).sum()) == pytest.approx(1.0, abs=1e-12)
    assert float((miss(g.energy, g) ** 2).sum()) == 0.0


def test_each_band_holds_its_own_partials_and_they_add_up():
    wrong = np.asarray(goal().energy)[:LAST].copy()
    wrong[4] *= 1.3  # the fifth partial: band 2
    parts, full = {}, {}
    for bands in ((0,), (1,), (2,), (0, 1, 2)):
        g = goal(bands=bands)
        rows = {(0,): slice(0, 1), (1,): slice(1, 8), (2,): slice(8, LAST), (0, 1, 2): slice(0, LAST)}[bands]
        mine = np.zeros(g.energy.shape)
        mine[: rows.stop - rows.start] = wrong[rows]
        parts[bands] = 0.5 * float((miss(jnp.asarray(mine), g) ** 2).sum())
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
    energy = model_energy(MODEL, jnp.asarray(logs(OTHER)), free)

    weight, model, measured = (np.asarray(x) for x in (known.weight, energy, known.energy))

    def cost(gain2: float) -> float:
        return float((weight**2 * (gain2 * model - measured) ** 2).sum())

    best = min(cost(g) for g in np.geomspace(0.1, 1000, 10_001))
    assert 0.5 * float((miss(energy, free) ** 2).sum()) == pytest.approx(best, rel=1e-6)
    assert 0.5 * float((miss(energy, known) ** 2).sum()) == pytest.approx(cost(1.0), rel=1e-12)
    assert cost(1.0) > best
    assert spectral_goal(wave(), RATE, F0, B, LAST, 30.0, unit=3.0).energy == pytest.approx(np.asarray(known.energy))


def test_a_sound_that_began_earlier_has_decayed_further():
    """The wave takes half a millisecond from the hammer to the pickup; a recording begins when it gets there."""
    late = round(0.0005 * RATE)
    aware, unaware = (spectral_goal(wave()[late:], RATE, F0, B, LAST, 30.0, delay=d) for d in (late / RATE, 0.0))
    energy = model_energy(MODEL, jnp.asarray(logs(TRUE)), aware)
    costs = [0.5 * float((miss(energy, g) ** 2).sum()) for g in (aware, unaware)]
    assert costs[0] < 1e-6
    assert costs[1] == pytest.approx((1 - np.exp(-2 * 30.0 * late / RATE)) ** 2, rel=0.01)


def test_bands_without_a_partial_are_refused():
    with pytest.raises(ValueError, match="band3"):
        spectral_goal(wave(), RATE, F0, B, 8, 30.0, bands=(2,))


# --- derivatives ------------------------------------------------------------------------------------------------------


def central(function, z: np.ndarray, step: float = 1e-5) -> np.ndarray:
    return np.array([(function(z + e) - function(z - e)) / (2 * step) for e in step * np.eye(len(z))])


def test_residuals_and_gradient_agree_with_differences_and_with_the_papers_formula():
    g = goal()
    z = logs(OTHER) + 0.02
    gradient, residuals = gradient_batch(MODEL), residual_batch(MODEL)
    cost, slope = (np.asarray(x)[0] for x in gradient(jnp.asarray(z[None]), g))
    residual, jacobian = (np.asarray(x)[0] for x in residuals(jnp.asarray(z[None]), g))
    assert 0.5 * (residual**2).sum() == pytest.approx(cost, rel=1e-12)
    np.testing.assert_allclose(residual @ jacobian, slope, rtol=1e-8, atol=1e-10)

    def value(at: np.ndarray) -> float:
        return float(gradient(jnp.asarray(at[None]), g)[0][0])

    np.testing.assert_allclose(slope, central(value, z), rtol=1e-5, atol=1e-7)

    # ∇C = 2 ∫ (|Y|² - |S|²) Re(Ȳ ∇Y) dω over ½ ∫ |S|⁴ dω, and C has the factor ½.
    def y(at: np.ndarray) -> np.ndarray:
        return np.asarray(MODEL.spectrum(jnp.exp(jnp.asarray(at)), g.frequency.ravel(), g.sigma))

    here, moved = y(z), central(y, z)
    weight2 = np.asarray(g.weight).ravel() ** 2
    formula = 2 * (weight2 * (np.abs(here) ** 2 - np.asarray(g.energy).ravel()) * (here.conj() * moved).real).sum(
        axis=1
    )
    np.testing.assert_allclose(slope, 2 * formula, rtol=1e-4, atol=1e-6)


def test_the_fast_paths_derivatives_agree_with_differences():
    g = goal(3.0)
    z = searched(TRUE) + 0.003 * np.arange(9)

    def nine(at: np.ndarray) -> float:
        return float(struck_gradients(at[None], g, SCENE, CFG)[0][0])

    slope = np.asarray(struck_gradients(z[None], g, SCENE, CFG)[1])[0]
    np.testing.assert_allclose(slope, central(nine, z, 1e-6), rtol=1e-5, atol=1e-7)
    held = hold(jnp.asarray(z), g, SCENE, CFG)
    residual, jacobian = (np.asarray(x)[0] for x in hammer_residuals(z[None, 4:], held, g, SCENE, CFG))
    np.testing.assert_allclose(residual @ jacobian, slope[4:], rtol=1e-8, atol=1e-10)


def test_a_contact_that_does_not_end_and_a_felt_out_of_bounds_are_infinitely_bad():
    g = goal()
    z = searched(TRUE)
    held = hold(jnp.asarray(z), g, SCENE, CFG)
    heavy = z[4:] + np.array([0.0, 0.0, 0.0, np.log(100.0), 0.0])
    narrow = SCENE._replace(stiff=np.log([1e3, 1e9]))
    assert np.isinf(float(hammer_costs(heavy[None], held, g, SCENE, CFG)[0][0]))
    assert np.isinf(float(hammer_costs(z[None, 4:], held, g, narrow, CFG)[0][0]))
    assert np.isfinite(float(hammer_costs(z[None, 4:], held, g, SCENE, CFG)[0][0]))


# --- the fit of any model ---------------------------------------------------------------------------------------------

NAMES = ("pitch", "loss", "more", "tilt", "idle")
VALUES = {"pitch": 196.0, "loss": 2.0, "more": 0.05, "tilt": 1.4, "idle": 1.0}
PARTIALS = np.arange(1, 13)
TONE_RATE = 16_000


def tones(values, xp=jnp):
    """Amplitude and pole of every partial: k^-tilt, a sine that decays at loss + more k²; `idle` does nothing."""
    pitch, loss, more, tilt, _ = values
    k = xp.asarray(PARTIALS, float)
    return -1j * k**-tilt, -(loss + more * k**2) + 2j * np.pi * pitch * k


def tone_spectrum(values, frequency, sigma):
    """Summed over samples, as the recording is: its kink at the beginning is not band-limited."""
    amplitude, pole = tones(values)
    s = (sigma + 2j * jnp.pi * frequency)[:, None]
    pair = [a / -jnp.expm1((p - s) / TONE_RATE) for a, p in ((amplitude, pole), (amplitude.conj(), pole.conj()))]
    return 0.5 / TONE_RATE * (pair[0] + pair[1]).sum(axis=1)


TONES = SoundModel(NAMES, (150.0, 0.1, 1e-3, 0.3, 1.0), (250.0, 20.0, 1.0, 4.0, 1.0), tone_spectrum)


@functools.cache
def tone_recording(noise: float = 1e-3, seed: int = 0, gain: float = 0.2):
    t = np.arange(2 * TONE_RATE) / TONE_RATE
    amplitude, pole = tones([*VALUES.values()], np)
    samples = gain * (amplitude[:, None] * np.exp(pole[:, None] * t)).real.sum(axis=0)
    samples = np.pad(samples, (1600, 0)) + np.random.default_rng(seed).normal(0, noise, len(t) + 1600)
    recording = recording_from_samples(samples, TONE_RATE, name="tones")
    return recording, analyse(recording)


START = {"pitch": 196.3, "loss": 1.0, "more": 0.1, "tilt": 1.0, "idle": 1.0}


def test_a_model_of_ones_own_is_fitted_with_intervals():
    recording, analysis = tone_recording()
    found = fit_model(TONES, recording, analysis, START, spread={"tilt": 0.3, "loss": 0.3})
    assert found.converged
    assert found.cost < 1e-6
    assert found.agreeing > 1
    assert 0.8 < found.misfit < 1.3
    assert found.gain == pytest.approx(0.2, rel=1e-3)
    assert found.values["idle"] == 1.0
    assert found.intervals["idle"] is None
    for name in NAMES[:-1]:
        low, high = found.intervals[name]
        assert low < found.values[name] < high
        sd = np.log(high / low) / 2 / 1.96
        assert sd < 0.01
        assert abs(np.log(found.values[name] / VALUES[name])) < 4 * sd, name
    again = fit_model(TONES, recording, analysis, START, spread={"tilt": 0.3, "loss": 0.3})
    assert again.values == found.values


def test_a_calibrated_recording_holds_its_gain_and_a_bound_is_said():
    recording, analysis = tone_recording()
    low = TONES._replace(upper=(250.0, 20.0, 0.03, 4.0, 1.0))
    scale = 1 / 0.2
    begins = 0.1
    found = fit_model(low, recording, analysis, START | {"more": 0.02}, scale=scale, begins=begins)
    assert found.gain == pytest.approx(0.2)
    assert found.values["more"] == 0.03
    assert found.intervals["more"] is None
    assert any("more" in said for said in found.messages)
    assert found.misfit > 2
    assert any("noise" in said for said in found.messages)
    free = fit_model(TONES, recording, analysis, START, scale=scale, begins=begins)
    assert free.misfit < 1.3
    assert free.values["loss"] == pytest.approx(2.0, rel=3e-3)


def test_what_the_recording_does_not_tell_is_said():
    """A loudness of the model's own is nothing beside a gain that is free."""
    louder = TONES._replace(
        lower=(*TONES.lower[:4], 0.1), upper=(*TONES.upper[:4], 10.0),
        spectrum=lambda values, frequency, sigma: values[4] * tone_spectrum(values, frequency, sigma),
    )  # fmt: skip
    found = fit_model(louder, *tone_recording(), START)
    assert any("idle" in said for said in found.messages if "identifiable" in said)
    low, high = found.intervals["idle"]
    assert high / low > 1e6
    assert all(high / low < 1.1 for low, high in (found.intervals[name] for name in NAMES[:-1]))
    held = fit_model(louder, *tone_recording(), START, scale=5.0, begins=0.1)
    assert held.values["idle"] == pytest.approx(1.0, rel=0.01)
    assert held.intervals["idle"][1] < 1.01


@pytest.mark.parametrize(
    ("model", "start", "said"),
    [
        (TONES, {"pitch": 196.0}, "start"),
        (TONES, START | {"tilt": 9.0}, "tilt=9.0"),
        (TONES._replace(lower=(0.0, *TONES.lower[1:])), START, "pitch"),
        (TONES._replace(lower=TONES.lower[1:]), START, "bounds"),
        (TONES._replace(spectrum=lambda v, f, s: f * v[0] * s), START, "complex"),
    ],
)
def test_a_model_or_a_start_that_cannot_be_used_is_refused(model, start, said):
    with pytest.raises(ParameterError, match=said):
        fit_model(model, *tone_recording(), start)


def test_a_spread_of_an_unknown_name_is_refused():
    with pytest.raises(ParameterError, match="colour"):
        fit_model(TONES, *tone_recording(), START, spread={"colour": 1.0})


@pytest.mark.slow
def test_intervals_cover():
    inside, deviations = [], []
    for seed in range(60):
        found = fit_model(TONES, *tone_recording(noise=1e-3, seed=seed), START)
        for name in NAMES[:-1]:
            low, high = found.intervals[name]
            inside.append(low <= VALUES[name] <= high)
            deviations.append(np.log(found.values[name] / VALUES[name]) / (np.log(high / low) / 2 / 1.96))
    assert 0.90 <= np.mean(inside) <= 0.99
    assert np.abs(deviations).max() < 4
