"""`fit`, the entry point: from recordings and given values to a `Result`."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any

from .analysis import Analysis, analyse, check_analyses
from .errors import ParameterError, SetupError, check_range, check_type
from .parameters import check_seed, check_velocity
from .progress import Progress, progress_bar
from .recording.recording import Recording, Source, load_recordings
from .setup import Measured, RecordingInfo, Setup, to_setup
from .threads import check_process, cores, numerical_settings

if TYPE_CHECKING:
    from .inference import RecordingObjective
    from .result import Result

# Largest budget of a fit from guesses, steps of a minimisation.
MAX_BUDGET = 1000


@numerical_settings()
def fit(
    *recordings: Source,
    setup: Setup | Mapping[str, Any] | str | os.PathLike[str] | None = None,
    note: str | int | None = None,
    f0: float | None = None,
    velocity: float | None = None,
    channel: str | int = "average",
    intervals: str = "laplace",
    seed: int = 0,
    progress: Progress | bool | None = None,
    analyses: Sequence[Analysis] | None = None,
    start: Mapping[str, float] | Sequence[Mapping[str, float]] = (),
    budget: int | None = None,
) -> Result:
    """Fit string and hammer to one or more recordings of one key, from soft to loud in any order.

    All recordings share string, felt, hammer mass and output path. Each stroke has its own velocity, and each recording
    its own gain and pitch. Measured velocities, path groups and gain groups come from the setup.

    Parameters
    ----------
    recordings : recordings, each a path, a `Recording`, or samples [samples], ±1 = full scale, with their rate in Hz.
    setup : the given values: a `Setup`, tables as in a `setup.toml`, or the path of one.
    note, f0 : the note, such as "F#2" or 42, or its pitch in Hz; estimated if None.
    velocity : measured hammer velocity of a single recording, m/s: exact, or a `Measured` value.
    channel : channel of files: "average", "left", "right", or "1" to "8".
    intervals : `laplace`, `profile`, or `posterior`, which needs pianofit[bayes].
    seed : seed of the search and of the posterior draws. The same seed gives the same result.
    progress : called with a stage's name and the fraction done; False for none. If None, a bar in a terminal and a line
        in a notebook.
    analyses : analyses of the recordings, in their order, if they were analysed before.
    start : guess of hammer and contact, by name in SI units, or several guesses, such as those of a neural network. The
        search starts from them too. The strokes of several recordings are `v_H0 1`, `v_H0 2` and so on, except the
        reference stroke, which is `v_H0`. Missing names have their initial values. Values of the string are not used,
        because the partials determine it before, and neither are values that the setup fixes.
    budget : largest number of steps of each minimisation. The search then starts from the guesses only, which takes a
        fraction of the time, and finds the nearest minimum instead of all minima.

    Returns
    -------
    A `Result`: every parameter with unit, 95 % interval and status, and a `Note` to render. If the fit did not
    converge, its messages say so.

    Raises
    ------
    PianofitError
        For invalid input: `ParameterError` for an argument, `SetupError`, `RecordingError` or `AnalysisError`.
        `FitError` if a recording is given twice, is of another key or only noise, if no hammer gives a finite sound, or
        if a contact does not end.

    Examples
    --------
    >>> import pianofit
    >>> it = pianofit.preset("chabassier-F3")
    >>> sound = pianofit.simulate(it.string, it.hammer, it.geometry, quantity="bridge-force").waveform(44_100, 88_200)
    >>> samples = 0.5 * sound / abs(sound).max()
    >>> setup = pianofit.Setup(length=0.96)
    >>> result = pianofit.fit((samples, 44_100), setup=setup, note="F3", velocity=2.0, progress=False)
    >>> result.parameters.c.unit, result.parameters.c.status, abs(result.parameters.c.value / it.string.c - 1) < 0.01
    ('m/s', 'fitted', True)
    >>> _ = result.save("fit", page=False)  # fit.json and the sounds
    """
    check_arguments(recordings, analyses, velocity, seed, progress)
    starts = check_start(start, budget)
    check_type("intervals=", intervals, str, "a text, such as 'laplace'")
    if intervals != "laplace":
        from .inference import check_intervals

        check_intervals(intervals)
    setup = given_setup(setup, velocity)
    with progress_bar(progress) as report:
        sounds, analyses = read_and_analyse(recordings, analyses, channel, note, f0, report)
        from .inference import run_inference
        from .modal_response import fit_modal_response
        from .result import build_result

        options = {"intervals": intervals, "seed": seed, "progress": report, "starts": starts, "budget": budget}
        inference = run_inference(sounds, analyses, setup, velocity=velocity, **options)
        report("sounds", 0.93)
        return fit_modal_response(build_result(inference), report)


@numerical_settings()
def objective(
    *recordings: Source,
    setup: Setup | Mapping[str, Any] | str | os.PathLike[str] | None = None,
    note: str | int | None = None,
    f0: float | None = None,
    velocity: float | None = None,
    channel: str | int = "average",
    analyses: Sequence[Analysis] | None = None,
) -> RecordingObjective:
    """Return the objective F of recordings of one key as a function of JAX of the parameters.

    F is minus the log marginal posterior density that `fit` minimises. Its hyperparameters and the weights of partials
    are those that minimise F at the initial values. `RecordingObjective.at` moves them to another point.

    Parameters
    ----------
    recordings, setup, note, f0, velocity, channel, analyses : as for `fit`.

    Returns
    -------
    A `RecordingObjective`, a function of the natural logarithms of the values in SI units [parameters].

    Raises
    ------
    PianofitError
        As `fit`, for invalid input.

    Examples
    --------
    >>> import pianofit
    >>> it = pianofit.typical("C5")
    >>> made = pianofit.synthetic_recording(it.string, it.hammer, it.geometry, seconds=1.5, noise_db=60)
    >>> F = pianofit.objective(made.recording, setup=made.setup)
    >>> value, slope = F.value_and_gradient(F.start)
    >>> further, _ = F.value_and_gradient(F.log_values({"M_H": 2 * it.hammer.M_H}))
    >>> further > value
    True
    """
    check_arguments(recordings, analyses, velocity, 0, None)
    setup = given_setup(setup, velocity)
    sounds, analyses = read_and_analyse(recordings, analyses, channel, note, f0, lambda *_: None)
    from .inference import build_problem, objective_of

    return objective_of(build_problem(sounds, analyses, setup, velocity))


@numerical_settings()
def analyse_all(
    recordings: Sequence[Recording], note: str | int | None = None, f0: float | None = None
) -> list[Analysis]:
    """Analyse recordings of one note, on all cores.

    Raises `AnalysisError` if a recording is too short, or its note or enough partials are not detected.
    """
    with ThreadPoolExecutor(cores()) as threads:
        return list(threads.map(lambda recording: analyse(recording, note=note, f0=f0), recordings))


def check_arguments(
    recordings: Sequence[Source], analyses: Sequence[Analysis] | None, velocity: float | None, seed: int, progress: Any
) -> None:
    """Reject invalid arguments and combinations, before a file is read."""
    check_process()
    if not recordings:
        raise ParameterError("no recording was given; give one, or several of one key")
    check_type("progress=", progress, Callable | bool | None, "a function of a stage and a fraction, True or False")
    check_analyses(analyses, len(recordings))
    check_velocity(velocity)
    if isinstance(velocity, Measured):
        Setup(recordings=(RecordingInfo(v_H0=velocity),))  # checks the standard deviation
    check_seed(seed)
    if velocity is not None and len(recordings) > 1:
        raise ParameterError(
            f"velocity={velocity} m/s needs a single recording; for several give v_H0 in [[recording]] of the setup"
        )


def check_start(
    start: Mapping[str, float] | Sequence[Mapping[str, float]], budget: int | None
) -> Sequence[Mapping[str, float]]:
    """Return the guesses as a list. Raise a `ParameterError` for a value that is not positive, or a bad budget."""
    starts = [start] if isinstance(start, Mapping) else start
    check_type("start=", starts, list | tuple, "values in SI units by name, or a list of such guesses")
    for own in starts:
        check_type("start=", own, Mapping, "values in SI units by name, or a list of such guesses")
        for name, value in own.items():
            if isinstance(value, bool) or not (isinstance(value, Real) and 0 < value < math.inf):
                raise ParameterError(f"start=: {name}={value!r} must be a positive number in SI units")
    if budget is not None:
        check_type("budget=", budget, Integral, "a whole number of steps")
        check_range("budget=", budget, 1, MAX_BUDGET)
        if not starts:
            raise ParameterError(f"budget={budget} needs start=, a guess of the hammer; or leave it out")
    return starts


def given_setup(setup: Setup | Mapping[str, Any] | str | os.PathLike[str] | None, velocity: float | None) -> Setup:
    """Read the setup in any form. Raise a `SetupError` for a measured `velocity`, m/s, outside its bounds."""
    setup = to_setup(setup)
    if velocity is not None and not setup.law.has_contact:
        raise ParameterError(f"velocity={velocity} m/s: a {setup.law.kind} has no hammer velocity; leave it out")
    low, high = setup.bounds.get("v_H0", (0.0, math.inf))
    if velocity is not None and not low <= velocity <= high:
        raise SetupError(
            f"velocity={velocity} m/s is outside [bounds] v_H0 = [{low:g}, {high:g}] of the setup; change one of them"
        )
    return setup


def read_and_analyse(
    recordings: Sequence[Source],
    analyses: Sequence[Analysis] | None,
    channel: str | int,
    note: str | int | None,
    f0: float | None,
    progress: Progress,
) -> tuple[list[Recording], list[Analysis]]:
    """Read the recordings, and analyse them unless `analyses` are given."""
    progress("reading", 0.0)
    sounds = load_recordings(recordings, channel)
    progress("partials", 0.02)
    return sounds, analyse_all(sounds, note, f0) if analyses is None else list(analyses)
