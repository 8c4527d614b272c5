"""Inference of a string and a hammer from recordings: one objective, one search, one posterior.

`likelihood` is the objective, minus the log marginal posterior of tables of partials. `problem` builds it for the
recordings of a fit. `multistart` and `refine` find its minima. `laplace` describes the posterior at them, and
`intervals` gives intervals by other methods. `run_inference` does all of this.
"""

from __future__ import annotations

from .map_estimate import Estimate, Progress, map_estimate
from .pipeline import InferenceResult, run_inference
from .problem import FitProblem, build_problem

__all__ = ["Estimate", "InferenceResult", "FitProblem", "Progress", "map_estimate", "run_inference", "build_problem"]
