"""Draws from exp(-F) by the No-U-Turn sampler of blackjax (Hoffman and Gelman 2014, JMLR 15).

The sampler draws θ, and φ and w of all tables (density.py). Chains start about the best minimum. A minimum that no
chain reaches has no draws. The discretisation error of the contact is that of the best minimum.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..conversions import HALF_WIDTH_95
from ..errors import ParameterError
from ..io.table_output import require_optional
from ..x64 import float64, x64_scope
from .batched_model import StaticConfig, thread_pool
from .density import DensityContext, density_context, log_density, log_likelihood, random_start, reflect_into_bounds
from .intervals import IntervalResult, Observations, parameter_indices, reported_parameters, unbounded_warnings
from .likelihood import ObservationTable
from .map_estimate import Estimate
from .problem import FitProblem

__all__ = ["check_sampler", "sample_posterior"]

# R-hat compares chains with each other, and four show more than two. Warm-up adapts step and metric. The draws leave
# some ten independent ones beyond each end of a 95 % interval.
CHAINS, WARMUP, DRAWS = 4, 200, 500
# Maximum doublings of a trajectory: in these coordinates one of 64 steps has always turned round.
DOUBLINGS = 6
# Target acceptance rate (Hoffman and Gelman's range is 0.6 to 0.8).
ACCEPTANCE = 0.8
# Standard deviation of the chains' starts about the minimum: wider than the posterior, so that R-hat can detect it.
START_SD = 1.5
# Limits of R-hat and of the number of independent draws (Vehtari et al. 2021, Bayesian Analysis 16).
MOST_RHAT, LEAST_ESS = 1.01, 400
# Quantiles of a two-sided 95 % interval.
TAILS = 0.025, 0.975
# Bins of a histogram of the interval, and the ratio of a normal density at the interval's ends to its maximum. A
# density that a bound cuts off has more.
BINS, CUT = 20, float(np.exp(-0.5 * HALF_WIDTH_95**2))


def check_sampler() -> None:
    """Reject the method if the sampler is not installed.

    Raises
    ------
    ParameterError
        Naming what to install.
    """
    require_optional("blackjax", "intervals='posterior'", "bayes", ParameterError)


def sample_posterior(problem: FitProblem, estimate: Estimate, seed: int) -> IntervalResult:
    """Intervals of the free shared parameters and of the reference stroke's velocity, from draws.

    The same seed draws the same on the same machine.
    """
    check_sampler()
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
    logs, names = u.log_values(theta), reported_parameters(problem)
    entries = {name: _entry(problem, i, logs[..., i]) for name, i in names.items()}
    convergence = _convergence_diagnostics(names, logs)
    diagnostics = {
        "sampler": _sampler(), "chains": CHAINS, "draws": DRAWS, "acceptance": float(acceptance.mean()),
        "divergences": int(divergent.sum()), "evaluations": int(steps.sum()), "parameters": convergence,
    }  # fmt: skip
    messages = (*_messages(convergence, int(divergent.sum())), *unbounded_warnings(entries))
    values = {name: np.exp(logs[..., i]) for name, i in parameter_indices(problem).items() if u.free[i]}
    observed = _observed(at, problem)
    return IntervalResult(
        "posterior", entries, messages, {"posterior": diagnostics}, values,
        dict(zip(observed, likelihoods, strict=True)), observed,
    )  # fmt: skip


def _observed(at: DensityContext, problem: FitProblem) -> dict[str, Observations]:
    """The observations, in the order of `log_likelihood`."""
    o = problem.observed

    def of(table: ObservationTable, entries: np.ndarray, number: np.ndarray, has_recordings: int) -> Observations:
        row, column = np.asarray(entries).reshape(-1, 2).T
        return Observations(
            np.asarray(table.value)[row, column], has_recordings * (row + 1), np.asarray(number)[column]
        )

    numbers = (o.number, 1), (o.string_number, 0), (o.string_number, 0)
    kinds = zip(("level", "frequency", "decay"), at.tables, at.detected, numbers, strict=True)
    observed = {kind: of(table, entries, *number) for kind, table, entries, number in kinds}
    return observed | {"absent": of(at.tables[0], at.tables[0].censored, *numbers[0])}


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
        blackjax.nuts, density, target_acceptance_rate=ACCEPTANCE, max_num_doublings=DOUBLINGS,
        adaptation_info_fn=get_filter_adapt_info_fn(),
    )  # fmt: skip
    start_key, warmup_key, draw_key = jax.random.split(key, 3)
    (state, adapted), _ = adapt.run(warmup_key, random_start(at, start_key, START_SD), num_steps=warmup)
    step: Any = blackjax.nuts(density, **adapted).step

    def draw(state: Any, key):
        state, info = step(key, state)
        theta = reflect_into_bounds(at, state.position.whitened)
        likelihoods = log_likelihood(at, state.position, cfg)
        return state, (theta, info.acceptance_rate, info.is_divergent, info.num_integration_steps, *likelihoods)

    return jax.lax.scan(draw, state, jax.random.split(draw_key, count))[1]


def _sampler() -> str:
    from importlib.metadata import version

    return f"NUTS, blackjax {version('blackjax')}"


def _entry(problem: FitProblem, i: int, log: np.ndarray) -> dict:
    """The interval of one value; an end is unbounded where a search bound cuts the density off."""
    bounds = problem.parametrisation.range(i)
    low, high = np.quantile(log, TAILS)
    highest = np.histogram(log, bins=BINS, range=(low, high))[0].max()
    width = (high - low) / BINS
    inward = {"low": log - bounds[0], "high": bounds[1] - log}
    cut = {word: (distance <= width).sum() > CUT * highest for word, distance in inward.items()}
    ends = bounds[0] if cut["low"] else low, bounds[1] if cut["high"] else high
    sides = [word for word, unbounded in cut.items() if unbounded]
    return {"interval": np.exp(ends).tolist(), "interval_by": "posterior", "interval_open": sides}


@float64
def _convergence_diagnostics(names: dict[str, int], logs: np.ndarray) -> dict[str, dict[str, float]]:
    """R-hat, and effective sample sizes of bulk and tails (Vehtari et al. 2021)."""
    import blackjax

    chains = jnp.asarray(logs[..., list(names.values())])
    rhat, bulk, tail = (np.atleast_1d(f(chains)) for f in (blackjax.rhat, blackjax.ess_bulk, blackjax.ess_tail))
    return {
        name: {"rhat": float(rhat[j]), "ess_bulk": float(bulk[j]), "ess_tail": float(tail[j]),
               "median": float(np.exp(np.median(logs[..., i])))}
        for j, (name, i) in enumerate(names.items())
    }  # fmt: skip


def _messages(convergence: dict[str, dict[str, float]], divergences: int) -> list[str]:
    messages, rhat = [], max(x["rhat"] for x in convergence.values())
    ess = min(min(x["ess_bulk"], x["ess_tail"]) for x in convergence.values())
    if not rhat <= MOST_RHAT:
        messages.append(f"The chains have not mixed (R-hat {rhat:.3f}). Do not use the posterior intervals.")
    if not ess >= LEAST_ESS:
        messages.append(f"The posterior has only {ess:.0f} independent draws: the ends of its intervals are rough.")
    if divergences:
        messages.append(f"The sampler reports {divergences} divergent steps: some of the posterior may be missing.")
    return messages
