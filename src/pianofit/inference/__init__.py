"""Inference of a string and a hammer from recordings: one objective, one search, one posterior.

`likelihood` is the objective F, minus the log marginal posterior of tables of partials. `problem` builds it for the
recordings of a fit. `multistart` finds its minima, each by `optimiser`. `laplace` describes the posterior at them, and
`profile` and `nuts` give intervals by other methods. `run_inference` does all of this.
"""

from . import priors
from .batched_model import run_in_batches, string_law
from .derivatives import LatentPosterior
from .laplace import Estimate, Interval, Minima, ObservedValues, Posterior
from .multistart import NO_HAMMER
from .observation_tables import KNOCK, select_partials
from .parametrisation import LOG_ABSENT_LOSS, STRING_SIZE, Parametrisation
from .pipeline import InferenceResult, check_intervals, map_estimate, run_inference
from .priors import InitialValues, starting_values
from .problem import FitProblem, build_problem, prior_parametrisation, simulation_grid
from .recording_objective import RecordingObjective, objective_of
