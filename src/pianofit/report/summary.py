"""A fit as text for a terminal."""

from pathlib import Path

from ..analysis import nearest_note
from ..excitation import STROKES
from ..io.number_format import columns, format_with_interval
from ..model import Simulation
from ..result import Result
from ..schema.derived import Recontact
from ..schema.fit import RecordingFit
from ..schema.quantities import Quantities
from .modal_response import modal_response_line
from .text import recontact_text


def fit_summary(result: Result) -> str:
    """Return statement, quantities with intervals, errors and warnings of a fit, as `pianofit fit` prints them."""
    fit, several = result.fit, len(result.fit.recordings) > 1
    lines = [fit.identifiability_statement, ""]
    # Invariants come first, because they do not depend on assumed sizes or velocities.
    derived, levels, criterion = fit.derived, fit.levels, fit.criterion
    tables = (fit.invariants, fit.parameters, derived.quantities)
    lines += [line for table in tables for line in _quantity_lines(table)]
    parts = (f"f0 {derived.f0:.3f} Hz ({nearest_note(derived.f0)})", f"B {derived.B:.4g}")
    lines.append(", ".join(filter(None, (*parts, recontact_text(derived.recontacts)))))
    hammer = levels.initial_hammer_db
    only = "" if hammer is None else f", initial hammer {hammer:.2f} dB"
    where = "levels of partials" + (f" in {len(fit.recordings)} recordings" if several else "")
    errors = f"initial {levels.initial_db:.2f} dB{only}, fitted {levels.fitted_db:.2f} dB"
    lines.append(f"{levels.partials} {where}: {errors}")
    lines += [] if fit.modal_response is None else [modal_response_line(fit.modal_response)]
    lines += [_recording_line(recording, STROKES[fit.excitation].unit) for recording in fit.recordings if several]
    for name, value in criterion.bands.items():
        lines.append(f"criterion, {name:7} {value.initial:10.4g} -> {value.final:.4g}")
    if criterion.excluded_bands:
        lines.append(f"dropped, no partial above the noise: {', '.join(criterion.excluded_bands)}")
    return "\n".join([*lines, "" if fit.converged else "NOT CONVERGED", *fit.warnings]) + "\n"


def contact_text(strike: Simulation) -> str:
    """Return the duration of the first contact of a simulated strike, and its recontacts."""
    again = recontact_text([Recontact.of(contact) for contact in strike.contacts[1:]])
    return "; ".join(filter(None, (f"contact {1e3 * strike.contact_time:.2f} ms", again)))


def _quantity_lines(table: Quantities) -> list[str]:
    """Return lines with value, interval and status, and an empty line. An empty table has no lines."""
    if not table:
        return []
    rows = [("", "value", "unit", "95 % interval", "status")]
    ends = {"low": "below: the bound", "high": "above: the bound"}
    for name, quantity in table.items():
        unbounded = ", ".join(ends[end] for end in quantity.interval_unbounded)
        status = quantity.status + (f" ({unbounded})" if unbounded else "")
        if name.startswith(("v/", "x0/L")) and quantity.note:
            status += f"  {Path(quantity.note).name}"
        elif name in ("F/M_S", "felt_force", "local_exponent"):
            status += f"  {quantity.note}"
        value, span = format_with_interval(quantity.value, quantity.interval)
        rows.append((name, value, "" if quantity.unit == "1" else quantity.unit, span, status))
    return [*columns(rows, right=1), ""]


def _recording_line(row: RecordingFit, unit: str) -> str:
    channel = f" ({row.channel})" * (row.channel not in ("mono", "average"))
    return (
        f"{Path(row.file).name}{channel}{' (the reference)' * row.is_reference}: {row.stroke_value:.3g} {unit}, "
        f"gain {row.gain:.3g}, {row.pitch_offset_cents:+z.2f} cents, "
        f"levels {row.levels.initial_db:.1f} -> {row.levels.fitted_db:.2f} dB"
    )
