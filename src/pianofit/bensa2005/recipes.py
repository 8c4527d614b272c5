"""The paper's own searches on eq. 19, for comparison: its three steps, and its criterion over the whole spectrum.

`paper` (Bensa et al. 2005, IV.C): 1. c and b1 in band 1, by gradient. 2. κ and b2 in band 2, by gradient. 3. K_H, μ,
M_H, p and v_H0 in band 3, by annealing with a fixed string, followed by least squares.
`global` (IV.B): all nine parameters on eq. 19 over the whole spectrum, by gradient.

Both start from the given initial values. This module chooses the details that the paper leaves open. The string is
searched with falling σ. At the first σ the lines of model and recording overlap. The last σ is the resolution of the
recording, where eq. 19 is that of the paper. The hammer is searched at the σ at which the criterion is reported.
"""

from __future__ import annotations

from numbers import Integral
from typing import NamedTuple

from ..analysis import Analysis
from ..errors import ParameterError, check_range, check_type
from ..felt import DEFAULT_LAW
from ..inference import InitialValues, Progress, starting_values
from ..parameters import FIT_NAMES, Hammer, String
from ..recording.recording import Recording
from ..result import Result
from ..setup import Setup
from .point_estimate import point_result
from .search import ALL, make_search, split

__all__ = ["RECIPES", "SearchResult", "check_recipe", "fit_by_paper", "fit_bensa2005"]

RECIPES = ("default", "paper", "global")
# Evaluations of the annealing: default,
EVALUATIONS = 20_000
# least, which leaves each chain a few steps,
FEWEST = 500
# and most, which takes some hours.
MOST = 10_000_000
OPENING = {
    "paper": "The paper's three steps (recipe “paper”), for comparison with it.",
    "global": "The paper's criterion over the whole spectrum (recipe “global”), for comparison with it.",
}
NO_INTERVALS = (
    "No intervals: this criterion gives neither the uncertainty nor the identifiability of the parameters. The default "
    "recipe reports both."
)
FELT_UNKNOWN = (
    " One uncalibrated recording does not identify the felt: its gain was free, and no output path was fitted."
)


class SearchResult(NamedTuple):
    """End of a search."""

    string: String
    hammer: Hammer
    delay: float  # s, from the hammer's first contact to the recording's onset
    converged: bool
    evaluations: int
    at_bound: tuple[str, ...]  # names of parameters that ended at a bound of the box


def check_recipe(recipe: str, evaluations: int | None) -> None:
    """Check a recipe and its number of evaluations.

    Raises
    ------
    ParameterError
        For a recipe that does not exist, or for evaluations out of range or of a recipe without annealing.
    """
    if recipe not in RECIPES:
        raise ParameterError(f"recipe={recipe!r} must be one of {', '.join(RECIPES)}")
    if evaluations is not None and recipe != "paper":
        raise ParameterError(f"evaluations={evaluations} needs an annealing: use recipe='paper'")
    if evaluations is not None:
        check_type("evaluations=", evaluations, Integral, "a whole number")
        check_range("evaluations=", evaluations, FEWEST, MOST)


def fit_bensa2005(
    recording: Recording, analysis: Analysis, setup: Setup, recipe: str, *, velocity: float | None = None,
    evaluations: int | None = None, seed: int = 0, progress: Progress = lambda *_: None,
) -> Result:  # fmt: skip
    """Fit one recording with the recipe `paper` or `global`. The result has no intervals.

    Parameters
    ----------
    setup : given values.
    velocity : measured hammer velocity, m/s, held fixed; that of the setup if None.
    evaluations, seed, progress : see `fit_by_paper`, also for the errors raised.
    """
    start = starting_values(analysis, setup, velocity)
    found = fit_by_paper(recording, analysis, start, recipe, evaluations=evaluations, seed=seed, progress=progress)
    opening = OPENING[recipe] + (FELT_UNKNOWN if start.scale is None else "")
    return point_result(
        recording, analysis, start, **found._asdict(), recipe=recipe, seed=seed, opening=opening,
        messages=(NO_INTERVALS,),
    )  # fmt: skip


def fit_by_paper(
    recording: Recording,
    analysis: Analysis,
    start: InitialValues,
    recipe: str = "paper",
    *,
    evaluations: int | None = None,
    seed: int = 0,
    progress: Progress = lambda *_: None,
) -> SearchResult:
    """Run the search of `fit_bensa2005` from any start.

    Parameters
    ----------
    evaluations : number of evaluations of the criterion in the annealing; 20,000 if None.
    seed : of the annealing. The same seed gives the same result.
    progress : called with the name of the stage and the fraction done.

    Raises
    ------
    ParameterError
        For another felt law than the paper's.
    FitError
        If no hammer gives a finite criterion, or a contact does not end.
    """
    if start.law.hammer_type is not Hammer:
        raise ParameterError(f"recipe={recipe!r} has no felt={start.law.name!r}: use {DEFAULT_LAW.name!r}")
    search = make_search(recording, analysis, start)
    x = search.x(search.values)
    progress("string", 0.1)
    if recipe == "global":
        x = search.descend(x, FIT_NAMES, ALL)
    else:
        x = search.descend(x, ("c", "b1"), (search.band(0),))
        x = search.descend(x, ("kappa", "b2"), (search.band(1),))
        progress("hammer", 0.2)
        x = search.anneal_hammer(x, evaluations or EVALUATIONS, seed)
    progress("gradient", 0.7)
    if search.calibrated:
        search.delay = search.first_contact(search.natural(x))
    x = search.descend(x, FIT_NAMES, ALL, finest=True) if recipe == "global" else search.refine_hammer(x)
    progress("done", 1.0)
    values = search.natural(x)
    return SearchResult(*split(values), search.delay, search.converged, search.evaluations, search.at_bound(values))
