"""What a coverage study counts: misses in standard errors, by parameter and by cell, as tables."""

from __future__ import annotations

import math

import numpy as np

from pianofit.schema.fit import Fit

__all__ = ["DEEPER", "STATUS", "entry", "nearest", "progress", "report", "row", "score"]

REACH = 1.96  # standard errors to either side of a 95 % interval
DEEPER = 1.0  # of F, a log density: more than this is a minimum that the search missed
FOUR = 4.0
STATUS = "fitted"  # what counts
OTHERS = "others' v_H0"
HEADING = (
    f"{'':14}{'held':>9}{'':9}{'largest miss':>14}{'rms miss':>10}{'rms error':>12}{'median':>10}{'vague':>7}"
    f"{'at bound':>10}"
)


def score(fit: Fit, true: dict, velocities: list[float]) -> list[dict]:
    """A row by parameter and recording: status, relative error in percent, and the miss in standard errors."""
    table = fit.parameters
    rows = [
        row(name, table[name].value, table[name].interval, table[name].status, true[name])
        for name in true
        if name in table
    ]
    for own, v in zip(fit.recordings, velocities, strict=False):
        if not own.is_reference:
            rows.append(row(OTHERS, own.stroke_value, own.stroke_interval, own.stroke_status, v))
    return rows


def nearest(true: float | tuple[float, float], value: float) -> float:
    """The truth, or of a range of truths the one next to `value`."""
    return min(max(value, true[0]), true[1]) if isinstance(true, tuple) else true


def row(name: str, value: float, interval, status: str, true: float | tuple[float, float]) -> dict:
    """One row of `score`."""
    true = nearest(true, value)
    error = math.log(value / true)
    found = {"name": name, "status": status, "percent": 100 * math.expm1(error), "miss": None, "held": None}
    if interval:
        low, high = interval
        # Intervals are symmetric in log(value).
        found |= {"miss": error * 2 * REACH / math.log(high / low), "held": bool(low <= true <= high)}
        found["width_percent"] = 100 * (math.sqrt(high / low) - 1)
    return found


def report(runs: list[dict]) -> tuple[list[str], dict]:
    """Tables of the cases that were fitted, and the errors of the others."""
    found = [run for run in runs if "rows" in run]
    lines, data = table(found)
    document = {"table": data}
    missed = [run for run in found if (run["deeper"] or 0.0) > DEEPER]
    if missed:
        lines.append(f"\nwithout {len(missed)} cases whose F is lower at the true values:")
        more, document["right_minimum"] = table([run for run in found if run not in missed])
        lines += more
    open_ended = sum(not run["converged"] for run in found)
    lines += ["", f"fitted {len(found)} of {len(runs)}; not converged: {open_ended}; minimum missed: {len(missed)}"]
    lines += [f"refused, seed {run['seed']}: {run['refused']}" for run in runs if "refused" in run]
    return lines, document | {"runs": runs}


def table(runs: list[dict]) -> tuple[list[str], dict]:
    """Lines to print, and the same as data: every parameter, and all together by cell."""
    rows = [one for run in runs for one in run["rows"]]
    lines, data = [HEADING], {}
    for name in dict.fromkeys(one["name"] for one in rows):
        data[name] = entry(one for one in rows if one["name"] == name)
        lines.append(line(name, data[name]))
    data["all"] = entry(rows)
    lines.append(line("all", data["all"]))
    cells = dict.fromkeys((run["recordings"], run["calibrated"]) for run in runs)
    if len(cells) > 1:
        for count, calibrated in sorted(cells):
            name = f"{count} rec{'s' * (count > 1)}, {'cal' if calibrated else 'path'}"
            mine = [run for run in runs if (run["recordings"], run["calibrated"]) == (count, calibrated)]
            data[name] = entry(one for run in mine for one in run["rows"])
            lines.append(line(name, data[name]))
    for name in ("glide", "beats"):
        mine = [run for run in runs if run.get(name)]
        if mine:
            data[name] = entry(one for run in mine for one in run["rows"])
            lines.append(line(name, data[name]))
    plain = [run for run in runs if not (run.get("glide") or run.get("beats"))]
    if 0 < len(plain) < len(runs):
        data["neither"] = entry(one for run in plain for one in run["rows"])
        lines.append(line("neither", data["neither"]))
    return lines, data


def entry(rows) -> dict:
    """Counts and sizes of some rows."""
    rows = list(rows)
    free = [one for one in rows if one["status"] == STATUS and one["held"] is not None]
    misses = [abs(one["miss"]) for one in free]
    status = [one["status"] for one in rows]
    return {
        "fitted": len(free),
        "held": sum(one["held"] for one in free),
        "coverage": sum(one["held"] for one in free) / len(free) if free else math.nan,
        "largest_miss": max(misses, default=math.nan),
        "beyond_four": sum(miss > FOUR for miss in misses),
        "rms_miss": float(np.sqrt(np.mean(np.square(misses)))) if free else math.nan,
        "rms_percent": float(np.sqrt(np.mean([one["percent"] ** 2 for one in free]))) if free else math.nan,
        "median_percent": float(np.median([abs(one["percent"]) for one in free])) if free else math.nan,
        "not_identifiable": status.count("not-identifiable"),
        "at_bound": status.count("at-bound"),
    }


def line(name: str, e: dict) -> str:
    """One entry as a line."""
    return (
        f"{name:14}{e['held']:4}/{e['fitted']:<4}{100 * e['coverage']:7.1f} %{e['largest_miss']:12.2f} σ"
        f"{e['rms_miss']:8.2f} σ{e['rms_percent']:10.2g} %{e['median_percent']:8.2g} %"
        f"{e['not_identifiable']:7}{e['at_bound']:10}"
    )


def progress(run: dict) -> str:
    """The line that is printed when a case is fitted."""
    head = f"  {run['kind']} {run['seed']:3}: {run['seconds']:5.1f} s, "
    if "rows" not in run:
        return head + "refused: " + run["refused"]
    scored = [one for one in run["rows"] if one["status"] == STATUS and one["held"] is not None]
    if not scored:
        return head + "nothing fitted"
    worst = max(scored, key=lambda one: abs(one["miss"]))
    basin = ", minimum missed" if (run["deeper"] or 0.0) > DEEPER else ""
    cell = f"{run['recordings']} recorded, {'calibrated' if run['calibrated'] else 'path'}"
    return f"{head}{cell}, largest miss {worst['miss']:+.2f} σ ({worst['name']}){basin}"
