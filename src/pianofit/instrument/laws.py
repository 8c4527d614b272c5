"""Keyboard laws: smooth curves of a quantity over the keys, by Gaussian process regression.

Each quantity is y_i = literature(x_i) + f(x_i) + h_i + e_i at key x_i. The difference f from the literature is smooth:
an unknown offset and tilt and a Gaussian process over the keys. h_i is the deviation of a single key. Its standard
deviation, the between-key scatter τ, is estimated from the data. e_i is the error of the key's fit, with the standard
deviation of its interval. All terms are Gaussian, so the posterior is linear algebra. The law is the posterior mean of
f. The value of a key is the posterior mean of f + h: a key with wide intervals moves towards its neighbours, and a key
with narrow intervals keeps its value. τ, and the size and length of f, maximise the marginal likelihood with weak
priors on their logarithms (empirical Bayes). With few keys, the law is mostly the literature with an offset.
Without keys, it is the literature.

A key further than `OUTLYING` standard deviations from the prediction of all others is an outlier. It is reported, left
out of the law, and takes the value of the law. Several outliers can mask one another. So suspects (by Student's
residuals about a stiff curve) are first removed together, and return if the rest predicts them. Three neighbours in a
row with deviations of one sign are not suspects, because the design of the instrument can cause them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

# Standard deviations from the prediction of the other keys beyond which a key is an outlier, and a suspect.
OUTLIER_SD = 4.0
SUSPECT = 3.0
# Number of neighbours with deviations of one sign that are not suspects.
RUN = 3
# With fewer keys, outliers cannot be identified.
ENOUGH_KEYS = 5
LENGTHS = (8.0, 16.0, 32.0)  # keys
SMOOTH = (0.02, 0.05, 0.12, 0.3, 0.8, 2.0)  # shares of the prior's spread
SCATTERS = (0.003, 0.01, 0.03, 0.06, 0.12, 0.25, 0.5, 1.0)
# Priors of size and scatter over the spread: medians, and standard deviation of the logarithm.
EXPECTED_SMOOTH, EXPECTED_SCATTER, FACTOR = 0.3, 0.05, 1.0


class Prior(NamedTuple):
    """Standard deviations of an instrument from the literature, on the scale of the law."""

    offset: float
    slope_sd: float  # from the middle of the keyboard to its end
    spread: float  # scale of smooth deviations and scatter


class Law(NamedTuple):
    """A law at the requested keys, and the posterior values of the fitted keys, on the scale of the law."""

    mean: np.ndarray  # [at]
    sd: np.ndarray  # [at], of f
    scatter: float  # τ
    length: float  # keys
    value: np.ndarray  # [keys], posterior mean of each fitted key
    value_sd: np.ndarray  # [keys]
    z: np.ndarray  # [keys], deviation from the prediction of the other keys over its standard deviation
    outlier: np.ndarray  # [keys], bool


class _Shape(NamedTuple):
    smooth: float
    scatter: float
    length: float


def fit_law(x: np.ndarray, y: np.ndarray, sd: np.ndarray, at: np.ndarray, prior: Prior) -> Law:
    """Fit one law.

    Parameters
    ----------
    x, y, sd : key number, difference from the literature and error of the fitted keys [keys].
    at : keys at which the law is evaluated [at].
    """
    inside = ~_suspects(x, y, sd, prior) if len(x) >= ENOUGH_KEYS else np.ones(len(x), bool)
    shape = _most_probable(x[inside], y[inside], sd[inside], prior)
    z = _leave_one_out_z(x, y, sd, inside, shape, prior)
    for _ in range(len(x)):
        accepted = np.abs(z) <= OUTLIER_SD
        if len(x) < ENOUGH_KEYS or accepted.sum() < ENOUGH_KEYS or (accepted == inside).all():
            break
        inside = accepted if accepted.sum() > inside.sum() else inside & accepted
        shape = _most_probable(x[inside], y[inside], sd[inside], prior)
        z = _leave_one_out_z(x, y, sd, inside, shape, prior)
    mean, variance = _predict(x, y, sd, inside, at, shape, prior)
    value, value_var = _posterior_values(x, y, sd, inside, shape, prior)
    return Law(mean, np.sqrt(variance), shape.scatter, shape.length, value, np.sqrt(value_var), z, ~inside)


def _covariance(a: np.ndarray, b: np.ndarray, shape: _Shape, prior: Prior) -> np.ndarray:
    """Covariance of f between keys `a` and `b`."""
    middle, half = 64.5, 43.5
    tilt = np.outer(a - middle, b - middle) / half**2
    near = np.exp(-0.5 * ((a[:, None] - b) / shape.length) ** 2)
    return prior.offset**2 + prior.slope_sd**2 * tilt + shape.smooth**2 * near


def _noisy(x: np.ndarray, sd: np.ndarray, shape: _Shape, prior: Prior) -> np.ndarray:
    """Covariance of the observed values f + h + e at keys `x`."""
    return _covariance(x, x, shape, prior) + np.diag(shape.scatter**2 + sd**2)


def _most_probable(x: np.ndarray, y: np.ndarray, sd: np.ndarray, prior: Prior) -> _Shape:
    """Size, scatter and length with the highest marginal likelihood."""

    def evidence(shape: _Shape) -> float:
        c = _noisy(x, sd, shape, prior)
        lower = np.linalg.cholesky(c + 1e-12 * np.trace(c) / len(x) * np.eye(len(x)))
        w = np.linalg.solve(lower, y)
        expected = np.array([EXPECTED_SMOOTH, EXPECTED_SCATTER]) * prior.spread
        deviation = np.log([shape.smooth, shape.scatter] / expected) / FACTOR
        return float(-0.5 * (w @ w) - np.log(np.diag(lower)).sum() - 0.5 * (deviation @ deviation))

    sizes = [(smooth * prior.spread, scatter * prior.spread) for smooth in SMOOTH for scatter in SCATTERS]
    return max((_Shape(*size, length) for length in LENGTHS for size in sizes), key=evidence)


def _suspects(x: np.ndarray, y: np.ndarray, sd: np.ndarray, prior: Prior) -> np.ndarray:
    """Keys that deviate strongly from a stiff robust curve (Student's t, 3 degrees of freedom) [keys]."""
    stiff = _covariance(x, x, _Shape(0.12 * prior.spread, 0.0, 32.0), prior)
    weight, residual, z = np.ones(len(x)), y, np.zeros(len(x))
    for _ in range(30):
        scale = max(1.4826 * float(np.median(np.abs(residual))), 1e-3 * prior.spread)
        noise = (scale**2 + sd**2) / weight
        residual = y - stiff @ np.linalg.solve(stiff + np.diag(noise), y)
        z = residual / np.sqrt(scale**2 + sd**2)
        weight = 4 / (3 + z**2)
    suspect = np.abs(z) > SUSPECT
    order, sign = np.argsort(x), np.sign(residual) * suspect
    for i in range(len(x) - RUN + 1):
        run = order[i : i + RUN]
        if abs(sign[run].sum()) == RUN:
            suspect[run] = False
    worst = np.argsort(-np.abs(z))[: len(x) // 3]
    return suspect & np.isin(np.arange(len(x)), worst)


def _predict(x, y, sd, inside, at, shape: _Shape, prior: Prior) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance of f at `at`, from the keys `inside`."""
    x, y, sd = x[inside], y[inside], sd[inside]
    k = _covariance(at, x, shape, prior)
    solved = np.linalg.solve(_noisy(x, sd, shape, prior), np.column_stack([y, k.T]))
    own = np.diag(_covariance(at, at, shape, prior))
    return k @ solved[:, 0], np.maximum(own - np.einsum("ij,ji->i", k, solved[:, 1:]), 0.0)


def _leave_one_out_z(x, y, sd, inside, shape: _Shape, prior: Prior) -> np.ndarray:
    """Deviation of each key from the prediction of the other keys `inside`, over its standard deviation.

    Keys inside use the inverse covariance of all (Rasmussen and Williams 2006, eq. 5.12).
    """
    mean, variance = _predict(x, y, sd, inside, x, shape, prior)
    z = (y - mean) / np.sqrt(variance + shape.scatter**2 + sd**2)
    inverse = np.linalg.inv(_noisy(x[inside], sd[inside], shape, prior))
    z[inside] = inverse @ y[inside] / np.sqrt(np.diag(inverse))
    return z


def _posterior_values(x, y, sd, inside, shape: _Shape, prior: Prior) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance of f + h at the fitted keys. The value of an outlier is not used."""
    noise = np.where(inside, sd, 1e6)
    k = _covariance(x, x, shape, prior) + shape.scatter**2 * np.eye(len(x))
    gain = np.linalg.solve(_noisy(x, noise, shape, prior), k).T
    return gain @ np.where(inside, y, 0.0), np.maximum(np.diag(k - gain @ k), 0.0)
