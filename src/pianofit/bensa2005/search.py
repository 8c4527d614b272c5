"""The paper's searches on eq. 19 of one recording: gradient descent with falling σ, or annealing over hammers.

A point `x` [9], in the order of `FIT_NAMES`, holds the logarithm of the felt's force at a reference compression, the
loss parameters as they are, and the logarithms of the rest. The reference compression is one that the stroke reaches,
because K_H and p are correlated along equal force there.

Each search has a box around its start. For the string, its size is a number of linewidths of the partials that
dominate the criterion. For the hammer it is a number of standard deviations of the hammers in the literature. The box
also scales the gradient.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from ..analysis import Analysis
from ..criterion import band_of, damping_for
from ..errors import FitError
from ..felt.hunt_crossley import HUNT_CROSSLEY
from ..inference import NO_HAMMER, InitialValues, simulation_grid
from ..inference.priors import HAMMER_SD
from ..model import simulate
from ..model.modes import mode_frequencies
from ..model.note import Note, arrival
from ..parameters import FIT_NAMES, HAMMER_NAMES, PARAMETERS, STRING_NAMES, Geometry, Hammer, String
from ..recording.recording import Recording
from ..result.alignment import align_attack
from .annealing import anneal
from .descent import DescentResult, LeastSquares, gradient_descent
from .spectral_criterion import Goal, SearchConstants, StaticConfig, criterion_gradients, fix_string, spectral_goal

ALL = (0, 1, 2)
# Parameters that are searched on a linear scale; the others on a log scale.
LINEAR = np.isin(FIT_NAMES, ("b1", "b2"))
K = FIT_NAMES.index("K_H")
P = FIT_NAMES.index("p")
STRING = len(STRING_NAMES)
# A felt law without loss coefficient has it fixed at this on the log scale, s/m.
ABSENT = 1e-12
# Longest contact, in units of the contact of the initial values.
CONTACTS = 1.6
# σ of the string's steps, in units of the σ of the reported criterion.
SIGMAS = np.array([1.0, 1 / 3, 0.1, 1 / 30, 0.01])
# The least σ, in units of the inverse length of the recording,
LEAST_SIGMA = 1.0
# and in units of the glide, 1/s, because a glide broadens the lines.
GLIDES = 8.0
CENT = math.log(2.0) / 1200
# A parameter is at a bound within this part of the box's logarithmic width.
EDGE = 1e-6
# Overlap of the spectra of two lines that lie one linewidth apart.
MEETING = 0.8
# Half-width of the box for the string, in linewidths.
LINES = 10.0
# Half-width of the box for the hammer, in standard deviations of the hammers in the literature.
SPREADS = 2.5
# The literature gives no spread of v_H0: 1 in its logarithm.
SPREAD = HAMMER_SD | {n: p.prior_sd for n, p in HUNT_CROSSLEY.parameters.items()} | {"v_H0": 1.0}
HAMMER_REACH = np.array([SPREADS * SPREAD[n] if n in HAMMER_NAMES else 0.0 for n in FIT_NAMES])
# Gradient steps at one σ, and evaluations of the final least squares.
ITERATIONS = 60
TOLERANCE = 1e-7
CHAINS = 32


class SearchResult(NamedTuple):
    """End of a search."""

    string: String
    hammer: Hammer
    delay: float  # s, from the hammer's first contact to the recording's onset
    converged: bool
    evaluations: int
    at_bound: tuple[str, ...]  # names of parameters that ended at a bound of the box


@dataclass
class Search:
    """One recording, the box in which string and hammer are searched, and the number of evaluations so far.

    Arrays are [9]. `start` holds quantity, scale and geometry. The strike position is fixed.
    """

    recording: Recording
    analysis: Analysis
    start: InitialValues
    values: np.ndarray  # start of the search, natural units
    lower: np.ndarray
    upper: np.ndarray
    free: np.ndarray  # bool
    delay: float  # s, from the first contact to the recording's onset
    scene: SearchConstants  # its reference compression is 1 m where K_H is fixed, so that K_H equals the force
    cfg: StaticConfig
    evaluations: int = 0
    converged: bool = True

    @property
    def calibrated(self) -> bool:
        """True if the recording has a scale in the unit of the pickup."""
        return self.start.scale is not None

    @property
    def last(self) -> int:
        """Number of the last detected partial."""
        return int(self.analysis.partials.number.max())

    @property
    def sigmas(self) -> list[float]:
        """σ of the string's steps, 1/s, falling; the length and the glide of the recording limit the last."""
        seconds = (len(self.recording.samples) - self.recording.onset) / self.recording.rate
        glide = 2 * np.pi * abs(self.analysis.glide_cents) * CENT * self.analysis.f0
        reported = damping_for(self.analysis.f0)
        least = min(max(LEAST_SIGMA / seconds, GLIDES * glide), reported)
        return [*(s for s in reported * SIGMAS if s > least), least]

    def band(self, wanted: int) -> int:
        """Return the band `wanted`, or the next band that contains a partial."""
        occupied = np.unique(band_of(self.analysis.partials.number)).tolist()
        return next((b for b in occupied if b >= wanted), max(occupied))

    def goal(self, bands: Sequence[int], sigma: float) -> Goal:
        """Eq. 19 on the given bands."""
        r, a = self.recording, self.analysis
        return spectral_goal(
            r.samples[r.onset :],
            r.rate,
            a.f0,
            a.B,
            self.last,
            sigma,
            bands=bands,
            delay=self.delay,
            unit=self.start.scale or 1.0,
            calibrated=self.calibrated,
        )

    # --- points and the box -------------------------------------------------------------------------------------------

    def x(self, values: np.ndarray) -> np.ndarray:
        """Return the point [9] of natural `values` [9]."""
        x = np.where(LINEAR, values, np.log(values))
        x[K] += values[P] * self.scene.log_u
        return x

    def natural(self, x: np.ndarray) -> np.ndarray:
        """Return natural values [9] of the point `x`, clipped to the box; fixed values are exactly as given."""
        values = np.exp(logs(x))
        values[K] = np.exp(x[K] - values[P] * self.scene.log_u)
        return np.where(self.free, np.clip(values, self.lower, self.upper), self.values)

    def box(self, x: np.ndarray, reach: np.ndarray, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        """Return bounds [9], [9] for the free parameters among `names`, at most `reach` [9] from `x`."""
        lower, upper = (np.where(LINEAR, edge, np.log(edge)) for edge in (self.lower, self.upper))
        # The force itself is not bounded; `scene` holds the bounds of K_H.
        lower[K], upper[K] = -np.inf, np.inf
        free = np.isin(FIT_NAMES, names) & self.free
        return np.where(free, np.maximum(lower, x - reach), x), np.where(free, np.minimum(upper, x + reach), x)

    def at_bound(self, values: np.ndarray) -> tuple[str, ...]:
        """Return the names of the free parameters whose `values` [9] lie at a bound."""
        value, low, high = np.log([values, self.lower, self.upper])
        bound = self.free & (np.minimum(value - low, high - value) <= EDGE * (high - low))
        return tuple(np.array(FIT_NAMES)[bound].tolist())

    def first_contact(self, values: np.ndarray) -> float:
        """Return the time from the first contact to the onset, s, for `values` [9] and a calibrated recording.

        The onset is the first detected sound. The shape of the attack gives the time of the first contact.
        """
        note = Note(*split(values), self.start.geometry, self.start.quantity, 1.0 / (self.start.scale or 1.0), None)
        return (self.recording.onset - align_attack(note, self.recording)) / self.recording.rate

    def cost(self, goal: Goal, x: np.ndarray) -> tuple[float, np.ndarray]:
        """Return eq. 19 at `x` and its gradient [9]."""
        cost, slope = (np.asarray(a)[0] for a in criterion_gradients(logs(x)[None], goal, self.scene, self.cfg))
        return float(cost), slope / np.where(LINEAR, x, 1.0)

    # --- the steps ----------------------------------------------------------------------------------------------------

    def descend(self, x: np.ndarray, names: Sequence[str], bands: Sequence[int], *, finest: bool = False) -> np.ndarray:
        """Minimise eq. 19 on the given bands over `names` by gradient descent, with falling σ or at the finest alone.

        The first σ is the finest at which the lines of model and recording overlap. A larger σ has a wider basin, but
        while the hammer is wrong it biases the string by more than a smaller σ can correct.
        """
        goals = [self.goal(bands, sigma) for sigma in self.sigmas[-1 if finest else 0 :]]
        apart = (i for i, goal in enumerate(goals) if self._overlap(x, goal) < MEETING)
        for goal in goals[max(next(apart, len(goals)) - 1, 0) :]:
            box, cost = self.box(x, self._reach(x, goal, bands), names), partial(self.cost, goal)
            x = self._count(gradient_descent(cost, x, *box, iterations=ITERATIONS, tolerance=TOLERANCE))
        return x

    def hammer_search(self, x: np.ndarray) -> LeastSquares:
        """Eq. 19 in the band of the hammer as a function of hammers [n, 5], on the string of `x`."""
        goal = self.goal((self.band(2),), damping_for(self.analysis.f0))
        lower, upper = self.box(x, HAMMER_REACH, HAMMER_NAMES)
        return fix_string(logs(x), lower[STRING:], upper[STRING:], goal, self.scene, self.cfg)

    def refine_hammer(self, x: np.ndarray) -> np.ndarray:
        """Minimise the same criterion over the hammer by least squares."""
        end = self.hammer_search(x).minimise(x[STRING:], evaluations=ITERATIONS, tolerance=TOLERANCE)
        return np.append(x[:STRING], self._count(end))

    def anneal_hammer(self, x: np.ndarray, evaluations: int, seed: int) -> np.ndarray:
        """Minimise eq. 19 in its band over the hammer by annealing, from `x` and from uniform points of the box."""
        problem = self.hammer_search(x)
        end = anneal(
            problem.costs,
            problem.lower,
            problem.upper,
            chains=CHAINS,
            evaluations=evaluations,
            seed=seed,
            start=x[STRING:],
        )
        self.evaluations += end.evaluations
        if not np.isfinite(end.cost):
            raise FitError(NO_HAMMER)
        return np.append(x[:STRING], end.z)

    def _overlap(self, x: np.ndarray, goal: Goal) -> float:
        """∫ |Y|² |S|² dω over the root of ∫ |Y|⁴ dω ∫ |S|⁴ dω: eq. 19 with the best gain is 1 minus its square."""
        cost, _ = self.cost(goal._replace(calibrated=np.zeros_like(goal.calibrated)), x)
        return max(1 - cost, 0.0) ** 0.5

    def _reach(self, x: np.ndarray, goal: Goal, bands: Sequence[int]) -> np.ndarray:
        """Half-width of the box [9]: it moves the lines, weighted by their share in eq. 19, by `LINES` linewidths."""
        (string, _), length, k = split(self.natural(x)), self.start.geometry.length, np.arange(1, self.last + 1)
        k = k[np.isin(band_of(k), bands)]
        beta2, omega = (k * np.pi / length) ** 2, 2 * np.pi * mode_frequencies(string, length, self.last)[k - 1]
        share = np.asarray((goal.weight * goal.energy) ** 2).sum(axis=1)[: len(k)]
        by = [string.c**2 * beta2 / omega, string.kappa**2 * beta2**2 / omega, np.ones(len(k)), beta2]
        moved = np.stack(by) / (float(goal.sigma) + string.b1 + string.b2 * beta2)
        return HAMMER_REACH + np.append(LINES / np.sqrt((share * moved**2).sum(axis=1)), np.zeros(len(HAMMER_NAMES)))

    def _count(self, end: DescentResult) -> np.ndarray:
        """Return the end of a descent and add up its evaluations."""
        self.evaluations += end.evaluations
        self.converged = end.converged
        return end.z


def make_search(recording: Recording, analysis: Analysis, start: InitialValues) -> Search:
    """Return the search from the user's initial values, which also set the sampling rate and length of the contact."""
    values, lower, upper, free = _box(start)
    string, hammer = split(values)
    first = simulate(string, hammer, start.geometry, rate=recording.rate, quantity=start.quantity)
    round_trip = 2 * start.geometry.strike_position / string.c
    rate, steps, rows = simulation_grid(first, round_trip, int(analysis.partials.number.max()), CONTACTS)
    log_u, stiff = 0.0, np.array([-np.inf, np.inf])  # a fixed stiffness needs no bounds
    if free[K]:
        log_u, stiff = float(np.log(0.5 * first.pulse.compression.max())), np.log([lower[K], upper[K]])
    scene = SearchConstants(Geometry(*map(np.float64, start.geometry)), np.float64(rate), np.float64(log_u), stiff)
    cfg = StaticConfig(max(first.modes.pole.shape[0], rows), steps, start.quantity)
    delay = arrival(string, start.geometry, start.quantity)
    return Search(recording, analysis, start, values, lower, upper, free, delay, scene, cfg)


def logs(x: np.ndarray) -> np.ndarray:
    """Return the logarithms [..., 9], as `spectral_criterion` takes them, of points `x` [..., 9]."""
    return np.where(LINEAR, np.log(np.where(LINEAR, x, 1.0)), x)


def split(values: np.ndarray) -> tuple[String, Hammer]:
    """Return string and hammer of natural `values` [9]."""
    string, hammer = String(*map(float, values[:STRING])), Hammer(*map(float, values[STRING:]))
    return string, hammer._replace(mu=hammer.mu if hammer.mu > ABSENT else 0.0)


def _box(start: InitialValues) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return values, lower and upper bounds, and the free mask, each [9]; the bounds of a fixed value are equal."""
    absent = np.array([name == "mu" and name not in start.law.parameters for name in FIT_NAMES])
    free = np.array([name not in start.fixed for name in FIT_NAMES]) & ~absent
    bounds = np.array([start.bounds.get(n, (PARAMETERS[n].lower, PARAMETERS[n].upper)) for n in FIT_NAMES])
    given = np.array([(start.values if n in start.fixed else start.initial)[n] for n in FIT_NAMES], float)
    held = np.where(absent, ABSENT, given)
    lower, upper = np.where(free, bounds.T, held)
    return np.clip(held, lower, upper), lower, upper, free
