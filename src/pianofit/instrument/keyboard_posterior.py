"""The joint posterior of the quantities of all 88 keys, given the fits of some of them.

A quantity q of key n, on the scale of its law (a logarithm, cents or dB), is

    y_q(n) = literature_q(n) + f_q(n) + δ_q(n)

The law f is smooth: an unknown offset and tilt, and a Gaussian process over the keys. δ is what single keys deviate by.
It has a Student's t distribution, so a key that differs from all others does not move the law. A fit of key n measures
all its quantities at once,

    fit(n) = y(n) - s_n d_n + e_n,     e_n ~ N(0, C_n)

with the joint covariance C_n of its posterior. The common scale of a key's velocities is unknown if no velocity was
given: s_n is the logarithm of the true scale over the assumed one, and d_n the change of the quantities with it. A key
therefore moves only in directions that its own data do not determine. A fit with several minima has a mean and a
covariance for each, and the other keys decide between them.

Given the size and length of f, the spread of δ and the weights of Student's t, all of this is linear and Gaussian.
Sizes, lengths and spreads maximise the marginal likelihood of the whole keyboard with weak priors (empirical Bayes).
The weights and the shares of the minima are computed in turn with them (EM).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize

# Middle of the keyboard, MIDI, and half of its length, keys: the tilt is 1 at its ends.
MIDDLE, HALF = 64.5, 43.5
# Degrees of freedom of Student's t of single keys.
STUDENT = 4.0
# Priors over the spread of a quantity: medians of size and scatter, and standard deviation of their logarithms.
EXPECTED_SMOOTH, EXPECTED_SCATTER, FACTOR = 0.3, 0.05, 1.0
# Prior of the length of a smooth law, keys: three octaves and a half have about four independent values.
EXPECTED_LENGTH, LENGTH_FACTOR = 14.0, 0.4
# Prior standard deviation of the logarithm of a key's velocity scale: the loudest layers of a library's keys differ by
# about a quarter.
VELOCITY_SCALE_SD = 0.25
# Rounds in which spreads, weights and shares are computed in turn. They change little after three.
ROUNDS = 4
# Share of the variance below which a covariance is rounding error.
JITTER = 1e-9


class Prior(NamedTuple):
    """Standard deviations of an instrument from the literature, on the scale of the law."""

    offset: float
    slope_sd: float  # from the middle of the keyboard to its end
    spread: float  # scale of smooth deviations and scatter
    scatter: float | None = None  # median of the scatter of single keys, if it is not `EXPECTED_SCATTER` of the spread

    @property
    def medians(self) -> tuple[float, float, float]:
        """Medians of the smooth size, the scatter and the length."""
        scatter = EXPECTED_SCATTER * self.spread if self.scatter is None else self.scatter
        return EXPECTED_SMOOTH * self.spread, scatter, EXPECTED_LENGTH


class Measurement(NamedTuple):
    """One minimum of a key's fit, on the scales of the laws."""

    weight: float  # of the posterior of the fit
    mean: np.ndarray  # [quantities]
    covariance: np.ndarray  # [quantities, quantities]


@dataclass(frozen=True, eq=False)
class KeyMeasurements:
    """Measurements of the fit of one key."""

    midi: int
    minima: tuple[Measurement, ...]
    scale_direction: np.ndarray  # d: change of the quantities with the logarithm of the velocity scale [quantities]


class LawShape(NamedTuple):
    """Spreads of one quantity over the keyboard, on the scale of its law."""

    smooth: float  # standard deviation of the Gaussian process
    scatter: float  # of single keys
    length: float  # of the Gaussian process, keys


@dataclass(frozen=True, eq=False)
class KeyboardPosterior:
    """Means and standard deviations on the scales of the laws; `at` are the requested keys."""

    law: np.ndarray  # literature + f [quantities, at]
    law_sd: np.ndarray  # [quantities, at]
    value: np.ndarray  # literature + f + δ of the fitted keys [quantities, keys]
    value_sd: np.ndarray  # [quantities, keys]
    z: np.ndarray  # deviation of a fit from the prediction of all other keys, standard deviations [quantities, keys]
    shapes: tuple[LawShape, ...]  # [quantities]
    log_scale: np.ndarray  # s, logarithm of the velocity scale [keys]
    shares: tuple[np.ndarray, ...]  # of the minima of each key, given all keys

    def value_at(self, q: int, keys: Sequence[int], at: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Value and standard deviation of quantity `q` at every key of `at`; an unrecorded key adds the scatter."""
        value, sd = self.law[q].copy(), np.hypot(self.law_sd[q], self.shapes[q].scatter)
        index = np.searchsorted(at, keys)
        value[index], sd[index] = self.value[q], self.value_sd[q]
        return value, sd


class _System(NamedTuple):
    """The Gaussian model of all fits, in the order [quantities, keys]."""

    inverse: np.ndarray  # of the covariance of the fits [n, n]
    solved: np.ndarray  # inverse times the deviations of the fits from the literature [n]
    log_density: float


class _Model(NamedTuple):
    """Spreads and priors of all quantities."""

    weights: np.ndarray  # of Student's t [quantities, keys]
    shapes: Sequence[LawShape]
    priors: Sequence[Prior]


class _Data(NamedTuple):
    """Fits as one Gaussian each."""

    x: np.ndarray  # keys [keys]
    y: np.ndarray  # deviations from the literature [quantities, keys]
    noise: np.ndarray  # with the unknown scale [keys, quantities, quantities]


def keyboard_posterior(
    keys: Sequence[KeyMeasurements], literature: np.ndarray, priors: Sequence[Prior], at: Sequence[int]
) -> KeyboardPosterior:
    """Combine the fits of some keys.

    Parameters
    ----------
    keys : measurements in ascending order of keys.
    literature : reference values on the scales of the laws [quantities, at].
    priors : of each quantity.
    at : MIDI numbers of the keys at which the laws are evaluated, ascending; they contain the fitted ones.
    """
    x, places = np.array([key.midi for key in keys], float), np.searchsorted(at, [key.midi for key in keys])
    reference = literature[:, places]
    weights = np.ones(reference.shape)
    shares = [np.array([one.weight for one in key.minima]) / sum(one.weight for one in key.minima) for key in keys]
    shapes = [LawShape(*prior.medians) for prior in priors]
    for _ in range(ROUNDS):
        data = _data(keys, shares, x, reference)
        shapes = _most_probable(data, weights, shapes, priors)
        system = _solve(data, weights, shapes, priors)
        weights = _student_weights(system, weights, shapes)
        shares = [_shares(system, data, reference, i, key) for i, key in enumerate(keys)]
    data = _data(keys, shares, x, reference)
    system, model = _solve(data, weights, shapes, priors), _Model(weights, shapes, priors)
    law, law_sd = _laws(data, system, model, literature, np.asarray(at, float))
    value, value_sd = _key_values(data, system, model, law[:, places])
    z = np.stack([_deviation(system, data, model, i) for i in range(len(keys))], axis=1)
    solved = system.solved.reshape(reference.shape)
    scale = [-(VELOCITY_SCALE_SD**2) * key.scale_direction @ solved[:, i] for i, key in enumerate(keys)]
    return KeyboardPosterior(law, law_sd, value, value_sd, z, tuple(shapes), np.array(scale), tuple(shares))


def _data(keys, shares, x: np.ndarray, reference: np.ndarray) -> _Data:
    """Fits with the mean and covariance of the mixture of their minima."""
    y, noise = np.empty(reference.shape), []
    for i, (key, share) in enumerate(zip(keys, shares, strict=True)):
        means = np.array([one.mean for one in key.minima])
        y[:, i] = share @ means - reference[:, i]
        apart = means - share @ means
        covariance = np.einsum("m,mij->ij", share, [one.covariance for one in key.minima])
        direction = VELOCITY_SCALE_SD * key.scale_direction
        noise.append(covariance + np.einsum("m,mi,mj->ij", share, apart, apart) + np.outer(direction, direction))
    return _Data(x, y, np.array(noise))


def _law_covariance(a: np.ndarray, b: np.ndarray, shape: LawShape, prior: Prior) -> np.ndarray:
    """Covariance of f between keys `a` and `b`."""
    tilt = np.outer(a - MIDDLE, b - MIDDLE) / HALF**2
    near = np.exp(-0.5 * ((a[:, None] - b) / shape.length) ** 2)
    return prior.offset**2 + prior.slope_sd**2 * tilt + shape.smooth**2 * near


def _solve(data: _Data, weights: np.ndarray, shapes: Sequence[LawShape], priors: Sequence[Prior]) -> _System:
    quantities, count = data.y.shape
    total = np.zeros((quantities, count, quantities, count))
    keys = np.arange(count)
    total[:, keys, :, keys] = data.noise
    for q, (shape, prior) in enumerate(zip(shapes, priors, strict=True)):
        total[q, :, q] += _law_covariance(data.x, data.x, shape, prior) + np.diag(shape.scatter**2 / weights[q])
    matrix = total.reshape(quantities * count, -1)
    matrix[np.diag_indices(len(matrix))] *= 1 + JITTER
    lower = np.linalg.cholesky(matrix)
    root = np.linalg.inv(lower)
    inverse = root.T @ root
    y = data.y.ravel()
    solved = inverse @ y
    return _System(inverse, solved, float(-0.5 * y @ solved - np.log(np.diag(lower)).sum()))


def _most_probable(
    data: _Data, weights: np.ndarray, start: Sequence[LawShape], priors: Sequence[Prior]
) -> list[LawShape]:
    """Shapes with the highest posterior density given the fits."""
    quantities, count = data.y.shape
    centre = np.log([prior.medians for prior in priors]).T
    sd = np.array([FACTOR, FACTOR, LENGTH_FACTOR])[:, None]

    def shapes_at(flat: np.ndarray) -> list[LawShape]:
        return [LawShape(*column) for column in np.exp(flat.reshape(3, -1)).T]

    def cost(flat: np.ndarray) -> tuple[float, np.ndarray]:
        shapes = shapes_at(flat)
        system = _solve(data, weights, shapes, priors)
        blocks = (np.outer(system.solved, system.solved) - system.inverse).reshape(quantities, count, quantities, count)
        gradient = np.empty((3, quantities))
        distance = (data.x[:, None] - data.x) ** 2
        for q, shape in enumerate(shapes):
            block = blocks[q, :, q]
            near = shape.smooth**2 * np.exp(-0.5 * distance / shape.length**2)
            gradient[0, q] = np.sum(block * near)
            gradient[1, q] = np.sum(np.diag(block) * shape.scatter**2 / weights[q])
            gradient[2, q] = 0.5 * np.sum(block * near * distance) / shape.length**2
        deviation = (flat.reshape(3, -1) - centre) / sd
        return -system.log_density + 0.5 * np.sum(deviation**2), (-gradient + deviation / sd).ravel()

    flat = np.log(np.array(start).T).ravel()
    bounds = [(c - 4 * s, c + 4 * s) for c, s in zip(centre.ravel(), np.repeat(sd, quantities), strict=True)]
    found = minimize(cost, flat, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 40})
    return shapes_at(found.x)


def _student_weights(system: _System, weights: np.ndarray, shapes: Sequence[LawShape]) -> np.ndarray:
    """Weights of Student's t from the posterior mean square of δ [quantities, keys] (EM)."""
    scatter = np.array([shape.scatter for shape in shapes])[:, None] ** 2
    prior = scatter / weights
    mean = prior * system.solved.reshape(weights.shape)
    variance = prior - prior**2 * np.diag(system.inverse).reshape(weights.shape)
    return (STUDENT + 1) / (STUDENT + (mean**2 + variance) / scatter)


def _left_out(system: _System, data: _Data, i: int) -> tuple[np.ndarray, np.ndarray]:
    """Fit of key `i` minus the prediction of the other keys [quantities], and the covariance of the prediction."""
    quantities, count = data.y.shape
    block = np.arange(quantities) * count + i
    covariance = np.linalg.inv(system.inverse[np.ix_(block, block)])
    return covariance @ system.solved[block], covariance - data.noise[i]


def _shares(system: _System, data: _Data, reference: np.ndarray, i: int, key: KeyMeasurements) -> np.ndarray:
    """Posterior shares of the minima of key `i`, by its own weights and the prediction of the other keys."""
    difference, prediction = _left_out(system, data, i)
    centre = data.y[:, i] + reference[:, i] - difference
    direction = VELOCITY_SCALE_SD * key.scale_direction
    log_share = []
    for one in key.minima:
        covariance = prediction + one.covariance + np.outer(direction, direction)
        residual = one.mean - centre
        square = residual @ np.linalg.solve(covariance, residual)
        log_share.append(np.log(one.weight) - 0.5 * (square + np.linalg.slogdet(covariance)[1]))
    share = np.exp(np.array(log_share) - max(log_share))
    return share / share.sum()


def _deviation(system: _System, data: _Data, model: _Model, i: int) -> np.ndarray:
    """Deviation of the fit of key `i` from the prediction of the other keys, standard deviations [quantities].

    The key is compared with ordinary keys, so its own deviation has the scatter of these.
    """
    difference, prediction = _left_out(system, data, i)
    scatter = np.array([shape.scatter**2 for shape in model.shapes])
    variance = np.diag(prediction) - scatter / model.weights[:, i] + scatter
    return difference / np.sqrt(variance + np.diag(data.noise[i]))


def _laws(data: _Data, system: _System, model: _Model, literature: np.ndarray, at: np.ndarray) -> Any:
    """Mean and standard deviation of literature + f at keys `at` [quantities, at]."""
    quantities, count = data.y.shape
    solved = system.solved.reshape(quantities, count)
    blocks = system.inverse.reshape(quantities, count, quantities, count)
    mean, sd = literature.copy(), np.empty(literature.shape)
    for q, (shape, prior) in enumerate(zip(model.shapes, model.priors, strict=True)):
        cross = _law_covariance(at, data.x, shape, prior)
        own = np.diag(_law_covariance(at, at, shape, prior))
        mean[q] += cross @ solved[q]
        sd[q] = _root(own - np.einsum("ai,ij,aj->a", cross, blocks[q, :, q], cross))
    return mean, sd


def _key_values(data: _Data, system: _System, model: _Model, law: np.ndarray) -> Any:
    """Mean and standard deviation of the values of the fitted keys, from their laws [quantities, keys]."""
    quantities, count = data.y.shape
    solved = system.solved.reshape(quantities, count)
    blocks = system.inverse.reshape(quantities, count, quantities, count)
    mean, sd = law.copy(), np.empty(law.shape)
    for q, (shape, prior) in enumerate(zip(model.shapes, model.priors, strict=True)):
        scatter = shape.scatter**2 / model.weights[q]
        covariance = _law_covariance(data.x, data.x, shape, prior) + np.diag(scatter)
        mean[q] += scatter * solved[q]
        sd[q] = _root(np.diag(covariance - covariance @ blocks[q, :, q] @ covariance))
    return mean, sd


def _root(variance: np.ndarray) -> np.ndarray:
    return np.sqrt(np.maximum(variance, 0.0))
