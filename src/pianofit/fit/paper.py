"""The paper's own searches, for comparison: its three steps, and its criterion over the whole spectrum.

`paper` (Bensa et al. 2005, IV.C): 1. c and b1 in band 1, by gradient. 2. κ and b2 in band 2, by gradient. 3. K_H, μ,
M_H, p and v_H0 in band 3, by annealing, with the string held; least squares take what was found to the floor of its
basin.
`global` (IV.B): all nine on eq. 19 over the whole spectrum, by gradient.

Both start from the given initial values. What the paper leaves open is chosen here. The string is searched with σ
falling, from lines wide enough to meet down to what the recording's length resolves, where eq. 19 is the paper's own;
the hammer on the σ at which the criterion is reported.
"""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from ..analysis import Analysis
from ..errors import ParameterError
from ..initial import Start
from ..parameters import FIT_NAMES, PARAMETERS
from ..recording import Recording
from .joint import Fit, ended
from .levenberg import Descent
from .recipe import Progress, _prepared, _touches
from .residuals import joint_batch
from .result import Result
from .space import Layout
from .state import settled_weights
from .steps import ALL, NUMBER, Search
from .takes import Take
from .verdict import FELT

__all__ = ["RECIPES", "check_recipe", "fit_by_paper", "without_claims"]

RECIPES = ("default", "paper", "global")
# Of the annealing: so many unless others are asked for, and how many may be.
EVALUATIONS, FEWEST, MOST = 20_000, 500, 10_000_000
OPENING = {
    "paper": "The paper's three steps (recipe “paper”), for comparison with it.",
    "global": "The paper's criterion over the whole spectrum (recipe “global”), for comparison with it.",
}
NO_INTERVALS = (
    "No intervals: the least value of this criterion does not say how far off the parameters may be, or which of them "
    "the recording tells at all. The default recipe says both."
)
FELT_UNKNOWN = (
    " One uncalibrated recording does not fix the felt: here its gain was free, and no output path was fitted."
)


def check_recipe(recipe: str, evaluations: int | None) -> None:
    """Refuse a recipe that does not exist, and evaluations that it cannot have.

    Raises
    ------
    ParameterError
        Naming the argument and its value.
    """
    if recipe not in RECIPES:
        raise ParameterError(f"recipe={recipe!r} must be one of {', '.join(RECIPES)}")
    if evaluations is not None and recipe != "paper":
        raise ParameterError(f"evaluations={evaluations} are those of the annealing: only the recipe paper has them")
    if evaluations is not None and not FEWEST <= evaluations <= MOST:
        raise ParameterError(f"evaluations={evaluations} must be from {FEWEST} to {MOST}")


def fit_by_paper(
    recording: Recording, analysis: Analysis, start: Start, recipe: str = "paper", *, hammer: str = "annealing",
    evaluations: int | None = None, seed: int = 0, progress: Progress = lambda *_: None,
) -> Fit:  # fmt: skip
    """Search as the paper does; `recipe` is `paper` or `global`.

    Parameters
    ----------
    hammer : how the recipe `paper` searches it: `annealing`, or `gradient`, down from where the annealing would start.
    evaluations : of the criterion by the annealing; 20,000 unless given.

    Raises
    ------
    FitError
        If no hammer gives a finite criterion.
    """
    take = Take(recording, analysis)
    search = Search(recording, analysis, _prepared([take], _given(start), Layout()))
    x = search.x(search.state.space.start[:NUMBER])
    progress("string", 0.1)
    if recipe == "global":
        x = search.down(x, FIT_NAMES, ALL)
    else:
        x = search.down(x, ("c", "b1"), (search.band(0),))
        x = search.down(x, ("kappa", "b2"), (search.band(1),))
        progress("hammer", 0.2)
        x = search.annealed(x, evaluations or EVALUATIONS, seed) if hammer == "annealing" else search.hammer_down(x)
    progress("gradient", 0.7)
    # The onset is where a sound is first seen; what was found says when the hammer touched.
    if search.state.data.calibrated:
        search.state = replace(search.state, delay=_touches([take], _rated(search, x)))
    if recipe == "global":
        x = search.finely_down(x, FIT_NAMES, ALL)
    else:
        x = search.hammer_settled(x) if hammer == "annealing" else search.hammer_down(x)
    progress("done", 1.0)
    return _rated(search, x)


def _given(start: Start) -> Start:
    """The start at the initial values; what is known is held, and so is the strike."""
    values = dict(start.values)
    for name in set(FIT_NAMES) - set(start.fixed):
        low, high = start.bounds.get(name, (PARAMETERS[name].lower, PARAMETERS[name].upper))
        values[name] = min(max(start.initial[name], low), high)
    return replace(start, values=values, fixed={"x0": "assumed"} | start.fixed)


def _rated(search: Search, x: np.ndarray) -> Fit:
    """What was found, with the scatter of the recording's partials about it."""
    state = search.state
    z = state.space.z(search.values(x)[None])
    spread, robust = settled_weights(state, state.target(state.first_spread(1.0, 0.3), state.unweighted), z)
    at = state.target(spread, robust)
    residual, jacobian = (np.asarray(a) for a in joint_batch(jnp.asarray(z), at, state.cfg)[:2])
    end = Descent(z, 0.5 * (residual**2).sum(axis=1), np.array([search.settled]), residual, jacobian, 0)
    return ended(state, end, at, spread, robust, search.evaluations)


def without_claims(result: Result, recipe: str, fit: Fit, start: Start) -> Result:
    """A result that says how it was found, and claims no more than that."""
    calibrated, parameters = fit.data.calibrated, {}
    for name, entry in result.document["parameters"].items():
        status = entry["status"]
        if status in ("free", "not-identifiable"):
            status = "assumed" if start.rests_on.get(name) else "free"
            status = status if calibrated or name not in FELT else "not-identifiable"
        parameters[name] = entry | {"interval": None, "interval_by": None, "status": status}
    document = result.document | {
        "recipe": recipe,
        "verdict": OPENING[recipe] + ("" if calibrated else FELT_UNKNOWN),
        "messages": _said(result, fit, start, [n for n, p in parameters.items() if p["status"] == "at-bound"]),
        "parameters": parameters,
        "derived": result.document["derived"] | {"felt_force_relative_error": None},
        "diagnostics": result.document["diagnostics"] | {"agreeing_starts": None, "correlated": []},
    }
    return replace(result, document=document)


def _said(result: Result, fit: Fit, start: Start, bound: list[str]) -> list[str]:
    """Plain sentences, the weightiest first."""
    said = [*fit.messages, NO_INTERVALS]
    if result.worse_bands:
        said.append(f"No lower on the paper's criterion than at the start: {', '.join(result.worse_bands)}.")
    if bound:
        said.append(f"At the edge of the box, so their values are the box's: {', '.join(bound)}.")
    rests = sorted({x for names in start.rests_on.values() for x in names})
    if rests:
        said.append(f"The string's {' and '.join(rests)} were not given and are the literature's for this key.")
    missing = [f"band {b + 1}" for b in range(3) if b not in fit.data.occupied]
    if missing:
        said.append(f"No partial above the noise in {' and '.join(missing)}; dropped, and the next band used.")
    return [*said, *result.recording.warnings, *result.analysis.warnings]
