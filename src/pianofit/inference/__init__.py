"""What recordings say of a string and a hammer: one objective, one search, one posterior.

`likelihood` is the objective, minus the log marginal posterior of tables of partials. `problem` poses it for the
recordings at hand, `search` and `finish` find its minima, `posterior` describes it about them, and `views` tells
intervals by other means. `infer` does all of it.
"""

from __future__ import annotations

from .map_estimate import Estimate, Progress, map_estimate
from .pipeline import InferenceResult, run_inference
from .problem import FitProblem, build_problem

__all__ = ["Estimate", "InferenceResult", "FitProblem", "Progress", "map_estimate", "run_inference", "build_problem"]
