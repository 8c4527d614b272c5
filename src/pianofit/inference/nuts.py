"""Draws from exp(-F), by the No-U-Turn sampler of blackjax (Hoffman and Gelman 2014, JMLR 15).

Drawn are θ, φ and w of all tables together: density.py. Chains start about the best minimum, and a minimum that no
chain finds has no draws; the contact's step error is that of the best minimum.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..conversions import NORMAL
from ..errors import ParameterError
from ..io.table_output import require_optional
from ..model.x64 import float64, x64_scope
from .batched_model import StaticConfig, thread_pool
from .density import DensityContext, density_context, log_density, log_likelihood, reflect_into_bounds, start
from .intervals import IntervalResult, Observations, named, reported_parameters, unbounded_warnings
from .likelihood import ObservationTable
from .map_estimate import Estimate
from .problem import FitProblem

__all__ = ["check_sampler", "sample_posterior"]

# R-hat compares chains with each other: four show more than two. Each settles its step and metric in so many draws,
# then makes so many that some ten independent ones lie beyond each end of a 95 % interval.
CHAINS, WARMUP, DRAWS = 4, 200, 500
# Doublings of a trajectory: in these coordinates one of 64 steps has long turned round.
DOUBLINGS = 6
# The sampler's step keeps this share of its proposals (Hoffman and Gelman's range is 0.6 to 0.8).
ACCEPTANCE = 0.8
# Starts of the chains, standard deviations from the minimum: wider than the posterior, so that R-hat can tell.
APART = 1.5
# The chains have not mixed above this, and tell too little below this many independent draws (Vehtari et al. 2021,
# Bayesian Analysis 16).
MOST_RHAT, LEAST_ESS = 1.01, 400
# Of a two-sided 95 % interval.
TAILS = 0.025, 0.975
# Bins of a histogram of what lies between, and the share of its highest that a density has at a normal's ends: next to
# an edge that cuts it off it has more.
BINS, CUT = 20, float(np.exp(-0.5 * NORMAL**2))


def check_sampler() -> None:
    """Refuse where the sampler is not installed.

    Raises
    ------
    ParameterError
        Saying what to install.
    """
    require_optional("blackjax", "intervals='posterior'", "bayes", ParameterError)


def sample_posterior(problem: FitProblem, found: Estimate, seed: int) -> IntervalResult:
    """Intervals of what is shared and free, and of the reference stroke's velocity, from draws.

    The same seed draws the same on the same machine.
    """
    check_sampler()
    at, u = density_context(problem, found), problem.unknowns
    with x64_scope():
        keys = np.asarray(jax.random.split(jax.random.PRNGKey(seed % 2**32), CHAINS))
        # Compiled before the threads begin: else each would.
        run = jax.jit(_chain, static_argnums=2).lower(keys[0], at, (problem.cfg, WARMUP, DRAWS)).compile()

    def chain(key: np.ndarray) -> list[np.ndarray]:
        with x64_scope():
            return [np.asarray(x) for x in run(key, at)]

    parts = list(thread_pool().map(chain, keys))
    z, acceptance, divergent, steps, *likelihoods = (np.stack(column) for column in zip(*parts, strict=True))
    logs, names = u.log_values(z), reported_parameters(problem)
    entries = {name: _entry(problem, i, logs[..., i]) for name, i in names.items()}
    mixed = _convergence_diagnostics(names, logs)
    told = {
        "sampler": _sampler(), "chains": CHAINS, "draws": DRAWS, "acceptance": float(acceptance.mean()),
        "divergences": int(divergent.sum()), "evaluations": int(steps.sum()), "parameters": mixed,
    }  # fmt: skip
    messages = (*_messages(mixed, int(divergent.sum())), *unbounded_warnings(entries))
    values = {name: np.exp(logs[..., i]) for name, i in named(problem).items() if u.free[i]}
    observed = _observed(at, problem)
    return IntervalResult(
        "posterior", entries, messages, {"posterior": told}, values, dict(zip(observed, likelihoods, strict=True)),
        observed,
    )  # fmt: skip


def _observed(at: DensityContext, problem: FitProblem) -> dict[str, Observations]:
    """What was observed, in the order of `log_likelihood`."""
    o = problem.observed

    def of(table: ObservationTable, where: np.ndarray, number: np.ndarray, own: int) -> Observations:
        row, column = np.asarray(where).reshape(-1, 2).T
        return Observations(np.asarray(table.value)[row, column], own * (row + 1), np.asarray(number)[column])

    numbers = (o.number, 1), (o.string_number, 0), (o.string_number, 0)
    kinds = zip(("level", "frequency", "decay"), at.tables, at.found, numbers, strict=True)
    found = {kind: of(table, where, *own) for kind, table, where, own in kinds}
    return found | {"absent": of(at.tables[0], at.tables[0].censored, *numbers[0])}


def _chain(key, at: DensityContext, how: tuple[StaticConfig, int, int]):
    """One chain: z in the box [draws, size]; of the trajectories acceptance, divergences and steps [draws].

    Then what `log_likelihood` gives [draws, observations].
    """
    import blackjax
    from blackjax.adaptation.base import get_filter_adapt_info_fn

    cfg, warmup, count = how

    def density(point):
        return log_density(at, point, cfg)

    adapt: Any = blackjax.window_adaptation(
        blackjax.nuts, density, target_acceptance_rate=ACCEPTANCE, max_num_doublings=DOUBLINGS,
        adaptation_info_fn=get_filter_adapt_info_fn(),
    )  # fmt: skip
    begin, settle, then = jax.random.split(key, 3)
    (state, chosen), _ = adapt.run(settle, start(at, begin, APART), num_steps=warmup)
    step: Any = blackjax.nuts(density, **chosen).step

    def one(state: Any, key):
        state, told = step(key, state)
        z = reflect_into_bounds(at, state.position.theta)
        likelihoods = log_likelihood(at, state.position, cfg)
        return state, (z, told.acceptance_rate, told.is_divergent, told.num_integration_steps, *likelihoods)

    return jax.lax.scan(one, state, jax.random.split(then, count))[1]


def _sampler() -> str:
    from importlib.metadata import version

    return f"NUTS, blackjax {version('blackjax')}"


def _entry(problem: FitProblem, i: int, log: np.ndarray) -> dict:
    """The interval of one value; an end is open where the box cuts the density off."""
    edges = problem.unknowns.range(i)
    low, high = np.quantile(log, TAILS)
    most = np.histogram(log, bins=BINS, range=(low, high))[0].max()
    width = (high - low) / BINS
    inward = {"low": log - edges[0], "high": edges[1] - log}
    cut = {word: (away <= width).sum() > CUT * most for word, away in inward.items()}
    ends = edges[0] if cut["low"] else low, edges[1] if cut["high"] else high
    sides = [word for word, open_ in cut.items() if open_]
    return {"interval": np.exp(ends).tolist(), "interval_by": "posterior", "interval_open": sides}


@float64
def _convergence_diagnostics(names: dict[str, int], logs: np.ndarray) -> dict[str, dict[str, float]]:
    """R-hat, and effective sample sizes of middle and tails (Vehtari et al. 2021)."""
    import blackjax

    inside = jnp.asarray(logs[..., list(names.values())])
    rhat, bulk, tail = (np.atleast_1d(f(inside)) for f in (blackjax.rhat, blackjax.ess_bulk, blackjax.ess_tail))
    return {
        name: {"rhat": float(rhat[j]), "ess_bulk": float(bulk[j]), "ess_tail": float(tail[j]),
               "median": float(np.exp(np.median(logs[..., i])))}
        for j, (name, i) in enumerate(names.items())
    }  # fmt: skip


def _messages(mixed: dict[str, dict[str, float]], divergences: int) -> list[str]:
    said, rhat = [], max(x["rhat"] for x in mixed.values())
    ess = min(min(x["ess_bulk"], x["ess_tail"]) for x in mixed.values())
    if not rhat <= MOST_RHAT:
        said.append(f"The chains have not mixed (R-hat {rhat:.3f}): the posterior's intervals are not to be trusted.")
    if not ess >= LEAST_ESS:
        said.append(f"Only {ess:.0f} independent draws of the posterior: the ends of its intervals are rough.")
    if divergences:
        said.append(f"{divergences} of the sampler's steps diverged: some of the posterior may be missing.")
    return said
