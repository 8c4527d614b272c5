"""The posterior of the law of one quantity over the keyboard, and of the values of single keys.

    y(n) = f(n) + δ(n) + e(n),     e ~ N(0, noise)

relative to the literature. Few keys hardly determine the size and length of the law f and the scatter of δ, so the
posterior is a mean over them. Their posterior density is computed at the points of a grid, along the principal axes of
the information at the most probable shape (Rue, Martino and Chopin 2009, "integrated nested Laplace approximations").
"""

import itertools
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
# Standard deviations of the prior of the logarithms of size, scatter and length.
SHAPE_SD = np.array([FACTOR, FACTOR, LENGTH_FACTOR])
# Points of the grid on each axis, standard deviations: its ends hold the tails of a posterior as wide as the prior.
STEPS = (-2.4, -1.2, 0.0, 1.2, 2.4)
# Range of the search for the most probable shape, standard deviations of the prior.
RANGE = 4.0


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

    def sd_at(self, midi: float) -> float:
        """Standard deviation of one key of any instrument from the literature, at the median shape."""
        smooth, scatter, _ = self.medians
        return float(np.sqrt(self.offset**2 + (self.slope_sd * (midi - MIDDLE) / HALF) ** 2 + smooth**2 + scatter**2))


class LawShape(NamedTuple):
    """Spreads of one quantity over the keyboard, on the scale of its law: numbers, or arrays of several shapes."""

    smooth: Any  # standard deviation of the Gaussian process
    scatter: Any  # scale of Student's t of single keys
    length: Any  # of the Gaussian process, keys


class Observed(NamedTuple):
    """One quantity of some keys."""

    x: np.ndarray  # keys [keys]
    y: np.ndarray  # deviations from the literature [keys]
    noise: np.ndarray  # covariance of their errors [keys, keys]
    weights: np.ndarray  # of Student's t [keys]


class QuantityLaw(NamedTuple):
    """Means and standard deviations of f at some keys, and of f + δ at the observed ones."""

    law: np.ndarray  # [at]
    law_sd: np.ndarray  # [at]
    value: np.ndarray  # [keys]
    value_sd: np.ndarray  # [keys]
    scatter_sd: float  # of δ of a key that was not observed


class _System(NamedTuple):
    """The Gaussian model of the observed keys, for every shape."""

    inverse: np.ndarray  # of the covariance [..., keys, keys]
    solved: np.ndarray  # inverse times y [..., keys]
    log_density: np.ndarray  # [...]


def law_covariance(a: np.ndarray, b: np.ndarray, shape: LawShape, prior: Prior) -> np.ndarray:
    """Covariance of f between keys `a` and `b`, for every shape [..., a, b]."""
    smooth, length = (np.asarray(x)[..., None, None] for x in (shape.smooth, shape.length))
    tilt = np.outer(a - MIDDLE, b - MIDDLE) / HALF**2
    near = np.exp(-0.5 * ((a[:, None] - b) / length) ** 2)
    return prior.offset**2 + prior.slope_sd**2 * tilt + smooth**2 * near


def key_variance(weights: np.ndarray, shape: LawShape) -> np.ndarray:
    """Variances of δ, for every shape [..., keys]."""
    return np.asarray(shape.scatter)[..., None] ** 2 / weights


def most_probable(observed: Observed, prior: Prior, start: LawShape) -> LawShape:
    """Return the shape with the highest posterior density of its logarithms."""

    def cost(u: np.ndarray) -> tuple[float, np.ndarray]:
        density, gradient = log_posterior(observed, prior, u)
        return -density, -gradient

    first = (np.log(start) - np.log(prior.medians)) / SHAPE_SD
    found = minimize(cost, first, jac=True, method="L-BFGS-B", bounds=[(-RANGE, RANGE)] * len(first))
    return _shape(prior, found.x)


def log_posterior(observed: Observed, prior: Prior, u: np.ndarray) -> tuple[float, np.ndarray]:
    """Log density of a shape, and its gradient.

    Parameters
    ----------
    u : logarithms of size, scatter and length over their medians, in standard deviations of the prior [3].
    """
    shape = _shape(prior, u)
    system = _solve(observed, prior, shape)
    change = np.outer(system.solved, system.solved) - system.inverse
    gradient = SHAPE_SD * 0.5 * np.einsum("ij,pij->p", change, _derivatives(observed, shape))
    return float(system.log_density - 0.5 * u @ u), gradient - u


def integrate(observed: Observed, prior: Prior, mode: LawShape, at: np.ndarray) -> QuantityLaw:
    """Return the posterior of f and δ, as a mean over the shapes around the most probable one.

    Parameters
    ----------
    mode : the most probable shape.
    at : keys at which f is evaluated [at].
    """
    u = _grid(observed, prior, mode)
    shapes = _shape(prior, u)
    system = _solve(observed, prior, shapes)
    log_share = system.log_density - 0.5 * (u**2).sum(axis=1)
    share = np.exp(log_share - log_share.max())
    share /= share.sum()
    scatter = key_variance(observed.weights, shapes)
    cross = law_covariance(at, observed.x, shapes, prior)
    own = cross[:, np.searchsorted(at, observed.x)] + scatter[:, :, None] * np.eye(len(observed.x))
    law_variance = np.diagonal(law_covariance(at, at, shapes, prior), axis1=1, axis2=2)
    value_variance = np.diagonal(own, axis1=1, axis2=2)
    law, law_sd = _mixture(share, cross, law_variance, system)
    value, value_sd = _mixture(share, own, value_variance, system)
    return QuantityLaw(
        law, law_sd, value, value_sd, float(np.sqrt(STUDENT / (STUDENT - 2) * share @ shapes.scatter**2))
    )


def _shape(prior: Prior, u: np.ndarray) -> LawShape:
    return LawShape(*np.exp(np.log(prior.medians) + SHAPE_SD * u).T)


def _solve(observed: Observed, prior: Prior, shape: LawShape) -> _System:
    total = law_covariance(observed.x, observed.x, shape, prior) + observed.noise
    total = total + key_variance(observed.weights, shape)[..., None] * np.eye(len(observed.x))
    root = np.linalg.inv(np.linalg.cholesky(total))
    inverse = np.swapaxes(root, -1, -2) @ root
    solved = inverse @ observed.y
    log_root = np.log(np.diagonal(root, axis1=-2, axis2=-1)).sum(axis=-1)
    return _System(inverse, solved, log_root - 0.5 * solved @ observed.y)


def _derivatives(observed: Observed, shape: LawShape) -> np.ndarray:
    """Derivatives of the covariance by the logarithms of size, scatter and length [3, keys, keys]."""
    square = ((observed.x[:, None] - observed.x) / shape.length) ** 2
    near = shape.smooth**2 * np.exp(-0.5 * square)
    return np.array([2 * near, 2 * np.diag(key_variance(observed.weights, shape)), near * square])


def _grid(observed: Observed, prior: Prior, mode: LawShape) -> np.ndarray:
    """Points along the principal axes of the expected information, as in `log_posterior` [points, 3]."""
    inverse = _solve(observed, prior, mode).inverse
    relative = inverse @ _derivatives(observed, mode)
    information = np.eye(3) + 0.5 * np.outer(SHAPE_SD, SHAPE_SD) * np.einsum("pij,qji->pq", relative, relative)
    precision, axes = np.linalg.eigh(information)
    middle = (np.log(mode) - np.log(prior.medians)) / SHAPE_SD
    return middle + (np.array(list(itertools.product(STEPS, repeat=3))) / np.sqrt(precision)) @ axes.T


def _mixture(share: np.ndarray, cross: np.ndarray, variance: np.ndarray, system: _System) -> tuple[Any, Any]:
    """Mean and standard deviation over all shapes, from covariances with the observed keys [shapes, at, keys]."""
    means = np.einsum("sak,sk->sa", cross, system.solved)
    variance = variance - np.einsum("sak,sak->sa", cross @ system.inverse, cross)
    mean = share @ means
    return mean, np.sqrt(np.maximum(share @ (variance + (means - mean) ** 2), 0.0))
