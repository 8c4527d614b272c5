"""The paper's own searches on eq. 19, for comparison: its three steps, and its criterion over the whole spectrum.

`paper` (Bensa et al. 2005, IV.C): 1. c and b1 in band 1, by gradient. 2. κ and b2 in band 2, by gradient. 3. K_H, μ,
M_H, p and v_H0 in band 3, by annealing, with the string held; least squares take what was found to the floor of its
basin.
`global` (IV.B): all nine on eq. 19 over the whole spectrum, by gradient.

Both start from the given initial values. What the paper leaves open is chosen here. The string is searched with σ
falling, from lines wide enough to meet down to what the recording's length resolves, where eq. 19 is the paper's own;
the hammer on the σ at which the criterion is reported.
"""

from __future__ import annotations

from numbers import Integral
from typing import NamedTuple

from ..analysis import Analysis
from ..errors import ParameterError, check_range, check_type
from ..felt import DEFAULT_LAW
from ..inference import Progress
from ..inference.initial_values import InitialValues, starting_values
from ..parameters import FIT_NAMES, Hammer, String
from ..recording.recording import Recording
from ..result import Result
from ..setup import Setup
from .point_estimate import point_result
from .search import ALL, pose, split

__all__ = ["RECIPES", "Found", "check_recipe", "fit_by_paper", "fit_bensa2005"]

RECIPES = ("default", "paper", "global")
# Evaluations by the annealing: unless others are asked for,
EVALUATIONS = 20_000
# the fewest that leave its chains a few steps each,
FEWEST = 500
# and the most, some hours.
MOST = 10_000_000
OPENING = {
    "paper": "The paper's three steps (recipe “paper”), for comparison with it.",
    "global": "The paper's criterion over the whole spectrum (recipe “global”), for comparison with it.",
}
NO_INTERVALS = (
    "No intervals: the least value of this criterion does not say how far off the parameters may be, or which of them "
    "the recording identifies at all. The default recipe says both."
)
FELT_UNKNOWN = (
    " One uncalibrated recording does not fix the felt: here its gain was free, and no output path was fitted."
)


class Found(NamedTuple):
    """Where a search ended."""

    string: String
    hammer: Hammer
    delay: float  # s, from the hammer's first contact to the recording's onset
    converged: bool
    evaluations: int
    at_bound: tuple[str, ...]  # names of parameters that ended on an edge of the box


def check_recipe(recipe: str, evaluations: int | None) -> None:
    """Refuse a recipe that does not exist, and evaluations that it cannot have, by a `ParameterError`."""
    if recipe not in RECIPES:
        raise ParameterError(f"recipe={recipe!r} must be one of {', '.join(RECIPES)}")
    if evaluations is not None and recipe != "paper":
        raise ParameterError(f"evaluations={evaluations} are those of the annealing: only the recipe paper has them")
    if evaluations is not None:
        check_type("evaluations=", evaluations, Integral, "a whole number")
        check_range("evaluations=", evaluations, FEWEST, MOST)


def fit_bensa2005(
    recording: Recording, analysis: Analysis, setup: Setup, recipe: str, *, velocity: float | None = None,
    evaluations: int | None = None, seed: int = 0, progress: Progress = lambda *_: None,
) -> Result:  # fmt: skip
    """Fit one recording by `paper` or `global`; the result claims no more than such a search can.

    Parameters
    ----------
    setup : what was known beforehand.
    velocity : measured hammer velocity, m/s, held fixed; that of the setup if None.
    evaluations, seed, progress : as `fit_by_paper` has them, which also says what it raises.
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
) -> Found:
    """The search behind `fit_bensa2005`, from any start.

    Parameters
    ----------
    evaluations : of the criterion by the annealing; 20,000 unless given.
    seed : of the annealing. The same seed gives the same result.
    progress : called with a stage's name and the fraction done.

    Raises
    ------
    ParameterError
        For a felt that relaxes.
    FitError
        If no hammer gives a finite criterion, or a contact does not end.
    """
    if start.law.kind is not Hammer:
        raise ParameterError(f"recipe={recipe!r} has no felt={start.law.name!r}: the paper's is {DEFAULT_LAW.name}")
    search = pose(recording, analysis, start)
    x = search.x(search.values)
    progress("string", 0.1)
    if recipe == "global":
        x = search.down(x, FIT_NAMES, ALL)
    else:
        x = search.down(x, ("c", "b1"), (search.band(0),))
        x = search.down(x, ("kappa", "b2"), (search.band(1),))
        progress("hammer", 0.2)
        x = search.annealed(x, evaluations or EVALUATIONS, seed)
    progress("gradient", 0.7)
    if search.calibrated:
        search.delay = search.first_contact(search.natural(x))
    x = search.down(x, FIT_NAMES, ALL, finest=True) if recipe == "global" else search.hammer_finished(x)
    progress("done", 1.0)
    values = search.natural(x)
    return Found(*split(values), search.delay, search.converged, search.evaluations, search.at_bound(values))
