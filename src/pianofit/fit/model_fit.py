"""Any model of a plucked, struck or otherwise ringing sound, fitted to one recording.

First eq. 19 over the whole spectrum, from several starts at once, with σ falling: broad lines lead to the basin, narrow
ones to its floor. Eq. 19 is a poor estimator, though: loud partials rule it, whatever their noise. So the last stage
divides each difference of energies by what measured noise makes of it, and its curvature gives the intervals.

On the damped circle noise of density D/2 (two-sided) is N with E[N_i N̄_j] = (D/2)/(2σ + j(ω_i - ω_j)): neighbouring
bins share it. |S|² = |Y + N|² then has the mean |Y|² + v and the covariance 2 Re(Ȳ_i Y_j E[N_i N̄_j]) + |E[N_i N̄_j]|²,
which stands between the curvature's inverses (a sandwich). Where the model misses by more, intervals are widened to
what it misses by.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import stdtrit

from ..analysis import Analysis
from ..criterion import line_sigma
from ..errors import ParameterError
from ..recording import Recording
from .levenberg import Descent, descend, in_groups
from .residuals import CENT
from .space import Box
from .spectral import Goal, SoundModel, best_gain, model_energy, residual_batch, spectral_goal

__all__ = ["ModelFit", "fit_model"]

# σ of the stages in units of the criterion's, and exp(-σT) is left where the recording ends: -σT = 14 leaves 1e-6.
SIGMAS, ENOUGH = (1.0, 0.35, 0.12), 14.0
ITERATIONS, ROUNDS = 30, 4
# Starts that go on after the first stage, and by how much the criteria of those may differ that ended at one place.
FINALISTS, AGREEMENT = 2, 1e-3
# Every second of the criterion's nodes: they stand closer than noise and lines change.
EVERY = 2
# A standard deviation of log(value) above this is no knowledge.
LOOSE = 0.5
# Eigenvalues of the scaled curvature below this are rounding.
FLOOR = 1e-14
# A noise that is not there is taken to lie this far below the loudest bin, energies.
SILENCE = 1e-16


class ModelFit(NamedTuple):
    """What a recording says about a model's parameters."""

    values: dict[str, float]
    intervals: dict[str, tuple[float, float] | None]  # 95 %; None for what was held or stopped at a bound
    covariance: np.ndarray  # of log(value), [parameters, parameters]
    gain: float  # full scale of the recording per unit of the model's signal
    cost: float  # eq. 19 over the whole spectrum: 0 for equal sounds, 1 for silence
    misfit: float  # rms difference over what noise explains; the intervals are widened by it where it is above 1
    converged: bool
    agreeing: int  # how many of the starts ended at the lowest cost; 0 where there was one only
    messages: tuple[str, ...]


def fit_model(
    model: SoundModel, recording: Recording, analysis: Analysis, start: Mapping[str, float], *,
    spread: Mapping[str, float] | None = None, starts: int = 8, scale: float | None = None, begins: float | None = None,
    seed: int = 0,
) -> ModelFit:  # fmt: skip
    """Fit `model` to one recording.

    Parameters
    ----------
    start : a value for each of the model's parameters.
    spread : by name, the standard deviation of log(value) about `start` for what is not known well; the first of the
        `starts` is `start` itself, the others are thrown.
    scale : the model's unit at digital full scale; None leaves the gain free.
    begins : where in the recording the model's sound begins, s; its onset by default. It matters where `scale` is
        given, for a sound that begins earlier has decayed further.

    Raises
    ------
    ParameterError
        For a model or a start that cannot be used.
    """
    box, z, width = _checked(model, start, spread or {})
    view = _View.of(recording, analysis, scale, begins)
    throw = np.random.default_rng(seed).standard_normal((starts if width.any() else 1, len(z)))
    throw[0] = 0.0
    z, batch = box.project(z + width * throw), residual_batch(model)
    wide, *narrower = view.sigmas
    end = descend(_on(batch, view.goal(wide), len(z)), z, box, iterations=ITERATIONS, tolerance=1e-4)
    agreeing = int((end.cost <= end.cost.min() + AGREEMENT).sum()) if len(z) > 1 else 0
    z = end.z[np.argsort(end.cost)[:FINALISTS]]
    for sigma in narrower:
        end = descend(_on(batch, view.goal(sigma), len(z)), z, box, iterations=ITERATIONS, tolerance=1e-4)
        z = end.z[np.argsort(end.cost)[:FINALISTS]]
    if not np.isfinite(end.cost).any():
        raise ParameterError("no start gives a finite spectrum; choose others, or narrower bounds")
    found = _estimate(model, batch, view, box, z[:1])
    return _concluded(model, batch, view, box, found, agreeing)


class _View(NamedTuple):
    """The recording as the goals are made from it."""

    recording: Recording
    analysis: Analysis
    last: int
    scale: float | None
    delay: float
    sigmas: tuple[float, ...]

    @classmethod
    def of(cls, recording: Recording, analysis: Analysis, scale: float | None, begins: float | None) -> _View:
        onset = recording.onset / recording.rate
        seconds = len(recording.samples) / recording.rate - onset
        glide = 2 * np.pi * abs(analysis.glide_cents) * CENT * analysis.f0
        sigmas = tuple(max(s * line_sigma(analysis.f0), ENOUGH / seconds, 8 * glide) for s in SIGMAS)
        delay = 0.0 if begins is None else onset - begins
        return cls(recording, analysis, int(analysis.partials.number.max()), scale, delay, sigmas)

    def goal(self, sigma: float) -> Goal:
        """Eq. 19's view of the recording."""
        r, a = self.recording, self.analysis
        return spectral_goal(
            r.samples[r.onset :], r.rate, a.f0, a.B, self.last, sigma,
            delay=self.delay, unit=self.scale or 1.0, calibrated=self.scale is not None, every=EVERY,
        )  # fmt: skip

    def noise(self, goal: Goal) -> np.ndarray:
        """One-sided density of the noise, unit²/Hz, at every row of `goal`."""
        p = self.analysis.partials
        middle = np.asarray(goal.frequency).mean(axis=1)
        density = np.interp(middle, p.frequency, self.analysis.noise_density) * (self.scale or 1.0) ** 2
        least = 4 * float(goal.sigma) * SILENCE * float(goal.energy.max())
        return np.maximum(density, least)


def _checked(model: SoundModel, start: Mapping[str, float], spread: Mapping[str, float]):
    """The box, the start and its spreads in logarithms."""
    lower, upper = np.asarray(model.lower, float), np.asarray(model.upper, float)
    if not len(model.names) == len(lower) == len(upper):
        raise ParameterError(f"model: {len(model.names)} names, {len(lower)} lower and {len(upper)} upper bounds")
    if set(start) != {*model.names}:
        raise ParameterError(f"start: values for {', '.join(start)}; the model has {', '.join(model.names)}")
    for name, low, high in zip(model.names, lower, upper, strict=True):
        if not 0 < low <= high < math.inf:
            raise ParameterError(f"model: bounds of {name}, {low:g} to {high:g}, must be positive and in order")
        if not low <= start[name] <= high:
            raise ParameterError(f"start: {name}={start[name]!r} must be from {low:g} to {high:g}")
    for name, sd in spread.items():
        if name not in model.names or not 0 <= sd < math.inf:
            raise ParameterError(f"spread: {name}={sd!r} must be a parameter's name and a number that is not negative")
    z = np.log([start[name] for name in model.names])
    shape = jax.eval_shape(model.spectrum, jnp.exp(z), jnp.zeros(7), jnp.asarray(1.0))
    if getattr(shape, "shape", None) != (7,) or shape.dtype.kind != "c":
        raise ParameterError("model: spectrum(values, frequency, sigma) must return one complex number a frequency")
    return Box(np.log(lower), np.log(upper)), z, np.array([spread.get(name, 0.0) for name in model.names])


def _on(batch: Callable, goal: Goal, rows: int) -> Callable:
    return in_groups(lambda z: batch(jnp.asarray(z), goal), rows)


def _spectrum(model: SoundModel, z: np.ndarray, goal: Goal, delay: float) -> np.ndarray:
    """Y on the recording's axis of time, with the gain, complex [rows, nodes]."""
    y = model.spectrum(jnp.exp(jnp.asarray(z)), goal.frequency.ravel(), goal.sigma).reshape(goal.frequency.shape)
    gain = jnp.sqrt(best_gain(y.real**2 + y.imag**2, goal))
    return np.asarray(y * gain * jnp.exp((goal.sigma + 2j * jnp.pi * goal.frequency) * delay))


def _estimate(model: SoundModel, batch: Callable, view: _View, box: Box, z: np.ndarray) -> tuple[Descent, Goal]:
    """Weights from the model's energies and the noise, energies from the weights, in turn."""
    plain = view.goal(view.sigmas[-1])
    noise = view.noise(plain)[:, None] / (4 * view.sigmas[-1])
    present = np.asarray(plain.weight) > 0
    goal, rounds = plain, 0
    while True:
        energy = np.abs(_spectrum(model, z[0], goal, view.delay)) ** 2
        sd = np.sqrt(2 * energy * noise + noise**2)
        # `miss` carries a factor √2: half the sum of squares of (difference/sd) is the cost.
        weight = np.where(present, 1 / (math.sqrt(2) * sd), 0.0)
        goal = plain._replace(weight=jnp.asarray(weight), energy=plain.energy - noise)
        end = descend(_on(batch, goal, len(z)), z, box, iterations=ITERATIONS, tolerance=1e-8)
        moved, z, rounds = np.abs(end.z - z).max(), end.z, rounds + 1
        if moved < 1e-6 or rounds == ROUNDS:
            return end, goal


def _shared_noise(model: SoundModel, view: _View, z: np.ndarray, goal: Goal) -> np.ndarray:
    """Covariance of the residuals [rows, nodes, nodes]; cells are apart enough to share no noise."""
    y, weight = _spectrum(model, z, goal, view.delay), math.sqrt(2) * np.asarray(goal.weight)
    apart = np.asarray(goal.frequency)[:, :, None] - np.asarray(goal.frequency)[:, None, :]
    noise = view.noise(goal)[:, None, None] / 2 / (2 * float(goal.sigma) + 2j * np.pi * apart)
    shared = 2 * (y.conj()[:, :, None] * y[:, None, :] * noise).real + np.abs(noise) ** 2
    return weight[:, :, None] * weight[:, None, :] * shared


class _Spread(NamedTuple):
    """How far the estimate may be off."""

    covariance: np.ndarray  # of log(value)
    misfit: float
    freedom: float  # independent differences left


def _sandwich(jacobian: np.ndarray, residual: np.ndarray, shared: np.ndarray, active: np.ndarray) -> _Spread:
    """Noise `shared` by the residuals [rows, nodes, nodes] between the inverses of the curvature of the `active`."""
    j = jacobian[:, active]
    by_cell = j.reshape(*shared.shape[:2], len(active))
    scale = np.sqrt((j**2).sum(axis=0)) + 1e-150
    # An eigenvalue at the rounding floor is a direction without any data: its variance is huge, not infinite.
    value, vector = np.linalg.eigh((j / scale).T @ (j / scale))
    known, blind = vector[:, value > FLOOR] / scale[:, None], vector[:, value <= FLOOR] / scale[:, None]
    inverse = known / value[value > FLOOR] @ known.T
    inner = np.einsum("rni,rnm,rmj->ij", by_cell, shared, by_cell, optimize=True)
    full = np.einsum("rnn->", shared)
    # What the squares should add up to, and how many independent ones that is.
    expected = max(full - np.trace(inverse @ inner), 1e-300)
    misfit = math.sqrt((residual**2).sum() / expected)
    covariance = np.zeros((jacobian.shape[1],) * 2)
    covariance[np.ix_(active, active)] = inverse @ inner @ inverse * max(misfit, 1.0) ** 2 + blind @ blind.T / FLOOR
    return _Spread(covariance, misfit, max(full**2 / (shared**2).sum() - len(active), 1.0))


def _concluded(model: SoundModel, batch: Callable, view: _View, box: Box, found: tuple[Descent, Goal], agreeing: int):
    (end, goal), names = found, model.names
    z = end.z[0]
    pressed = box.free & ((z <= box.lower) | (z >= box.upper))
    shared = _shared_noise(model, view, z, goal)
    spread = _sandwich(end.jacobian[0], end.residual[0], shared, np.flatnonzero(box.free & ~pressed))
    # A bound that went through a logarithm and back comes out beside itself.
    values = np.where(z <= box.lower, model.lower, np.where(z >= box.upper, model.upper, np.exp(z)))
    sd = np.sqrt(np.diag(spread.covariance))
    reach = np.exp(np.minimum(stdtrit(spread.freedom, 0.975) * sd, 700.0))
    broad = view.goal(view.sigmas[0])
    gain = float(np.sqrt(best_gain(model_energy(model, jnp.asarray(z), goal), goal))) / (view.scale or 1.0)
    return ModelFit(
        values=dict(zip(names, values.tolist(), strict=True)),
        intervals={
            name: (float(v / r), float(v * r)) if r > 1 else None
            for name, v, r in zip(names, values, reach, strict=True)
        },
        covariance=spread.covariance,
        gain=gain,
        cost=0.5 * float((np.asarray(batch(jnp.asarray(z[None]), broad)[0]) ** 2).sum()),
        misfit=spread.misfit,
        converged=bool(end.settled[0]),
        agreeing=agreeing,
        messages=_messages(names, pressed, sd, spread.misfit, bool(end.settled[0]), agreeing),
    )


def _messages(
    names, pressed: np.ndarray, sd: np.ndarray, misfit: float, settled: bool, agreeing: int
) -> tuple[str, ...]:
    """What to beware of, the weightiest first."""
    bound = [name for name, at in zip(names, pressed, strict=True) if at]
    vague = [name for name, s in zip(names, sd, strict=True) if s > LOOSE]
    said = [
        "" if settled else "The search stopped before it settled; no value is a result.",
        f"At a bound, so their values are the box's: {', '.join(bound)}." if bound else "",
        f"Not identifiable from this recording: {', '.join(vague)}." if vague else "",
        "Only one start reached the lowest criterion; more starts may find a better one." if agreeing == 1 else "",
        f"The model misses by {misfit:.1f} times the noise; the intervals are widened by that." if misfit > 2 else "",
    ]
    return tuple(text for text in said if text)
