"""Minimisation of F by θ, φ and w together: Levenberg-Marquardt, BFGS and EM.

With φ and w fixed, one quadratic of the residuals replaces F for any number of candidates (`QuadraticSurrogate`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from ..model.simulate import MAX_MODES
from .batched_model import level_jacobians, level_jacobians_per_string, levels_per_string, run_in_batches
from .candidates import Candidates, TableState, select
from .derivatives import evaluate_batch
from .likelihood import ObservationTable, em_weights
from .parametrisation import STRING_SIZE
from .problem import FitProblem
from .quadratic_surrogate import QuadraticSurrogate

__all__ = ["LEVELS", "STRINGS", "Optimiser"]

# Levenberg-Marquardt damping relative to the curvature's diagonal: initial,
FIRST_DAMPING = 1e-2
# lowest, where rounding begins,
LEAST_DAMPING = 1e-7
# and highest, where a step is too short to change F measurably.
MOST_DAMPING = 1e6
# Longest step of θ, in the smaller of 1 and the prior's standard deviations,
LONGEST_STEP = 1.5
# and of φ, logarithms.
LONGEST_PHI = 1.0
# Strokes of one model call if each has its own string: the strokes of an ordinary fit.
STRING_BATCH_SIZE = 4
# With the string fixed, steps are longer and modes fewer by this factor: a third of the time.
STEP_COARSENING = 2
# Refinement of the step that estimates the discretisation error of the contact, with all modes of the model.
FINER = 4
# A minimum is reached when a step lowers F by less than this, a tenth of a percent of a likelihood.
CONVERGED = 1e-3
# Range of hyperparameters, in standard deviations of their priors: the excess of a clean recording may be near zero.
HYPER_REACH = 12.0

# The tables of a minimisation: levels, with the string fixed; those of the string, before a hammer is known; and all.
LEVELS, STRINGS = ("level",), ("frequency", "decay")
EVERY = (*LEVELS, *STRINGS)


class Optimiser:
    """Minimiser of one problem's F, or of its part in some tables.

    Without frequencies and decays the string is fixed at `string`, and one string serves all candidates. With them the
    string is searched, and every stroke has the pitch offset with which it was recorded.
    """

    def __init__(self, problem: FitProblem, string: np.ndarray | None = None, tables: Sequence[str] = EVERY) -> None:
        self.problem, self.unknowns = problem, problem.parametrisation
        self.model_inputs, self.cfg = problem.model_inputs, problem.cfg
        self.string = self.unknowns.mean[:STRING_SIZE] if string is None else string
        self.tables = tuple(getattr(problem.observed, name) for name in tables)
        self.uses_levels, self.string_fixed = "level" in tables, "frequency" not in tables
        if self.string_fixed:
            inputs, cfg = self.model_inputs, self.cfg
            self.model_inputs = inputs._replace(
                rate=inputs.rate / STEP_COARSENING, steps=inputs.steps // STEP_COARSENING
            )
            self.cfg = cfg._replace(n_modes=max(cfg.rows, cfg.n_modes // STEP_COARSENING))
        self.table = problem.observed.level
        self.stroke = np.array(problem.structure.stroke)
        self.columns = problem.observed.number - 1
        self.has_level = self.table.detected + 0.0
        self.has_level[tuple(self.table.censored.T)] = 1.0
        self.is_free = self.unknowns.free.copy()
        self.is_free[:STRING_SIZE] &= not self.string_fixed
        self.is_free[STRING_SIZE:] &= self.uses_levels
        self.n_strokes_computed = 0

    # --- the model ----------------------------------------------------------------------------------------------------

    def model_inputs_of(self, theta: np.ndarray) -> np.ndarray:
        """Batch entries of every stroke [B · strokes, entries]."""
        u = self.unknowns
        hammers = np.repeat(theta[:, STRING_SIZE : u.shared], u.strokes, axis=0)
        return np.concatenate([hammers, theta[:, u.shared :].reshape(-1, 1)], axis=1)

    def model_inputs_with_strings(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Strings, pitch offsets and batch entries of every stroke [B · strokes, ...]."""
        strokes = self.unknowns.strokes
        first = [int(np.argmax(self.stroke == s)) for s in range(strokes)]
        cents = np.tile(self.problem.observed.cents[first], len(theta))
        return np.repeat(theta[:, :STRING_SIZE], strokes, axis=0), cents, self.model_inputs_of(theta)

    def model(self, theta: np.ndarray, offset: np.ndarray) -> tuple[list[tuple[np.ndarray, np.ndarray]], np.ndarray]:
        """Residuals [B, R, K] and derivatives [B, R, K, size] of every table, and whether contacts ended [B]."""
        models, valid = [], np.ones(len(theta), bool)
        if self.uses_levels:
            *levels, valid = self._levels(theta, offset)
            models.append(tuple(levels))
        if not self.string_fixed:
            strings = [self.problem.string_residuals(point[:STRING_SIZE]) for point in theta]
            for table in range(len(STRINGS)):
                slope = np.array([slopes[table] for _, slopes in strings]) * self.is_free[:STRING_SIZE]
                jacobian = np.zeros((*slope.shape[:-1], self.unknowns.size))
                jacobian[..., :STRING_SIZE] = slope
                models.append((np.array([residuals[table] for residuals, _ in strings]), jacobian))
        return models, valid

    def _levels(self, theta: np.ndarray, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Residuals of levels, their derivatives, and whether contacts ended."""
        self.n_strokes_computed += len(theta) * self.unknowns.strokes
        level, slope, ended = self._level_jacobians(theta)
        shared = self.model_inputs.free[self.model_inputs.free >= 0][:-1] + STRING_SIZE
        if not self.string_fixed:
            shared = np.append(np.arange(STRING_SIZE), shared)
        slope = slope[..., : len(shared) + 1]
        jacobian = np.zeros((*level.shape, self.unknowns.size))
        jacobian[..., shared] = slope[..., :-1]
        for r, stroke in enumerate(self.stroke):
            jacobian[:, r, :, self.unknowns.shared + stroke] = slope[:, r, :, -1]
        jacobian *= self.has_level[..., None] * self.is_free
        residual = (self.table.value - level - offset) * self.has_level
        valid = ended & np.isfinite(jacobian).all(axis=(1, 2, 3))
        residual = np.where(valid[:, None, None], residual, 0.0)
        return residual, np.where(valid[:, None, None, None], jacobian, 0.0), valid

    def discretisation_error_db(self, theta: np.ndarray) -> np.ndarray:
        """Error of the levels at `theta` [B, size] from the contact's step, dB [B, R, K]; extrapolated at order 2."""
        p = self.problem
        fine = p.model_inputs._replace(rate=p.model_inputs.rate * FINER, steps=p.model_inputs.steps * FINER)
        finer = run_in_batches(
            levels_per_string, self.model_inputs_with_strings(theta), fine, p.cfg._replace(n_modes=MAX_MODES),
            STRING_BATCH_SIZE,
        )[0]  # fmt: skip
        change = self._by_recording(finer) - self.level(theta)
        shorter = (fine.rate / self.model_inputs.rate) ** 2
        return change * shorter / (shorter - 1) * self.has_level

    def level(self, theta: np.ndarray) -> np.ndarray:
        """Levels of the model at `theta` [B, size], dB [B, R, K], by the search's program, which is compiled anyway."""
        return self._level_jacobians(theta)[0]

    def _level_jacobians(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Levels, dB [B, R, K], their derivatives [B, R, K, directions], and whether contacts ended [B]."""
        if self.string_fixed:
            level, slope, ended = run_in_batches(
                level_jacobians, (self.string, self.model_inputs_of(theta)), self.model_inputs, self.cfg
            )
        else:
            batch = self.model_inputs_with_strings(theta)
            level, slope, ended = run_in_batches(
                level_jacobians_per_string, batch, self.model_inputs, self.cfg, STRING_BATCH_SIZE
            )
        return self._by_recording(level), self._by_recording(slope), np.all(ended.reshape(len(theta), -1), axis=1)

    def _by_recording(self, rows: np.ndarray) -> np.ndarray:
        """Select every recording's columns [B, R, K, ...] from the model's rows [B · strokes, rows, ...]."""
        return rows.reshape(-1, self.unknowns.strokes, *rows.shape[1:])[:, self.stroke][:, :, self.columns]

    def prior(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Part of F by the prior of θ: value [B], gradient [B, size] and curvature [size, size]."""
        u = self.unknowns
        weight = np.where(self.is_free, u.precision, 0.0)
        deviation = theta - u.mean
        return 0.5 * (weight * deviation**2).sum(axis=1), weight * deviation, np.diag(weight)

    def total(self, candidates: Candidates) -> np.ndarray:
        """F [B] of this optimiser's tables and of the prior of its free parameters."""
        return self.prior(candidates.theta)[0] + sum(part.derivatives.nll for part in candidates.parts)

    def initialise(
        self, theta: np.ndarray, phi: Sequence[np.ndarray], w: Sequence[np.ndarray] | None = None,
        offset: np.ndarray | float = 0.0, surrogate: QuadraticSurrogate | None = None,
    ) -> Candidates:  # fmt: skip
        """Create candidates at `theta` [B, size], without those whose contact does not end.

        Parameters
        ----------
        phi, w : of every table, for all candidates or for each; w is 1 if None.
        offset : discretisation error of the levels, dB, for all candidates or for each (`discretisation_error_db`).
        surrogate : replaces F of the levels, with φ and w fixed; see `minimise`.
        """
        offset = np.broadcast_to(offset, (len(theta), *self.table.value.shape))
        models, valid = self.model(theta, offset)
        count = int(valid.sum())
        parts = []
        for i, (table, (residual, jacobian)) in enumerate(zip(self.tables, models, strict=True)):
            hyper = np.broadcast_to(phi[i], (len(theta), 4))[valid]
            weights = np.broadcast_to(1.0 if w is None else w[i], residual.shape)[valid]
            state = residual[valid], jacobian[valid]
            derivatives = evaluate_batch(table, *state, hyper, weights) if surrogate is None else surrogate(*state)
            inverse = np.tile(_first_inverse(table), (count, 1, 1))
            parts.append(TableState(hyper, weights, *state, derivatives, inverse))
        return Candidates(
            theta[valid], offset[valid], tuple(parts), np.full(count, FIRST_DAMPING), np.full(count, np.inf)
        )

    # --- minimisation -------------------------------------------------------------------------------------------------

    def minimise(
        self, candidates: Candidates, floor: float, iterations: int, tolerance: float = CONVERGED,
        surrogate: QuadraticSurrogate | None = None,
    ) -> Candidates:  # fmt: skip
        """Minimise F from every candidate; sort, lowest first. σ of levels stays above `floor`, dB.

        With a `surrogate`, only the surrogate is minimised, and φ and w are fixed.
        """
        candidates = replace(
            candidates,
            last_decrease=np.full(len(candidates), np.inf),
            damping=np.minimum(candidates.damping, FIRST_DAMPING),
        )
        if surrogate is None:
            candidates = replace(
                candidates, parts=tuple(self._reevaluate_exactly(*pair, floor) for pair in self._by_table(candidates))
            )
        for _ in range(iterations):
            active = np.flatnonzero(candidates.last_decrease > tolerance)
            if not len(active):
                break
            candidates = candidates.put(active, self._lm_step(candidates.take(active), floor, surrogate))
        return candidates.take(np.argsort(self.total(candidates), kind="stable"))

    def _by_table(self, candidates: Candidates) -> Iterable[tuple[ObservationTable, TableState]]:
        return zip(self.tables, candidates.parts, strict=True)

    def _reevaluate_exactly(self, table: ObservationTable, part: TableState, floor: float) -> TableState:
        """Re-evaluate with the exact F after steps on the surrogate; φ is moved to a raised lower limit."""
        phi = np.clip(part.phi, *self._range(table, floor))
        return part._replace(phi=phi, derivatives=evaluate_batch(table, part.residual, part.jacobian, phi, part.w))

    def _range(self, table: ObservationTable, floor: float) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest φ, with σ of levels above `floor`, dB."""
        mean, sd = (np.asarray(x) for x in table.prior)
        lower, upper = mean - HYPER_REACH * sd, mean + HYPER_REACH * sd
        if floor and table is self.table:
            lower[0] = max(lower[0], np.log(floor))
        return lower, np.maximum(upper, lower)

    def _lm_step(self, now: Candidates, floor: float, surrogate: QuadraticSurrogate | None) -> Candidates:
        """Step in θ by Levenberg-Marquardt, then in φ by BFGS and in w by EM."""
        before = self.total(now)
        theta = self.unknowns.project(now.theta + self._direction(now, now.damping)[0])
        models, valid = self.model(theta, now.offset)
        parts = tuple(
            part._replace(
                residual=model[0], jacobian=model[1],
                derivatives=evaluate_batch(table, *model, part.phi, part.w) if surrogate is None else surrogate(*model),
            )
            for (table, part), model in zip(self._by_table(now), models, strict=True)
        )  # fmt: skip
        trial = replace(now, theta=theta, parts=parts)
        better = np.where(valid, self.total(trial), np.inf) < before
        stuck = ~better & (now.damping >= MOST_DAMPING)
        damping = np.clip(now.damping * np.where(better, 0.2, 8.0), LEAST_DAMPING, 8 * MOST_DAMPING)
        now = replace(select(better, trial, now), damping=damping)
        if surrogate is None:
            now = replace(now, parts=tuple(self._update_nuisances(*pair, floor) for pair in self._by_table(now)))
        return replace(now, last_decrease=np.where(better | stuck, before - self.total(now), np.inf))

    def _update_nuisances(self, table: ObservationTable, part: TableState, floor: float) -> TableState:
        """Step in φ by BFGS and in w by EM, taken where it lowers F."""
        lower, upper = self._range(table, floor)
        slope = part.derivatives.by_phi
        active = ((part.phi <= lower) & (slope > 0)) | ((part.phi >= upper) & (slope < 0))
        step = -np.einsum("bij,bj->bi", part.inverse, np.where(active, 0.0, slope))
        step = np.clip(np.where(active, 0.0, step), -LONGEST_PHI, LONGEST_PHI)
        phi = np.clip(part.phi + step, lower, upper)
        w = em_weights(table, part.derivatives.by_log_w, part.w)
        derivatives = evaluate_batch(table, part.residual, part.jacobian, phi, w)
        inverse = _bfgs(part.inverse, phi - part.phi, derivatives.by_phi - slope)
        trial = part._replace(phi=phi, w=w, derivatives=derivatives, inverse=inverse)
        return select(derivatives.nll < part.derivatives.nll, trial, part._replace(inverse=0.3 * part.inverse))

    def slope(self, candidates: Candidates) -> np.ndarray:
        """F's gradient by θ [B, size]."""
        return self.prior(candidates.theta)[1] + sum(part.derivatives.gradient for part in candidates.parts)

    def predicted_decrease(self, candidates: Candidates) -> np.ndarray:
        """Decrease of F that a step of θ predicts from the quadratic approximation [B]."""
        return self._direction(candidates, np.zeros(len(candidates)))[1]

    def _direction(self, now: Candidates, damping: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Steps of θ [B, size] and half their predicted decrease [B]; a parameter that would cross a bound stays."""
        u = self.unknowns
        gradient = self.slope(now)
        curvature = self.prior(now.theta)[2] + sum(part.derivatives.curvature for part in now.parts)
        lower, upper = u.bounds_at(now.theta)
        active = ((now.theta <= lower) & (gradient > 0)) | ((now.theta >= upper) & (gradient < 0))
        along = u.bound_jacobian(now.theta, active)
        gradient = np.einsum("bij,bi->bj", along, gradient)
        curvature = np.einsum("bki,bkl,blj->bij", along, curvature, along)
        active |= ((now.theta <= lower) & (gradient > 0)) | ((now.theta >= upper) & (gradient < 0))
        free = self.is_free & ~active
        lhs = curvature + (damping[:, None] * np.einsum("bii->bi", curvature))[..., None] * np.eye(u.size)
        lhs = np.where(free[:, :, None] & free[:, None, :], lhs, np.eye(u.size))
        step = np.linalg.solve(lhs, np.where(free, -gradient, 0.0)[..., None])[..., 0]
        size = (np.abs(step) / np.where(u.free, np.minimum(u.sd, 1.0), 1.0)).max(axis=1)
        return step * np.minimum(1.0, LONGEST_STEP / np.maximum(size, 1e-12))[:, None], -0.5 * (gradient * step).sum(1)


def _first_inverse(table: ObservationTable) -> np.ndarray:
    """Initial inverse of F's Hessian by φ [4, 4]: every entry counts twice for σ; the others have their priors."""
    sd = np.asarray(table.prior[1])
    inverse = sd**2
    inverse[0] = 1 / (2 * float(table.detected.sum()) + 1 / sd[0] ** 2)
    return np.diag(inverse)


def _bfgs(inverse: np.ndarray, step: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Update inverse Hessians [B, n, n] by steps and changes of the gradient [B, n]; keep those without information."""
    product = np.einsum("bi,bi->b", step, change)
    valid = product > 1e-10
    rho = 1 / np.where(valid, product, 1.0)
    left = np.eye(step.shape[1]) - rho[:, None, None] * np.einsum("bi,bj->bij", step, change)
    new = np.einsum("bij,bjk,blk->bil", left, inverse, left) + rho[:, None, None] * np.einsum("bi,bj->bij", step, step)
    return np.where(valid[:, None, None], new, inverse)
