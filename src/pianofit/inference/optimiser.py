"""Descents on one problem's F, by θ, φ and w together: Levenberg and Marquardt's method, BFGS and EM.

While φ and w are held, F of any number of candidates is one parabola of their residuals (`QuadraticSurrogate`), and that is
lowered in its place.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from ..model.simulate import MOST_MODES
from .batched_model import level_jacobians, level_jacobians_per_string, levels_per_string, run_in_batches
from .candidates import Candidates, TableState, chosen
from .derivatives import evaluate_batch
from .likelihood import ObservationTable, em_weights
from .parametrisation import STRING_SIZE
from .problem import FitProblem
from .quadratic_surrogate import QuadraticSurrogate

__all__ = ["LEVELS", "STRINGS", "Optimiser"]

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
STEP_COARSENING = 2
# The contact's step error is read off a step so many times finer than the problem's, with all modes the model takes.
FINER = 4
# A minimum is reached when a step gains less than this, F: a tenth of a percent of a likelihood.
CONVERGED = 1e-3
# Hyperparameters stay within so many standard deviations of their priors: a clean sound's excess may sink to nothing.
HYPER_REACH = 12.0

# The tables of a descent: of levels, while the string is held; of the string, before any hammer is known; and all.
LEVELS, STRINGS = ("level",), ("frequency", "decay")
EVERY = (*LEVELS, *STRINGS)


class Optimiser:
    """Descents on one problem's F, or on the part of it that some of its tables are.

    Without frequencies and decays the string is held at `string`, and one string serves all candidates. With them it is
    searched, and every stroke has the tension it was struck at.
    """

    def __init__(self, problem: FitProblem, string: np.ndarray | None = None, tables: Sequence[str] = EVERY) -> None:
        self.problem, self.unknowns = problem, problem.unknowns
        self.scene, self.cfg = problem.scene, problem.cfg
        self.string = self.unknowns.mean[:STRING_SIZE] if string is None else string
        self.tables = tuple(getattr(problem.observed, name) for name in tables)
        self.uses_levels, self.string_fixed = "level" in tables, "frequency" not in tables
        if self.string_fixed:
            scene, cfg = self.scene, self.cfg
            self.scene = scene._replace(rate=scene.rate / STEP_COARSENING, steps=scene.steps // STEP_COARSENING)
            self.cfg = cfg._replace(n_modes=max(cfg.rows, cfg.n_modes // STEP_COARSENING))
        self.table = problem.observed.level
        self.stroke = np.array(problem.layout.stroke)
        self.columns = problem.observed.number - 1
        self.has_level = self.table.detected + 0.0
        self.has_level[tuple(self.table.censored.T)] = 1.0
        self.is_free = self.unknowns.free.copy()
        self.is_free[:STRING_SIZE] &= not self.string_fixed
        self.is_free[STRING_SIZE:] &= self.uses_levels
        self.lanes = 0

    # --- the model ----------------------------------------------------------------------------------------------------

    def model_inputs_of(self, z: np.ndarray) -> np.ndarray:
        """One lane a stroke [B · strokes, lane]."""
        u = self.unknowns
        hammers = np.repeat(z[:, STRING_SIZE : u.shared], u.strokes, axis=0)
        return np.concatenate([hammers, z[:, u.shared :].reshape(-1, 1)], axis=1)

    def model_inputs_with_strings(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Strings, tensions and lanes of every stroke [B · strokes, ...]."""
        strokes = self.unknowns.strokes
        first = [int(np.argmax(self.stroke == s)) for s in range(strokes)]
        cents = np.tile(self.problem.observed.cents[first], len(z))
        return np.repeat(z[:, :STRING_SIZE], strokes, axis=0), cents, self.model_inputs_of(z)

    def model(self, z: np.ndarray, offset: np.ndarray) -> tuple[list[tuple[np.ndarray, np.ndarray]], np.ndarray]:
        """Of every table residuals [B, R, K] and the law's derivatives [B, R, K, size]; whether contacts ended [B]."""
        laws, good = [], np.ones(len(z), bool)
        if self.uses_levels:
            *levels, good = self._levels(z, offset)
            laws.append(tuple(levels))
        if not self.string_fixed:
            each = [self.problem.string_residuals(point[:STRING_SIZE]) for point in z]
            for table in range(len(STRINGS)):
                slope = np.array([slopes[table] for _, slopes in each]) * self.is_free[:STRING_SIZE]
                jacobian = np.zeros((*slope.shape[:-1], self.unknowns.size))
                jacobian[..., :STRING_SIZE] = slope
                laws.append((np.array([residuals[table] for residuals, _ in each]), jacobian))
        return laws, good

    def _levels(self, z: np.ndarray, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Residuals of levels, their law's derivatives, and whether contacts ended."""
        self.lanes += len(z) * self.unknowns.strokes
        level, slope, ended = self._sloped(z)
        shared = self.scene.free[self.scene.free >= 0][:-1] + STRING_SIZE
        if not self.string_fixed:
            shared = np.append(np.arange(STRING_SIZE), shared)
        slope = slope[..., : len(shared) + 1]
        jacobian = np.zeros((*level.shape, self.unknowns.size))
        jacobian[..., shared] = slope[..., :-1]
        for r, stroke in enumerate(self.stroke):
            jacobian[:, r, :, self.unknowns.shared + stroke] = slope[:, r, :, -1]
        jacobian *= self.has_level[..., None] * self.is_free
        residual = (self.table.value - level - offset) * self.has_level
        good = ended & np.isfinite(jacobian).all(axis=(1, 2, 3))
        return np.where(good[:, None, None], residual, 0.0), np.where(good[:, None, None, None], jacobian, 0.0), good

    def discretisation_error_db(self, z: np.ndarray) -> np.ndarray:
        """What a contact stepped without end adds to levels at `z` [B, size], dB [B, R, K]: the error is of order 2."""
        p = self.problem
        fine = p.scene._replace(rate=p.scene.rate * FINER, steps=p.scene.steps * FINER)
        finer = run_in_batches(
            levels_per_string, self.model_inputs_with_strings(z), fine, p.cfg._replace(n_modes=MOST_MODES), OWN_LANES
        )[0]
        change = self._of_recordings(finer) - self.level(z)
        shorter = (fine.rate / self.scene.rate) ** 2
        return change * shorter / (shorter - 1) * self.has_level

    def level(self, z: np.ndarray) -> np.ndarray:
        """Levels by the model at `z` [B, size], dB [B, R, K], by the descent's program: that is compiled anyway."""
        return self._sloped(z)[0]

    def _sloped(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Levels, dB [B, R, K], their derivatives [B, R, K, directions], and whether contacts ended [B]."""
        if self.string_fixed:
            level, slope, ended = run_in_batches(
                level_jacobians, (self.string, self.model_inputs_of(z)), self.scene, self.cfg
            )
        else:
            level, slope, ended = run_in_batches(
                level_jacobians_per_string, self.model_inputs_with_strings(z), self.scene, self.cfg, OWN_LANES
            )
        return self._of_recordings(level), self._of_recordings(slope), np.all(ended.reshape(len(z), -1), axis=1)

    def _of_recordings(self, rows: np.ndarray) -> np.ndarray:
        """Of every recording's columns [B, R, K, ...], of all of the model's rows [B · strokes, rows, ...]."""
        return rows.reshape(-1, self.unknowns.strokes, *rows.shape[1:])[:, self.stroke][:, :, self.columns]

    def prior(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of F, the prior of θ: value [B], gradient [B, size] and curvature [size, size]."""
        u = self.unknowns
        weight = np.where(self.is_free, u.precision, 0.0)
        away = z - u.mean
        return 0.5 * (weight * away**2).sum(axis=1), weight * away, np.diag(weight)

    def total(self, candidates: Candidates) -> np.ndarray:
        """F [B], of this descent's tables and the prior of what moves."""
        return self.prior(candidates.theta)[0] + sum(part.derivatives.nll for part in candidates.parts)

    def initialise(
        self, z: np.ndarray, phi: Sequence[np.ndarray], w: Sequence[np.ndarray] | None = None,
        offset: np.ndarray | float = 0.0, parabola: QuadraticSurrogate | None = None,
    ) -> Candidates:  # fmt: skip
        """Candidates at `z` [B, size], without those whose contact does not end.

        Parameters
        ----------
        phi, w : of every table, of all candidates or of each; w is 1 if None.
        offset : their levels' step error, dB, of all candidates or of each; see `step_error`.
        parabola : F while φ and w are held, of the levels alone; see `descend`.
        """
        offset = np.broadcast_to(offset, (len(z), *self.table.value.shape))
        laws, good = self.model(z, offset)
        count = int(good.sum())
        parts = []
        for i, (table, (residual, jacobian)) in enumerate(zip(self.tables, laws, strict=True)):
            own = np.broadcast_to(phi[i], (len(z), 4))[good]
            weights = np.broadcast_to(1.0 if w is None else w[i], residual.shape)[good]
            there = residual[good], jacobian[good]
            found = evaluate_batch(table, *there, own, weights) if parabola is None else parabola(*there)
            parts.append(TableState(own, weights, *there, found, np.tile(_first_inverse(table), (count, 1, 1))))
        return Candidates(z[good], offset[good], tuple(parts), np.full(count, FIRST_DAMPING), np.full(count, np.inf))

    # --- descent ------------------------------------------------------------------------------------------------------

    def minimise(
        self, candidates: Candidates, floor: float, iterations: int, tolerance: float = CONVERGED,
        parabola: QuadraticSurrogate | None = None,
    ) -> Candidates:  # fmt: skip
        """Lower F from every candidate, sorted, the lowest first; σ of levels is held above `floor`, dB.

        With a `parabola` it alone is lowered, and φ and w stay.
        """
        candidates = replace(
            candidates,
            last_decrease=np.full(len(candidates), np.inf),
            damping=np.minimum(candidates.damping, FIRST_DAMPING),
        )
        if parabola is None:
            candidates = replace(
                candidates, parts=tuple(self._reevaluate_exactly(*pair, floor) for pair in self._by_table(candidates))
            )
        for _ in range(iterations):
            on = np.flatnonzero(candidates.last_decrease > tolerance)
            if not len(on):
                break
            candidates = candidates.put(on, self._lm_step(candidates.take(on), floor, parabola))
        return candidates.take(np.argsort(self.total(candidates), kind="stable"))

    def _by_table(self, candidates: Candidates) -> Iterable[tuple[ObservationTable, TableState]]:
        return zip(self.tables, candidates.parts, strict=True)

    def _reevaluate_exactly(self, table: ObservationTable, part: TableState, floor: float) -> TableState:
        """By F itself, which a parabola may have stood for, with φ where a floor which has risen allows it."""
        phi = np.clip(part.phi, *self._range(table, floor))
        return part._replace(phi=phi, derivatives=evaluate_batch(table, part.residual, part.jacobian, phi, part.w))

    def _range(self, table: ObservationTable, floor: float) -> tuple[np.ndarray, np.ndarray]:
        """Least and largest φ, with σ of levels above `floor`, dB."""
        mean, sd = (np.asarray(x) for x in table.prior)
        lower, upper = mean - HYPER_REACH * sd, mean + HYPER_REACH * sd
        if floor and table is self.table:
            lower[0] = max(lower[0], np.log(floor))
        return lower, np.maximum(upper, lower)

    def _lm_step(self, now: Candidates, floor: float, parabola: QuadraticSurrogate | None) -> Candidates:
        """After one step: of θ by Levenberg and Marquardt, then of φ by BFGS and of w by EM."""
        before = self.total(now)
        z = self.unknowns.project(now.theta + self._direction(now, now.damping)[0])
        laws, good = self.model(z, now.offset)
        parts = tuple(
            part._replace(
                residual=law[0], jacobian=law[1],
                derivatives=evaluate_batch(table, *law, part.phi, part.w) if parabola is None else parabola(*law),
            )
            for (table, part), law in zip(self._by_table(now), laws, strict=True)
        )  # fmt: skip
        tried = replace(now, theta=z, parts=parts)
        there = self.total(tried)
        better = np.where(good, there, np.inf) < before
        stuck = ~better & (now.damping >= MOST_DAMPING)
        damping = np.clip(now.damping * np.where(better, 0.2, 8.0), LEAST_DAMPING, 8 * MOST_DAMPING)
        now = replace(chosen(better, tried, now), damping=damping)
        if parabola is None:
            now = replace(now, parts=tuple(self._update_nuisances(*pair, floor) for pair in self._by_table(now)))
        return replace(now, last_decrease=np.where(better | stuck, before - self.total(now), np.inf))

    def _update_nuisances(self, table: ObservationTable, part: TableState, floor: float) -> TableState:
        """After a step of φ by BFGS and of w by EM, where it lowers F."""
        lower, upper = self._range(table, floor)
        slope = part.derivatives.by_phi
        active = ((part.phi <= lower) & (slope > 0)) | ((part.phi >= upper) & (slope < 0))
        step = -np.einsum("bij,bj->bi", part.inverse, np.where(active, 0.0, slope))
        step = np.clip(np.where(active, 0.0, step), -LONGEST_PHI, LONGEST_PHI)
        phi = np.clip(part.phi + step, lower, upper)
        w = em_weights(table, part.derivatives.by_log_w, part.w)
        found = evaluate_batch(table, part.residual, part.jacobian, phi, w)
        inverse = _bfgs(part.inverse, phi - part.phi, found.by_phi - slope)
        settled = part._replace(phi=phi, w=w, derivatives=found, inverse=inverse)
        return chosen(found.nll < part.derivatives.nll, settled, part._replace(inverse=0.3 * part.inverse))

    def slope(self, candidates: Candidates) -> np.ndarray:
        """F's gradient by θ [B, size]."""
        return self.prior(candidates.theta)[1] + sum(part.derivatives.gradient for part in candidates.parts)

    def predicted_decrease(self, candidates: Candidates) -> np.ndarray:
        """What a step of θ would gain if F were its parabola [B]."""
        return self._direction(candidates, np.zeros(len(candidates)))[1]

    def _direction(self, now: Candidates, damping: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Steps of θ [B, size], an unknown on an edge that a step would leave stays; and half their slope [B]."""
        u = self.unknowns
        gradient = self.slope(now)
        curvature = self.prior(now.theta)[2] + sum(part.derivatives.curvature for part in now.parts)
        lower, upper = u.bounds_at(now.theta)
        active = ((now.theta <= lower) & (gradient > 0)) | ((now.theta >= upper) & (gradient < 0))
        along = u.bound_jacobian(now.theta, active)
        gradient = np.einsum("bij,bi->bj", along, gradient)
        curvature = np.einsum("bki,bkl,blj->bij", along, curvature, along)
        active |= ((now.theta <= lower) & (gradient > 0)) | ((now.theta >= upper) & (gradient < 0))
        moves = self.is_free & ~active
        lhs = curvature + (damping[:, None] * np.einsum("bii->bi", curvature))[..., None] * np.eye(u.size)
        lhs = np.where(moves[:, :, None] & moves[:, None, :], lhs, np.eye(u.size))
        step = np.linalg.solve(lhs, np.where(moves, -gradient, 0.0)[..., None])[..., 0]
        size = (np.abs(step) / np.where(u.free, np.minimum(u.sd, 1.0), 1.0)).max(axis=1)
        return step * np.minimum(1.0, LONGEST_STEP / np.maximum(size, 1e-12))[:, None], -0.5 * (gradient * step).sum(1)


def _first_inverse(table: ObservationTable) -> np.ndarray:
    """Of F's Hessian by φ [4, 4]: every entry counts twice for σ, others by their priors."""
    spread = np.asarray(table.prior[1])
    inverse = spread**2
    inverse[0] = 1 / (2 * float(table.detected.sum()) + 1 / spread[0] ** 2)
    return np.diag(inverse)


def _bfgs(inverse: np.ndarray, step: np.ndarray, change: np.ndarray) -> np.ndarray:
    """The inverse Hessians [B, n, n] after steps and changes of the gradient [B, n]; kept where they say nothing."""
    product = np.einsum("bi,bi->b", step, change)
    good = product > 1e-10
    rho = 1 / np.where(good, product, 1.0)
    left = np.eye(step.shape[1]) - rho[:, None, None] * np.einsum("bi,bj->bij", step, change)
    new = np.einsum("bij,bjk,blk->bil", left, inverse, left) + rho[:, None, None] * np.einsum("bi,bj->bij", step, step)
    return np.where(good[:, None, None], new, inverse)
