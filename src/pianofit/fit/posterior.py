"""The posterior about a settled fit, by the No-U-Turn sampler of blackjax (Hoffman and Gelman 2014, JMLR 15).

Log density is minus the cost: residuals in units of noise and scatter with the weights at which the fit settled, and
its weak priors; else flat in the logarithms, within the box. The box is folded: beyond an edge lies the mirror image of
what is inside, so that the sampler meets a continuous density without a wall, and what is folded back has exactly the
density in the box. Draws are made in coordinates in which the curvature is that of a unit normal, so few of the
sampler's steps are needed, and `chains` differ in nothing but their seeds and starts.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..errors import ParameterError
from .space import LOG, K, P, Space
from .state import pool
from .surface import Surface

__all__ = ["Draws", "check_sampler", "draw"]

CHAINS, WARMUP, DRAWS = 4, 200, 500
# Doublings of a trajectory: in these coordinates one of 64 steps has long turned round.
DOUBLINGS = 6
# The sampler's step keeps this share of its proposals.
ACCEPTANCE = 0.8
# Starts of the chains, standard deviations from the estimate: wider than the posterior, so that R-hat can tell.
APART = 1.5
# What is hardly bounded by the data is first looked for within this share of its box.
OF_BOX = 0.25


class Box(NamedTuple):
    """Edges of the search coordinates [size]; those of K_H are its own, not of the force that is searched."""

    lower: jax.Array
    upper: jax.Array
    log_u: jax.Array


class Draws(NamedTuple):
    """What the chains drew, in the box, and how well they mixed."""

    z: np.ndarray  # search points [chains, draws, size], K_H's logarithm in its place
    rhat: np.ndarray  # [size], 1 for what is fixed
    bulk: np.ndarray  # effective sample size [size], of the middle
    tail: np.ndarray  # and of the 5 % tails
    acceptance: float
    divergences: int
    evaluations: int


def check_sampler() -> None:
    """Refuse where the sampler is not installed.

    Raises
    ------
    ParameterError
        Saying what to install.
    """
    if find_spec("blackjax") is None:
        raise ParameterError(
            "intervals='posterior' needs blackjax, which is not installed; pip install 'pianofit[bayes]'"
        )


def draw(surface: Surface, seed: int, *, chains: int = CHAINS, warmup: int = WARMUP, draws: int = DRAWS) -> Draws:
    """Sample the posterior; the same seed draws the same on the same machine."""
    check_sampler()
    free = surface.space.free
    white, box = whitened(surface), box_of(surface.space)
    keys = jax.random.split(jax.random.PRNGKey(seed % 2**32), 2 * chains)
    begin = APART * jax.vmap(lambda key: jax.random.normal(key, (int(free.sum()),)))(keys[chains:])
    at = (jnp.asarray(surface.z), jnp.asarray(white), box, surface.arrays)
    program = jax.jit(_chain, static_argnums=(3, 4, 5, 6)).lower(
        keys[0], begin[0], at, surface.batch, surface.cfg, warmup, draws
    )  # fmt: skip
    run: Callable = program.compile()
    parts = list(pool().map(lambda i: run(keys[i], begin[i], at), range(chains)))
    x, acceptance, divergent, steps = (np.stack([np.asarray(p) for p in column]) for column in zip(*parts, strict=True))
    z = surface.z + x @ white.T
    plain = np.asarray(jax.vmap(jax.vmap(lambda point: folded(point, box)))(jnp.asarray(z)))
    return Draws(plain, *_mixing(plain, free), float(acceptance.mean()), int(divergent.sum()), int(steps.sum()))


def whitened(surface: Surface) -> np.ndarray:
    """From unit normals to search coordinates [size, free]: a root of the inverse curvature."""
    space = surface.space
    free = np.flatnonzero(space.free)
    j, width = surface.jacobian[:, free], (space.z(space.upper) - space.z(space.lower))[free]
    width = np.where(np.isin(free, K), np.log(space.upper[K] / space.lower[K]), width)
    curvature = j.T @ j + np.diag((OF_BOX * width) ** -2.0)
    scale = 1 / np.sqrt(np.diag(curvature))
    root = np.linalg.cholesky(curvature * np.outer(scale, scale))
    out = np.zeros((len(space.free), len(free)))
    out[free] = scale[:, None] * np.linalg.inv(root).T
    return out


def box_of(space: Space) -> Box:
    """The box as `folded` needs it."""
    edges = []
    for values in (space.lower, space.upper):
        edge = np.array(values, float)
        edge[:LOG] = np.log(edge[:LOG])
        edges.append(jnp.asarray(edge))
    return Box(edges[0], edges[1], jnp.asarray(space.log_u))


def folded(z, box: Box):
    """A point [size] anywhere, folded into the box, with log K_H in the force's place.

    Each coordinate is folded for itself, so volumes stay as they are. The edges of K_H are met by p at a constant
    force, which is what the recording knows; by the force they would be met across the valley.
    """
    away = -box.log_u  # log K_H = log F_ref + p `away`; 0 where K_H is held
    least, most = jnp.exp(box.lower[P]), jnp.exp(box.upper[P])
    force = _fold(z[K], box.lower[K] - most * away, box.upper[K] - least * away)
    apart = jnp.where(away > 0, away, 1.0)
    low, high = (jnp.log(jnp.maximum((edge[K] - force) / apart, 1e-300)) for edge in (box.lower, box.upper))
    low = jnp.where(away > 0, jnp.maximum(low, box.lower[P]), box.lower[P])
    high = jnp.where(away > 0, jnp.minimum(high, box.upper[P]), box.upper[P])
    exponent = _fold(z[P], low, high)
    plain = _fold(z, box.lower, box.upper)
    return plain.at[P].set(exponent).at[K].set(force + jnp.exp(exponent) * away)


def _fold(x, low, high):
    width = high - low
    safe = jnp.where(width > 0, width, 1.0)
    turn = jnp.mod(x - low, 2 * safe)
    return jnp.where(width > 0, low + jnp.where(turn < safe, turn, 2 * safe - turn), low)


def _chain(key, begin, at: tuple, batch, cfg: tuple, warmup: int, draws: int):
    """One chain: unit-normal coordinates [draws, free], acceptance, divergences and evaluations [draws]."""
    import blackjax
    from blackjax.adaptation.base import get_filter_adapt_info_fn

    centre, white, box, arrays = at

    @jax.custom_jvp
    def cost(z):
        return 0.5 * (batch(z[None], arrays, cfg)[0][0] ** 2).sum()

    @cost.defjvp
    def _cost_jvp(given, tangents):
        residual, jacobian = (x[0] for x in batch(given[0][None], arrays, cfg)[:2])
        return 0.5 * (residual**2).sum(), (residual @ jacobian) @ tangents[0]

    def log_density(x):
        plain = folded(centre + white @ x, box)
        return -cost(plain.at[K].add(jnp.exp(plain[P]) * box.log_u))

    adapt: Any = blackjax.window_adaptation(
        blackjax.nuts, log_density, target_acceptance_rate=ACCEPTANCE, max_num_doublings=DOUBLINGS,
        adaptation_info_fn=get_filter_adapt_info_fn(),
    )  # fmt: skip
    first, then = jax.random.split(key)
    (state, chosen), _ = adapt.run(first, begin, num_steps=warmup)
    step: Callable = blackjax.nuts(log_density, **chosen).step

    def one(state: Any, key):
        state, told = step(key, state)
        return state, (state.position, told.acceptance_rate, told.is_divergent, told.num_integration_steps)

    return jax.lax.scan(one, state, jax.random.split(then, draws))[1]


def _mixing(z: np.ndarray, free: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """R-hat, and effective sample sizes of middle and tails (Vehtari et al. 2021), [size] each."""
    import blackjax

    rhat, bulk, tail = np.ones(len(free)), *np.zeros((2, len(free)))
    inside = jnp.asarray(z[..., free])
    rhat[free], bulk[free], tail[free] = (
        np.atleast_1d(f(inside)) for f in (blackjax.rhat, blackjax.ess_bulk, blackjax.ess_tail)
    )
    return rhat, bulk, tail
