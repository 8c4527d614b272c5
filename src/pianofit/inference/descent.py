"""Descents on one problem's F, by θ, φ and w together: Levenberg and Marquardt's method, BFGS and EM.

While φ and w are held, F of any number of candidates is one parabola of their residuals (`Parabola`), and that is
lowered in its place.
"""

from __future__ import annotations

import numpy as np

from ..model.simulate import MOST_MODES
from .coordinates import STRING_SIZE
from .lanes import in_lanes, own_levels, own_slopes, slopes
from .likelihood import next_weights
from .parabola import Parabola
from .population import Population
from .problem import Problem
from .reports import Report, reports
from .string import StringState, string_report

__all__ = ["Descent"]

# Levenberg and Marquardt's damping over the curvature's diagonal: at first,
FIRST_DAMPING = 1e-2
# at the least, where rounding begins,
LEAST_DAMPING = 1e-7
# and where a step is too short to say anything.
MOST_DAMPING = 1e6
# Longest step of θ, in the smaller of 1 and the prior's standard deviations,
LONGEST_STEP = 1.5
# and of φ, logarithms.
LONGEST_PHI = 1.0
# Lanes of one call where each has a string of its own: the strokes of an ordinary fit,
OWN_LANES = 4
# While the string is held, steps are so many times as long, and modes so many times fewer: a third of the time.
COARSER = 2
# The contact's step error is read off a step so many times finer than the problem's, with all modes the model takes.
FINER = 4
# A minimum is reached when a step gains less than this, F: a tenth of a percent of a likelihood.
CONVERGED = 1e-3
# Hyperparameters stay within so many standard deviations of their priors: a clean sound's excess may sink to nothing.
HYPER_REACH = 12.0

# Value [B], gradient [B, size] and curvature [B, size, size].
Known = tuple[np.ndarray, np.ndarray, np.ndarray]


class Descent:
    """Descents on one problem's F.

    With `strings` None the string is held, and one string serves all candidates. Else it is searched too: frequencies
    and decays join F, with φ and w of `strings`, and every stroke has the tension it was struck at. `offset` [R, K],
    dB, is what a contact stepped without end would add to the levels.
    """

    def __init__(self, problem: Problem, string: np.ndarray, strings: StringState | None = None) -> None:
        self.problem, self.unknowns = problem, problem.unknowns
        self.scene, self.cfg = problem.scene, problem.cfg
        if strings is None:
            scene, cfg = self.scene, self.cfg
            self.scene = scene._replace(rate=scene.rate / COARSER, steps=scene.steps // COARSER)
            self.cfg = cfg._replace(n_modes=max(cfg.rows, cfg.n_modes // COARSER))
        self.table = problem.observed.level
        self.string, self.strings = string, strings
        self.offset = np.zeros_like(self.table.value)
        self.stroke = np.array(problem.layout.stroke)
        self.columns = problem.observed.number - 1
        self.there = self.table.found + 0.0
        self.there[tuple(self.table.absent.T)] = 1.0
        self.moves = self.unknowns.free.copy()
        self.moves[:STRING_SIZE] &= strings is not None
        self.lanes = 0

    # --- the model ----------------------------------------------------------------------------------------------------

    def lanes_of(self, z: np.ndarray) -> np.ndarray:
        """One lane a stroke [B · strokes, lane]."""
        u = self.unknowns
        hammers = np.repeat(z[:, STRING_SIZE : u.shared], u.strokes, axis=0)
        return np.concatenate([hammers, z[:, u.shared :].reshape(-1, 1)], axis=1)

    def own_lanes(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Strings, tensions and lanes of every stroke [B · strokes, ...]."""
        strokes = self.unknowns.strokes
        first = [int(np.argmax(self.stroke == s)) for s in range(strokes)]
        cents = np.tile(self.problem.observed.cents[first], len(z))
        return np.repeat(z[:, :STRING_SIZE], strokes, axis=0), cents, self.lanes_of(z)

    def model(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Residuals [B, R, K], the law's derivatives [B, R, K, size], and whether all contacts ended [B]."""
        strokes = self.unknowns.strokes
        self.lanes += len(z) * strokes
        free = self.scene.free[self.scene.free >= 0]
        if self.strings is None:
            level, slope, ended = in_lanes(slopes, (self.string, self.lanes_of(z)), self.scene, self.cfg)
            shared = free[:-1] + STRING_SIZE
        else:
            level, slope, ended = in_lanes(own_slopes, self.own_lanes(z), self.scene, self.cfg, OWN_LANES)
            shared = np.append(np.arange(STRING_SIZE), free[:-1] + STRING_SIZE)
        level = level.reshape(len(z), strokes, -1)[:, self.stroke][..., self.columns]
        slope = slope.reshape(len(z), strokes, *slope.shape[1:])[:, self.stroke][:, :, self.columns]
        slope = slope[..., : len(shared) + 1]
        jacobian = np.zeros((*level.shape, self.unknowns.size))
        jacobian[..., shared] = slope[..., :-1]
        for r, stroke in enumerate(self.stroke):
            jacobian[:, r, :, self.unknowns.shared + stroke] = slope[:, r, :, -1]
        jacobian *= self.there[..., None] * self.moves
        residual = (self.table.value - level - self.offset) * self.there
        good = np.logical_and(ended.reshape(len(z), strokes).all(axis=1), np.isfinite(jacobian).all(axis=(1, 2, 3)))
        return np.where(good[:, None, None], residual, 0.0), np.where(good[:, None, None, None], jacobian, 0.0), good

    def step_error(self, z: np.ndarray) -> np.ndarray:
        """What a contact stepped without end adds to the levels at `z` [size], dB [R, K]: the error is of order 2."""
        p = self.problem
        fine = p.scene._replace(rate=p.scene.rate * FINER, steps=p.scene.steps * FINER)
        finer = in_lanes(own_levels, self.own_lanes(z[None]), fine, p.cfg._replace(n_modes=MOST_MODES), OWN_LANES)[0]
        change = (finer - self.level(z))[self.stroke][:, self.columns]
        shorter = (fine.rate / self.scene.rate) ** 2
        return change * shorter / (shorter - 1) * self.there

    def level(self, z: np.ndarray) -> np.ndarray:
        """Levels by the model at `z` [size], dB [strokes, rows], by the descent's program: that is compiled anyway."""
        if self.strings is None:
            return in_lanes(slopes, (self.string, self.lanes_of(z[None])), self.scene, self.cfg)[0]
        return in_lanes(own_slopes, self.own_lanes(z[None]), self.scene, self.cfg, OWN_LANES)[0]

    def known(self, z: np.ndarray) -> Known:
        """Of F, what levels do not say: value [B], gradient [B, size] and curvature [B, size, size].

        That is the prior of θ and, where the string is searched, its frequencies and decays.
        """
        u = self.unknowns
        weight = np.where(self.moves, 1 / np.where(u.free, u.sd, 1.0) ** 2, 0.0)
        away = z - u.mean
        value, gradient = 0.5 * (weight * away**2).sum(axis=1), weight * away
        curvature = np.tile(np.diag(weight), (len(z), 1, 1))
        if self.strings is not None:
            some = slice(0, STRING_SIZE)
            for i, point in enumerate(z):
                for found in string_report(self.problem, point[some], self.strings):
                    value[i] += found.F
                    gradient[i, some] += np.where(self.moves[some], found.gradient, 0.0)
                    curvature[i, some, some] += found.curvature
        return value, gradient, curvature

    def total(self, z: np.ndarray, report: Report) -> np.ndarray:
        """F with the prior of θ [B]."""
        return report.F + self.known(z)[0]

    def begun(
        self, z: np.ndarray, phi: np.ndarray, w: np.ndarray | None = None, parabola: Parabola | None = None
    ) -> Population:
        """Candidates at `z` [B, size]; those whose contact does not end are left out. See `_judged` of `parabola`."""
        residual, jacobian, good = self.model(z)
        z, residual, jacobian = z[good], residual[good], jacobian[good]
        count = len(z)
        phi = np.broadcast_to(phi, (count, 4)).copy()
        w = np.broadcast_to(np.ones_like(self.table.value) if w is None else w, residual.shape).copy()
        if not count:
            empty = Report(*(np.zeros((0, 0)),) * 5)
            return Population(z, phi, w, residual, jacobian, empty, np.zeros(0), np.zeros((0, 4, 4)), np.zeros(0))
        found = self._judged(residual, jacobian, phi, w, parabola)
        return Population(
            z, phi, w, residual, jacobian, found, np.full(count, FIRST_DAMPING),
            np.tile(self._first_inverse(), (count, 1, 1)), np.full(count, np.inf),
        )  # fmt: skip

    def _first_inverse(self) -> np.ndarray:
        """Of F's Hessian by φ: every level counts twice for σ, others by their priors."""
        spread = np.asarray(self.table.prior[1])
        inverse = spread**2
        inverse[0] = 1 / (2 * float(self.table.found.sum()) + 1 / spread[0] ** 2)
        return np.diag(inverse)

    # --- descent ------------------------------------------------------------------------------------------------------

    def _judged(
        self, residual: np.ndarray, jacobian: np.ndarray, phi: np.ndarray, w: np.ndarray, parabola: Parabola | None
    ) -> Report:
        """F, or its parabola while φ and w are held, of candidates."""
        return reports(self.table, residual, jacobian, phi, w) if parabola is None else parabola(residual, jacobian)

    def descend(
        self, people: Population, floor: float, iterations: int, tolerance: float = CONVERGED,
        parabola: Parabola | None = None,
    ) -> Population:  # fmt: skip
        """Lower F from every candidate, sorted, the lowest first; σ is held above `floor`, dB, or φ and w as they are.

        With a `parabola` it alone is lowered, and φ and w stay.
        """
        people.gained = np.full(len(people), np.inf)
        people.damping = np.minimum(people.damping, FIRST_DAMPING)
        if parabola is None:
            self._lift(people, floor)
        for _ in range(iterations):
            on = np.flatnonzero(people.gained > tolerance)
            if not len(on):
                break
            self._step(people, on, floor, parabola)
        return people.take(np.argsort(self.total(people.z, people.report), kind="stable"))

    def _lift(self, people: Population, floor: float) -> None:
        """F where φ is put that a floor which has risen no longer allows."""
        people.phi = np.clip(people.phi, *self._range(floor))
        people.report = reports(self.table, people.residual, people.jacobian, people.phi, people.w)

    def _range(self, floor: float) -> tuple[np.ndarray, np.ndarray]:
        """Least and largest φ, with σ above `floor`, dB."""
        mean, sd = (np.asarray(x) for x in self.table.prior)
        lower, upper = mean - HYPER_REACH * sd, mean + HYPER_REACH * sd
        lower[0] = max(lower[0], np.log(max(floor, 1e-9)))
        return lower, np.maximum(upper, lower)

    def _step(self, people: Population, on: np.ndarray, floor: float, parabola: Parabola | None) -> None:
        """One step of the candidates `on`: of θ by Levenberg and Marquardt, then of φ by BFGS and of w by EM."""
        now = people.take(on)
        known = self.known(now.z)
        before = now.report.F + known[0]
        z = self.unknowns.project(now.z + self._direction(now, known, now.damping)[0])
        residual, jacobian, good = self.model(z)
        found = self._judged(residual, jacobian, now.phi, now.w, parabola)
        elsewhere = self.known(z)[0]
        better = np.where(good, found.F + elsewhere, np.inf) < before
        stuck = ~better & (now.damping >= MOST_DAMPING)
        now.damping = np.clip(now.damping * np.where(better, 0.2, 8.0), LEAST_DAMPING, 8 * MOST_DAMPING)
        now.put(np.flatnonzero(better), Population(
            z[better], now.phi[better], now.w[better], residual[better], jacobian[better], found.take(better),
            now.damping[better], now.inverse[better], now.gained[better],
        ))  # fmt: skip
        if parabola is None:
            self._settle(now, floor)
        now.gained = np.where(better | stuck, before - now.report.F - np.where(better, elsewhere, known[0]), np.inf)
        people.put(on, now)

    def _settle(self, now: Population, floor: float) -> None:
        """A step of φ by BFGS and of w by EM, where it lowers F."""
        lower, upper = self._range(floor)
        slope = now.report.by_phi
        active = ((now.phi <= lower) & (slope > 0)) | ((now.phi >= upper) & (slope < 0))
        step = -np.einsum("bij,bj->bi", now.inverse, np.where(active, 0.0, slope))
        step = np.clip(np.where(active, 0.0, step), -LONGEST_PHI, LONGEST_PHI)
        phi = np.clip(now.phi + step, lower, upper)
        w = next_weights(self.table, now.report.by_log_w, now.w)
        found = reports(self.table, now.residual, now.jacobian, phi, w)
        inverse = _bfgs(now.inverse, phi - now.phi, found.by_phi - slope)
        better = found.F < now.report.F
        now.inverse = np.where(better[:, None, None], inverse, 0.3 * now.inverse)
        now.phi = np.where(better[:, None], phi, now.phi)
        now.w = np.where(better[:, None, None], w, now.w)
        for mine, new in zip(now.report, found, strict=True):
            mine[better] = new[better]

    def promised(self, people: Population) -> np.ndarray:
        """What a step of θ would gain if F were its parabola [B]."""
        return self._direction(people, self.known(people.z), np.zeros(len(people)))[1]

    def _direction(self, now: Population, known: Known, damping: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Steps of θ [B, size], an unknown on an edge that a step would leave stays; and half their slope [B]."""
        u = self.unknowns
        gradient, curvature = known[1] + now.report.gradient, known[2] + now.report.curvature
        lower, upper = u.edges(now.z)
        active = ((now.z <= lower) & (gradient > 0)) | ((now.z >= upper) & (gradient < 0))
        along = u.along_edges(now.z, active)
        gradient = np.einsum("bij,bi->bj", along, gradient)
        curvature = np.einsum("bki,bkl,blj->bij", along, curvature, along)
        active |= ((now.z <= lower) & (gradient > 0)) | ((now.z >= upper) & (gradient < 0))
        moves = self.moves & ~active
        lhs = curvature + (damping[:, None] * np.einsum("bii->bi", curvature))[..., None] * np.eye(u.size)
        lhs = np.where(moves[:, :, None] & moves[:, None, :], lhs, np.eye(u.size))
        step = np.linalg.solve(lhs, np.where(moves, -gradient, 0.0)[..., None])[..., 0]
        size = (np.abs(step) / np.where(u.free, np.minimum(u.sd, 1.0), 1.0)).max(axis=1)
        return step * np.minimum(1.0, LONGEST_STEP / np.maximum(size, 1e-12))[:, None], -0.5 * (gradient * step).sum(1)


def _bfgs(inverse: np.ndarray, step: np.ndarray, change: np.ndarray) -> np.ndarray:
    """The inverse Hessians [B, n, n] after steps and changes of the gradient [B, n]; kept where they say nothing."""
    product = np.einsum("bi,bi->b", step, change)
    good = product > 1e-10
    rho = 1 / np.where(good, product, 1.0)
    left = np.eye(step.shape[1]) - rho[:, None, None] * np.einsum("bi,bj->bij", step, change)
    new = np.einsum("bij,bjk,blk->bil", left, inverse, left) + rho[:, None, None] * np.einsum("bi,bj->bij", step, step)
    return np.where(good[:, None, None], new, inverse)
