"""The diagnostics of a fit: sizes of the computation, hyperparameters, and checks of the intervals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..inference import KNOCK, InferenceResult
from ..schema.decode import convert
from ..schema.diagnostics import Correlation, Diagnostics, ExcessSd, PathPrior, PosteriorDiagnostics, ProfileCurve
from .correlations import StrongCorrelation


def diagnostics_of(fit: InferenceResult, correlated: Sequence[StrongCorrelation]) -> Diagnostics:
    """The diagnostics of a fit; `correlated` are the pairs that the recordings do not distinguish."""
    problem, minima = fit.problem, fit.estimate.minima
    (sigma, smooth, octaves, floor, walk), *strings = (np.exp(x[0]).tolist() for x in minima.candidates.phi)
    cents, decay = (float(np.hypot(*hyper[:2])) for hyper in strings)
    other: dict[str, Any] = {} if fit.alternative is None else fit.alternative.diagnostics
    where = ("diagnostics", "this is an error in pianofit")
    return Diagnostics(
        evaluations=fit.estimate.n_strokes_computed,
        partials=int(np.asarray(problem.observed.level.detected)[:, problem.observed.number != KNOCK].sum()),
        correlated=tuple(Correlation((pair.first, pair.second), pair.correlation) for pair in correlated),
        negative_log_posterior=float(minima.nll[0]),
        censored=len(problem.observed.level.censored),
        contact_rate_Hz=float(problem.model_inputs.rate),
        modes=problem.cfg.n_modes,
        steps=int(problem.model_inputs.steps),
        excess_sd=ExcessSd(frequency_cents=cents, decay_relative=decay, level_db=sigma),
        path=PathPrior(smooth, octaves) if problem.has_unknown_path else None,
        interference_ratio=floor,
        velocity_discrepancy_db=walk if len({*problem.structure.stroke}) > 1 else None,
        profile=convert(other["profile"], dict[str, ProfileCurve], *where) if "profile" in other else None,
        posterior=convert(other["posterior"], PosteriorDiagnostics, *where) if "posterior" in other else None,
    )
