"""The fit of one or more takes of a string, stage by stage.

1. The string, on the paper's criterion in bands 1 and 2, from where the analysis put it, with σ falling.
2. The hammer, on the paper's criterion in band 3, from many starts at once: this finds the basin. Several takes are
   compared with each other instead, and many more hammers screened.
3. The hammer on levels in dB through the unknown path, the best of those starts.
4. String and hammer together, weighted by noise and scatter, until the weights settle: this gives the estimate. Of
   several hammers through an unknown path it is the likeliest, once each has its own weights.

Several takes share string, felt, hammer and path. Each has a velocity, a gain and a pitch of its own, and what their
levels have in common beyond the smooth path is the path's roughness, not the hammer's doing.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from ..initial import Start
from ..model import simulate
from ..model.simulate import count_modes
from ..parameters import FELT_LAWS, Geometry
from . import screen
from .hammers import anchored, comparable, search_hammers
from .joint import Fit, gone_on
from .levenberg import descend
from .likeliest import elsewhere, likeliest
from .residuals import CENT, Cfg, Target, hammer_batch, joint_batch, level_batch, string_batch
from .space import LOG, NAMES, K, Layout, Space, default_box, split, struck
from .state import TOGETHER, State, search_space
from .takes import Take
from .target import lines, measured, measured_alike, side_by_side
from .voice import arrival, lag, placed

__all__ = ["fit_partials"]

STRIKE, WIDTH = NAMES.index("x0"), NAMES.index("width")
# Of the room that a contact has: rounding must not push its window off the string.
ON_STRING = 1 - 1e-9
# A search's contacts last a whole number of times this many steps, so that notes share compiled programs.
STEPS = 256
# How much of the attack, s, tells when the hammer touched.
ATTACK = 0.05
# σ of the string's stage in units of the criterion's: wide lines first. Glide blurs what is finer than the second.
SIGMAS = (1.0, 0.35)
# The contact may last this many times as long as that of the literature's hammer, and until the agraffe's reflection
# has come back twice, for in the bass it is what throws the hammer off. If one lasts nearly as long, better ones may
# last longer still: all is done again with twice the time.
CONTACTS, RETURNS, MOST_CONTACTS, NEARLY = 1.6, 2.0, 6.0, 0.9
# Levels that scatter by no more than this, dB, show what the contact's step does to them. That is read off a step so
# many times finer, again where the fit has moved, until what is left is this share of a level's standard deviation.
FINE_LEVEL, REFINEMENT, READINGS, LEFT = 1.0, 8, 4, 0.05
# A band whose criterion is 1, as for silence, costs half this much where the path is unknown: there it is not noise
# that says which partials matter.
CRITERION = 100.0

Progress = Callable[[str, float], None]


def fit_partials(
    takes: Sequence[Take],
    start: Start,
    layout: Layout,
    *,
    seed: int = 0,
    progress: Progress = lambda *_: None,
    contacts: float | None = None,
) -> Fit:
    """Fit the nine parameters, the strike position where it is not known, and the takes' velocities over the first's.

    Parameters
    ----------
    contacts : how long a contact may last, in those of the literature's hammer; twice as long if one is as long.

    Raises
    ------
    FitError
        If no start leads to a finite cost.
    """
    contacts = contacts or CONTACTS
    state = _prepared(takes, start, layout, contacts)
    programs = [_compiled_ahead(hammer_batch, state, TOGETHER), _compiled_ahead(joint_batch, state, 1)]
    if comparable(state):
        programs.append(_compiled_ahead(level_batch, state, screen.CALL, jnp.zeros(screen.VELOCITIES)))
    try:
        progress("string", 0.1)
        space, count = _string_stage(takes[0], state)
        state = replace(state, space=space)
        progress("hammer", 0.3)
        for program in programs[:1] + programs[2:]:
            program.join()
        z, agreeing, searched = search_hammers(state, seed)
        progress("string and hammer", 0.6)
        programs[1].join()
        fit = elsewhere(likeliest(state, z, seed), seed)
        state, z = anchored(fit.state, fit.z)
        if state is not fit.state:
            fit = gone_on(fit, state, z)
        if state.data.calibrated:
            fit = _with_attack(takes, _with_window(fit))
        if fit.spread.level < FINE_LEVEL:
            progress("refinement", 0.8)
            fit = _corrected(takes, fit)
    finally:
        # A program that still compiles when Python ends would take it down; after Ctrl-C too.
        for program in programs:
            program.join()
    if contacts < MOST_CONTACTS and _longest(fit) > NEARLY:
        return fit_partials(takes, start, layout, seed=seed, progress=progress, contacts=2 * contacts)
    progress("done", 1.0)
    return replace(fit, agreeing=agreeing, evaluations=fit.evaluations + count + searched)


def _prepared(takes: Sequence[Take], start: Start, layout: Layout, contacts: float = CONTACTS) -> State:
    """Choose the contact's rate and length, and what the programs are compiled for, from the literature's strike."""
    space = search_space(start, takes, layout)
    tables = measured_alike([take.analysis.partials for take in takes])
    alike = [replace(take.analysis, partials=table) for take, table in zip(takes, tables, strict=True)]
    data = side_by_side(
        tuple(measured(t.recording, analysis, start) for t, analysis in zip(takes, alike, strict=True)), layout
    )
    string, hammer = split(space.start)
    rate = max(take.recording.rate for take in takes)
    first = simulate(string, hammer, start.geometry, rate=rate, quantity=start.quantity)
    # A stiffness that is known is held as it is: at 1 m it is the force.
    log_u = float(np.log(0.5 * first.pulse.compression.max())) if space.free[K] else 0.0
    space = replace(space, log_u=log_u)
    rate = 1.0 / float(first.modes.step)
    returns = 2 * RETURNS * start.geometry.strike / string.c
    longest = contacts * max(first.contact_time, returns / CONTACTS)
    steps = STEPS * int(np.ceil(longest * rate / STEPS))
    memory = "epsilon" in FELT_LAWS[start.felt]
    cfg = Cfg(max(first.modes.pole.shape[0], data.rows), steps, start.quantity, data.calibrated, memory)
    delay = np.full(layout.takes, arrival(string, start.geometry, start.quantity))
    alone = layout.takes == 1 and not data.calibrated
    return State(data, start, space, rate, delay, cfg, CRITERION if alone else 0.0)


def _longest(fit: Fit) -> float:
    """The longest contact of all takes, in units of the time it may last."""
    string, hammer = split(fit.values)
    geometry, slowest = struck(fit.state.start.geometry, fit.values), float(fit.values[fit.data.layout.ratio].min())
    slow = hammer._replace(v_H0=hammer.v_H0 * float(np.exp(slowest)))
    played = simulate(string, slow, geometry, quantity=fit.state.start.quantity)
    return played.contact_time * fit.state.rate / fit.state.cfg.steps


def _compiled_ahead(function: Callable, state: State, starts: int, *more) -> threading.Thread:
    """Call a batch function once, in a thread: its program compiles while the stages before it run."""

    def call() -> None:
        at = state.target(state.first_spread(1.0, 0.3), state.unweighted)
        function(jnp.asarray(np.tile(state.space.z(state.space.start), (starts, 1))), *more, at, state.cfg)

    thread = threading.Thread(target=call, daemon=True)
    thread.start()
    return thread


def _with_attack(takes: Sequence[Take], fit: Fit) -> Fit:
    """The fit of calibrated recordings gone on with when the hammer touched.

    The onset is where a sound is first seen; a model this close says when the touch was.
    """
    return gone_on(fit, replace(fit.state, delay=_touches(takes, fit)))


def _with_window(fit: Fit) -> Fit:
    """The fit of calibrated recordings with the width of the contact free.

    A felt's window is measured, if at all, by its width, and the model's is a raised cosine: one of another shape acts
    as a raised cosine of another width does. Levels of a microphone do not show that, and a path would take it up.
    """
    state = replace(fit.state, space=_with_free_width(fit.space, fit.state.start.geometry))
    return replace(fit, state=state, space=state.space)


def _corrected(takes: Sequence[Take], fit: Fit) -> Fit:
    """The fit gone on with what its levels leave out.

    That changes little while the parameters change little, so it is read off now and then, and held meanwhile.
    """
    more = _left_out(fit)
    for _ in range(READINGS):
        delay, before = _touches(takes, fit) if fit.data.calibrated else fit.state.delay, more
        fit = gone_on(fit, replace(fit.state, delay=delay, more=before))
        more = _left_out(fit)
        if np.abs(np.asarray(fit.target.level_weight) * (more - before)).max() < LEFT:
            break
    return fit


def _left_out(fit: Fit) -> np.ndarray:
    """What the levels at the fit's point would have more, dB [takes, rows], by a step without end and a gliding string.

    Errors go with the square of the step. A string that glides was tenser when it was struck, and tenser in a take
    that is sharper than the first.
    """
    string, _ = split(fit.values)
    layout, rate = fit.data.layout, fit.state.rate * REFINEMENT
    rows = max(fit.cfg.n_modes, count_modes(string, fit.state.start.geometry, rate))
    fine = fit.cfg._replace(steps=fit.cfg.steps * REFINEMENT, n_modes=rows)
    at, ratio = fit.target._replace(rate=jnp.asarray(rate)), jnp.asarray(fit.values[layout.ratio])
    sharp = np.array([data.sharp for data in fit.data.each]) + fit.values[layout.cents]
    tense = np.tile(fit.z, (len(sharp), 1))
    tense[:, 0] += CENT * sharp

    def levels(z: np.ndarray, target: Target, cfg: Cfg) -> np.ndarray:
        return np.asarray(level_batch(jnp.asarray(z), ratio, target, cfg)[0])[0, :, : fit.data.rows]

    coarse, finer = levels(fit.z, fit.target, fit.cfg), levels(fit.z, at, fine)
    with np.errstate(invalid="ignore"):  # a contact that did not end
        more = (finer - coarse) * REFINEMENT**2 / (REFINEMENT**2 - 1)
        for take in np.flatnonzero(sharp):
            more[take] += levels(tense[take : take + 1], fit.target, fit.cfg)[take] - coarse[take]
    return np.where(fit.data.found & np.isfinite(more), more, 0.0)


def _with_free_width(space: Space, geometry: Geometry) -> Space:
    low, high = default_box(geometry.length, geometry.width)
    free, lower, upper = space.free.copy(), space.lower.copy(), space.upper.copy()
    # The window stays on the string wherever it is struck.
    room = ON_STRING * 2 * min(space.lower[STRIKE], geometry.length - space.upper[STRIKE])
    free[WIDTH], lower[WIDTH], upper[WIDTH] = True, low[WIDTH], max(min(high[WIDTH], room), geometry.width)
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
        sound, heard = model.waveform(r.rate, samples), r.samples * fit.state.start.scale
        # From one length of the attack before the guess to one after it.
        first = r.onset - round(float(delay) * r.rate) - samples
        near = np.pad(heard, (max(-first, 0), 3 * samples))[max(first, 0) :][: 3 * samples]
        at, sign = placed(sound, near)
        late = first + at + lag(sound, sign * near[at:][:samples])
        out.append((r.onset - late) / r.rate)
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
