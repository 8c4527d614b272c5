"""What the command line prints of a fit: a screenful of words and numbers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ..analysis.note_names import near_note
from ..io.number_format import columns, format_like, format_with_interval
from ..report.text import recontact_text, ringing_line

if TYPE_CHECKING:
    from ..model import Simulation

__all__ = ["comparison", "contact", "contact_of", "cross_validation", "summary"]

ONLY = {"low": "below", "high": "above"}


def comparison(document: dict, true: dict[str, float]) -> str:
    """True values beside found ones."""
    lines = [
        f"{'':8}{'initial':>12}{'true':>14}{'found':>14}{'off by':>11}   95 % interval, and whether it holds the truth"
    ]
    for name, value in true.items():
        p = document["parameters"][name]
        found, span = format_with_interval(p["value"], p["interval"])
        off = 100 * (p["value"] / value - 1)
        holds = "-" if p["interval"] is None else "yes" if p["interval"][0] <= value <= p["interval"][1] else "NO"
        note = "" if p["status"] == "fitted" else f", {p['status']}"
        truth = format_like(value, p["value"], p["interval"])
        lines.append(f"{name:8}{p['initial']:12.5g}{truth:>14}{found:>14}{off:+9.1g} %   {span} {holds}{note}")
    return "\n".join(lines) + "\n"


def summary(document: dict, folder: Path) -> str:
    """What was found, in a screenful."""
    lines = [document["claims"], ""] if document["claims"] else []
    # What no assumed size or velocity enters comes before the SI values.
    lines += [x for table in (document["invariants"], document["parameters"]) for x in _found(table)]
    d, levels = document["derived"], document["levels"]
    lines.append(f"f0 {d['f0']:.3f} Hz ({near_note(d['f0'])}), B {d['B']:.4g}, {contact(d)}")
    only = "" if levels["path_only_db"] is None else f", initial hammer {levels['path_only_db']:.2f} dB"
    count = len(document["recordings"])
    where = "levels of partials" + (f" in {count} recordings" if count > 1 else "")
    lines.append(f"{levels['partials']} {where}: start {levels['initial_db']:.2f} dB{only}, "
                 f"fitted {levels['fitted_db']:.2f} dB")  # fmt: skip
    lines += [ringing_line(document["ringing"])] if "ringing" in document else []
    if count > 1:
        lines += [_line_of(recording) for recording in document["recordings"]]
    for name in ("global", "band1", "band2", "band3"):
        if name in document["criterion"]:
            c = document["criterion"][name]
            lines.append(f"criterion, {name:7} {c['initial']:10.4g} -> {c['final']:.4g}")
    if document["criterion"]["dropped"]:
        lines.append(f"dropped, no partial above the noise: {', '.join(document['criterion']['dropped'])}")
    lines += ["" if document["converged"] else "NOT CONVERGED", *document["messages"], "", f"written to {folder}"]
    return "\n".join(lines) + "\n"


def contact(derived: dict) -> str:
    """How long the hammer first stayed, and whether it came back."""
    first = f"contact {derived['contact_ms']:.2f} ms"
    again = recontact_text(derived["later_contacts"])
    return f"{first}; {again}" if again else first


def contact_of(strike: Simulation) -> str:
    """`contact` of a strike that was computed."""
    again = [one.document() for one in strike.contacts[1:]]
    return contact({"contact_ms": 1e3 * strike.contact_time, "later_contacts": again})


def _found(table: dict) -> list[str]:
    """Values with their intervals and statuses, a line each, and an empty one; nothing of nothing."""
    rows = [("", "value", "unit", "95 % interval", "status")] if table else []
    for name, p in table.items():
        open_at = ", ".join(f"{ONLY[end]}: the bound" for end in p.get("interval_open", ()))
        status = p["status"] + (f" ({open_at})" if open_at else "")
        about = {"v": f"  {Path(p['note']).name}", "F": f"  {p['note']}"}.get(name[0], "") if "/" in name else ""
        value, span = format_with_interval(p["value"], p["interval"])
        rows.append((name, value, "" if p["unit"] == "1" else p["unit"], span, status + about))
    return [*columns(rows, right=1), ""] if rows else []


def _line_of(recording: dict) -> str:
    levels, reference = recording["levels"], " (the reference)" * bool(recording["first"])
    one = f" ({recording['channel']})" * (recording["channel"] not in ("mono", "average"))
    return (
        f"{Path(recording['file']).name}{one}{reference}: {recording['v_H0']:.3g} m/s, gain {recording['gain']:.3g}, "
        f"{recording['cents']:+.2f} cents, "
        f"levels {levels['initial_db']:.1f} -> {levels['fitted_db']:.2f} dB"
    )


def cross_validation(document: dict) -> str:
    """Each recording left out and predicted, beside what needs no model."""
    lines = [f"{'':32}{'v_H0, m/s':>10}{'predicted':>11}{'nearest':>9}{'blend':>7}   dB a partial"]
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
