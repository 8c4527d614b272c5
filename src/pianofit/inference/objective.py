"""The objective F at many θ, φ and w: all of it, its part in some tables, or a quadratic surrogate.

All objectives have one interface: `Objective.start` evaluates θ, φ and w, and `Objective.move` evaluates another θ with
the same φ and w. `optimiser.minimise` minimises any of them.

With C at the nodes of τ and of the gains, F = -log Σ_t weight_t exp(-½ rᵀC_t⁻¹r - ...) is concave in the quadratics. It
therefore lies below ½ rᵀQr + constant, Q = Σ_t p_t C_t⁻¹, with the nodes' weights p at a residual, and touches it
there: a step that lowers this surrogate lowers F. F lies below it with any other weights too. With the weights of one
node of the gains, minimising the surrogate minimises F of that node alone. Censored partials are left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import numpy as np

from .batched_model import LevelModel, Residuals, StringModel, thread_pool
from .curvature import inverse_curvature
from .derivatives import Evaluation, dense_inverse, evaluate
from .likelihood import ObservationTable, em_weights, node_weights, solve_nodes
from .parametrisation import STRING_SIZE
from .problem import FitProblem

# Initial Levenberg-Marquardt damping.
FIRST_DAMPING = 1e-2
# Range of φ, in standard deviations of its prior: the excess of a clean recording may be near zero.
HYPER_REACH = 12.0
# Longest step of φ, logarithms.
LONGEST_PHI = 1.0


class TableState(NamedTuple):
    """State of the candidates in one table; [B, ...] throughout."""

    residual: np.ndarray  # [B, R, K]
    jacobian: np.ndarray  # derivatives of the model by θ [B, R, K, size]
    phi: np.ndarray  # [B, 5]
    w: np.ndarray  # [B, R, K]
    derivatives: Evaluation
    inverse: np.ndarray  # approximate inverse Hessian of F by φ [B, 5, 5]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Candidates:
    """Candidates: θ, then φ and w of every table, and the state of each minimisation. [B, ...] throughout."""

    theta: np.ndarray
    offset: np.ndarray  # discretisation error of the contact in the levels, dB [B, R, K]
    parts: tuple[TableState, ...]
    damping: np.ndarray  # of Levenberg-Marquardt; relative to the curvature's diagonal
    last_decrease: np.ndarray  # decrease of F by the last step

    def __len__(self) -> int:
        return len(self.theta)

    @property
    def phi(self) -> tuple[np.ndarray, ...]:
        """φ of every table [B, 5]."""
        return tuple(part.phi for part in self.parts)

    @property
    def w(self) -> tuple[np.ndarray, ...]:
        """w of every table [B, R, K]."""
        return tuple(part.w for part in self.parts)

    @property
    def level(self) -> TableState:
        """State of the table of levels, which is the first."""
        return self.parts[0]

    def take(self, which: np.ndarray) -> Candidates:
        """Select some, in this order."""
        return jax.tree.map(lambda x: x[which], self)

    def put(self, which: np.ndarray, other: Candidates) -> Candidates:
        """Replace some by those of `other`."""

        def replaced(old: np.ndarray, new: np.ndarray) -> np.ndarray:
            out = old.copy()
            out[which] = new
            return out

        return jax.tree.map(replaced, self, other)

    def join(self, other: Candidates) -> Candidates:
        """Append those of `other`."""
        return jax.tree.map(lambda *pair: np.concatenate(pair), self, other)


def select(mask: np.ndarray, one, other):
    """`one` where `mask` [B] is true, else `other`: trees of arrays [B, ...]."""
    return jax.tree.map(lambda a, b: np.where(mask.reshape(-1, *(1,) * (np.ndim(a) - 1)), a, b), one, other)


# --- one table --------------------------------------------------------------------------------------------------------


class TableTerm(NamedTuple):
    """F of one table by its residuals, φ, w and the velocities in θ."""

    table: ObservationTable

    def evaluate(
        self, residual: np.ndarray, jacobian: np.ndarray, phi: np.ndarray, w: np.ndarray, theta: np.ndarray
    ) -> Evaluation:
        """F and its derivatives [B, ...]."""
        return evaluate(self.table, residual, jacobian, phi, w, theta)

    def enter(self, state: TableState, theta: np.ndarray, sigma_floor: float) -> TableState:
        """Evaluate a state of any objective, with φ moved into its range."""
        phi = np.clip(state.phi, *self._phi_range(sigma_floor))
        derivatives = self.evaluate(state.residual, state.jacobian, phi, state.w, theta)
        return state._replace(phi=phi, derivatives=derivatives)

    def step(self, state: TableState, theta: np.ndarray, sigma_floor: float) -> TableState:
        """Step in φ by BFGS and in w by EM, taken where it lowers F."""
        lower, upper = self._phi_range(sigma_floor)
        slope = state.derivatives.by_phi
        active = ((state.phi <= lower) & (slope > 0)) | ((state.phi >= upper) & (slope < 0))
        step = -np.einsum("bij,bj->bi", state.inverse, np.where(active, 0.0, slope))
        step = np.clip(np.where(active, 0.0, step), -LONGEST_PHI, LONGEST_PHI)
        phi = np.clip(state.phi + step, lower, upper)
        w = em_weights(self.table, state.derivatives.by_log_w, state.w)
        derivatives = self.evaluate(state.residual, state.jacobian, phi, w, theta)
        inverse = _bfgs(state.inverse, phi - state.phi, derivatives.by_phi - slope)
        trial = state._replace(phi=phi, w=w, derivatives=derivatives, inverse=inverse)
        return select(derivatives.nll < state.derivatives.nll, trial, state._replace(inverse=0.3 * state.inverse))

    def _phi_range(self, sigma_floor: float) -> tuple[np.ndarray, np.ndarray]:
        mean, sd = (np.asarray(x) for x in self.table.prior)
        lower, upper = mean - HYPER_REACH * sd, mean + HYPER_REACH * sd
        if sigma_floor:
            lower[0] = max(lower[0], np.log(sigma_floor))
        return lower, np.maximum(upper, lower)


def _bfgs(inverse: np.ndarray, step: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Update inverse Hessians [B, n, n] by steps and changes of the gradient [B, n]; keep those without information."""
    product = np.einsum("bi,bi->b", step, change)
    valid = product > 1e-10
    rho = 1 / np.where(valid, product, 1.0)
    left = np.eye(step.shape[1]) - rho[:, None, None] * np.einsum("bi,bj->bij", step, change)
    new = left @ inverse @ left.mT + rho[:, None, None] * np.einsum("bi,bj->bij", step, step)
    return np.where(valid[:, None, None], new, inverse)


class QuadraticSurrogate(NamedTuple):
    """½ rᵀQr + constant over the detected entries of one table, with φ and w fixed."""

    table: ObservationTable
    Q: np.ndarray  # [detected, detected]
    at: np.ndarray  # flat indices of the detected entries in [R, K]
    constant: float  # makes surrogates of several nodes of the gains comparable

    @classmethod
    def of_gains(cls, table: ObservationTable, phi: np.ndarray) -> list[QuadraticSurrogate]:
        """One for each node of the gains, before a residual is known: at the middle τ, at w = 1 and equal velocities.

        Their constants are those of a zero residual.
        """
        ones, velocities = np.ones_like(table.value), np.zeros(table.velocity.shape[1])
        nodes = solve_nodes(table, *(x[None] for x in (0 * ones, phi, ones, velocities)))
        middle, at = len(table.log_tau) // 2, np.flatnonzero(np.asarray(table.detected))
        constants = (nodes.nll_per_node[0] - table.log_weight)[middle]
        inverses = dense_inverse(table, nodes.factors)[0, middle]
        return [cls(table, Q[np.ix_(at, at)], at, float(own)) for Q, own in zip(inverses, constants, strict=True)]

    @classmethod
    def at_residual(
        cls,
        table: ObservationTable,
        phi: np.ndarray,
        w: np.ndarray,
        residual: np.ndarray,
        theta: np.ndarray,
        gains: int | None = None,
    ) -> QuadraticSurrogate:
        """Build it at φ, w, `residual` [R, K] and the velocities in θ, with all nodes of the gains or one."""
        nodes = solve_nodes(table, *(x[None] for x in (residual, phi, w, theta)))
        weight = node_weights(table, nodes.nll_per_node)[0]
        if gains is not None:
            weight = np.where(np.arange(weight.shape[1]) == gains, weight + np.finfo(float).tiny, 0.0)
            weight /= weight.sum()
        at = np.flatnonzero(np.asarray(table.detected))
        return cls(table, np.tensordot(weight, dense_inverse(table, nodes.factors)[0], 2)[np.ix_(at, at)], at, 0.0)

    def dense(self) -> np.ndarray:
        """Q of all entries, 0 for entries that are not detected [R, K, R, K]."""
        shape = self.table.value.shape
        Q = np.zeros((np.prod(shape), np.prod(shape)))
        Q[np.ix_(self.at, self.at)] = self.Q
        return Q.reshape(*shape, *shape)

    def evaluate(self, residual: np.ndarray, jacobian: np.ndarray, *_: np.ndarray) -> Evaluation:
        """Value at residuals [B, R, K], gradient and curvature by the parameters of `jacobian`, at any φ and w."""
        count, entries, size = len(residual), self.table.value.size, jacobian.shape[-1]
        r, J = residual.reshape(count, entries)[:, self.at], jacobian.reshape(count, entries, size)[:, self.at]
        weighted = r @ self.Q
        curvature = list(thread_pool().map(lambda own: own.T @ (self.Q @ own), J))
        return Evaluation(
            0.5 * (weighted * r).sum(axis=1) + self.constant,
            -np.einsum("bi,bin->bn", weighted, J),
            np.array(curvature).reshape(count, size, size),
            np.zeros((count, len(self.table.prior[0]))),
            np.zeros_like(residual),
            np.zeros((count, size)),
        )

    def enter(self, state: TableState, *_: Any) -> TableState:
        """Evaluate a state of any objective."""
        return state._replace(derivatives=self.evaluate(state.residual, state.jacobian))

    def step(self, state: TableState, *_: Any) -> TableState:
        """Keep φ and w."""
        return state


# --- all tables -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Objective:
    """F of some tables and of the prior of the searched parameters."""

    problem: FitProblem
    free: np.ndarray  # mask of the searched parameters [size]
    models: tuple[LevelModel | StringModel, ...]
    terms: tuple[TableTerm | QuadraticSurrogate, ...]  # one for each table of the models

    @classmethod
    def of_levels(cls, problem: FitProblem, string: np.ndarray) -> Objective:
        """F of the levels, with the string fixed at `string` [4] and coarser steps of the contact."""
        free = problem.parametrisation.free & (np.arange(problem.parametrisation.size) >= STRING_SIZE)
        return cls(problem, free, (LevelModel(problem, string),), (TableTerm(problem.observed.level),))

    @classmethod
    def of_string(cls, problem: FitProblem) -> Objective:
        """F of frequencies and decays: only the string is searched."""
        free = problem.parametrisation.free & (np.arange(problem.parametrisation.size) < STRING_SIZE)
        terms = TableTerm(problem.observed.frequency), TableTerm(problem.observed.decay)
        return cls(problem, free, (StringModel(problem),), terms)

    @classmethod
    def complete(cls, problem: FitProblem) -> Objective:
        """F of all tables and all parameters."""
        o, models = problem.observed, (LevelModel(problem), StringModel(problem))
        terms = TableTerm(o.level), TableTerm(o.frequency), TableTerm(o.decay)
        return cls(problem, problem.parametrisation.free, models, terms)

    def with_surrogate(self, surrogate: QuadraticSurrogate) -> Objective:
        """Replace F of the only table by a surrogate; φ and w are then fixed."""
        return replace(self, terms=(surrogate,))

    @property
    def level_model(self) -> LevelModel:
        """The model of the levels."""
        (model,) = (model for model in self.models if isinstance(model, LevelModel))
        return model

    def start(
        self,
        theta: np.ndarray,
        phi: Sequence[np.ndarray],
        w: Sequence[np.ndarray] | None = None,
        offset: np.ndarray | float = 0.0,
    ) -> Candidates:
        """Create candidates at `theta` [B, size], without those whose contact does not end.

        Parameters
        ----------
        phi, w : of every table, for all candidates or for each; w is 1 if None.
        offset : discretisation error of the levels, dB, for all candidates or for each.
        """
        offset = np.broadcast_to(offset, (len(theta), *self.problem.observed.level.value.shape))
        models, valid = self._residuals(theta, offset)
        parts = []
        for i, (term, (residual, jacobian)) in enumerate(zip(self.terms, models, strict=True)):
            hyper = np.broadcast_to(phi[i], (len(theta), len(term.table.prior[0])))[valid]
            weights = np.broadcast_to(1.0 if w is None else w[i], residual.shape)[valid]
            state, at = (residual[valid], jacobian[valid], hyper, weights), theta[valid]
            # Every entry counts twice for σ; the other φ have their priors.
            sd = np.asarray(term.table.prior[1])
            inverse = np.diag([1 / (2 * float(term.table.detected.sum()) + 1 / sd[0] ** 2), *sd[1:] ** 2])
            parts.append(TableState(*state, term.evaluate(*state, at), np.tile(inverse, (len(hyper), 1, 1))))
        state = np.full(valid.sum(), FIRST_DAMPING), np.full(valid.sum(), np.inf)
        return Candidates(theta[valid], offset[valid], tuple(parts), *state)

    def move(self, candidates: Candidates, theta: np.ndarray) -> tuple[Candidates, np.ndarray]:
        """Evaluate other θ [B, size] with the same φ and w; also, whether contacts ended [B]."""
        models, valid = self._residuals(theta, candidates.offset)
        parts = tuple(
            part._replace(residual=r, jacobian=J, derivatives=term.evaluate(r, J, part.phi, part.w, theta))
            for term, part, (r, J) in zip(self.terms, candidates.parts, models, strict=True)
        )
        return replace(candidates, theta=theta, parts=parts), valid

    def _residuals(self, theta: np.ndarray, offset: np.ndarray) -> Residuals:
        tables, valid = zip(*(model.residuals(theta, offset) for model in self.models), strict=True)
        return [pair for own in tables for pair in own], np.all(valid, axis=0)

    def enter(self, candidates: Candidates, sigma_floor: float) -> Candidates:
        """Evaluate candidates of any objective, with φ in its range and σ of the first table above `sigma_floor`."""
        parts = zip(self.terms, candidates.parts, (sigma_floor, 0.0, 0.0), strict=False)
        theta = candidates.theta
        return replace(candidates, parts=tuple(term.enter(part, theta, floor) for term, part, floor in parts))

    def step_nuisances(self, candidates: Candidates, sigma_floor: float) -> Candidates:
        """Step in φ and w of every table; keep them on a surrogate."""
        parts = zip(self.terms, candidates.parts, (sigma_floor, 0.0, 0.0), strict=False)
        theta = candidates.theta
        return replace(candidates, parts=tuple(term.step(part, theta, floor) for term, part, floor in parts))

    def total(self, candidates: Candidates) -> np.ndarray:
        """F [B] of the tables and of the prior of the searched parameters."""
        return self.prior(candidates.theta)[0] + sum(part.derivatives.nll for part in candidates.parts)

    def negative_log_mass(self, candidates: Candidates) -> np.ndarray:
        """Minus the logarithm of the posterior mass about each candidate [B]: F + ½ log|H|, H the curvature by θ.

        F alone does not compare minima. With few levels the deepest minima are the narrowest, because every parameter
        is fitted to a small excess σ.
        """
        free = np.flatnonzero(self.free)
        curvature = self.curvature(candidates)[:, free][:, :, free]
        return self.total(candidates) + 0.5 * np.linalg.slogdet(curvature)[1]

    def widths(self, candidates: Candidates) -> np.ndarray:
        """Standard deviations of θ about each candidate by F's curvature, 0 for fixed parameters [B, size]."""
        free, widths = np.flatnonzero(self.free), np.zeros(candidates.theta.shape)
        inverse = inverse_curvature(self.curvature(candidates)[:, free][:, :, free])
        widths[:, free] = np.sqrt(np.diagonal(inverse, axis1=1, axis2=2))
        return widths

    def gradient(self, candidates: Candidates) -> np.ndarray:
        """F's gradient by θ [B, size]."""
        return self.prior(candidates.theta)[1] + sum(part.derivatives.gradient for part in candidates.parts)

    def curvature(self, candidates: Candidates) -> np.ndarray:
        """F's Gauss-Newton curvature by θ [B, size, size]."""
        return self.prior(candidates.theta)[2] + sum(part.derivatives.curvature for part in candidates.parts)

    def prior(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Part of F by the prior of θ: value [B], gradient [B, size] and curvature [B, size, size]."""
        u = self.problem.parametrisation
        weight = np.where(self.free, u.precision, 0.0)
        deviation = theta - u.mean
        value, gradient = 0.5 * (weight * deviation**2).sum(axis=1), weight * deviation
        if u.joint is None:
            return value, gradient, np.broadcast_to(np.diag(weight), (len(theta), u.size, u.size))
        of_keys = u.joint.evaluate(theta, u.law, self.free)
        return value + of_keys[0], gradient + of_keys[1], np.diag(weight) + of_keys[2]
