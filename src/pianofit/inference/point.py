"""A result without intervals: one point that another search has found, and what may be said of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..analysis import Analysis
from ..criterion import BANDS
from ..io import FIT_SCHEMA
from ..model import Simulation
from ..model.note import Note, arrival
from ..model.response import level_db, ringing
from ..parameters import FIT_NAMES, Hammer, String
from ..recording import Recording
from .coordinates import names_of
from .entries import derived, given, sizes, versions
from .listener import Listener, level_errors, together, worse_bands
from .quantities import UNITS, Covariance
from .result import FittedRecording, Result
from .start import Start

__all__ = ["point_result"]


def point_result(
    recording: Recording, analysis: Analysis, start: Start, string: String, hammer: Hammer, *, recipe: str, seed: int,
    delay: float, converged: bool, evaluations: int, at_bound: Sequence[str], opening: str, messages: Sequence[str],
) -> Result:  # fmt: skip
    """What is found at `string` and `hammer`, in the form of every result.

    Parameters
    ----------
    delay : s, from the hammer's first contact to the recording's onset.
    at_bound : names of parameters that ended on an edge of their range.
    opening, messages : what is said of the search itself.
    """
    listener = Listener.of(recording, analysis)
    calibrated = start.scale is not None
    unit, gain = (20 * np.log10(start.scale), 1.0 / start.scale) if start.scale is not None else (0.0, None)
    begins = recording.onset - round(delay * recording.rate) if calibrated else None
    values = start.values | start.initial
    first = Note(
        String(*(values[n] for n in String._fields)), Hammer(*(values[n] for n in Hammer._fields)), start.geometry,
        start.quantity, 1.0, None,
    )  # fmt: skip
    last = first._replace(string=string, hammer=hammer)
    before, after = (
        listener.play(note, gain, begins, _levels(note, note.strike(recording.rate), analysis))
        for note in (first, last)
    )
    measured = analysis.partials.level + unit
    criterion = listener.criterion(before, after, calibrated)
    levels = {"initial_db": before.level, "fitted_db": after.level, "path_only_db": None}
    errors = level_errors(levels, analysis.partials, measured)
    heard = FittedRecording(before, after, measured, recording, analysis, criterion, errors)
    missing = [f"band {i + 1}" for i, name in enumerate(BANDS) if name in criterion["dropped"]]
    said = [] if converged else ["The search stopped before it converged; no value is a result."]
    said += messages
    worse = worse_bands(criterion)
    said += [f"The paper's criterion is no lower than at the start: {', '.join(worse)}."] * bool(worse)
    said += [f"At the edge of the box, so their values are the box's: {', '.join(at_bound)}."] * bool(at_bound)
    said += [f"No partial above the noise in {' and '.join(missing)}; dropped, and the next band used."] * bool(missing)
    found = dict(zip(FIT_NAMES, (*string, *hammer), strict=True))
    document = {
        "schema": FIT_SCHEMA, "program": "pianofit", "recipe": recipe, "felt": start.law.name, "seed": seed,
        "converged": converged, "claims": opening, "messages": [*said, *recording.warnings, *analysis.warnings],
        "invariants": {},
        "parameters": _parameters(start, found, values, at_bound, calibrated),
        "recordings": [{
            "file": recording.path, "sha256": recording.sha256, "channel": recording.channel, "rate": recording.rate,
            "onset_s": recording.onset / recording.rate, "v_H0": float(hammer.v_H0), "v_H0_interval": None,
            "v_H0_status": _status(start, "v_H0", at_bound, calibrated), "gain": after.note.gain,
            "gain_status": "given" if calibrated else "fitted", "first": True, "cents": 0.0, "group": 0, "stroke": 0,
            "criterion": criterion, "levels": errors,
        }],
        "pickup": {"quantity": start.quantity, "path": None},
        "minima": [],
        "derived": derived(after.note, after.simulation, analysis),
        "criterion": criterion,
        "levels": together([errors]),
        "diagnostics": {"evaluations": evaluations, "partials": len(analysis.partials), "correlated": []},
        "versions": versions(),
    }  # fmt: skip
    names = (*names_of(start.law), "v_H0")
    nothing = Covariance(names, np.zeros((len(names), len(names))))
    document |= {"covariance": nothing.document()}
    return Result(document, (heard,), 0, nothing, ((after.note,),), (1.0,))


def _levels(note: Note, simulation: Simulation, analysis: Analysis) -> np.ndarray:
    """Levels of the recording's partials by the model, dB [partials]."""
    pole = np.asarray(simulation.modes.pole)
    delay = arrival(note.string, note.geometry, note.quantity)
    decay = -np.real(pole)
    amplitude = np.asarray(ringing(simulation.modes, simulation.pulse.drive)) * np.exp(-decay * delay)
    level = np.asarray(level_db(amplitude, decay, np))
    return level[np.minimum(analysis.partials.number, len(level)) - 1]


def _status(start: Start, name: str, at_bound: Sequence[str], calibrated: bool) -> str:
    if name in start.fixed:
        return "assumed" if start.fixed[name] == "assumed" else "given"
    if name in at_bound:
        return "at-bound"
    if not calibrated and name in start.law.parameters:
        return "not-identifiable"
    return "scaled" if start.rests_on.get(name) else "fitted"


def _parameters(start: Start, found: dict, initial: dict, at_bound: Sequence[str], calibrated: bool) -> dict:
    g = start.geometry
    table = {}
    for name in FIT_NAMES:
        status = _status(start, name, at_bound, calibrated)
        table[name] = given(found[name], name, status) | {"initial": float(initial[name])}
    for name, value in (("x0", g.strike), ("width", g.width)):
        known = start.fixed.get(name) == "fixed"
        table[name] = given(float(value), name, "given" if known else "assumed") | {"unit": UNITS[name]}
    return table | sizes(start)
