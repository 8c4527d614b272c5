"""F of many points at once, on all cores, and what F is made of at one of them: as programs that are kept."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..model.cache import kept
from . import likelihood
from .lanes import pool
from .likelihood import Latent, Report, Table

__all__ = ["Opened", "latent", "opened", "report"]

# Points of one call.
TOGETHER = 6


@kept
def reports(table: Table, count, residual, jacobian, phi, w, _):
    """`likelihood.report` of the first `count` of a batch of points."""
    points = residual, jacobian, phi, w

    def one(i):
        return tuple(likelihood.report(table, *(x[i] for x in points)))

    blank = tuple(jnp.zeros((len(residual), *x.shape), x.dtype) for x in jax.eval_shape(one, 0))
    return jax.lax.fori_loop(
        0, count, lambda i, out: tuple(x.at[i].set(y) for x, y in zip(out, one(i), strict=True)), blank
    )


def report(table: Table, residual: np.ndarray, jacobian: np.ndarray, phi: np.ndarray, w: np.ndarray) -> Report:
    """`reports` of any number of points [B, ...], `TOGETHER` at a time, on all cores."""
    count = len(residual)
    args = residual, jacobian, phi, w
    padded = [np.concatenate([x, np.repeat(x[-1:], -count % TOGETHER, axis=0)]) for x in args]

    def some(first: int) -> list[np.ndarray]:
        now = np.int64(min(count - first, TOGETHER))
        return [np.asarray(x) for x in reports(table, now, *(x[first : first + TOGETHER] for x in padded), None)]

    parts = list(pool().map(some, range(0, len(padded[0]), TOGETHER)))
    return Report(*(np.concatenate(column)[:count] for column in zip(*parts, strict=True)))


@kept
def latents(table: Table, residual, phi, w, _):
    """`likelihood.latent` of one point."""
    return tuple(likelihood.latent(table, residual, phi, w))


def latent(table: Table, residual: np.ndarray, phi: np.ndarray, w: np.ndarray) -> Latent:
    """`likelihood.latent` of one point, as arrays of NumPy."""
    return Latent(*(np.asarray(x) for x in latents(table, residual, phi, w, None)))


class Opened(NamedTuple):
    """F at every node of τ and of the gains, opened; see `likelihood.Solved`."""

    inverse: np.ndarray  # C⁻¹ [T, M, RK, RK]
    weight: np.ndarray  # of the nodes at this residual [T, M]
    variance: np.ndarray  # var/w [R, K]
    push: np.ndarray  # C⁻¹r [T, M, R, K]
    pull: np.ndarray  # of what is absent: derivatives of its mean by the residual [T, M, N, R, K],
    z: np.ndarray  # bound less mean, in standard deviations [T, M, N],
    spread: np.ndarray  # these deviations, dB,
    hazard: np.ndarray  # and minus the slope of -log Φ(z)


@kept
def opens(table: Table, residual, phi, w, _):
    """`Opened` of one point."""
    s = likelihood.solved(table, residual, phi, w)
    return (
        likelihood.inverse(table, s.pieces), likelihood.responsible(table, s.each),
        likelihood.variance(table, phi, w), s.push, likelihood.pulled(table, s), s.z, s.spread, likelihood.hazard(s.z),
    )  # fmt: skip


def opened(table: Table, residual: np.ndarray, phi: np.ndarray, w: np.ndarray) -> Opened:
    """F at one point, opened, as arrays of NumPy."""
    return Opened(*(np.asarray(x) for x in opens(table, residual, phi, w, None)))
