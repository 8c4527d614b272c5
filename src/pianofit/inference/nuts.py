"""Draws from exp(-F) by the No-U-Turn sampler of blackjax (Hoffman and Gelman 2014, JMLR 15).

Chains start about the best minimum. A minimum that no chain reaches has no draws. The discretisation error of the
contact is that of the best minimum.

exp(-F) is a proper density (likelihood.py) of all unknowns: θ, and φ and log w of levels, frequencies and decays. θ is
whitened by Laplace's covariance. log w is scaled by the standard deviation that its curvature gives. The bounds
reflect: beyond a bound the density is the mirror image of the inside. A sampler therefore meets a continuous density
without a wall, and the reflected points have exactly the density inside the bounds. The search range of φ of the levels
reflects too.
"""

from __future__ import annotations

import math
from importlib.metadata import version
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..conversions import HALF_WIDTH_95
from ..x64 import float64, x64_scope
from .batched_model import thread_pool
from .density import (
    DensityContext,
    density_context_at,
    negative_log_density,
    reflect,
    reflect_into_bounds,
    table_terms,
)
from .laplace import HYPER, Estimate, Interval, IntervalResult, ObservedValues, unbounded_warnings
from .likelihood import pointwise
from .objective import HYPER_REACH
from .problem import FitProblem, StaticConfig

# R-hat compares chains with each other, and four show more than two. Warm-up adapts step and metric. The draws leave
# some ten independent ones beyond each end of a 95 % interval.
CHAINS, WARMUP, DRAWS = 4, 200, 500
# Limits of R-hat and of the number of independent draws (Vehtari et al. 2021, Bayesian Analysis 16).
MOST_RHAT, LEAST_ESS = 1.01, 400
# Bins of a histogram of the interval, and the ratio of a normal density at the interval's ends to its maximum. A
# density that a bound cuts off has more.
BINS, CUT = 20, float(np.exp(-0.5 * HALF_WIDTH_95**2))
# Scale of a parameter at a bound: its prior's standard deviation, or this fraction of its range if that is smaller.
RANGE_FRACTION = 0.25


def sample_posterior(problem: FitProblem, estimate: Estimate, seed: int) -> IntervalResult:
    """Intervals of the free shared parameters and of the reference stroke's velocity, from draws.

    The same seed draws the same on the same machine.
    """
    at, u = density_context(problem, estimate), problem.parametrisation
    with x64_scope():
        keys = np.asarray(jax.random.split(jax.random.PRNGKey(seed % 2**32), CHAINS))
        # Compile before the threads begin, or each thread would compile.
        run = jax.jit(_chain, static_argnums=2).lower(keys[0], at, (problem.cfg, WARMUP, DRAWS)).compile()

    def chain(key: np.ndarray) -> list[np.ndarray]:
        with x64_scope():
            return [np.asarray(x) for x in run(key, at)]

    parts = list(thread_pool().map(chain, keys))
    theta, acceptance, divergent, steps, *likelihoods = (np.stack(column) for column in zip(*parts, strict=True))
    logs, names = u.log_values(theta), problem.reported_parameters
    intervals = {name: _interval(u.range(i), logs[..., i]) for name, i in names.items()}
    convergence = _convergence_diagnostics(names, logs)
    diagnostics = {
        "sampler": f"NUTS, blackjax {version('blackjax')}",
        "chains": CHAINS,
        "draws": DRAWS,
        "acceptance": float(acceptance.mean()),
        "divergences": int(divergent.sum()),
        "evaluations": int(steps.sum()),
        "parameters": convergence,
    }
    messages = (*_messages(convergence, int(divergent.sum())), *unbounded_warnings(intervals))
    values = {name: np.exp(logs[..., i]) for name, i in problem.parameter_indices.items() if u.free[i]}
    observed = _observed(at, problem)
    likelihood = dict(zip(observed, likelihoods, strict=True))
    return IntervalResult("posterior", intervals, messages, {"posterior": diagnostics}, values, likelihood, observed)


def _observed(at: DensityContext, problem: FitProblem) -> dict[str, ObservedValues]:
    """The observations, in the order of `log_likelihood`."""
    level, *strings = [np.asarray(table.value) for table in at.tables]
    number, string_number = problem.observed.number, problem.observed.string_number

    def of_levels(entries: np.ndarray) -> ObservedValues:
        row, column = entries.T
        return ObservedValues(level[row, column], row + 1, number[column])

    found = {"level": of_levels(at.detected[0])}
    for kind, value, entries in zip(("frequency", "decay"), strings, at.detected[1:], strict=True):
        row, column = entries.T
        found[kind] = ObservedValues(value[row, column], 0 * row, string_number[column])
    return found | {"absent": of_levels(np.asarray(at.tables[0].censored).reshape(-1, 2))}


def _chain(key, at: DensityContext, settings: tuple[StaticConfig, int, int]):
    """One chain: θ inside the bounds [draws, size]; acceptance, divergences and steps of the trajectories [draws].

    Then the result of `log_likelihood` [draws, observations].
    """
    import blackjax
    from blackjax.adaptation.base import get_filter_adapt_info_fn

    cfg, warmup, count = settings

    def density(point):
        return log_density(at, point, cfg)

    adapt: Any = blackjax.window_adaptation(
        blackjax.nuts,
        density,
        target_acceptance_rate=0.8,  # Hoffman and Gelman's range is 0.6 to 0.8
        max_num_doublings=6,  # in these coordinates a trajectory of 64 steps has always turned round
        adaptation_info_fn=get_filter_adapt_info_fn(),
    )
    start_key, warmup_key, draw_key = jax.random.split(key, 3)
    # The chains start wider than the posterior, so that R-hat can detect what they have not reached.
    (state, adapted), _ = adapt.run(warmup_key, random_start(at, start_key, 1.5), num_steps=warmup)
    step: Any = blackjax.nuts(density, **adapted).step

    def draw(state: Any, key):
        state, info = step(key, state)
        theta = reflect_into_bounds(at, state.position.whitened)
        likelihoods = log_likelihood(at, state.position, cfg)
        return state, (theta, info.acceptance_rate, info.is_divergent, info.num_integration_steps, *likelihoods)

    return jax.lax.scan(draw, state, jax.random.split(draw_key, count))[1]


def _interval(bounds: tuple[float, float], log: np.ndarray) -> Interval:
    """The interval of one value; an end is unbounded where a search bound cuts the density off."""
    low, high = np.quantile(log, (0.025, 0.975))
    highest = np.histogram(log, bins=BINS, range=(low, high))[0].max()
    width = (high - low) / BINS
    inward = {"low": log - bounds[0], "high": bounds[1] - log}
    cut = {word: (distance <= width).sum() > CUT * highest for word, distance in inward.items()}
    low, high = np.exp((bounds[0] if cut["low"] else low, bounds[1] if cut["high"] else high)).tolist()
    return Interval(low, high, "posterior", tuple(word for word, unbounded in cut.items() if unbounded))


@float64
def _convergence_diagnostics(names: dict[str, int], logs: np.ndarray) -> dict[str, dict[str, float]]:
    """R-hat, and effective sample sizes of bulk and tails (Vehtari et al. 2021)."""
    import blackjax

    chains = jnp.asarray(logs[..., list(names.values())])
    rhat, bulk, tail = (np.atleast_1d(f(chains)) for f in (blackjax.rhat, blackjax.ess_bulk, blackjax.ess_tail))
    median = [float(np.exp(np.median(logs[..., i]))) for i in names.values()]
    columns = zip(rhat.tolist(), bulk.tolist(), tail.tolist(), median, strict=True)
    keys = "rhat", "ess_bulk", "ess_tail", "median"
    return {name: dict(zip(keys, column, strict=True)) for name, column in zip(names, columns, strict=True)}


def _messages(convergence: dict[str, dict[str, float]], divergences: int) -> list[str]:
    messages, rhat = [], max((x["rhat"] for x in convergence.values()), default=1.0)
    ess = min((min(x["ess_bulk"], x["ess_tail"]) for x in convergence.values()), default=math.inf)
    if not rhat <= MOST_RHAT:
        messages.append(f"The chains have not mixed (R-hat {rhat:.3f}). Do not use the posterior intervals.")
    if not ess >= LEAST_ESS:
        messages.append(f"The posterior has only {ess:.0f} independent draws: the ends of its intervals are rough.")
    if divergences:
        messages.append(f"The sampler reports {divergences} divergent steps: some of the posterior may be missing.")
    return messages


# --- the density ------------------------------------------------------------------------------------------------------


class Point(NamedTuple):
    """Whitened unknowns: 0 at the minimum, of order 1 in the posterior."""

    whitened: Array  # θ [free]
    phi: tuple[Array, ...]  # of levels, frequencies and decays
    log_w: tuple[Array, ...]  # of the detected entries


def density_context(problem: FitProblem, estimate: Estimate) -> DensityContext:
    """Collect what the density needs at the best minimum."""
    best = estimate.minima.candidates
    phi, w = [phi[0] for phi in best.phi], [w[0] for w in best.w]
    return density_context_at(problem, best.theta[0], _whitening_root(problem, estimate), phi, w, best.offset[0])


def _whitening_root(problem: FitProblem, estimate: Estimate) -> np.ndarray:
    """Root of Laplace's covariance of θ [size, free]; parameters at a bound use `RANGE_FRACTION`."""
    u = problem.parametrisation
    free, tangent = np.flatnonzero(u.free), np.linalg.inv(u.tangent(estimate.theta))
    # With K_H at a bound, the force only follows p and counts as at a bound too.
    at_bound = u.at_bound(estimate.theta)[free]
    covariance = (tangent @ estimate.posterior.covariance[0] @ tangent.T)[np.ix_(free, free)]
    covariance = np.where(at_bound[:, None] | at_bound, 0.0, covariance)
    span = u.upper - u.lower
    if u.force_and_exponent_index:
        span[u.force_and_exponent_index[0]] = np.inf
    wide = np.minimum(u.sd, RANGE_FRACTION * span)[free]
    scale = np.sqrt(np.where(np.diag(covariance) > 0, np.diag(covariance), wide**2))
    correlation = covariance / np.outer(scale, scale)
    np.fill_diagonal(correlation, 1.0)
    root = np.zeros((u.size, len(free)))
    root[free] = scale[:, None] * np.linalg.cholesky(correlation)
    return root


def random_start(at: DensityContext, key, spread: float) -> Point:
    """A random point, every coordinate with standard deviation `spread` about the minimum."""
    zero = Point(
        jnp.zeros(at.root.shape[1]),
        tuple(jnp.zeros(len(own)) for own in HYPER),
        tuple(jnp.zeros(len(x)) for x in at.detected),
    )
    leaves, tree = jax.tree.flatten(zero)
    keys = jax.random.split(key, len(leaves))
    return tree.unflatten([spread * jax.random.normal(k, x.shape) for k, x in zip(keys, leaves, strict=True)])


def log_density(at: DensityContext, point: Point, cfg: StaticConfig):
    """-F; minus infinity where a contact does not end."""
    at = jax.tree.map(jnp.asarray, at)
    return -negative_log_density(at, *_unknowns(at, point), cfg)


def log_likelihood(at: DensityContext, point: Point, cfg: StaticConfig) -> tuple[Array, ...]:
    """Log density of each observation given all others: of levels, frequencies, decays, and censored partials."""
    at = jax.tree.map(jnp.asarray, at)
    densities = [pointwise(*term, xp=jnp) for term in table_terms(at, *_unknowns(at, point), cfg)[1]]
    detected = [entries[tuple(index.T)] for (entries, _), index in zip(densities, at.detected, strict=True)]
    return *detected, densities[0][1]


def _unknowns(at: DensityContext, point: Point) -> tuple[Array, list[Array], list[Array]]:
    """θ inside the bounds, and φ and w of every table."""
    theta, phis, ws = reflect_into_bounds(at, point.whitened), [], []
    for table, phi, w, index, x, y in zip(at.tables, at.phi, at.w, at.detected, point.phi, point.log_w, strict=True):
        centre, sd = table.prior
        reach = HYPER_REACH * sd if table is at.tables[0] else jnp.full_like(sd, jnp.inf)
        hyper = phi.at[: len(x)].add(sd[: len(x)] * x)
        phis.append(reflect(hyper, centre - reach, centre + reach))
        # At its minimum, F has the curvature (ν + 1)/2 in log w of one entry.
        scale = jnp.sqrt(2 / (table.degrees_of_freedom + 1))
        change = jnp.zeros_like(w).at[index[:, 0], index[:, 1]].set(scale * y)
        ws.append(w * jnp.exp(change))
    return theta, phis, ws
