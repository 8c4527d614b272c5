"""Simulation-based calibration: ranks of true values in the posteriors of data that were drawn with them.

    python benchmarks/calibration.py                          all priors as in a fit
    python benchmarks/calibration.py --hyper 0.05 --hammer 0.25    narrow priors, as tests/test_calibration.py has them

Every case draws θ, the hyperparameters, output path, gains, weights and errors from their priors. The model and these
draws give the levels, frequencies and decay rates of two strokes of one string; no sound is made. The covariance of
the draws is computed entry by entry (tests/table_cases.py), independently of the likelihood. The posterior follows
from the same tables. The rank of a true value is its probability in that posterior, and has a uniform distribution if
the posterior is right (Talts et al. 2018, arXiv:1804.06788). The descent starts at the true value, so this study
does not test the search.

The table has the share of 95 % intervals that hold the true value, and the rms of the errors in standard deviations.
Laplace's approximation is nearly exact with narrow priors. With the priors of a fit the table shows its error.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.special import ndtr, ndtri

if TYPE_CHECKING:
    from pianofit.inference import FitProblem

# Standard deviations of the logarithms of c, κ, b1 and b2. Those of a fit, which have no effect there, would move the
# partials of the fixed table above the range of hearing.
STRING_SD = (0.002, 0.1, 0.3, 0.5)
# Velocities of the strokes of the template, m/s.
VELOCITIES = (1.1, 2.2)
# Partials this far below the loudest of their recording are censored, dB.
FLOOR = 55.0
TABLES = ("level", "frequency", "decay")


class Case(NamedTuple):
    """True values and the problem of their data."""

    theta: np.ndarray
    problem: FitProblem


def template(hyper: float = 1.0, hammer: float = 1.0) -> FitProblem:
    """Two strokes through an unknown path, with factors of the widths of the priors."""
    from observed_cases import GEOMETRY, played, tone

    from pianofit.inference import build_problem
    from pianofit.setup import Setup

    sizes = {"length": GEOMETRY.length, "mass": GEOMETRY.mass}
    strike = {"position": GEOMETRY.strike_position, "width": GEOMETRY.width}
    data = {"string": sizes, "strike": strike, "pickup": {"quantity": "pressure"}, "felt": {"law": "hunt-crossley"}}
    analyses = [played(velocity, quantity="pressure", path_db=np.zeros(18)) for velocity in VELOCITIES]
    problem = build_problem([tone(i, str(i)) for i in range(2)], analyses, Setup.from_dict(data, "here"))
    sd = problem.parametrisation.sd * hammer
    sd[: len(STRING_SD)] = STRING_SD
    tables = {name: getattr(problem.observed, name) for name in TABLES}
    tables = {name: t._replace(prior=(t.prior[0], t.prior[1] * hyper)) for name, t in tables.items()}
    return replace(
        problem, parametrisation=replace(problem.parametrisation, sd=sd), observed=replace(problem.observed, **tables)
    )


def draw(random: np.random.Generator, problem: FitProblem) -> Case:
    """Draw true values from their prior, and data from them."""
    from pianofit.inference.batched_model import LevelModel, StringModel

    u, levels, string = problem.parametrisation, LevelModel(problem), StringModel(problem)
    while True:
        theta = np.where(u.free, u.mean + u.sd * random.normal(size=u.size), u.mean)
        if (u.project(theta) != theta).any():
            continue
        (level,), ended = levels.residuals(theta[None], levels.discretisation_error_db(theta[None]))
        if ended.all():
            break
    residuals = [level, *string.residuals(theta[None], None)[0]]
    tables = {}
    for name, (residual, _) in zip(TABLES, residuals, strict=True):
        table = getattr(problem.observed, name)
        y = table.value - residual[0] + _deviations(random, table, theta)
        bound = y.max(axis=1, keepdims=True) - FLOOR if name == "level" else np.full((1, 1), -np.inf)
        tables[name] = table._replace(
            value=np.maximum(y, bound), detected=(y >= bound) + 0.0, censored=np.argwhere(y < bound)
        )
    return Case(theta, replace(problem, observed=replace(problem.observed, **tables)))


def _deviations(random: np.random.Generator, table, theta: np.ndarray) -> np.ndarray:
    """Draw hyperparameters, paths, gains, weights and errors of a table: data minus model [R, K]."""
    from table_cases import noise, shared

    phi, shape = table.prior[0] + table.prior[1] * random.normal(size=5), table.value.shape
    share = np.exp(table.log_weight)
    node = np.unravel_index(random.choice(share.size, p=share.ravel() / share.sum()), share.shape)
    variance, axes = np.linalg.eigh(shared(table, phi, node, theta))
    common = axes @ (np.sqrt(np.maximum(variance, 0.0)) * random.normal(size=len(axes)))
    half = 0.5 * float(table.degrees_of_freedom)
    own = np.sqrt(noise(table, phi) / random.gamma(half, 1 / half, size=shape)) * random.normal(size=shape)
    return common.reshape(shape) + own


def normal_scores(case: Case) -> np.ndarray:
    """Ranks of the true free values in their posterior, as standard normal numbers [free]."""
    from pianofit.inference.laplace import laplace
    from pianofit.inference.objective import Objective
    from pianofit.inference.pipeline import ITERATIONS, refine

    objective, u = Objective.complete(case.problem), case.problem.parametrisation
    phi = [term.table.prior[0] for term in objective.terms]
    ones = [np.ones_like(term.table.value) for term in objective.terms]
    _, posterior = laplace(objective, refine(objective, case.theta[None], phi, ones, ITERATIONS))
    sd = np.sqrt(np.diagonal(posterior.covariance, axis1=1, axis2=2))[:, u.free]
    z = (u.log_values(case.theta) - posterior.mean)[:, u.free] / sd
    return ndtri(np.clip(posterior.weight @ ndtr(z), 1e-300, 1 - 1e-16))


def main() -> None:
    """Print the table."""
    from pianofit.program_folder import enable_program_cache

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--hyper", type=float, default=1.0, help="factor of the widths of the hyperparameters' priors")
    parser.add_argument("--hammer", type=float, default=1.0, help="factor of the widths of hammer and velocities")
    options = parser.parse_args()
    enable_program_cache()
    problem = template(options.hyper, options.hammer)
    cases = (draw(np.random.default_rng([options.seed, n]), problem) for n in range(options.count))
    z = np.array([normal_scores(case) for case in cases])
    u = problem.parametrisation
    names = [*u.names, *(f"v_H0 {n + 1}" for n in range(u.strokes))]
    print("           95 %   rms")
    for i, name in enumerate(np.array(names)[u.free]):
        print(f"{name:8}{100 * (np.abs(z[:, i]) < 1.96).mean():7.1f}{np.sqrt((z[:, i] ** 2).mean()):7.2f}")
    print(f"all     {100 * (np.abs(z) < 1.96).mean():7.1f}{np.sqrt((z**2).mean()):7.2f}")


sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
if __name__ == "__main__":
    main()
