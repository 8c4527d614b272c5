"""Smooth laws over the keyboard: what neighbouring keys say about one another.

Each quantity is y_i = literature(x_i) + f(x_i) + h_i + e_i at key x_i. The difference f from the literature is smooth:
an unknown offset and tilt and a Gaussian process over the keys. h_i is the key's own: keys differ, and by how much (the
between-key scatter τ) is estimated from the data. e_i is the error of the key's fit, known from its interval. All are
Gaussian, so everything below is linear algebra: the law is the mean of f, a key's value that of f + h, in which a key
with wide intervals is drawn to its neighbours and one with narrow intervals stays. τ, and the size and length of f, are
those of the highest marginal likelihood with weak priors on their logarithms (empirical Bayes). With few keys the
offset decides, with none the literature is left.

A key further than `OUTLYING` standard deviations from what all others predict is an outlier: it is named, left out of
the law, and takes the law's value. To find several that hide one another, suspects (by Student's residuals about a
stiff curve) are first set aside together, and come back if the rest predicts them. Three neighbours in a row that are
off the same way are no suspects: they are how this instrument is built.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

__all__ = ["OUTLYING", "Law", "Prior", "fit_law"]

OUTLYING = 4.0
SUSPECT = 3.0
RUN = 3
# With fewer keys nobody can say which of them is wrong.
ENOUGH_KEYS = 5
LENGTHS = (8.0, 16.0, 32.0)  # keys
SMOOTH = (0.02, 0.05, 0.12, 0.3, 0.8, 2.0)  # of the prior's spread
SCATTERS = (0.003, 0.01, 0.03, 0.06, 0.12, 0.25, 0.5, 1.0)
# Where size and scatter are expected, and within which factor (standard deviation of the logarithm).
EXPECTED_SMOOTH, EXPECTED_SCATTER, FACTOR = 0.3, 0.05, 1.0


class Prior(NamedTuple):
    """How far an instrument may be from the literature: standard deviations in the law's own scale."""

    offset: float
    slope_sd: float  # from the middle of the keyboard to its end
    spread: float  # to which smooth deviations and scatter are compared


class Law(NamedTuple):
    """A law at the keys asked for, and what it does to the keys it was fitted to. All in the law's scale."""

    mean: np.ndarray  # [at]
    sd: np.ndarray  # [at], of f
    scatter: float  # τ
    length: float  # keys
    value: np.ndarray  # [keys], posterior mean of each own key
    value_sd: np.ndarray  # [keys]
    z: np.ndarray  # [keys], standard deviations from what the others predict
    outlier: np.ndarray  # [keys], bool


class _Shape(NamedTuple):
    smooth: float
    scatter: float
    length: float


def fit_law(x: np.ndarray, y: np.ndarray, sd: np.ndarray, at: np.ndarray, prior: Prior) -> Law:
    """Fit one law.

    Parameters
    ----------
    x, y, sd : of the known keys [keys]: key number, difference from the literature, error.
    at : keys at which the law is wanted [at].
    """
    inside = ~_suspects(x, y, sd, prior) if len(x) >= ENOUGH_KEYS else np.ones(len(x), bool)
    shape = _most_probable(x[inside], y[inside], sd[inside], prior)
    z = _leave_one_out_z(x, y, sd, inside, shape, prior)
    for _ in range(len(x)):
        now = np.abs(z) <= OUTLYING
        if len(x) < ENOUGH_KEYS or now.sum() < ENOUGH_KEYS or (now == inside).all():
            break
        inside = now if now.sum() > inside.sum() else inside & now
        shape = _most_probable(x[inside], y[inside], sd[inside], prior)
        z = _leave_one_out_z(x, y, sd, inside, shape, prior)
    mean, variance = _predict(x, y, sd, inside, at, shape, prior)
    value, value_var = _own(x, y, sd, inside, shape, prior)
    return Law(mean, np.sqrt(variance), shape.scatter, shape.length, value, np.sqrt(value_var), z, ~inside)


def _covariance(a: np.ndarray, b: np.ndarray, shape: _Shape, prior: Prior) -> np.ndarray:
    """Of f between keys `a` and `b`."""
    middle, half = 64.5, 43.5
    tilt = np.outer(a - middle, b - middle) / half**2
    near = np.exp(-0.5 * ((a[:, None] - b) / shape.length) ** 2)
    return prior.offset**2 + prior.slope_sd**2 * tilt + shape.smooth**2 * near


def _noisy(x: np.ndarray, sd: np.ndarray, shape: _Shape, prior: Prior) -> np.ndarray:
    """Covariance of what is known of keys `x`: of f + h + e."""
    return _covariance(x, x, shape, prior) + np.diag(shape.scatter**2 + sd**2)


def _most_probable(x: np.ndarray, y: np.ndarray, sd: np.ndarray, prior: Prior) -> _Shape:
    """Size, scatter and length of the highest marginal likelihood."""

    def evidence(shape: _Shape) -> float:
        c = _noisy(x, sd, shape, prior)
        lower = np.linalg.cholesky(c + 1e-12 * np.trace(c) / len(x) * np.eye(len(x)))
        w = np.linalg.solve(lower, y)
        expected = np.array([EXPECTED_SMOOTH, EXPECTED_SCATTER]) * prior.spread
        far = np.log([shape.smooth, shape.scatter] / expected) / FACTOR
        return float(-0.5 * (w @ w) - np.log(np.diag(lower)).sum() - 0.5 * (far @ far))

    sizes = [(smooth * prior.spread, scatter * prior.spread) for smooth in SMOOTH for scatter in SCATTERS]
    return max((_Shape(*size, length) for length in LENGTHS for size in sizes), key=evidence)


def _suspects(x: np.ndarray, y: np.ndarray, sd: np.ndarray, prior: Prior) -> np.ndarray:
    """Keys far off a stiff curve, in which the far ones count little (Student's t, 3 degrees of freedom) [keys]."""
    stiff = _covariance(x, x, _Shape(0.12 * prior.spread, 0.0, 32.0), prior)
    weight, off, far = np.ones(len(x)), y, np.zeros(len(x))
    for _ in range(30):
        scale = max(1.4826 * float(np.median(np.abs(off))), 1e-3 * prior.spread)
        noise = (scale**2 + sd**2) / weight
        off = y - stiff @ np.linalg.solve(stiff + np.diag(noise), y)
        far = off / np.sqrt(scale**2 + sd**2)
        weight = 4 / (3 + far**2)
    suspect = np.abs(far) > SUSPECT
    order, sign = np.argsort(x), np.sign(off) * suspect
    for i in range(len(x) - RUN + 1):
        run = order[i : i + RUN]
        if abs(sign[run].sum()) == RUN:
            suspect[run] = False
    worst = np.argsort(-np.abs(far))[: len(x) // 3]
    return suspect & np.isin(np.arange(len(x)), worst)


def _predict(x, y, sd, inside, at, shape: _Shape, prior: Prior) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance of f at `at` from the keys inside."""
    x, y, sd = x[inside], y[inside], sd[inside]
    k = _covariance(at, x, shape, prior)
    solved = np.linalg.solve(_noisy(x, sd, shape, prior), np.column_stack([y, k.T]))
    own = np.diag(_covariance(at, at, shape, prior))
    return k @ solved[:, 0], np.maximum(own - np.einsum("ij,ji->i", k, solved[:, 1:]), 0.0)


def _leave_one_out_z(x, y, sd, inside, shape: _Shape, prior: Prior) -> np.ndarray:
    """How many standard deviations each key is off what the other keys inside predict.

    Of a key inside, from the inverse covariance of all (Rasmussen and Williams 2006, eq. 5.12).
    """
    mean, variance = _predict(x, y, sd, inside, x, shape, prior)
    z = (y - mean) / np.sqrt(variance + shape.scatter**2 + sd**2)
    inverse = np.linalg.inv(_noisy(x[inside], sd[inside], shape, prior))
    z[inside] = inverse @ y[inside] / np.sqrt(np.diag(inverse))
    return z


def _own(x, y, sd, inside, shape: _Shape, prior: Prior) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance of f + h at the keys themselves; an outlier's own value does not count."""
    noise = np.where(inside, sd, 1e6)
    k = _covariance(x, x, shape, prior) + shape.scatter**2 * np.eye(len(x))
    gain = np.linalg.solve(_noisy(x, noise, shape, prior), k).T
    return gain @ np.where(inside, y, 0.0), np.maximum(np.diag(k - gain @ k), 0.0)
