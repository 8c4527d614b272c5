"""What recordings say of a string and a hammer: one objective, one search, one posterior.

`likelihood` is the objective, minus the log marginal posterior of tables of partials. `problem` poses it for the
recordings at hand, `search` and `finish` find its minima, `posterior` describes it about them, and `views` tells
intervals by other means. `infer` does all of it.
"""

from __future__ import annotations

from .estimate import Estimate, Progress, estimate
from .infer import Inferred, infer
from .problem import Problem, pose

__all__ = ["Estimate", "Inferred", "Problem", "Progress", "estimate", "infer", "pose"]
