"""The paper's own searches on eq. 19: its three steps, and its criterion over the whole spectrum.

`paper` (Bensa et al. 2005, IV.C): 1. c and b1 in band 1, by gradient. 2. κ and b2 in band 2, by gradient. 3. K_H, μ,
M_H, p and v_H0 in band 3, by annealing with a fixed string, followed by least squares.
`global` (IV.B): all nine parameters on eq. 19 over the whole spectrum, by gradient.

Both start from the given initial values. This module chooses the details that the paper leaves open. The string is
searched with falling σ. At the first σ the lines of model and recording overlap. The last σ is the resolution of the
recording, where eq. 19 is that of the paper. The hammer is searched at the σ at which the criterion is reported.
"""

import os
from collections.abc import Mapping
from dataclasses import replace
from numbers import Integral
from typing import Any

from ..analysis import Analysis
from ..errors import ParameterError, check_range, check_type
from ..felt.hunt_crossley import HUNT_CROSSLEY, POWER
from ..fitting import check_arguments, given_setup, read_and_analyse
from ..inference import InitialValues, starting_values
from ..parameters import FIT_NAMES
from ..progress import Progress, progress_bar
from ..recording.recording import Recording, Source
from ..result import Result
from ..setup import Setup, recording_info_for
from .point_estimate import point_result
from .search import ALL, SearchResult, make_search, split

METHODS = ("paper", "global")
# Evaluations of the annealing: default,
EVALUATIONS = 20_000
# least, which leaves each chain a few steps,
FEWEST = 500
# and most, which takes some hours.
MOST = 10_000_000


def fit(
    recording: Source,
    *,
    setup: Setup | Mapping[str, Any] | str | os.PathLike[str] | None = None,
    note: str | int | None = None,
    f0: float | None = None,
    velocity: float | None = None,
    channel: str | int = "average",
    method: str = "paper",
    evaluations: int | None = None,
    seed: int = 0,
    progress: Progress | bool | None = None,
    analysis: Analysis | None = None,
) -> Result:
    """Fit string and hammer to one recording by a method of the paper. The result has no intervals.

    Parameters
    ----------
    recording, setup, note, f0, velocity, channel, progress : see `pianofit.fit`.
    method : `paper`, the three steps of the paper, or `global`, its criterion over the whole spectrum.
    evaluations : evaluations of the criterion by the annealing of the method `paper`; 20,000 if None.
    seed : seed of the annealing. The same seed gives the same result.
    analysis : analysis of the recording, if it was analysed before.

    Raises
    ------
    PianofitError
        As `pianofit.fit`, and a `ParameterError` for another felt law than the one of the paper.
    """
    analyses = None if analysis is None else (analysis,)
    check_arguments((recording,), analyses, velocity, seed, progress)
    _check_method(method, evaluations)
    setup = given_setup(setup, velocity)
    if not setup.law.has_contact:
        raise ParameterError(f"method={method!r} fits a struck string, not a {setup.excitation}; leave one of them out")
    setup = replace(setup, felt=setup.felt or HUNT_CROSSLEY.name)
    with progress_bar(progress) as report:
        (sound,), (analysis,) = read_and_analyse((recording,), analyses, channel, note, f0, report)
        if velocity is None:
            velocity = recording_info_for(setup, sound.path, alone=True).v_H0
        start = starting_values(analysis, setup, velocity)
        found = search_parameters(sound, analysis, start, method, evaluations=evaluations, seed=seed, progress=report)
        return point_result(sound, analysis, start, found, method, seed)


def _check_method(method: str, evaluations: int | None) -> None:
    """Reject a method that does not exist, and evaluations out of range or of a method without annealing."""
    check_type("method=", method, str, "a text, such as 'paper'")
    if method not in METHODS:
        raise ParameterError(f"method={method!r} must be one of {', '.join(METHODS)}")
    if evaluations is not None:
        if method != "paper":
            raise ParameterError(f"evaluations={evaluations} needs an annealing: use method='paper'")
        check_type("evaluations=", evaluations, Integral, "a whole number")
        check_range("evaluations=", evaluations, FEWEST, MOST)


def search_parameters(
    recording: Recording,
    analysis: Analysis,
    start: InitialValues,
    method: str = "paper",
    *,
    evaluations: int | None = None,
    seed: int = 0,
    progress: Progress = lambda *_: None,
) -> SearchResult:
    """Run the search of `fit` from any start.

    Raises
    ------
    ParameterError
        For another felt law than the one of the paper.
    FitError
        If no hammer gives a finite criterion, or a contact does not end.
    """
    if start.law not in (HUNT_CROSSLEY, POWER):
        raise ParameterError(f"method={method!r} has no felt={start.law.name!r}: use {HUNT_CROSSLEY.name!r}")
    search = make_search(recording, analysis, start)
    x = search.x(search.values)
    progress("string", 0.1)
    if method == "global":
        x = search.descend(x, FIT_NAMES, ALL)
    else:
        x = search.descend(x, ("c", "b1"), (search.band(0),))
        x = search.descend(x, ("kappa", "b2"), (search.band(1),))
        progress("hammer", 0.2)
        x = search.anneal_hammer(x, evaluations or EVALUATIONS, seed)
    progress("gradient", 0.7)
    if search.calibrated:
        search.delay = search.first_contact(search.natural(x))
    x = search.descend(x, FIT_NAMES, ALL, finest=True) if method == "global" else search.refine_hammer(x)
    progress("done", 1.0)
    values = search.natural(x)
    return SearchResult(*split(values), search.delay, search.converged, search.evaluations, search.at_bound(values))
