"""Adaptive simulated annealing: distributions against numerical ones, invariants, and success in finding minima."""

from collections import deque
from collections.abc import Iterator
from dataclasses import fields, replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.stats import kstest

from pianofit.bensa2005.annealing import (
    AnnealingState,
    Schedule,
    anneal,
    annealing,
    cost_temperature,
    generate,
    jump_cdf,
    temperatures,
)

UNLIKELY = 1e-3  # p-value below which a test fails


def density(y: float, temperature: float) -> float:
    """Density of a jump y, box widths (Ingber 1989)."""
    return 1 / (2 * (abs(y) + temperature) * np.log(1 + 1 / temperature))


def share(low: float, high: float, temperature: float) -> float:
    """Probability of a jump between `low` and `high`, by piecewise integration."""
    knots = temperature * np.concatenate([-np.logspace(9, -2, 34), [0.0], np.logspace(-2, 9, 34)])
    knots = np.unique(np.clip(knots, low, high))
    return sum(quad(density, a, b, args=(temperature,))[0] for a, b in pairwise(knots))


def rastrigin(z):
    return (z**2 - 10 * np.cos(2 * np.pi * z) + 10).sum(axis=-1)


def box(size: int, low: float = -5.12, high: float = 5.12) -> tuple[np.ndarray, np.ndarray]:
    return np.full(size, low), np.full(size, high)


def last(states: Iterator[AnnealingState]) -> AnnealingState:
    return deque(states, maxlen=1).pop()


def same(first: AnnealingState, second: AnnealingState) -> bool:
    return all(np.array_equal(getattr(first, f.name), getattr(second, f.name)) for f in fields(first))


# --- the distribution of jumps ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("temperature", [1.0, 0.1, 1e-3, 1e-7])
def test_the_distribution_of_jumps_is_the_integral_of_ingbers_density(temperature):
    assert share(-1, 1, temperature) == pytest.approx(1.0, rel=1e-9)
    for y in (-1.0, -0.5, -1e-3, -1e-8, 0.0, 1e-8, 1e-4, 0.02, 0.9, 1.0):
        assert jump_cdf(np.array(y), np.array(temperature)) == pytest.approx(share(-1, y, temperature), abs=1e-9)


@pytest.mark.parametrize("temperature", [1.0, 0.1, 1e-3, 1e-7])
@pytest.mark.parametrize("x", [0.0, 0.003, 0.5, 0.9, 1.0])
def test_jumps_in_the_box_are_those_drawn_anew_until_they_are_inside(x, temperature):
    """Rejection sampling of y = sgn(u − 1/2) T [(1 + 1/T)^|2u−1| − 1] (Ingber), compared with one draw."""
    random = np.random.default_rng(4)
    v = 2 * random.random(40_000) - 1
    drawn = x + np.sign(v) * temperature * ((1 + 1 / temperature) ** np.abs(v) - 1)
    drawn = drawn[(drawn >= 0) & (drawn <= 1)]
    ours = generate(random.random(15_000), np.full(15_000, x), np.full(15_000, temperature))
    assert ((ours >= 0) & (ours <= 1)).all()
    # The jumps extend over decades, so their logarithms are compared, for each side.
    assert np.mean(ours > x) == pytest.approx(np.mean(drawn > x), abs=0.02)
    for side in (-1, 1):
        a, b = ((side * (p - x))[side * (p - x) > 1e-14] for p in (ours, drawn))
        if min(len(a), len(b)) > 100:
            assert kstest(np.log(a), np.log(b)).pvalue > UNLIKELY


def test_the_jumps_of_a_run_follow_the_schedule():
    """The trials of a chain that never moves have the distribution of the temperature of their step."""
    tried = []

    def only_the_start(z):
        tried.append(z[:, 0].copy())
        return np.where(z[:, 0] == 0.3, 0.0, 1.0)

    schedule = Schedule(start=0.5, end=1e-4, cost_start=0.0, samples=1, reanneal=0, exchanges=0)
    end = anneal(only_the_start, [0.0], [1.0], chains=1, evaluations=4001, start=[0.3], schedule=schedule)
    assert end.z[0] == 0.3
    k = np.arange(1, 4001)
    T = 0.5 * np.exp(-np.log(0.5 / 1e-4) / 4000 * k)  # D = 1: exponential in k
    low, high = jump_cdf(-0.3, T), jump_cdf(0.7, T)
    u = (jump_cdf(np.concatenate(tried[1:]) - 0.3, T) - low) / (high - low)
    assert kstest(u, "uniform").pvalue > UNLIKELY
    warmer = jump_cdf(-0.3, 3 * T), jump_cdf(0.7, 3 * T)
    other = (jump_cdf(np.concatenate(tried[1:]) - 0.3, 3 * T) - warmer[0]) / (warmer[1] - warmer[0])
    assert kstest(other, "uniform").pvalue < UNLIKELY  # the test detects a wrong schedule


@pytest.mark.parametrize("size", [1, 2, 5, 10])
def test_temperatures_fall_as_the_root_of_k_says(size):
    schedule = Schedule(start=0.8, end=1e-5, cost_end=1e-3, reanneal=0, samples=1)
    state = next(annealing(rastrigin, *box(size), chains=1, evaluations=301, schedule=schedule))
    assert state.length == 300
    c, c_cost = np.log(0.8 / 1e-5) / 300 ** (1 / size), np.log(1e3) / 300 ** (1 / size)
    for k in (1, 7, 150, 300):
        at = replace(state, steps=k, accepted=np.array([k / 2]), width=np.ones((1, size)))
        np.testing.assert_allclose(temperatures(at, schedule), 0.8 * np.exp(-c * k ** (1 / size)), rtol=1e-10)
        expected = state.cost_start * np.exp(-c_cost * (k / 2) ** (1 / size))
        np.testing.assert_allclose(cost_temperature(at, schedule), expected, rtol=1e-10)
    wide = replace(at, width=np.full((1, size), 1e9))
    np.testing.assert_array_equal(temperatures(wide, schedule), 0.8)


# --- acceptance ------------------------------------------------------------------------------------------------------


def test_at_a_fixed_temperature_chains_settle_into_boltzmanns_distribution():
    """With truncation at the edges, jumps from x have the density g(y)/Z(x), where Z is the share of g inside the box.

    Detailed balance holds for π(x) ∝ Z(x) exp(−E/T), because g is symmetric. The 4000 chains are independent.
    """
    T, warm = 0.05, 0.7

    def energy(z):
        return (1.5 * np.cos(9 * z) + 2 * z)[:, 0]

    schedule = Schedule(start=T, end=T, cost_start=warm, cost_end=1.0, samples=1, reanneal=0, exchanges=0)
    end = last(annealing(energy, [0.0], [1.0], chains=4000, evaluations=4000 * 150, seed=3, schedule=schedule))
    x = np.linspace(0, 1, 2001)
    inside = np.array([share(-p, 1 - p, T) for p in x[::20]])
    weight = np.interp(x, x[::20], inside) * np.exp(-energy(x[:, None]) / warm)
    cdf = np.concatenate([[0], np.cumsum(0.5 * (weight[1:] + weight[:-1]))])
    assert kstest(end.z[:, 0], lambda z: np.interp(z, x, cdf / cdf[-1])).pvalue > UNLIKELY
    flat = np.concatenate([[0], np.cumsum(np.exp(-energy(x[1:, None]) / (1.5 * warm)))])
    assert kstest(end.z[:, 0], lambda z: np.interp(z, x, flat / flat[-1])).pvalue < UNLIKELY


@pytest.mark.parametrize("rise", [0.0, 0.2, 1.0, 3.0])
def test_a_rise_is_accepted_with_boltzmanns_probability(rise):
    def step_up(z):
        return np.where((z == 0.5).all(axis=1), 0.0, rise)

    schedule = Schedule(cost_start=0.8, cost_end=1.0, samples=1, exchanges=0)
    begin = np.full((5000, 3), 0.5)
    states = annealing(
        step_up, np.zeros(3), np.ones(3), chains=5000, evaluations=10_000, start=begin, schedule=schedule, seed=1
    )
    taken = np.mean((last(states).z != 0.5).any(axis=1))
    assert taken == pytest.approx(np.exp(-rise / 0.8), abs=0.025)


# --- re-annealing ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("exponent", [0.5, 1.0])
def test_reannealing_searches_insensitive_parameters_more_widely(exponent):
    slope = np.array([1.0, 100.0, 4.0, 0.0, 1e-6, 7.0])
    lower, upper = np.zeros(6), np.array([1.0, 1.0, 5.0, 1.0, 1.0, 0.0])  # the last is held
    schedule = Schedule(reanneal=10, samples=1, exponent=exponent, max_width=500.0)
    states = annealing(lambda z: z @ slope, lower, upper, chains=3, evaluations=2000, schedule=schedule)
    state = next(state for state in states if state.steps == 11)
    # Per box width the slopes are 1, 100, 20, none, 1e-6. A parameter without sensitivity keeps its temperature.
    expected = np.minimum((100 / np.array([1, 100, 20, 100, 1e-6])) ** exponent, 500.0)
    np.testing.assert_allclose(state.width, np.tile(expected, (3, 1)), rtol=1e-6)
    warm = temperatures(state, schedule)
    assert (warm[:, 0] > warm[:, 2]).all()
    assert (warm[:, 2] > warm[:, 1]).all()


def test_reannealing_sets_the_acceptance_to_what_there_is_still_to_gain():
    """The gap to a chain's best, at most T_0 and at least T. Every case must occur."""
    schedule = Schedule(reanneal=20, samples=20, exponent=0.0, exchanges=0.0, cost_end=1e-2)
    states = annealing(rastrigin, *box(3), chains=4, evaluations=4000, schedule=schedule, seed=2)
    met = []
    for before, state in pairwise(states):
        if state.steps % 20:
            np.testing.assert_array_equal(state.cost_start, before.cost_start)
            continue
        accepted = before.accepted + (state.z != before.z).any(axis=1)
        now = cost_temperature(replace(before, accepted=accepted), schedule)
        choices = np.stack([now, state.cost - state.best_cost, before.cost_start])
        np.testing.assert_allclose(state.cost_start, np.sort(choices, axis=0)[1])  # the middle one: now <= start
        np.testing.assert_array_equal(state.accepted, 1.0)
        met += list(np.argsort(choices, axis=0, kind="stable")[1])
    assert set(met) == {0, 1, 2}


def test_units_and_offsets_of_the_cost_change_nothing():
    def whole(z):
        return np.round(1024 * rastrigin(z)) / 1024  # so that adding rounds nothing away

    ends = [
        last(annealing(cost, *box(3), chains=4, evaluations=3000, seed=5))
        for cost in (whole, lambda z: 8 * whole(z), lambda z: whole(z) + 2.0**20)
    ]
    for other in ends[1:]:
        np.testing.assert_array_equal(other.z, ends[0].z)


@pytest.mark.parametrize("share_of_plain", [0.8, 0.999999])
def test_units_of_the_cost_change_nothing_where_most_of_it_is_a_plain(share_of_plain):
    def plain(z):
        return np.where(z[:, 0] < -5.12 + 10.24 * share_of_plain, 300.0, np.round(rastrigin(z)))

    costs = (lambda z, f=f: f * plain(z) for f in (1.0, 64.0))
    ends = [last(annealing(cost, *box(3), chains=4, evaluations=3000, seed=5)) for cost in costs]
    np.testing.assert_array_equal(ends[1].z, ends[0].z)
    np.testing.assert_array_equal(ends[1].cost_start, 64 * ends[0].cost_start)


def test_the_seed_decides():
    first, again, other = (last(annealing(rastrigin, *box(4), evaluations=1000, seed=seed)) for seed in (1, 1, 2))
    assert same(first, again)
    assert not np.array_equal(first.z, other.z)


# --- promises --------------------------------------------------------------------------------------------------------


@settings(max_examples=60)
@given(
    st.integers(0, 2**32 - 1), st.integers(1, 10), st.integers(1, 9), st.integers(20, 400), st.sampled_from([1, 5, 100])
)  # fmt: skip
def test_points_stay_in_the_box_batches_keep_their_shape_and_the_lowest_is_returned(
    seed, size, chains, evaluations, every
):
    random = np.random.default_rng(seed)
    lower = random.normal(size=size) * 10.0 ** random.integers(-8, 8, size)
    upper = lower + random.random(size) * 10.0 ** random.integers(-8, 8, size) * random.integers(0, 2, size)
    slope, nowhere = random.normal(size=size), random.choice([np.nan, np.inf, -np.inf])
    seen, costs = [], []

    def cost(z):
        seen.append(z.copy())
        wave = np.cos(7 * (z - lower) / np.where(upper > lower, upper - lower, 1)) @ slope
        costs.append(np.where(np.sin(40 * wave) > 0.7, nowhere, wave))
        z[:] = np.nan  # a cost may change its argument
        return costs[-1]

    start = random.normal(size=(min(2, chains), size))
    end = anneal(
        cost, lower, upper, chains=chains, evaluations=evaluations, seed=seed, start=start,
        schedule=Schedule(samples=3, reanneal=every),
    )  # fmt: skip
    assert {z.shape for z in seen} == {(chains, size)}
    tried, costs = np.concatenate(seen), np.concatenate(costs)
    assert ((tried >= lower) & (tried <= upper)).all()
    assert end.evaluations == len(tried) <= evaluations
    assert len(tried) > evaluations - chains or (lower == upper).all()
    np.testing.assert_array_equal(seen[0][: len(start)], np.clip(start, lower, upper))
    costs = np.where(np.isfinite(costs), costs, np.inf)
    assert end.cost == costs.min()
    if end.cost < np.inf:
        assert end.cost in costs[(tried == end.z).all(axis=1)]


def test_where_no_cost_is_finite_the_result_says_so():
    end = anneal(lambda z: np.full(len(z), np.nan), *box(3), evaluations=500)
    assert end.cost == np.inf


def test_a_finite_island_is_found_and_searched():
    def island(z):
        return np.where(np.abs(z - 3).max(axis=1) < 0.8, rastrigin(z - 3), np.inf)

    ends = [anneal(island, *box(3), evaluations=4000, seed=seed) for seed in range(5)]
    np.testing.assert_allclose([end.cost for end in ends], 0.0, atol=1e-3)


def test_nothing_free_is_no_trouble():
    end = anneal(rastrigin, np.ones(3), np.ones(3), chains=2, evaluations=500)
    np.testing.assert_array_equal(end.z, np.ones(3))
    assert end.cost == rastrigin(np.ones(3))


def test_chains_meet_unless_they_are_not_to():
    """Only one chain starts in a hole that no jump finds. The others reach it only through this chain."""

    def hole(z):
        return np.where(np.abs(z - 0.123).max(axis=1) < 1e-9, -1.0, z.sum(axis=1))

    shares = []
    for exchanges in (0.0, 30.0):
        states = annealing(
            hole, np.zeros(4), np.ones(4), chains=12, evaluations=6000, start=np.full(4, 0.123),
            schedule=Schedule(exchanges=exchanges),
        )  # fmt: skip
        shares.append(np.mean(last(states).best_cost == -1.0))
    assert shares[0] == 1 / 12
    assert shares[1] == 1.0


# --- success in finding minima (benchmarks/annealing_study.py compares the rates with other methods) -----------------


@pytest.mark.parametrize(("chains", "runs"), [(1, 3), (16, 6)])
def test_rastrigins_deepest_minimum_is_found_among_ten_thousands(chains, runs):
    """There are 11^4 minima. At a success rate of 95 %, one failure of six has a probability of 1/4, two of 1/30."""
    moved = np.array([0.4, -1.1, 0.8, 1.3])
    ends = [
        anneal(lambda z: rastrigin(z - moved), *box(4), chains=chains, evaluations=8000, seed=s) for s in range(runs)
    ]
    found = [end.cost < 0.01 and np.abs(end.z - moved).max() < 0.01 for end in ends]
    assert sum(found) >= runs - 1


def test_a_smooth_bowl_is_searched_to_its_bottom():
    """In spite of heavy tails, the cooling must reach small scales: 2e-5 of the box in every coordinate."""
    for size in (1, 2, 5):
        end = anneal(lambda z: ((z - 0.3) ** 2).sum(axis=1), *box(size, 0.0, 1.0), evaluations=8000)
        assert np.abs(end.z - 0.3).max() < 2e-5
