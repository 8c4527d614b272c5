"""A result without intervals: one point that another search has found, and what may be said of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..analysis import Analysis
from ..criterion import BANDS
from ..inference.initial_values import InitialValues
from ..inference.parametrisation import names_of
from ..model import Simulation
from ..model.free_response import level_db, modal_amplitudes
from ..model.note import Note, arrival
from ..parameters import FIT_NAMES, Hammer, String
from ..recording.recording import Recording
from ..result import Covariance, Result
from ..result.comparison import RecordingComparison, worse_bands
from ..result.identifiability import AT_EDGE, STOPPED
from ..result.serialise import fixed_entry, recording_entry, sizes, to_document

__all__ = ["point_result"]


def point_result(
    recording: Recording,
    analysis: Analysis,
    start: InitialValues,
    string: String,
    hammer: Hammer,
    *,
    recipe: str,
    seed: int,
    delay: float,
    converged: bool,
    evaluations: int,
    at_bound: Sequence[str],
    opening: str,
    messages: Sequence[str],
) -> Result:
    """What is found at `string` and `hammer`, in the form of every result.

    Parameters
    ----------
    delay : s, from the hammer's first contact to the recording's onset.
    at_bound : names of parameters that ended on an edge of their range.
    opening, messages : what is said of the search itself.
    """
    listener, values = RecordingComparison.of(recording, analysis, start.scale), start.values | start.initial
    begins = None if start.scale is None else recording.onset - round(delay * recording.rate)
    first = Note(
        String(*(values[n] for n in String._fields)), Hammer(*(values[n] for n in Hammer._fields)), start.geometry,
        start.quantity, 1.0, None,
    )  # fmt: skip
    before, after = (
        listener.play(note, listener.gain, begins, _levels(note, note.strike(recording.rate), analysis))
        for note in (first, first._replace(string=string, hammer=hammer))
    )
    heard = listener.compared(before, after, {"initial_db": before.level, "fitted_db": after.level})
    parameters = _parameters(start, (*string, *hammer), values, at_bound)
    names = (*(name for name in names_of(start.law) if name in parameters), "v_H0")
    document = to_document(
        start, [heard], 0, [recording_entry(heard, parameters["v_H0"], start.scale is not None)],
        Covariance(names, np.zeros((len(names), len(names)))), recipe=recipe, seed=seed, converged=converged,
        claims=opening,
        messages=[*_said(heard.criterion, converged, at_bound, messages), *recording.warnings, *analysis.warnings],
        invariants={}, parameters=parameters, minima=[],
        diagnostics={"evaluations": evaluations, "partials": len(analysis.partials), "correlated": []},
    )  # fmt: skip
    return Result(document, (heard,), 0, ((after.note,),), (1.0,))


def _said(criterion: dict, converged: bool, at_bound: Sequence[str], messages: Sequence[str]) -> list[str]:
    """What to beware of."""
    worse = worse_bands(criterion)
    missing = [f"band {i + 1}" for i, name in enumerate(BANDS) if name in criterion["dropped"]]
    said = [*([] if converged else [STOPPED]), *messages]
    said += [f"The paper's criterion is no lower than at the start: {', '.join(worse)}."] * bool(worse)
    said += [AT_EDGE.format(", ".join(at_bound))] * bool(at_bound)
    said += [f"No partial above the noise in {' and '.join(missing)}; dropped, and the next band used."] * bool(missing)
    return said


def _levels(note: Note, simulation: Simulation, analysis: Analysis) -> np.ndarray:
    """Levels of the recording's partials by the model, dB [partials]."""
    pole = np.asarray(simulation.modes.pole)
    delay = arrival(note.string, note.geometry, note.quantity)
    decay = -np.real(pole)
    amplitude = np.asarray(modal_amplitudes(simulation.modes, simulation.pulse.drive)) * np.exp(-decay * delay)
    level = np.asarray(level_db(amplitude, decay, np))
    return level[np.minimum(analysis.partials.number, len(level)) - 1]


def _parameters(
    start: InitialValues, found: Sequence[float], initial: dict[str, float], at_bound: Sequence[str]
) -> dict:
    """Every parameter with value, unit and status."""

    def status(name: str) -> str:
        if name in start.fixed:
            return "assumed" if start.fixed[name] == "assumed" else "given"
        if name in at_bound:
            return "at-bound"
        if start.scale is None and name in start.law.parameters:
            return "not-identifiable"
        return "scaled" if start.assumptions.get(name) else "fitted"

    table = {
        name: fixed_entry(value, name, status(name)) | {"initial": float(initial[name])}
        for name, value in zip(FIT_NAMES, found, strict=True)
    }
    for name, value in (("x0", start.geometry.strike_position), ("width", start.geometry.width)):
        table[name] = fixed_entry(value, name, "given" if start.fixed.get(name) == "fixed" else "assumed")
    return table | sizes(start)
