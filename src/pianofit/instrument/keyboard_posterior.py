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
Sizes, lengths and spreads maximise the marginal likelihood of the whole keyboard with weak priors. The weights and the
shares of the minima are computed in turn with them (EM). Few keys hardly determine the sizes, lengths and spreads of a
quantity. Its posterior therefore is a mean over them, with those of all other quantities at their most probable values
(`quantity_law`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from .quantity_law import (
    STUDENT,
    LawShape,
    Observed,
    Prior,
    integrate,
    key_variance,
    law_covariance,
    most_probable,
)

# Prior standard deviation of the logarithm of a key's velocity scale: the loudest layers of a library's keys differ by
# about a quarter.
VELOCITY_SCALE_SD = 0.25
# Rounds in which spreads, weights and shares are computed in turn. They change little after three.
ROUNDS = 4
# Share of the variance below which a covariance is rounding error.
JITTER = 1e-9


class Measurement(NamedTuple):
    """One minimum of a key's fit, on the scales of the laws."""

    weight: float  # relative to the other minima
    mean: np.ndarray  # [quantities]
    covariance: np.ndarray  # [quantities, quantities]


@dataclass(frozen=True, eq=False)
class KeyMeasurements:
    """Measurements of the fit of one key."""

    midi: int
    minima: tuple[Measurement, ...]
    scale_direction: np.ndarray  # d: change of the quantities with the logarithm of the velocity scale [quantities]


@dataclass(frozen=True, eq=False)
class KeyboardPosterior:
    """Means and standard deviations on the scales of the laws; `at` are the requested keys."""

    mean: np.ndarray  # of f, then of f + δ, with the literature [2, quantities, at]
    sd: np.ndarray  # [2, quantities, at]
    z: np.ndarray  # deviation of a fit from the prediction of all other keys, standard deviations [quantities, keys]
    shapes: tuple[LawShape, ...]  # the most probable ones [quantities]
    log_scale: np.ndarray  # s, logarithm of the velocity scale [keys]
    shares: tuple[np.ndarray, ...]  # of the minima of each key, given all keys


class JointLaws(NamedTuple):
    """Laws and values of some quantities at some keys with their joint covariance, on the scales of the laws."""

    mean: np.ndarray  # of f, then of f + δ, with the literature [2, quantities, at]
    covariance: np.ndarray  # in the order of the mean [n, n]

    def value_of(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Mean [quantities] and covariance [quantities, quantities] of the values of one key, an index of the keys."""
        joint = self.covariance.reshape(*self.mean.shape, *self.mean.shape)
        return self.mean[1, :, i], joint[1, :, i, 1, :, i]

    def draw(self, count: int, random: np.random.Generator) -> np.ndarray:
        """Draw laws and values [count, 2, quantities, at]."""
        variance, axes = np.linalg.eigh(self.covariance)
        root = axes * np.sqrt(np.maximum(variance, 0.0))
        return self.mean + (random.normal(size=(count, len(root))) @ root.T).reshape(count, *self.mean.shape)


class _System(NamedTuple):
    """The Gaussian model of all fits, in the order [quantities, keys]."""

    inverse: np.ndarray  # of the covariance of the fits [n, n]
    solved: np.ndarray  # inverse times the deviations of the fits from the literature [n]


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


class _Fitted(NamedTuple):
    """The most probable model of some fits."""

    data: _Data
    model: _Model
    system: _System
    shares: list[np.ndarray]


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
    reference = literature[:, np.searchsorted(at, [key.midi for key in keys])]
    fitted = _fit_model(keys, reference, priors)
    data, model, system = fitted.data, fitted.model, fitted.system
    mean, sd = _marginals(fitted, literature, range(len(priors)), at)
    solved = system.solved.reshape(reference.shape)
    scale = [-(VELOCITY_SCALE_SD**2) * key.scale_direction @ solved[:, i] for i, key in enumerate(keys)]
    return KeyboardPosterior(
        mean=mean,
        sd=sd,
        z=np.stack([_deviation(system, data, model, i) for i in range(len(keys))], axis=1),
        shapes=tuple(model.shapes),
        log_scale=np.array(scale),
        shares=tuple(fitted.shares),
    )


def _fit_model(keys: Sequence[KeyMeasurements], reference: np.ndarray, priors: Sequence[Prior]) -> _Fitted:
    """Find shapes, weights and shares in turn; `reference` are values of the literature [quantities, keys]."""
    x = np.array([key.midi for key in keys], float)
    shares = [np.array([one.weight for one in key.minima]) / sum(one.weight for one in key.minima) for key in keys]
    model = _Model(np.ones(reference.shape), [LawShape(*prior.medians) for prior in priors], priors)
    for _ in range(ROUNDS):
        data = _data(keys, shares, x, reference)
        model = model._replace(shapes=_most_probable(data, model))
        system = _solve(data, model)
        model = model._replace(weights=_student_weights(system, model))
        shares = [_shares(system, data, reference, i, key) for i, key in enumerate(keys)]
    data = _data(keys, shares, x, reference)
    return _Fitted(data, model, _solve(data, model), shares)


def joint_laws(
    keys: Sequence[KeyMeasurements],
    literature: np.ndarray,
    priors: Sequence[Prior],
    at: Sequence[int],
    chosen: Sequence[int],
    shown: Sequence[int] | None = None,
) -> JointLaws:
    """Combine the fits of some keys, and return some quantities with their joint covariance.

    The correlations are those at the most probable shapes. Means and standard deviations are means over all shapes,
    as those of `keyboard_posterior`, whose arguments these are.

    Parameters
    ----------
    chosen : indices of the returned quantities, ascending.
    shown : indices in `at` of the returned keys; all if None.
    """
    fitted = _fit_model(keys, literature[:, np.searchsorted(at, [key.midi for key in keys])], priors)
    returned = [*range(len(at))] if shown is None else [*shown]
    mean, sd = (x[..., returned] for x in _marginals(fitted, literature, chosen, at))
    covariance = _joint_covariance(fitted, chosen, np.asarray(at, float)[returned]).reshape(mean.size, mean.size)
    factor = sd.ravel() / np.sqrt(np.diag(covariance))
    return JointLaws(mean, covariance * np.outer(factor, factor))


def _marginals(
    fitted: _Fitted, literature: np.ndarray, chosen: Sequence[int], at: Sequence[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Means and standard deviations of f and f + δ over all shapes [2, chosen, at], with the literature."""
    data, model, system = fitted.data, fitted.model, fitted.system
    places = np.searchsorted(at, data.x)
    mean, sd = np.empty((2, len(chosen), len(at))), np.empty((2, len(chosen), len(at)))
    for row, q in enumerate(chosen):
        law = integrate(_observed(system, data, model, q), model.priors[q], model.shapes[q], np.asarray(at, float))
        mean[:, row], sd[0, row], sd[1, row] = law.law, law.law_sd, np.hypot(law.law_sd, law.scatter_sd)
        mean[1, row, places], sd[1, row, places] = law.value, law.value_sd
    return mean + literature[[*chosen]], sd


def _joint_covariance(fitted: _Fitted, chosen: Sequence[int], at: np.ndarray) -> np.ndarray:
    """Covariance of f and f + δ of some quantities at the most probable shapes [2, chosen, at, 2, chosen, at].

    The correlation of the errors of a fit enters by the covariance of all fits.
    """
    data, model = fitted.data, fitted.model
    same, count = at[:, None] == data.x, (len(chosen), len(at))
    cross = np.zeros((2, *count, *data.y.shape))
    prior = np.zeros((2, *count, 2, *count))
    for row, q in enumerate(chosen):
        shape, scatter = model.shapes[q], key_variance(model.weights[q], model.shapes[q])
        unrecorded = STUDENT / (STUDENT - 2) * shape.scatter**2
        cross[:, row, :, q] = law_covariance(at, data.x, shape, model.priors[q])
        cross[1, row, :, q] += same * scatter
        prior[:, row, :, :, row] = law_covariance(at, at, shape, model.priors[q])[:, None, :]
        prior[1, row, :, 1, row] += np.diag(np.where(same.any(axis=1), same @ scatter, unrecorded))
    rows = cross.reshape(prior[..., 0, 0, 0].size, -1)
    covariance = prior.reshape(len(rows), len(rows)) - rows @ fitted.system.inverse @ rows.T
    return (0.5 * (covariance + covariance.T)).reshape(prior.shape)


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


def _spread(x: np.ndarray, model: _Model, q: int) -> np.ndarray:
    """Covariance of f + δ of one quantity at the fitted keys [keys, keys]."""
    shape = model.shapes[q]
    return law_covariance(x, x, shape, model.priors[q]) + np.diag(key_variance(model.weights[q], shape))


def _solve(data: _Data, model: _Model) -> _System:
    quantities, count = data.y.shape
    total = np.zeros((quantities, count, quantities, count))
    keys = np.arange(count)
    total[:, keys, :, keys] = data.noise
    for q in range(quantities):
        total[q, :, q] += _spread(data.x, model, q)
    matrix = total.reshape(quantities * count, -1)
    matrix[np.diag_indices(len(matrix))] *= 1 + JITTER
    root = np.linalg.inv(np.linalg.cholesky(matrix))
    inverse = root.T @ root
    return _System(inverse, inverse @ data.y.ravel())


def _observed(system: _System, data: _Data, model: _Model, q: int) -> Observed:
    """Values of one quantity given all others: the errors of a fit are correlated."""
    blocks = system.inverse.reshape(*data.y.shape, *data.y.shape)  # [quantities, keys, quantities, keys]
    own = np.linalg.inv(blocks[q, :, q])
    y = own @ system.solved.reshape(data.y.shape)[q]
    return Observed(data.x, y, own - _spread(data.x, model, q), model.weights[q])


def _most_probable(data: _Data, model: _Model) -> list[LawShape]:
    """Shapes of higher posterior density, one quantity at a time."""
    system = _solve(data, model)
    for q, prior in enumerate(model.priors):
        before, shapes = _spread(data.x, model, q), list(model.shapes)
        shapes[q] = most_probable(_observed(system, data, model, q), prior, shapes[q])
        model = model._replace(shapes=shapes)
        system = _changed(system, data, q, _spread(data.x, model, q) - before)
    return list(model.shapes)


def _changed(system: _System, data: _Data, q: int, change: np.ndarray) -> _System:
    """The system after a change of the covariance of one quantity (Woodbury's identity)."""
    count = len(data.x)
    rows = system.inverse[q * count : (q + 1) * count]
    own = rows[:, q * count : (q + 1) * count]
    inverse = system.inverse - rows.T @ np.linalg.solve(np.eye(count) + change @ own, change @ rows)
    return _System(inverse, inverse @ data.y.ravel())


def _student_weights(system: _System, model: _Model) -> np.ndarray:
    """Weights of Student's t from the posterior mean square of δ [quantities, keys] (EM)."""
    weights, scatter = model.weights, np.array([shape.scatter for shape in model.shapes])[:, None] ** 2
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
