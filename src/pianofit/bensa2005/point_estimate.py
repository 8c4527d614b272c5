"""A result without intervals, from the point where one of the paper's searches ended."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..analysis import Analysis
from ..criterion import BANDS
from ..inference import InitialValues
from ..model import Simulation
from ..model.free_response import level_db, modal_amplitudes
from ..model.note import Note, arrival
from ..parameters import FIT_NAMES, Hammer, String
from ..recording.recording import Recording
from ..result import Result
from ..result.comparison import RecordingComparison, worse_bands
from ..result.derived_table import with_derived
from ..result.estimates import fixed_quantity, sizes
from ..result.records import derived_of, pickup_of, record_of
from ..result.warnings import AT_BOUND, NOT_CONVERGED
from ..schema.diagnostics import Diagnostics
from ..schema.fit import Criterion, Fit, package_versions
from ..schema.quantities import Quantities, Status
from .search import SearchResult

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


def point_result(
    recording: Recording, analysis: Analysis, start: InitialValues, found: SearchResult, recipe: str, seed: int
) -> Result:
    """Return the `Result` at the end of a search."""
    comparison, values = RecordingComparison(recording, analysis, start.scale), start.values | start.initial
    begins = None if start.scale is None else recording.onset - round(found.delay * recording.rate)
    first = Note(
        String(*(values[n] for n in String._fields)),
        Hammer(*(values[n] for n in Hammer._fields)),
        start.geometry,
        start.quantity,
        1.0,
        None,
    )
    notes = (first, first._replace(string=found.string, hammer=found.hammer))
    before, after = (comparison.render(note, comparison.gain, begins) for note in notes)
    levels = [comparison.at_best_gain(one, _levels(one.note, one.simulation, analysis)) for one in (before, after)]
    compared = comparison.compare(before, after, levels, comparison.level_errors(*levels))
    parameters = _parameters(start, (*found.string, *found.hammer), values, found.at_bound)
    record = record_of(compared, parameters["v_H0"], start.scale is not None)
    fit = Fit(
        recipe=recipe,
        felt=start.law.name,
        seed=seed,
        converged=found.converged,
        identifiability_statement=OPENING[recipe] + (FELT_UNKNOWN if start.scale is None else ""),
        warnings=(
            *_statements(compared.criterion, found),
            *recording.warnings,
            *analysis.warnings,
        ),
        invariants=Quantities({}),
        parameters=parameters,
        recordings=(record,),
        pickup=pickup_of(start.quantity, [compared], [record]),
        minima=(),
        derived=derived_of(compared),
        criterion=compared.criterion,
        levels=compared.levels,
        diagnostics=Diagnostics(found.evaluations, len(analysis.partials)),
        versions=package_versions(),
    )
    return with_derived(Result(fit, (compared,), ((after.note,),)))


def _statements(criterion: Criterion, found: SearchResult) -> list[str]:
    """Warnings about the result."""
    worse = worse_bands(criterion)
    missing = [f"band {i + 1}" for i, name in enumerate(BANDS) if name in criterion.excluded_bands]
    statements = [NO_INTERVALS] if found.converged else [NOT_CONVERGED, NO_INTERVALS]
    if worse:
        statements.append(f"The paper's criterion did not fall below its value at the start: {', '.join(worse)}.")
    if found.at_bound:
        statements.append(AT_BOUND.format(", ".join(found.at_bound)))
    if missing:
        statements.append(f"No partial above the noise in {' and '.join(missing)}. The next band was used instead.")
    return statements


def _levels(note: Note, simulation: Simulation, analysis: Analysis) -> np.ndarray:
    """Levels that the model gives the recording's partials, dB [partials]."""
    pole = np.asarray(simulation.modes.pole)
    delay = arrival(note.string, note.geometry, note.quantity)
    decay = -np.real(pole)
    amplitude = np.asarray(modal_amplitudes(simulation.modes, simulation.pulse.drive)) * np.exp(-decay * delay)
    level = np.asarray(level_db(amplitude, decay, np))
    return level[np.minimum(analysis.partials.number, len(level)) - 1]


def _parameters(
    start: InitialValues, final: Sequence[float], initial: dict[str, float], at_bound: Sequence[str]
) -> Quantities:
    """Every parameter without an interval."""

    def status(name: str) -> Status:
        if name in start.fixed:
            return "assumed" if start.fixed[name] == "assumed" else "given"
        if name in at_bound:
            return "at-bound"
        if start.scale is None and name in start.law.parameters:
            return "not-identifiable"
        return "scaled" if start.assumptions.get(name) else "fitted"

    table = [
        replace(fixed_quantity(name, value, status(name)), initial=float(initial[name]))
        for name, value in zip(FIT_NAMES, final, strict=True)
    ]
    for name, value in (("x0", start.geometry.strike_position), ("width", start.geometry.width)):
        table.append(fixed_quantity(name, value, "given" if start.fixed.get(name) == "fixed" else "assumed"))
    return Quantities.of([*table, *sizes(start)])
