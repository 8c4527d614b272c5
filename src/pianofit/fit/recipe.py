"""The fit of one or more takes of a string, stage by stage.

1. The string, on the paper's criterion in bands 1 and 2, from where the analysis put it, with σ falling.
2. The hammer, on the paper's criterion in band 3, from many starts at once: this finds the basin.
3. The hammer on levels in dB through the unknown path, the best of those starts.
4. String and hammer together, weighted by noise and scatter, until the weights settle: this gives the estimate.

Several takes share string, felt, hammer and path. Each has a velocity, a gain and a pitch of its own, and what their
levels have in common beyond the smooth path is the path's roughness, not the hammer's doing.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np

from ..errors import FitError
from ..initial import Start
from ..model import simulate
from ..model.simulate import count_modes
from ..parameters import Geometry
from .levenberg import Descent, descend
from .residuals import CENT, Cfg, Target, hammer_batch, joint_batch, string_batch
from .space import LOG, NAMES, Layout, Space, default_box, split, struck
from .state import WIDTH, State, predicted, search_space, settled_weights
from .takes import Take
from .target import Spreads, Takes, lines, measured, side_by_side
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
WINDOW_SCATTER = 0.01

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Fit:
    """Where the search ended, before it is put into words."""

    z: np.ndarray  # [1, size]
    values: np.ndarray  # [size]: in the order of `NAMES`, then gain and path in dB
    space: Space
    data: Takes
    spread: Spreads
    robust: np.ndarray  # [3, takes, rows]
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


def fit_partials(
    takes: Sequence[Take], start: Start, layout: Layout, *, seed: int = 0, progress: Progress = lambda *_: None
) -> Fit:
    """Fit the nine parameters, the strike position where it is not known, and the takes' velocities over the first's.

    Raises
    ------
    FitError
        If no start leads to a finite cost.
    """
    state = _prepared(takes, start, layout)
    programs = [_compiled_ahead(hammer_batch, state, STARTS), _compiled_ahead(joint_batch, state, 1)]
    try:
        progress("string", 0.1)
        space, count = _string_stage(takes[0], state)
        state = replace(state, space=space)
        progress("hammer", 0.3)
        programs[0].join()
        z, agreeing, searched = _hammer_stage(state, seed)
        progress("string and hammer", 0.6)
        programs[1].join()
        fit = _joint_stage(state, z)
        if state.data.calibrated:
            fit = _with_attack(takes, fit)
        if fit.spread.level < FINE_LEVEL and np.median(state.data.level_error[state.data.found]) < FINE_LEVEL:
            progress("refinement", 0.8)
            fit = _refined(fit)
    finally:
        # A program that still compiles when Python ends would take it down; after Ctrl-C too.
        for program in programs:
            program.join()
    progress("done", 1.0)
    return replace(fit, agreeing=agreeing, evaluations=fit.evaluations + count + searched)


def _prepared(takes: Sequence[Take], start: Start, layout: Layout) -> State:
    """Choose the contact's rate and length, and what the programs are compiled for, from the literature's strike."""
    space = search_space(start, takes, layout)
    data = side_by_side(tuple(measured(take.recording, take.analysis, start) for take in takes), layout)
    string, hammer = split(space.start)
    rate = max(take.recording.rate for take in takes)
    first = simulate(string, hammer, start.geometry, rate=rate, quantity=start.quantity)
    space = replace(space, log_u=float(np.log(0.5 * first.pulse.compression.max())))
    rate = 1.0 / float(first.modes.step)
    steps = STEPS * int(np.ceil(1.6 * first.contact_time * rate / STEPS))
    cfg = Cfg(max(first.modes.pole.shape[0], data.rows), steps, start.quantity, data.calibrated)
    delay = np.full(layout.takes, arrival(string, start.geometry, start.quantity))
    alone = layout.takes == 1 and not data.calibrated
    return State(data, start, space, rate, delay, cfg, CRITERION if alone else 0.0)


def _compiled_ahead(function: Callable, state: State, starts: int) -> threading.Thread:
    """Call a batch function once, in a thread: its program compiles while the stages before it run."""

    def call() -> None:
        at = state.target(state.first_spread(1.0, 0.3), state.unweighted)
        function(jnp.asarray(np.tile(state.space.z(state.space.start), (starts, 1))), at, state.cfg)

    thread = threading.Thread(target=call, daemon=True)
    thread.start()
    return thread


def _with_attack(takes: Sequence[Take], fit: Fit) -> Fit:
    """The fit of calibrated recordings gone on with what their attacks tell.

    The onset is where a sound is first seen; a model this close says when the hammer touched. If it still misses by
    more than noise, there is no path to blame: the felt's window is of another shape than the model's.
    """
    state = replace(fit.state, delay=_touches(takes, fit))
    fit = _joint_stage(state, fit.z, fit.spread, fit.robust)
    if fit.spread.level <= WINDOW_SCATTER or state.space.free[WIDTH]:
        return fit
    state = replace(state, space=_with_free_width(state.space, state.start.geometry))
    fit = _joint_stage(state, fit.z, fit.spread, fit.robust)
    state = replace(state, delay=_touches(takes, fit))
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
    low, high = default_box(geometry.length, geometry.width)
    free, lower, upper = space.free.copy(), space.lower.copy(), space.upper.copy()
    free[WIDTH], lower[WIDTH], upper[WIDTH] = True, low[WIDTH], high[WIDTH]
    return replace(space, free=free, lower=lower, upper=upper)


def _touches(takes: Sequence[Take], fit: Fit) -> np.ndarray:
    """When the hammer touched before each onset, s [takes], by laying the fitted attacks on the recorded."""
    string, hammer = split(fit.values)
    geometry, ratios = struck(fit.state.start.geometry, fit.values), np.exp(fit.values[fit.data.layout.ratio])
    out = []
    for take, ratio, delay in zip(takes, ratios, fit.state.delay, strict=True):
        r = take.recording
        samples = int(ATTACK * r.rate)
        played = hammer._replace(v_H0=hammer.v_H0 * float(ratio))
        model = simulate(string, played, geometry, rate=r.rate, quantity=fit.state.start.quantity)
        guess = r.onset - round(float(delay) * r.rate)
        heard = np.pad(r.samples, (max(-guess, 0), samples))[max(guess, 0) :][:samples]
        late = lag(model.waveform(r.rate, samples), heard)
        out.append((r.onset - guess - late) / r.rate)
    return np.array(out)


def _string_stage(take: Take, state: State) -> tuple[Space, int]:
    """c and b1 in band 1, κ and b2 in band 2 (paper IV.C, steps 1 and 2), near where the analysis put them."""
    space, data, analysis = state.space, state.data.each[0], take.analysis
    near = {
        "c": 1 + 10 * max(analysis.f0_error / analysis.f0, CENT),
        "kappa": 1 + 5 * max(analysis.B_error / max(analysis.B, 1e-9), 0.02),
        "b1": 1.5,
        "b2": 2.0,
    }
    factor = np.array([near.get(n, 1.0) for n in NAMES] + [1.0] * (len(space.start) - LOG))
    local = replace(
        space, lower=np.maximum(space.lower, space.start / factor), upper=np.minimum(space.upper, space.start * factor)
    )
    z, count = local.z(local.start[None]), 0
    glide = 2 * np.pi * abs(analysis.glide_cents) * CENT * analysis.f0
    for wanted, names in ((0, ("c", "b1")), (1, ("kappa", "b2"))):
        band = next((b for b in data.occupied if b >= wanted), max(data.occupied))  # or the next occupied one
        free = np.append(np.isin(NAMES, names), np.zeros(len(space.start) - LOG, bool))
        for narrow in SIGMAS:
            sigma = max(narrow * data.sigma, 8 * glide)
            cells = lines(take.recording, analysis, data, band, sigma, state.start, state.rate)
            end = descend(
                lambda z, cells=cells: string_batch(jnp.asarray(z), cells, state.cfg),
                z, local, iterations=8, free=free, tolerance=1e-4,
            )  # fmt: skip
            z, count = end.z, count + end.evaluations
    return replace(space, start=local.natural(z[0])), count


def _hammer_stage(state: State, seed: int) -> tuple[np.ndarray, int, int]:
    """Hammers by the batch, until two of them end at the same lowest cost or `BATCHES` are spent. The best [1, size].

    Of a calibrated recording a hammer should explain all but the first scatter; many can agree on one that does not.
    One uncalibrated recording does not fix the hammer, and more than one batch has not bettered its levels.
    """
    random, size = np.random.default_rng(seed), len(state.space.start)
    z, cost, count, agreeing = np.zeros((0, size)), np.zeros(0), 0, 0
    batches = BATCHES if state.data.calibrated or state.data.layout.takes > 1 else 1
    for batch in range(batches):
        throw = random.standard_normal((STARTS, size))
        if batch == 0:
            throw[0] = 0.0  # the literature's own hammer is one of the starts
        end, evaluations = _hammers(state, throw)
        z, cost, count = np.append(z, end.z, axis=0), np.append(cost, end.cost), count + evaluations
        agreeing = int((cost < cost.min() + AGREEMENT).sum())
        if agreeing > 1 and not (state.data.calibrated and cost.min() > 0.5 * state.data.found.sum()):
            break
    if not np.isfinite(cost).any():
        raise FitError("no hammer within the bounds gives a finite sound; widen [bounds] or check [known] in the setup")
    best = int(np.argmin(cost))
    return z[best : best + 1], agreeing, count


def _hammers(state: State, throw: np.ndarray) -> tuple[Descent, int]:
    """Many hammers on one string: eq. 19 in the hammer's band, then levels, the loud ones first.

    `throw` [starts, size] is where they start, in units of the literature's spread. Several takes are compared with
    each other, which eq. 19 cannot do: theirs begin with the levels.
    """
    space, layout = state.space, state.data.layout
    spread = state.first_spread(10.0, 1.0)
    index = np.arange(layout.size)
    hammer = index >= 4
    physical = hammer & ((index < LOG) | np.isin(index, layout.ratio)) & np.isfinite(space.spread)
    z = space.z(space.start[None]) + throw * np.where(physical, space.spread, 0.0)
    at, count = state.target(spread, state.unweighted), 0
    if layout.takes == 1:
        by_energy = at._replace(by_energy=jnp.ones_like(at.by_energy))
        end = descend(state.evaluate(hammer_batch, by_energy), z, space, iterations=20, free=physical, tolerance=1e-3)
        z, count = end.z, end.evaluations
    z = _levelled(state, at, space.project(z))
    (lead, first), (finish, last) = GRADES
    at = state.target(spread, state.unweighted, lead)
    end = descend(state.evaluate(hammer_batch, at), z, space, iterations=first, free=hammer, tolerance=1e-4)
    at, count = state.target(spread, state.unweighted, finish), count + end.evaluations
    end = descend(state.evaluate(hammer_batch, at), end.z, space, iterations=last, free=hammer, tolerance=1e-4)
    return end, count + end.evaluations


def _levelled(state: State, at: Target, z: np.ndarray) -> np.ndarray:
    """The points `z` [starts, size] with the gains at which each take is right on average."""
    if state.data.calibrated:
        return z
    level = np.asarray(hammer_batch(jnp.asarray(z), at, state.cfg)[2])[:, :, 2]
    weight = np.asarray(at.level_weight) ** 2
    gain = ((np.asarray(at.level) - level) * weight).sum(axis=2) / weight.sum(axis=1)
    z = z.copy()
    for take in range(state.data.layout.takes):
        column = state.data.layout.gain[take]
        same = state.data.layout.gain == column
        z[:, column] = np.clip(gain[:, same].mean(axis=1), -300, 300)
    return z


def _joint_stage(state: State, z, spread: Spreads | None = None, robust: np.ndarray | None = None) -> Fit:
    """All together; weights from the residuals, residuals from the weights, until they agree."""
    count, rounds = 0, 0
    spread = spread or state.first_spread(1.0, 0.3)
    robust = state.unweighted if robust is None else robust
    while True:
        at = state.target(spread, robust)
        end = descend(state.evaluate(joint_batch, at), z, state.space, iterations=60, tolerance=1e-8)
        z, count, rounds, before = end.z, count + end.evaluations, rounds + 1, spread
        spread, robust = settled_weights(state, at, z)
        agreed = abs(spread.level - before.level) < 0.02 * spread.level + 1e-4
        if rounds == ROUNDS or (agreed and end.settled[0]):
            return _ended(state, end, at, before, robust, count)


def _ended(state: State, end: Descent, at: Target, spread: Spreads, robust, count: int) -> Fit:
    values = state.space.natural(end.z[0])
    downhill = -(end.jacobian[0].T @ end.residual[0])
    pressed = state.space.at_bound(values) & (np.abs(downhill) > 0)
    messages = () if bool(end.settled[0]) else ("The last stage stopped before it settled.",)
    return Fit(
        end.z, values, state.space, state.data, spread, robust, at, state.cfg, end.jacobian[0], end.residual[0],
        float(end.cost[0]), pressed, bool(end.settled[0]), count, 0, messages, state,
    )  # fmt: skip
