"""From recordings to parameters with intervals: one objective, one search, one posterior.

`likelihood` is the objective, minus the log marginal posterior of tables of partials. `problem` poses it for the
recordings at hand, `search` and `finish` find its minima, `posterior` describes it about them, and `conclude` puts what
was found into a `Result`.
"""

from __future__ import annotations

from .conclude import conclude
from .estimate import Estimate, Progress, estimate
from .infer import Inferred, infer
from .problem import Problem, pose
from .quantities import Covariance, Quantities, Quantity
from .result import FittedRecording, Result, Sound

__all__ = [
    "Covariance", "Estimate", "FittedRecording", "Inferred", "Problem", "Progress", "Quantities", "Quantity", "Result",
    "Sound", "conclude", "estimate", "infer", "pose",
]  # fmt: skip
