"""Text summaries of fits for a terminal."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ..analysis.note_names import nearest_note
from ..io.number_format import columns, format_like, format_with_interval
from ..report.text import modal_response_line, recontact_text

if TYPE_CHECKING:
    from ..model import Simulation

__all__ = ["comparison", "contact", "contact_of", "cross_validation", "summary"]

ONLY = {"low": "below", "high": "above"}


def comparison(document: dict, true: dict[str, float]) -> str:
    """Table of true and fitted values."""
    lines = [f"{'':8}{'initial':>12}{'true':>14}{'fitted':>14}{'error':>11}   95 % interval, and true value inside"]
    for name, value in true.items():
        p = document["parameters"][name]
        fitted, span = format_with_interval(p["value"], p["interval"])
        error = 100 * (p["value"] / value - 1)
        holds = "-" if p["interval"] is None else "yes" if p["interval"][0] <= value <= p["interval"][1] else "NO"
        note = "" if p["status"] == "fitted" else f", {p['status']}"
        truth = format_like(value, p["value"], p["interval"])
        lines.append(f"{name:8}{p['initial']:12.5g}{truth:>14}{fitted:>14}{error:+9.1g} %   {span} {holds}{note}")
    return "\n".join(lines) + "\n"


def summary(document: dict, folder: Path) -> str:
    """Summary of a fit."""
    lines = [document["claims"], ""] if document["claims"] else []
    # Invariants come first, because they do not depend on assumed sizes or velocities.
    lines += [x for table in (document["invariants"], document["parameters"]) for x in _value_lines(table)]
    d, levels = document["derived"], document["levels"]
    lines.append(f"f0 {d['f0']:.3f} Hz ({nearest_note(d['f0'])}), B {d['B']:.4g}, {contact(d)}")
    only = "" if levels["path_only_db"] is None else f", initial hammer {levels['path_only_db']:.2f} dB"
    count = len(document["recordings"])
    where = "levels of partials" + (f" in {count} recordings" if count > 1 else "")
    lines.append(f"{levels['partials']} {where}: initial {levels['initial_db']:.2f} dB{only}, "
                 f"fitted {levels['fitted_db']:.2f} dB")  # fmt: skip
    lines += [modal_response_line(document["ringing"])] if "ringing" in document else []
    if count > 1:
        lines += [_recording_line(recording) for recording in document["recordings"]]
    for name in ("global", "band1", "band2", "band3"):
        if name in document["criterion"]:
            c = document["criterion"][name]
            lines.append(f"criterion, {name:7} {c['initial']:10.4g} -> {c['final']:.4g}")
    if document["criterion"]["dropped"]:
        lines.append(f"dropped, no partial above the noise: {', '.join(document['criterion']['dropped'])}")
    lines += ["" if document["converged"] else "NOT CONVERGED", *document["messages"], "", f"written to {folder}"]
    return "\n".join(lines) + "\n"


def contact(derived: dict) -> str:
    """Duration of the first contact, and recontacts."""
    first = f"contact {derived['contact_ms']:.2f} ms"
    again = recontact_text(derived["later_contacts"])
    return f"{first}; {again}" if again else first


def contact_of(strike: Simulation) -> str:
    """`contact` of a simulation."""
    later = [recontact.document() for recontact in strike.contacts[1:]]
    return contact({"contact_ms": 1e3 * strike.contact_time, "later_contacts": later})


def _value_lines(table: dict) -> list[str]:
    """Lines with value, interval and status, and an empty line. An empty table has no lines."""
    rows = [("", "value", "unit", "95 % interval", "status")] if table else []
    for name, p in table.items():
        open_at = ", ".join(f"{ONLY[end]}: the bound" for end in p.get("interval_open", ()))
        status = p["status"] + (f" ({open_at})" if open_at else "")
        about = {"v": f"  {Path(p['note']).name}", "F": f"  {p['note']}"}.get(name[0], "") if "/" in name else ""
        value, span = format_with_interval(p["value"], p["interval"])
        rows.append((name, value, "" if p["unit"] == "1" else p["unit"], span, status + about))
    return [*columns(rows, right=1), ""] if rows else []


def _recording_line(recording: dict) -> str:
    levels, reference = recording["levels"], " (the reference)" * bool(recording["first"])
    channel = f" ({recording['channel']})" * (recording["channel"] not in ("mono", "average"))
    return (
        f"{Path(recording['file']).name}{channel}{reference}: {recording['v_H0']:.3g} m/s, "
        f"gain {recording['gain']:.3g}, {recording['cents']:+.2f} cents, "
        f"levels {levels['initial_db']:.1f} -> {levels['fitted_db']:.2f} dB"
    )


def cross_validation(document: dict) -> str:
    """Prediction errors of recordings that were left out, next to errors of methods without a model."""
    lines = [f"{'':32}{'v_H0, m/s':>10}{'predicted':>11}{'nearest':>9}{'blend':>7}   rms error, dB"]
    for row in document["recordings"]:
        predicted, nearest, blend = (
            "-" if row[key] is None else f"{row[key]:.2f}" for key in ("predicted_db", "nearest_db", "blend_db")
        )
        note = "" if row["inner"] else "  (beyond the others)"
        lines.append(f"{Path(row['file']).name:32}{row['v_H0']:10.3g}{predicted:>11}{nearest:>9}{blend:>7}{note}")
    if document["median_inner_db"] is not None:
        lines.append(f"between the others: median {document['median_inner_db']:.2f} dB, worst "
                     f"{document['worst_inner_db']:.2f} dB")  # fmt: skip
    return "\n".join([*lines, *document["messages"]]) + "\n"
