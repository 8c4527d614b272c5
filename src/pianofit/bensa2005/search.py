"""The paper's searches on eq. 19 of one recording: down the gradient with σ falling, or by annealing over hammers.

A point `x` [9], in the order of `FIT_NAMES`, holds the felt's log force at a reference compression, losses as they are,
and the logarithms of the rest: K_H and p trade off along equal force at the compressions that a stroke really reaches.

How far a step looks to either side of a point is counted in widths of the lines that rule the criterion for the string,
and in spreads of the literature's hammers for the hammer; the gradient takes its scale from that.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from ..analysis import Analysis
from ..criterion import band_of, line_sigma
from ..errors import FitError
from ..felt import DEFAULT_LAW
from ..inference.initial_values import InitialValues
from ..inference.multistart import NO_HAMMER
from ..inference.priors import HAMMER_SPREAD
from ..inference.problem import simulation_grid
from ..model import simulate
from ..model.modes import mode_frequencies
from ..model.note import Note, arrival
from ..parameters import FIT_NAMES, HAMMER_NAMES, PARAMETERS, STRING_NAMES, Geometry, Hammer, String
from ..recording.recording import Recording
from ..result.alignment import align_attack
from .annealing import anneal
from .descent import Descended, LeastSquares, gradient_descent
from .spectral_criterion import Goal, Scene, StaticConfig, fix_string, spectral_goal, struck_gradients

__all__ = ["ALL", "Search", "pose", "split"]

ALL = (0, 1, 2)
# Which of the nine are searched as they are, not by their logarithm.
LINEAR = np.isin(FIT_NAMES, ("b1", "b2"))
K = FIT_NAMES.index("K_H")
P = FIT_NAMES.index("p")
STRING = len(STRING_NAMES)
# A loss coefficient that the felt's law does not have is held at this on its log scale, s/m.
ABSENT = 1e-12
# The contact may last this many times as long as that of the initial values.
CONTACTS = 1.6
# σ of the string's steps in units of the criterion's.
SIGMAS = np.array([1.0, 1 / 3, 0.1, 1 / 30, 0.01])
# The least σ in units of 1/s over the recording's length,
LEAST_SIGMA = 1.0
# and in units of the glide, 1/s: what a glide blurs is not resolved.
GLIDES = 8.0
CENT = math.log(2.0) / 1200
# A parameter is on an edge of the box within this part of the box's logarithmic width.
EDGE = 1e-6
# Overlap of the spectra of two lines that lie one linewidth apart.
MEETING = 0.8
# Widths of a line to either side.
LINES = 10.0
# Spreads of the literature's hammers to either side.
SPREADS = 2.5
# Of the logarithm of v_H0 no more is said.
SPREAD = HAMMER_SPREAD | {n: p.prior_sd for n, p in DEFAULT_LAW.parameters.items()} | {"v_H0": 1.0}
HAMMER_REACH = np.array([SPREADS * SPREAD[n] if n in HAMMER_NAMES else 0.0 for n in FIT_NAMES])
# Steps of the gradient at one σ, and evaluations by the least squares that end a search.
ITERATIONS = 60
TOLERANCE = 1e-7
CHAINS = 32


@dataclass
class Search:
    """One recording, the box in which string and hammer are searched, and what the search has cost so far.

    Arrays are [9]. `start` holds quantity, scale and geometry; the strike position is held.
    """

    recording: Recording
    analysis: Analysis
    start: InitialValues
    values: np.ndarray  # natural units: where the search starts
    lower: np.ndarray
    upper: np.ndarray
    free: np.ndarray  # bool
    delay: float  # s, from the first contact to the recording's onset
    scene: Scene  # the reference compression is 1 m where the stiffness is known, which is then the force
    cfg: StaticConfig
    evaluations: int = 0
    converged: bool = True

    @property
    def calibrated(self) -> bool:
        """Whether the recording is in the pickup's own unit."""
        return self.start.scale is not None

    @property
    def last(self) -> int:
        """Number of the last partial found."""
        return int(self.analysis.partials.number.max())

    @property
    def sigmas(self) -> list[float]:
        """σ of the string's steps, 1/s, falling: no finer than the recording's length or its glide allow."""
        seconds = (len(self.recording.samples) - self.recording.onset) / self.recording.rate
        glide = 2 * np.pi * abs(self.analysis.glide_cents) * CENT * self.analysis.f0
        reported = line_sigma(self.analysis.f0)
        least = min(max(LEAST_SIGMA / seconds, GLIDES * glide), reported)
        return [*(s for s in reported * SIGMAS if s > least), least]

    def band(self, wanted: int) -> int:
        """The band wanted, or the next with a partial in it."""
        occupied = np.unique(band_of(self.analysis.partials.number)).tolist()
        return next((b for b in occupied if b >= wanted), max(occupied))

    def goal(self, bands: Sequence[int], sigma: float) -> Goal:
        """Eq. 19 on some bands."""
        r, a = self.recording, self.analysis
        return spectral_goal(
            r.samples[r.onset :], r.rate, a.f0, a.B, self.last, sigma, bands=bands, delay=self.delay,
            unit=self.start.scale or 1.0, calibrated=self.calibrated,
        )  # fmt: skip

    # --- points and the box -------------------------------------------------------------------------------------------

    def x(self, values: np.ndarray) -> np.ndarray:
        """The point [9] of natural `values` [9]."""
        x = np.where(LINEAR, values, np.log(values))
        x[K] += values[P] * self.scene.log_u
        return x

    def natural(self, x: np.ndarray) -> np.ndarray:
        """Natural values [9] of the point `x`, within the box to the last digit; what is held is exactly as given."""
        values = np.exp(logs(x))
        values[K] = np.exp(x[K] - values[P] * self.scene.log_u)
        return np.where(self.free, np.clip(values, self.lower, self.upper), self.values)

    def box(self, x: np.ndarray, reach: np.ndarray, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        """Edges [9], [9] no farther than `reach` [9] from `x` between which the free ones of `names` may move."""
        lower, upper = (np.where(LINEAR, edge, np.log(edge)) for edge in (self.lower, self.upper))
        # The force has no bounds of its own; the scene has the stiffness's.
        lower[K], upper[K] = -np.inf, np.inf
        moves = np.isin(FIT_NAMES, names) & self.free
        return np.where(moves, np.maximum(lower, x - reach), x), np.where(moves, np.minimum(upper, x + reach), x)

    def at_bound(self, values: np.ndarray) -> tuple[str, ...]:
        """Names of the free parameters whose `values` [9] lie on an edge of the box."""
        value, low, high = np.log([values, self.lower, self.upper])
        on = self.free & (np.minimum(value - low, high - value) <= EDGE * (high - low))
        return tuple(np.array(FIT_NAMES)[on].tolist())

    def first_contact(self, values: np.ndarray) -> float:
        """Time from the first contact to the onset, s, of `values` [9]. For calibrated recordings.

        The onset is where a sound is first seen; the attack says when the hammer touched.
        """
        note = Note(*split(values), self.start.geometry, self.start.quantity, 1.0 / (self.start.scale or 1.0), None)
        return (self.recording.onset - align_attack(note, self.recording)) / self.recording.rate

    def cost(self, goal: Goal, x: np.ndarray) -> tuple[float, np.ndarray]:
        """Eq. 19 at `x`, and its gradient [9]."""
        cost, slope = (np.asarray(a)[0] for a in struck_gradients(logs(x)[None], goal, self.scene, self.cfg))
        return float(cost), slope / np.where(LINEAR, x, 1.0)

    # --- the steps ----------------------------------------------------------------------------------------------------

    def down(self, x: np.ndarray, names: Sequence[str], bands: Sequence[int], *, finest: bool = False) -> np.ndarray:
        """Down the gradient of eq. 19 on some bands with σ falling, or at the finest alone; only `names` move.

        It begins at the finest σ at which the model's lines still meet the recording's. Wider ones meet from afar, but
        while the hammer is wrong they bend the string to excuse it, farther than narrow ones find back.
        """
        goals = [self.goal(bands, sigma) for sigma in self.sigmas[-1 if finest else 0 :]]
        apart = (i for i, goal in enumerate(goals) if self._overlap(x, goal) < MEETING)
        for goal in goals[max(next(apart, len(goals)) - 1, 0) :]:
            box, cost = self.box(x, self._reach(x, goal, bands), names), partial(self.cost, goal)
            x = self._counted(gradient_descent(cost, x, *box, iterations=ITERATIONS, tolerance=TOLERANCE))
        return x

    def hammers(self, x: np.ndarray) -> LeastSquares:
        """Eq. 19 of hammers [n, 5] in their band, on the string of `x`."""
        goal = self.goal((self.band(2),), line_sigma(self.analysis.f0))
        lower, upper = self.box(x, HAMMER_REACH, HAMMER_NAMES)
        return fix_string(logs(x), lower[STRING:], upper[STRING:], goal, self.scene, self.cfg)

    def hammer_finished(self, x: np.ndarray) -> np.ndarray:
        """The hammer alone, to the floor of its basin, by least squares on the same criterion."""
        end = self.hammers(x).finished(x[STRING:], evaluations=ITERATIONS, tolerance=TOLERANCE)
        return np.append(x[:STRING], self._counted(end))

    def annealed(self, x: np.ndarray, evaluations: int, seed: int) -> np.ndarray:
        """The hammer alone, by annealing on eq. 19 in its band, starting from `x` and from points all over the box.

        Raises
        ------
        FitError
            If no hammer has a finite criterion.
        """
        on = self.hammers(x)
        found = anneal(
            on.costs, on.lower, on.upper, chains=CHAINS, evaluations=evaluations, seed=seed, start=x[STRING:]
        )
        self.evaluations += found.evaluations
        if not np.isfinite(found.cost):
            raise FitError(NO_HAMMER)
        return np.append(x[:STRING], found.z)

    def _overlap(self, x: np.ndarray, goal: Goal) -> float:
        """∫ |Y|² |S|² dω over the root of ∫ |Y|⁴ dω ∫ |S|⁴ dω: eq. 19 with the best gain is 1 less its square."""
        cost, _ = self.cost(goal._replace(calibrated=np.zeros_like(goal.calibrated)), x)
        return max(1 - cost, 0.0) ** 0.5

    def _reach(self, x: np.ndarray, goal: Goal, bands: Sequence[int]) -> np.ndarray:
        """How far to look [9]: what moves the lines, each with its share in eq. 19, by some of their widths."""
        (string, _), length, k = split(self.natural(x)), self.start.geometry.length, np.arange(1, self.last + 1)
        k = k[np.isin(band_of(k), bands)]
        beta2, omega = (k * np.pi / length) ** 2, 2 * np.pi * mode_frequencies(string, length, self.last)[k - 1]
        share = np.asarray((goal.weight * goal.energy) ** 2).sum(axis=1)[: len(k)]
        by = [string.c**2 * beta2 / omega, string.kappa**2 * beta2**2 / omega, np.ones(len(k)), beta2]
        moved = np.stack(by) / (float(goal.sigma) + string.b1 + string.b2 * beta2)
        return HAMMER_REACH + np.append(LINES / np.sqrt((share * moved**2).sum(axis=1)), np.zeros(len(HAMMER_NAMES)))

    def _counted(self, end: Descended) -> np.ndarray:
        """Where it ended; what it took is added."""
        self.evaluations += end.evaluations
        self.converged = end.converged
        return end.z


def pose(recording: Recording, analysis: Analysis, start: InitialValues) -> Search:
    """The search from the user's initial values; the contact's rate and length are from a stroke with these.

    Raises
    ------
    FitError
        If that contact does not end.
    """
    values, lower, upper, free = _box(start)
    string, hammer = split(values)
    first = simulate(string, hammer, start.geometry, rate=recording.rate, quantity=start.quantity)
    round_trip = 2 * start.geometry.strike_position / string.c
    rate, steps, rows = simulation_grid(first, round_trip, int(analysis.partials.number.max()), CONTACTS)
    log_u, stiff = 0.0, np.array([-np.inf, np.inf])  # a stiffness that is known needs no bounds
    if free[K]:
        log_u, stiff = float(np.log(0.5 * first.pulse.compression.max())), np.log([lower[K], upper[K]])
    scene = Scene(Geometry(*map(np.float64, start.geometry)), np.float64(rate), np.float64(log_u), stiff)
    cfg = StaticConfig(max(first.modes.pole.shape[0], rows), steps, start.quantity)
    delay = arrival(string, start.geometry, start.quantity)
    return Search(recording, analysis, start, values, lower, upper, free, delay, scene, cfg)


def logs(x: np.ndarray) -> np.ndarray:
    """Search coordinates of `spectral` [..., 9], logarithms throughout, of points `x` [..., 9]."""
    return np.where(LINEAR, np.log(np.where(LINEAR, x, 1.0)), x)


def split(values: np.ndarray) -> tuple[String, Hammer]:
    """String and hammer of natural `values` [9]."""
    string, hammer = String(*map(float, values[:STRING])), Hammer(*map(float, values[STRING:]))
    return string, hammer._replace(mu=hammer.mu if hammer.mu > ABSENT else 0.0)


def _box(start: InitialValues) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Values, edges and what is free, each [9]; what is held has no width."""
    absent = np.array([name == "mu" and name not in start.law.parameters for name in FIT_NAMES])
    free = np.array([name not in start.fixed for name in FIT_NAMES]) & ~absent
    bounds = np.array([start.bounds.get(n, (PARAMETERS[n].lower, PARAMETERS[n].upper)) for n in FIT_NAMES])
    given = np.array([(start.values if n in start.fixed else start.initial)[n] for n in FIT_NAMES], float)
    held = np.where(absent, ABSENT, given)
    lower, upper = np.where(free, bounds.T, held)
    return np.clip(held, lower, upper), lower, upper, free
