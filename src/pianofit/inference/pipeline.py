"""From recordings to the posterior: fit of the string, search, refinement of every minimum, Laplace's approximation."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..analysis import Analysis
from ..errors import FitError, ParameterError
from ..excitation import GEOMETRY_FIELDS
from ..io.table_output import require_optional
from ..progress import Progress
from ..recording.recording import Recording
from ..setup import Setup
from ..threads import numerical_settings
from .batched_model import LevelModel, compile_ahead
from .derivatives import LatentPosterior, latent_posterior
from .laplace import Estimate, Interval, IntervalResult, Minima, Posterior, laplace
from .likelihood import walk_covariance
from .multistart import NO_HAMMER, deduplicate, from_starts, multistart, rank_hammers
from .objective import Candidates, Objective, QuadraticSurrogate
from .optimiser import minimise, predicted_decrease
from .parametrisation import STRING_SIZE
from .problem import FitProblem, build_problem
from .profile import profiles

# Minima whose posterior mass is smaller by more than this, in logarithms, have no weight: exp(-6) is a quarter of a
# percent.
MAX_LOG_MASS_GAP = 6.0
# A minimisation has not converged if its last step lowered F by more than this and as large a decrease is predicted.
MAX_DECREASE = 1.0
# Maximum number of minima that are refined, a limit of time.
MAX_MINIMA = 12
# A refinement ends when the discretisation error at its end differs from the one that it used by less than this
# fraction of the levels' standard deviations, rms.
MAX_OFFSET_CHANGE = 0.05
# Steps of a minimisation.
ITERATIONS = 25
# Initial log σ and log A of frequencies and decays, in standard deviations of the prior from its median,
STRING_STARTS = tuple(itertools.product((-2.0, -1.0, 0.0), (-1.0, 0.0, 1.0)))
# and maximum number of steps from each: they compute no contact.
STRING_STEPS = 100
METHODS = ("laplace", "profile", "posterior")


@dataclass(frozen=True)
class InferenceResult:
    """The problem, its estimate, and intervals by a method other than Laplace's approximation."""

    problem: FitProblem
    estimate: Estimate
    seed: int
    alternative: IntervalResult | None = None

    @property
    def posterior(self) -> Posterior:
        """Posterior by Laplace's approximation at all minima."""
        return self.estimate.posterior

    @cached_property
    def initial_theta(self) -> np.ndarray:
        """Initial θ of the hammer's search, with the fitted string [size]."""
        return initial_point(self.problem, self.estimate.theta[:STRING_SIZE])

    @cached_property
    def gauge_fixed(self) -> Posterior:
        """The posterior, gauge-fixed at the reference velocity if only the prior sets the scale of the velocities."""
        if not self.problem.velocity_scale_open:
            return self.posterior
        return self.posterior.condition_on(
            np.eye(self.problem.parametrisation.size)[self.problem.reference_velocity_index]
        )

    @property
    def excess(self) -> float:
        """Standard deviation of the levels beyond noise, other sounds and path, dB: white excess and velocity walk."""
        candidates, table = self.estimate.minima.candidates, self.problem.observed.level
        phi = candidates.level.phi[0]
        walk = np.exp(2 * phi[4]) * np.trace(walk_covariance(table, candidates.theta[:1])[0]) / len(table.velocity)
        return float(np.sqrt(np.exp(2 * phi[0]) + walk))

    def alternative_interval(self, name: str) -> Interval | None:
        """Interval of a parameter by the other method, if there is one."""
        return None if self.alternative is None else self.alternative.intervals.get(name)

    def level(self, theta: np.ndarray) -> np.ndarray:
        """Levels of the model at `theta` [size], dB [R, K]."""
        return LevelModel(self.problem).level_jacobians(theta[None])[0][0]

    def latent(self, minimum: int) -> LatentPosterior:
        """Posterior means of what F integrates out of the levels, at one minimum: paths, columns and residuals."""
        level = self.estimate.minima.candidates.level
        table = self.problem.observed.level
        theta = self.estimate.minima.candidates.theta[minimum]
        return latent_posterior(table, level.residual[minimum], level.phi[minimum], level.w[minimum], theta)

    @cached_property
    def initial_hammer_level(self) -> np.ndarray:
        """Levels of the initial hammer at its best velocities, gain and output path, dB [R, K].

        A free strike position is fitted too. So the remaining difference to the fitted hammer is due to mass and felt.
        """
        u, theta = self.problem.parametrisation, self.estimate.theta
        hammer = np.arange(u.size) < u.shared
        hammer[:STRING_SIZE] = False
        hammer[[u.index_of(name) for name in GEOMETRY_FIELDS if name in u.names]] = False
        mean, sd = np.where(hammer, self.initial_theta, u.mean), np.where(hammer, 0.0, u.sd)
        fixed = replace(u, mean=mean, sd=sd, joint=None)
        string = u.model_entries(theta)[:STRING_SIZE]
        objective = Objective.of_levels(replace(self.problem, parametrisation=fixed), string)
        table, phi = self.problem.observed.level, self.estimate.minima.candidates.level.phi[:1]
        offset = objective.level_model.discretisation_error_db(theta[None])[0]
        surrogates = QuadraticSurrogate.of_gains(table, phi[0])
        hammers = fixed.project(np.stack([self.initial_theta, theta]))
        values = u.law.stroke.fine(self.problem.initial_values.geometry)
        starts = np.concatenate(rank_hammers(objective, hammers, values, surrogates, offset))
        starts = objective.start(starts, [phi], offset=offset)
        candidates = minimise(objective, starts, ITERATIONS, 0.1)  # to a tenth of a dB
        if not len(candidates):
            return np.full(table.value.shape, -300.0)  # no contact ends
        best = candidates.level
        latent = latent_posterior(table, best.residual[0], best.phi[0], best.w[0], candidates.theta[0])
        return np.asarray(table.value) - latent.residual - latent.discrepancy


@numerical_settings()
def run_inference(
    recordings: Sequence[Recording],
    analyses: Sequence[Analysis],
    setup: Setup | None = None,
    *,
    velocity: float | None = None,
    intervals: str = "laplace",
    seed: int = 0,
    progress: Progress = lambda *_: None,
    starts: Sequence[Mapping[str, float]] = (),
    budget: int | None = None,
) -> InferenceResult:
    """Infer string and hammer from recordings of one key; the arguments are those of `fit`, which documents them.

    Raises `ParameterError` for an unknown method of intervals. Raises `FitError` if a recording is given twice, is of
    another key or contains only noise, or if no hammer gives a finite sound.
    """
    check_intervals(intervals)
    problem = build_problem(recordings, analyses, setup or Setup(), velocity)
    estimate = map_estimate(problem, seed, progress, starts, budget)
    return InferenceResult(problem, estimate, seed, compute_intervals(problem, estimate, intervals, seed, progress))


def check_intervals(method: str) -> None:
    """Reject an unknown method, and a sampler that is not installed.

    Raises
    ------
    ParameterError
        Naming the argument and its value.
    """
    if method not in METHODS:
        raise ParameterError(f"intervals={method!r} must be one of {', '.join(METHODS)}")
    if method == "posterior":
        require_optional("blackjax", "intervals='posterior'", "bayes", ParameterError)


def compute_intervals(
    problem: FitProblem, estimate: Estimate, method: str, seed: int, progress: Progress
) -> IntervalResult | None:
    """Intervals by the `method` asked for; None for Laplace's approximation, which every estimate contains."""
    if method == "profile":
        progress("profiles", 0.9)
        return profiles(problem, estimate)
    if method == "posterior":
        from .nuts import sample_posterior

        progress("posterior", 0.9)
        return sample_posterior(problem, estimate, seed)
    return None


def map_estimate(
    problem: FitProblem,
    seed: int = 0,
    progress: Progress = lambda *_: None,
    starts: Sequence[Mapping[str, float]] = (),
    budget: int | None = None,
) -> Estimate:
    """Search F, and describe the posterior at its minima.

    Parameters
    ----------
    starts : values by name from which the search starts too, in addition to samples of the prior.
    budget : largest number of steps of every minimisation; F is then minimised from the starts only.

    Raises
    ------
    ParameterError
        For a start with an unknown name.
    FitError
        If no hammer gives a finite sound.
    """
    progress("string", 0.05)
    complete = Objective.complete(problem)
    compile_ahead(problem)
    string = fit_string(problem)
    progress("hammer", 0.15)
    levels = Objective.of_levels(problem, string.theta[0, :STRING_SIZE])
    first = initial_point(problem, string.theta[0, :STRING_SIZE])
    given = [starting_point(problem, first, start) for start in starts]
    if budget is None:
        candidates = multistart(levels, seed, np.array([first, *given]), progress)
    else:
        candidates = from_starts(levels, np.array(given), budget)
    progress("string and hammer", 0.75)
    minima = refine_minima(complete, levels, candidates, string, budget or ITERATIONS)
    progress("intervals", 0.88)
    strokes = levels.level_model.strokes_computed + complete.level_model.strokes_computed
    return Estimate(*laplace(complete, minima), strokes)


def fit_string(problem: FitProblem) -> Candidates:
    """Fit c, κ, b1 and b2 to frequencies, decays and the prior alone, before any hammer is known.

    F has a minimum for each set of partials that Student's t takes for outliers: few if the excess σ is large, more if
    it is small. They are reached from different σ and sizes A of the smooth deviation. The lowest is kept.
    """
    objective = Objective.of_string(problem)
    phi = []
    for term in objective.terms:
        median, sd = (np.asarray(x) for x in term.table.prior)
        starts = np.tile(median, (len(STRING_STARTS), 1))
        starts[:, :2] += sd[:2] * np.array(STRING_STARTS)
        phi.append(starts)
    start = objective.start(np.tile(problem.parametrisation.mean, (len(STRING_STARTS), 1)), phi)
    # Strings of clean recordings are determined to 1e-8.
    return minimise(objective, start, STRING_STEPS, 1e-6).take(np.array([0]))


def initial_point(problem: FitProblem, string: np.ndarray) -> np.ndarray:
    """θ of the setup's initial values, and of the prior means for all others [size]."""
    u, start = problem.parametrisation, problem.initial_values
    logs = u.log_values(u.mean)
    for i, name in enumerate(u.names):
        if u.free[i]:
            logs[i] = np.log(start.initial[name])
    theta = u.from_log_values(logs)
    theta[:STRING_SIZE] = string
    reference = problem.reference_velocity_index
    if u.free[reference]:
        theta[reference] = np.log(start.initial[u.law.stroke.name])
    return u.project(theta)


def starting_point(problem: FitProblem, first: np.ndarray, start: Mapping[str, float]) -> np.ndarray:
    """θ [size] of given values by name, and of `first` for all others, inside the bounds.

    Fixed values stay, and so does the string: the frequencies and decays of the partials determine it better.
    """
    u, indices = problem.parametrisation, problem.parameter_indices
    logs = u.log_values(first)
    for name, value in start.items():
        if name not in indices:
            raise ParameterError(f"start=: this fit has no parameter {name!r}; use {', '.join(indices)}")
        at = indices[name]
        low, high = np.exp(u.range(at)).tolist()
        if u.free[at] and not low <= value <= high:
            raise ParameterError(f"start=: {name}={value:g} must be within its bounds, {low:g} to {high:g}")
        if u.free[at] and at >= STRING_SIZE:
            logs[at] = np.log(value)
    return u.project(u.from_log_values(logs))


def refine_minima(
    objective: Objective, levels: Objective, candidates: Candidates, string: Candidates, steps: int
) -> Minima:
    """Refine every distinct minimum of a posterior mass near the largest on the complete F.

    Parameters
    ----------
    levels : F of the levels with a fixed string, of which the candidates are minima.
    string : the string's own minimum.
    """
    free = objective.problem.parametrisation.free

    def distinct(of: Objective, minima: Candidates) -> np.ndarray:
        """Indices of minima that do not lie within a standard deviation of one with a larger mass."""
        scores, widths = of.negative_log_mass(minima), of.widths(minima)
        return np.array(deduplicate(minima, free, scores, MAX_LOG_MASS_GAP, widths))

    near = candidates.take(distinct(levels, candidates)[:MAX_MINIMA])
    minima = refine(objective, near.theta, near.phi + string.phi, near.w + string.w, steps)
    # Two distinct starts can end in the same minimum: it counts once.
    return minima.take(distinct(objective, minima.candidates))


def refine(
    objective: Objective, theta: np.ndarray, phi: Sequence[np.ndarray], w: Sequence[np.ndarray], steps: int
) -> Minima:
    """Minimise F and correct each candidate's discretisation error in turn; drop those whose contact does not end.

    Parameters
    ----------
    theta, phi, w : starts [B, size]; of every table, for all candidates or for each, [5] and [R, K].
    """
    table, model = objective.problem.observed.level, objective.level_model

    def minimised(theta: np.ndarray, phi: Sequence[np.ndarray], w: Sequence[np.ndarray]) -> Candidates:
        """Minimise each with the discretisation error at its start."""
        starts = objective.start(theta, phi, w, model.discretisation_error_db(theta))
        return minimise(objective, starts, steps)

    candidates = minimised(theta, phi, w)
    if not len(candidates):
        raise FitError(NO_HAMMER)
    for _ in range(3):  # at most: it ends when the errors at the end are those that were used
        sd = np.sqrt(table.variance + np.exp(2 * candidates.level.phi[:, :1, None]))
        change = (model.discretisation_error_db(candidates.theta) - candidates.offset) / sd
        rms = np.sqrt((change**2 * table.detected).sum(axis=(1, 2)) / max(table.detected.sum(), 1))
        active = np.flatnonzero(rms >= MAX_OFFSET_CHANGE)
        if not len(active):
            break
        some = candidates.take(active)
        candidates = candidates.put(active, minimised(some.theta, some.phi, some.w))
    left = np.minimum(candidates.last_decrease, predicted_decrease(objective, candidates))
    return Minima(candidates, objective.total(candidates), left < MAX_DECREASE)
