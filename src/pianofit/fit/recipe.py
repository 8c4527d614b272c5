"""The fit of one recording, stage by stage.

1. The string, on the paper's criterion in bands 1 and 2, from where the analysis put it, with σ falling.
2. The hammer, on the paper's criterion in band 3, from many starts at once: this finds the basin.
3. The hammer on levels in dB through the unknown path, the best of those starts.
4. String and hammer together, weighted by noise and scatter, until the weights settle: this gives the estimate.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np

from ..analysis import Analysis
from ..criterion import PATH_SPREAD, PATH_TERMS
from ..errors import FitError
from ..initial import Start
from ..model import simulate
from ..model.simulate import count_modes
from ..parameters import Geometry
from ..recording import Recording
from .levenberg import Descent, descend
from .misfit import huber, scatter
from .residuals import Cfg, Target, hammer_batch, joint_batch, string_batch
from .space import NAMES, SIZE, Space, default_box, split, struck
from .target import CENT, ROWS, Measured, Spreads, doubt, lines, measured, target
from .voice import arrival, lag

__all__ = ["Fit", "fit_partials", "predicted"]

STARTS, BATCHES = 16, 4
# A search's contacts last a whole number of times this many steps, so that notes share compiled programs.
STEPS = 256
# Power of energy by which levels are weighed, and iterations: loud partials lead to the basin, all of them finish.
GRADES = ((0.25, 30), (0.0, 15))
# How much of the attack, s, tells when the hammer touched.
ATTACK = 0.05
# Starts whose costs differ by less than this ended at the same place.
AGREEMENT = 0.5
# σ of the string's stage in units of the criterion's: wide lines first. Glide blurs what is finer than the second.
SIGMAS = (1.0, 0.35)
ROUNDS = 4
# Levels better known than this, dB, show the contact's step; the last stage then takes a finer one.
FINE_LEVEL, REFINEMENT = 0.05, 8
# A band whose criterion is 1, as for silence, costs half this much where the path is unknown: there it is not noise
# that says which partials matter.
CRITERION = 100.0
# Levels of a calibrated recording that scatter more than this, dB, ask for a contact window of another shape, for which
# a raised cosine of another width is a good stand-in.
WINDOW_SCATTER, WIDTH = 0.01, NAMES.index("width")
# The model's window, as given or of an effective width, is a stand-in all the same: levels through it are off by about
# this much, dB, however well they can be fitted.
STAND_IN = {False: 0.003, True: 0.01}
# No real path is as smooth as the model's, dB; a few partials would otherwise be fitted to the last digit.
LEAST_SCATTER = 1.0
# Before the first round the model is taken to miss a partial by this much, dB.
FIRST_SCATTER = {True: 1.0, False: 4.0}

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Fit:
    """Where the search ended, before it is put into words."""

    z: np.ndarray  # [1, size]
    values: np.ndarray  # [size]: in the order of `NAMES`, then gain and path in dB
    space: Space
    data: Measured
    spread: Spreads
    robust: np.ndarray  # [3, partials]
    target: Target
    cfg: Cfg
    jacobian: np.ndarray  # [residuals, size]
    residual: np.ndarray  # [residuals]
    cost: float
    pressed: np.ndarray  # [size]
    converged: bool
    evaluations: int
    agreeing: int  # how many of the hammer's starts ended at the lowest cost
    messages: tuple[str, ...]
    state: State


def search_space(start: Start) -> Space:
    """The box and the starting point [size]; gain and path start at 0 dB."""
    lower, upper = default_box(start.geometry.length, start.geometry.width)
    for name, (low, high) in start.bounds.items():
        lower[NAMES.index(name)], upper[NAMES.index(name)] = low, high
    blank = np.zeros(SIZE - len(NAMES))
    values = np.append([start.values[n] for n in NAMES], blank)
    calibrated, known = start.scale is not None, start.quantity != "pressure"
    free = np.append([n not in start.fixed for n in NAMES], [not calibrated] + [not (calibrated or known)] * PATH_TERMS)
    lower, upper = np.where(free, lower, values), np.where(free, upper, values)
    spread = np.concatenate([[start.spread[n] for n in NAMES], [np.inf], PATH_SPREAD])
    return Space(lower, upper, free, np.clip(values, lower, upper), spread, 0.0)


def fit_partials(
    recording: Recording, analysis: Analysis, start: Start, *, seed: int = 0, progress: Progress = lambda *_: None
) -> Fit:
    """Fit the nine parameters, and the strike position where it is not known.

    Raises
    ------
    FitError
        If no start leads to a finite cost.
    """
    state = _prepared(recording, analysis, start)
    programs = [_compiled_ahead(hammer_batch, state, STARTS), _compiled_ahead(joint_batch, state, 1)]
    try:
        progress("string", 0.1)
        space, count = _string_stage(recording, analysis, state)
        state = replace(state, space=space)
        progress("hammer", 0.3)
        programs[0].join()
        z, agreeing, searched = _hammer_stage(state, seed)
        progress("string and hammer", 0.6)
        programs[1].join()
        fit = _joint_stage(state, z)
        if state.data.calibrated:
            fit = _with_attack(recording, fit)
        if fit.spread.level < FINE_LEVEL and np.median(state.data.partials.level_error) < FINE_LEVEL:
            progress("refinement", 0.8)
            fit = _refined(fit)
    finally:
        # A program that still compiles when Python ends would take it down; after Ctrl-C too.
        for program in programs:
            program.join()
    progress("done", 1.0)
    return replace(fit, agreeing=agreeing, evaluations=fit.evaluations + count + searched)


def _prepared(recording: Recording, analysis: Analysis, start: Start) -> State:
    """Choose the contact's rate and length, and what the programs are compiled for, from the literature's strike."""
    space = search_space(start)
    data = measured(recording, analysis, start)
    string, hammer = split(space.start)
    first = simulate(string, hammer, start.geometry, rate=recording.rate, quantity=start.quantity)
    space = replace(space, log_u=float(np.log(0.5 * first.pulse.compression.max())))
    rate = 1.0 / float(first.modes.step)
    steps = STEPS * int(np.ceil(1.6 * first.contact_time * rate / STEPS))
    rows = max(first.modes.pole.shape[0], ROWS * int(np.ceil(data.partials.number.max() / ROWS)))
    cfg = Cfg(rows, steps, start.quantity, data.calibrated)
    delay = arrival(string, start.geometry, start.quantity)
    return State(data, start, space, rate, delay, cfg, 0.0 if data.calibrated else CRITERION)


def _compiled_ahead(function: Callable, state: State, starts: int) -> threading.Thread:
    """Call a batch function once, in a thread: its program compiles while the stages before it run."""

    def call() -> None:
        at = state.target(Spreads(1.0, 0.3, FIRST_SCATTER[state.data.calibrated]), np.ones((3, state.data.found)))
        function(jnp.asarray(np.tile(state.space.z(state.space.start), (starts, 1))), at, state.cfg)

    thread = threading.Thread(target=call, daemon=True)
    thread.start()
    return thread


def _with_attack(recording: Recording, fit: Fit) -> Fit:
    """The fit of a calibrated recording gone on with what its attack tells.

    The onset is where a sound is first seen; a model this close says when the hammer touched. If it still misses by
    more than noise, there is no path to blame: the felt's window is of another shape than the model's.
    """
    state = replace(fit.state, delay=_touch(recording, fit))
    fit = _joint_stage(state, fit.z, fit.spread, fit.robust)
    if fit.spread.level <= WINDOW_SCATTER or state.space.free[WIDTH]:
        return fit
    state = replace(state, space=_with_free_width(state.space, state.start.geometry))
    fit = _joint_stage(state, fit.z, fit.spread, fit.robust)
    state = replace(state, delay=_touch(recording, fit))
    return _joint_stage(state, fit.z, fit.spread, fit.robust)


def _refined(fit: Fit) -> Fit:
    """The fit gone on with a finer step of the contact."""
    state = fit.state
    rate = state.rate * REFINEMENT
    string, _ = split(fit.values)
    rows = max(state.cfg.n_modes, count_modes(string, state.start.geometry, rate))
    state = replace(state, rate=rate, cfg=state.cfg._replace(steps=state.cfg.steps * REFINEMENT, n_modes=rows))
    return _joint_stage(state, fit.z, fit.spread, fit.robust)


def _with_free_width(space: Space, geometry: Geometry) -> Space:
    lower, upper = default_box(geometry.length, geometry.width)
    this = np.arange(SIZE) == WIDTH
    return replace(
        space,
        free=space.free | this,
        lower=np.where(this, lower, space.lower),
        upper=np.where(this, upper, space.upper),
    )


def _touch(recording: Recording, fit: Fit) -> float:
    """When the hammer touched before the recording's onset, s, by laying the fitted sound's attack on the recorded."""
    string, hammer = split(fit.values)
    geometry = struck(fit.state.start.geometry, fit.values)
    samples = int(ATTACK * recording.rate)
    model = simulate(string, hammer, geometry, rate=recording.rate, quantity=fit.state.start.quantity)
    guess = recording.onset - round(float(fit.target.delay) * recording.rate)
    heard = np.pad(recording.samples, (max(-guess, 0), samples))[max(guess, 0) :][:samples]
    late = lag(model.waveform(recording.rate, samples), heard)
    return (recording.onset - guess - late) / recording.rate


@dataclass(frozen=True)
class State:
    """What the stages after the string's share."""

    data: Measured
    start: Start
    space: Space
    rate: float
    delay: float
    cfg: Cfg
    criterion: float

    def target(self, spread: Spreads, robust: np.ndarray, grade: float = 0.0) -> Target:
        """The recording, weighted."""
        return target(
            self.data, self.start, self.space, spread, robust, rate=self.rate, delay=self.delay, grade=grade,
            criterion=self.criterion,
        )  # fmt: skip

    def evaluate(self, function, at: Target):
        return lambda z: function(jnp.asarray(z), at, self.cfg)


def _string_stage(recording: Recording, analysis: Analysis, state: State) -> tuple[Space, int]:
    """c and b1 in band 1, κ and b2 in band 2 (paper IV.C, steps 1 and 2), near where the analysis put them."""
    space, data = state.space, state.data
    near = {
        "c": 1 + 10 * max(analysis.f0_error / analysis.f0, CENT),
        "kappa": 1 + 5 * max(analysis.B_error / max(analysis.B, 1e-9), 0.02),
        "b1": 1.5,
        "b2": 2.0,
    }
    factor = np.array([near.get(n, 1.0) for n in NAMES] + [1.0] * (SIZE - len(NAMES)))
    local = replace(
        space, lower=np.maximum(space.lower, space.start / factor), upper=np.minimum(space.upper, space.start * factor)
    )
    z, count = local.z(local.start[None]), 0
    glide = 2 * np.pi * abs(analysis.glide_cents) * CENT * analysis.f0
    for wanted, names in ((0, ("c", "b1")), (1, ("kappa", "b2"))):
        band = next((b for b in data.occupied if b >= wanted), max(data.occupied))  # or the next occupied one
        free = np.append(np.isin(NAMES, names), np.zeros(SIZE - len(NAMES), bool))
        for narrow in SIGMAS:
            sigma = max(narrow * data.sigma, 8 * glide)
            cells = lines(recording, analysis, data, band, sigma, state.start, state.rate)
            end = descend(
                lambda z, cells=cells: string_batch(jnp.asarray(z), cells, state.cfg),
                z, local, iterations=8, free=free, tolerance=1e-4,
            )  # fmt: skip
            z, count = end.z, count + end.evaluations
    return replace(space, start=local.natural(z[0])), count


def _hammer_stage(state: State, seed: int) -> tuple[np.ndarray, int, int]:
    """Hammers by the batch, until two of them end at the same lowest cost or `BATCHES` are spent. The best [1, size].

    Of a calibrated recording a hammer should explain all but the first scatter; many can agree on one that does not.
    """
    random = np.random.default_rng(seed)
    z, cost, count, agreeing = np.zeros((0, SIZE)), np.zeros(0), 0, 0
    for batch in range(BATCHES):
        throw = random.standard_normal((STARTS, SIZE))
        if batch == 0:
            throw[0] = 0.0  # the literature's own hammer is one of the starts
        end, evaluations = _hammers(state, throw)
        z, cost, count = np.append(z, end.z, axis=0), np.append(cost, end.cost), count + evaluations
        agreeing = int((cost < cost.min() + AGREEMENT).sum())
        if agreeing > 1 and not (state.data.calibrated and cost.min() > 0.5 * state.data.found):
            break
    if not np.isfinite(cost).any():
        raise FitError("no hammer within the bounds gives a finite sound; widen [bounds] or check [known] in the setup")
    best = int(np.argmin(cost))
    return z[best : best + 1], agreeing, count


def _hammers(state: State, throw: np.ndarray) -> tuple[Descent, int]:
    """Many hammers on one string: eq. 19 in the hammer's band, then levels, the loud ones first.

    `throw` [starts, size] is where they start, in units of the literature's spread.
    """
    space, data = state.space, state.data
    robust = np.ones((3, len(data.partials)))
    spread = Spreads(10.0, 1.0, FIRST_SCATTER[data.calibrated])
    hammer = np.arange(SIZE) >= 4
    physical = hammer & (np.arange(SIZE) < len(NAMES)) & np.isfinite(space.spread)
    z = space.z(space.start[None]) + throw * np.where(physical, space.spread, 0.0)
    at = state.target(spread, robust)
    by_energy = at._replace(by_energy=jnp.ones_like(at.by_energy))
    end = descend(state.evaluate(hammer_batch, by_energy), z, space, iterations=20, free=physical, tolerance=1e-3)
    z, count = _levelled(state, at, end.z), end.evaluations
    for grade, iterations in GRADES:
        at = state.target(spread, robust, grade)
        end = descend(state.evaluate(hammer_batch, at), z, space, iterations=iterations, free=hammer, tolerance=1e-4)
        z, count = end.z, count + end.evaluations
    return end, count


def _levelled(state: State, at: Target, z: np.ndarray) -> np.ndarray:
    """The points `z` [starts, size] with the gain at which each is right on average."""
    if state.data.calibrated:
        return z
    level = np.asarray(hammer_batch(jnp.asarray(z), at, state.cfg)[2])[:, 2]
    weight = np.asarray(at.level_weight) ** 2
    z = z.copy()
    z[:, len(NAMES)] = np.clip(((np.asarray(at.level) - level) * weight).sum(axis=1) / weight.sum(), -300, 300)
    return z


def _joint_stage(state: State, z, spread: Spreads | None = None, robust: np.ndarray | None = None) -> Fit:
    """All together; weights from the residuals, residuals from the weights, until they agree."""
    data, count, rounds = state.data, 0, 0
    spread = spread or Spreads(1.0, 0.3, FIRST_SCATTER[data.calibrated])
    robust = np.ones((3, len(data.partials))) if robust is None else robust
    while True:
        at = state.target(spread, robust)
        end = descend(state.evaluate(joint_batch, at), z, state.space, iterations=60, tolerance=1e-8)
        z, count, rounds, before = end.z, count + end.evaluations, rounds + 1, spread
        spread, robust = _weights(state, at, z)
        agreed = abs(spread.level - before.level) < 0.02 * spread.level + 1e-4
        if rounds == ROUNDS or (agreed and end.settled[0]):
            return _ended(state, end, at, before, robust, count)


def _weights(state: State, at: Target, z: np.ndarray) -> tuple[Spreads, np.ndarray]:
    """Scatter of each kind of residual about the model at `z` [1, size], and Huber's factors."""
    data, p = state.data, state.data.partials
    observed = np.stack([p.frequency, p.decay, data.level[: data.found]])
    frequency, decay, level = observed - predicted(data, at, state.cfg, z[0])
    cent = p.frequency * CENT * doubt(p.number)
    cents, cents_sd, decay_sd = frequency / cent, p.frequency_error / cent, p.decay_error / p.decay
    hammer_freedom = float(state.space.free[4:].sum())
    spread = Spreads(
        scatter(cents, cents_sd, 2),
        scatter(decay / p.decay, decay_sd, 2),
        scatter(level, p.level_error, hammer_freedom),
    )
    least = LEAST_SCATTER if state.start.quantity == "pressure" else STAND_IN[bool(state.space.free[WIDTH])]
    spread = replace(spread, level=max(spread.level, least))
    robust = np.stack(
        [
            huber(cents, np.hypot(cents_sd, spread.frequency)),
            huber(decay / p.decay, np.hypot(decay_sd, spread.decay)),
            huber(level, np.hypot(p.level_error, spread.level)),
        ]
    )
    return spread, robust


def predicted(data: Measured, at: Target, cfg: Cfg, z: np.ndarray) -> np.ndarray:
    """Frequency, Hz, decay, 1/s, and level, dB, of the model's partials [3, partials], with gain, path and noise."""
    frequency, decay, level = np.asarray(joint_batch(jnp.asarray(z[None]), at, cfg)[2])[0]
    level = level + np.asarray(at.basis) @ z[len(NAMES) :]
    level = 10 * np.log10(10 ** (level / 10) + 10 ** (np.asarray(at.floor) / 10))
    return np.stack([frequency, decay, level])[:, : data.found]


def _ended(state: State, end: Descent, at: Target, spread: Spreads, robust, count: int) -> Fit:
    values = state.space.natural(end.z[0])
    downhill = -(end.jacobian[0].T @ end.residual[0])
    pressed = state.space.at_bound(values) & (np.abs(downhill) > 0)
    messages = () if bool(end.settled[0]) else ("The last stage stopped before it settled.",)
    return Fit(
        end.z, values, state.space, state.data, spread, robust, at, state.cfg, end.jacobian[0], end.residual[0],
        float(end.cost[0]), pressed, bool(end.settled[0]), count, 0, messages, state,
    )  # fmt: skip
