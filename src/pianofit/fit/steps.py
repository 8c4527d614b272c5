"""Single steps of a search on eq. 19: down the gradient with σ falling, or by annealing over hammers.

A point `x` [9] holds the felt's log force at a reference compression, losses as they are, and the logarithms of the
rest. How far a search looks to either side is counted in widths of the lines that rule the criterion for the string,
and in spreads of the literature's hammers for the hammer; the gradient takes its scale from that.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from ..analysis import Analysis
from ..criterion import band_of
from ..errors import FitError
from ..initial import HAMMER_SPREAD
from ..parameters import FIT_NAMES, HAMMER_NAMES, Geometry
from ..recording import Recording
from .annealing import anneal
from .gradient import gradient_descent
from .levenberg import descend
from .residuals import CENT
from .space import Box
from .spectral import Goal, spectral_goal
from .state import State
from .struck import Held, Scene, hammer_costs, hammer_residuals, hold, struck_gradients
from .target import Measured

__all__ = ["ALL", "Search"]

ALL = (0, 1, 2)
# σ of the string's steps in units of the criterion's, and the least in units of 1/s over the recording's length.
SIGMAS, LEAST_SIGMA = (1.0, 1 / 3, 0.1, 1 / 30, 0.01), 1.0
# Likeness of two lines that lie one linewidth apart.
MEETING = 0.8
# Widths of a line, and spreads of hammers, to either side.
LINES, SPREADS = 10.0, 2.5
# Of the gradient, at one σ, and where it ends a search.
ITERATIONS, LAST_ITERATIONS = 60, 400
TOLERANCE = 1e-7
CHAINS = 32
NUMBER = len(FIT_NAMES)
LINEAR = np.isin(FIT_NAMES, ("b1", "b2"))
K, P = FIT_NAMES.index("K_H"), FIT_NAMES.index("p")
HAMMER_REACH = SPREADS * np.array([0.0] * 4 + [HAMMER_SPREAD[name] for name in HAMMER_NAMES])
NO_HAMMER = "no hammer within the bounds gives a finite sound; widen [bounds] or check [known] in the setup"


@dataclass
class Search:
    """What the steps of one search share, and what they have cost so far."""

    recording: Recording
    analysis: Analysis
    state: State
    evaluations: int = 0
    settled: bool = True

    @property
    def data(self) -> Measured:
        """The recording's partials."""
        return self.state.data.each[0]

    @property
    def log_u(self) -> float:
        """Log of the reference compression, m; of 1 m where the stiffness is known, which is then the force."""
        return self.state.space.log_u if self.state.space.free[K] else 0.0

    def x(self, values: np.ndarray) -> np.ndarray:
        """The point of natural `values` [9]."""
        x = np.where(LINEAR, values, np.log(values))
        x[K] += values[P] * self.log_u
        return x

    def values(self, x: np.ndarray) -> np.ndarray:
        """Natural values [size] within the box to the last digit; what is held is exactly as given."""
        space, values = self.state.space, self.state.space.start.copy()
        values[:NUMBER] = np.exp(_logs(x))
        values[K] = np.exp(x[K] - values[P] * self.log_u)
        return np.where(space.free, np.clip(values, space.lower, space.upper), space.start)

    @property
    def sigmas(self) -> list[float]:
        """σ of the string's steps, 1/s, falling: no finer than the recording's length or its glide allow."""
        seconds = (len(self.recording.samples) - self.recording.onset) / self.recording.rate
        glide = 2 * np.pi * abs(self.analysis.glide_cents) * CENT * self.analysis.f0
        least = min(max(LEAST_SIGMA / seconds, 8 * glide), self.data.sigma)
        return [*(s for s in self.data.sigma * np.array(SIGMAS) if s > least), least]

    def band(self, wanted: int) -> int:
        """The band wanted, or the next with a partial in it."""
        occupied = self.data.occupied
        return next((b for b in occupied if b >= wanted), max(occupied))

    def goal(self, bands: Sequence[int], sigma: float) -> Goal:
        """Eq. 19 on some bands."""
        r, a, data, start = self.recording, self.analysis, self.data, self.state.start
        return spectral_goal(
            r.samples[r.onset :], r.rate, a.f0, a.B, int(data.partials.number.max()), sigma, bands=bands,
            delay=float(self.state.delay[0]), unit=start.scale or 1.0, calibrated=data.calibrated,
        )  # fmt: skip

    def down(self, x: np.ndarray, names: Sequence[str], bands: Sequence[int]) -> np.ndarray:
        """Down the gradient of eq. 19 on some bands with σ falling; only `names` move.

        It begins at the finest σ at which the model's lines still meet the recording's. Wider ones meet from afar, but
        while the hammer is wrong they bend the string to excuse it, farther than narrow ones find back.
        """
        goals = [self.goal(bands, sigma) for sigma in self.sigmas]
        apart = [i for i, goal in enumerate(goals) if self._likeness(x, goal) < MEETING]
        first = min(apart, default=len(goals))
        for goal in goals[max(first - 1, 0) :]:
            x = self._string_down(x, names, bands, goal)
        return x

    def finely_down(self, x: np.ndarray, names: Sequence[str], bands: Sequence[int]) -> np.ndarray:
        """The same at the finest σ alone."""
        return self._string_down(x, names, bands, self.goal(bands, self.sigmas[-1]))

    def _string_down(self, x: np.ndarray, names: Sequence[str], bands: Sequence[int], goal: Goal) -> np.ndarray:
        scene, box = self.scene(), self.box(x, self._reach(x, goal, bands), names)
        return self._descended(lambda z: struck_gradients(z, goal, scene, self.state.cfg), x, box, ITERATIONS)

    def _likeness(self, x: np.ndarray, goal: Goal) -> float:
        """∫ |Y|² |S|² dω over the root of ∫ |Y|⁴ dω ∫ |S|⁴ dω: eq. 19 with the best gain is 1 less its square."""
        free = goal._replace(calibrated=jnp.zeros_like(goal.calibrated))
        cost = float(struck_gradients(jnp.asarray(_logs(x))[None], free, self.scene(), self.state.cfg)[0][0])
        return max(1 - cost, 0.0) ** 0.5

    def hammer_down(self, x: np.ndarray) -> np.ndarray:
        """The hammer alone, down the gradient of eq. 19 in its band."""
        held, goal, scene = self.held(x)

        def function(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            residual, jacobian = hammer_residuals(z[:, 4:], held, goal, scene, self.state.cfg)
            gradient = np.einsum("sr,srn->sn", residual, jacobian)
            return 0.5 * (np.asarray(residual) ** 2).sum(axis=1), np.pad(gradient, ((0, 0), (4, 0)))

        return self._descended(function, x, self.box(x, HAMMER_REACH, HAMMER_NAMES), LAST_ITERATIONS)

    def hammer_settled(self, x: np.ndarray) -> np.ndarray:
        """The hammer alone, to the floor of its basin, by least squares on the same criterion."""
        held, goal, scene = self.held(x)
        lower, upper = self.box(x, HAMMER_REACH, HAMMER_NAMES)
        end = descend(
            lambda z: hammer_residuals(jnp.asarray(z), held, goal, scene, self.state.cfg), x[None, 4:],
            Box(lower[4:], upper[4:]), iterations=ITERATIONS, tolerance=TOLERANCE,
        )  # fmt: skip
        self.evaluations += end.evaluations
        self.settled = bool(end.settled[0])
        return np.append(x[:4], end.z[0])

    def annealed(self, x: np.ndarray, evaluations: int, seed: int) -> np.ndarray:
        """The hammer alone, by annealing on eq. 19 in its band, starting from `x` and from points all over the box.

        Raises
        ------
        FitError
            If no hammer has a finite criterion.
        """
        held, goal, scene = self.held(x)
        lower, upper = self.box(x, HAMMER_REACH, HAMMER_NAMES)
        found = anneal(
            lambda z: hammer_costs(jnp.asarray(z), held, goal, scene, self.state.cfg)[0], lower[4:], upper[4:],
            chains=CHAINS, evaluations=evaluations, seed=seed, start=x[4:],
        )  # fmt: skip
        self.evaluations += found.evaluations
        if not np.isfinite(found.cost):
            raise FitError(NO_HAMMER)
        return np.append(x[:4], found.z)

    def held(self, x: np.ndarray) -> tuple[Held, Goal, Scene]:
        """The string of `x`, with the goal of the hammer's band."""
        goal, scene = self.goal((self.band(2),), self.data.sigma), self.scene()
        return hold(jnp.asarray(_logs(x)), goal, scene, self.state.cfg), goal, scene

    def scene(self) -> Scene:
        """What stays while parameters are searched; a stiffness that is known needs no bounds."""
        space, geometry = self.state.space, Geometry(*map(np.float64, self.state.start.geometry))
        stiff = np.log([space.lower[K], space.upper[K]]) if space.free[K] else np.array([-np.inf, np.inf])
        return Scene(*jax.tree.map(jnp.asarray, (geometry, self.state.rate, self.log_u, stiff)))

    def box(self, x: np.ndarray, reach: np.ndarray, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        """Edges [9], [9] about `x` between which `names` may move, so far as they are free."""
        space = self.state.space
        lower, upper = (np.where(LINEAR, e, np.log(e)) for e in (space.lower[:NUMBER], space.upper[:NUMBER]))
        # The force has no bounds of its own; the scene has the stiffness's.
        lower[K], upper[K] = -np.inf, np.inf
        moves = np.isin(FIT_NAMES, names) & space.free[:NUMBER]
        return np.where(moves, np.maximum(lower, x - reach), x), np.where(moves, np.minimum(upper, x + reach), x)

    def _reach(self, x: np.ndarray, goal: Goal, bands: Sequence[int]) -> np.ndarray:
        """How far to look [9]: what moves the lines, each with its share in eq. 19, by some of their widths."""
        c, kappa, b1, b2 = self.values(x)[:4]
        k = np.arange(1, int(self.data.partials.number.max()) + 1)
        k = k[np.isin(band_of(k), bands)]
        beta2 = (k * np.pi / self.state.start.geometry.length) ** 2
        omega = np.sqrt(c**2 * beta2 + kappa**2 * beta2**2)
        width = float(goal.sigma) + b1 + b2 * beta2
        share = np.asarray((goal.weight * goal.energy) ** 2).sum(axis=1)[: len(k)]
        moved = np.stack([c**2 * beta2 / omega, kappa**2 * beta2**2 / omega, np.ones(len(k)), beta2]) / width
        return HAMMER_REACH + np.append(LINES / np.sqrt((share * moved**2).sum(axis=1)), np.zeros(5))

    def _descended(self, function: Callable, x: np.ndarray, box: tuple, iterations: int) -> np.ndarray:
        """Down the gradient of `function(z [1, 9])`, which knows logarithms only."""

        def by_point(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            cost, slope = (np.asarray(a) for a in function(jnp.asarray(_logs(points))))
            return cost, slope / np.where(LINEAR, points, 1.0)

        end = gradient_descent(by_point, x[None], *box, iterations=iterations, tolerance=TOLERANCE)
        self.evaluations += end.evaluations
        self.settled = bool(end.settled[0])
        return end.z[0]


def _logs(x: np.ndarray) -> np.ndarray:
    """Search coordinates of `struck` [..., 9]: logarithms throughout."""
    return np.where(LINEAR, np.log(np.where(LINEAR, x, 1.0)), x)
