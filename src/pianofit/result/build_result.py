"""From what was inferred to a result: sounds, tables and sentences in one document."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..inference.intervals import IntervalResult, named
from ..inference.laplace import Posterior
from ..inference.parametrisation import ABSENT
from ..inference.pipeline import InferenceResult
from ..model.note import Note
from ..parameters import FIT_NAMES
from ..threads import one_blas_thread
from .comparison import compare_recordings, pool_level_errors, worse_bands
from .draws import Draws
from .identifiability import (
    correlated,
    identifiability_statement,
    invariant_status,
    retracted,
    scaling,
    statuses,
    velocity_statuses,
    warnings,
)
from .minima_notes import notes_of
from .quantities import UNITS, Covariance
from .result import FittedRecording, Result
from .serialise import entry, no_interval, recording_entry, sizes, to_document, unit_and_meaning, wander_document

__all__ = ["build_result"]

# The logarithm of a number that can still be written.
LARGEST = 700.0
# In the paper's order, then what lies between hammer and string; last what only some felts have.
FIRST = (*FIT_NAMES, "x0", "width")


@one_blas_thread()
def build_result(fit: InferenceResult) -> Result:
    """Put what was inferred into sounds, numbers and words.

    Raises
    ------
    FitError
        If an initial or a final contact does not end.
    """
    problem, found = fit.problem, fit.found
    played = [notes_of(problem, found.minima, which) for which in range(len(found.minima.F))]
    heard = compare_recordings(fit, played[0])
    notes = tuple(
        tuple(note._replace(gain=each.fitted.note.gain) for note, each in zip(one, heard, strict=True))
        for one in played
    )
    states, struck, levels = statuses(fit), _velocities(fit), pool_level_errors([each.levels for each in heard])
    document = to_document(
        problem.start, heard, problem.reference, _rows(fit, heard, struck), _covariance(fit), recipe="default",
        seed=fit.seed, converged=bool(found.minima.converged[0]), claims=identifiability_statement(fit, states, levels),
        messages=warnings(
            fit, states, worse_bands(heard[problem.reference].criterion), [each.levels["fitted_db"] for each in heard]
        ),
        invariants=_invariants(fit, states),
        parameters=_parameters(fit, states, struck[problem.layout.stroke[problem.reference]]),
        minima=_minima(fit, notes), diagnostics=_diagnostics(fit),
    )  # fmt: skip
    draws = None if fit.view is None or fit.view.draws is None else _draws(fit, document, fit.view)
    return Result(document, heard, problem.reference, notes, tuple(found.posterior.share.tolist()), draws)


# --- tables -----------------------------------------------------------------------------------------------------------


def _interval(
    posterior: Posterior, change: np.ndarray, value: float, box: tuple[float, float] = (-np.inf, np.inf)
) -> dict:
    """Of a sum of logarithms, about the value that is shown; it ends at the `box` of logarithms, and says where."""
    found = posterior.interval(change)
    if found is None:
        return no_interval()
    ends = np.clip(np.add(found, np.log(value) - float(posterior.mean[0] @ change)), *box)
    return {
        "interval": np.exp(np.minimum(ends, LARGEST)).tolist(),
        "interval_by": "laplace",
        "interval_open": [side for side, end, edge in zip(("low", "high"), ends, box, strict=True) if end == edge],
    }


def _velocities(fit: InferenceResult) -> list[dict]:
    """Every stroke's velocity, as an entry of `parameters`."""
    problem, u = fit.problem, fit.problem.unknowns
    rows = []
    for at, measured, status in zip(
        range(u.shared, u.size), problem.measured_velocity, velocity_statuses(fit), strict=True
    ):
        value = float(np.exp(fit.found.z[at])) if measured is None else float(measured)
        note = "its scale is the prior's" if status == "scaled" else ""
        span = _interval(fit.posterior, np.eye(u.size)[at], value, u.range(at))
        begun = float(np.exp(fit.begun[at]))
        rows.append(entry(value, {"unit": UNITS["v_H0"]}, status, begun, note, span))
    rows[problem.velocity - u.shared] |= fit.alternative_interval("v_H0")
    return rows


def _parameters(fit: InferenceResult, states: dict[str, str], velocity: dict) -> dict[str, dict]:
    """Every parameter with value, unit, interval and status; `velocity` is the reference stroke's."""
    u, start = fit.problem.unknowns, fit.problem.start
    log, table = fit.posterior.mean[0], {"v_H0": velocity}
    for name in u.reported:
        i = u.index_of(name)
        if log[i] <= ABSENT:
            said = {"unit": UNITS[name]}
            table[name] = entry(0.0, said, "given", 0.0, f"the felt's law, {u.law.name}, has none")
            continue
        rests = [f"the assumed {x}" for x in start.assumptions.get(name, ())]
        rests += ["the velocities"] * (name in scaling(fit))
        note = f"scales with {' and '.join(rests)}" if states[name] == "scaled" else ""
        if name == "width" and u.free[i]:
            note = "effective: of the raised cosine that acts as the felt's own window does"
        # What is held is shown as it was given, to the last digit.
        value = u.value(name, log[i]) if u.free[i] else float(start.values[name])
        begun = float(start.initial[name])
        span = _interval(fit.posterior, np.eye(u.size)[i], value, u.range(i)) | fit.alternative_interval(name)
        table[name] = entry(value, unit_and_meaning(name, u.law), states[name], begun, note, span)
    order = [*(name for name in FIRST if name in table), *(name for name in table if name not in FIRST)]
    return {name: table[name] for name in order} | sizes(start)


def _invariants(fit: InferenceResult, states: dict[str, str]) -> dict:
    """What no assumed length or mass enters: value, unit, 95 % interval and status by name.

    Nor does the scale of the velocities, but for the felt's force at a compression, whose status then is `scaled`.
    """
    u, g = fit.problem.unknowns, fit.problem.start.geometry
    change, values = (
        np.eye(u.size)[u.index_of("kappa")] - np.eye(u.size)[u.index_of("c")],
        np.exp(fit.posterior.mean[0]),
    )
    B = (values[u.index_of("kappa")] * np.pi / (values[u.index_of("c")] * g.length)) ** 2
    table = {
        "f0": _alone(fit, states, "c", 2 * g.length, "Hz"),
        "B": _combined(fit.gauge_fixed, 2 * change, B, "1", [states["c"], states["kappa"]]),
        "M_H/M_S": _alone(fit, states, "M_H", g.mass),
        "x0/L": _alone(fit, states, "x0", g.length),
    }
    if (
        u.force_and_exponent_index and u.free[u.force_and_exponent_index[0]]
    ):  # a given K_H has no compression of reference
        table["F/M_S"] = _force(fit, states, *u.force_and_exponent_index)
    return table | _ratios(fit)


def _combined(by: Posterior, change: np.ndarray, value: float, unit: str, own: list[str], note: str = "") -> dict:
    """Of a product of powers of values with statuses `own`, whose logarithms sum by `change` [size]."""
    status = invariant_status(own, by.spread(change))
    return {"value": value, "unit": unit, **_interval(by, change, value), "note": note, "status": status}


def _alone(fit: InferenceResult, states: dict[str, str], name: str, over: float, unit: str = "1") -> dict:
    """Of one parameter over something known; another view of F sees it too."""
    at, seen = fit.problem.unknowns.index_of(name), fit.alternative_interval(name)
    row = _combined(
        fit.gauge_fixed, np.eye(fit.problem.unknowns.size)[at], float(np.exp(fit.posterior.mean[0, at])) / over, unit,
        [states[name]],
    )  # fmt: skip
    return row | seen | ({"interval": [end / over for end in seen["interval"]]} if seen else {})


def _force(fit: InferenceResult, states: dict[str, str], stiffness: int, p: int) -> dict:
    """Of the felt at the reference compression, over the mass of the string."""
    problem, u, z = fit.problem, fit.problem.unknowns, fit.found.z
    change = np.eye(u.size)[stiffness] + float(np.exp(z[p])) * u.log_reference_compression * np.eye(u.size)[p]
    note = f"static force of the felt at {1e3 * np.exp(u.log_reference_compression):.3g} mm"
    note += ", at the reference velocity shown" if problem.velocity_scale_free else ""
    own = [states[u.names[i]] for i in (stiffness, p)]
    lost = ["at-bound"] * ("at-bound" in own) + ["not-identifiable"] * (u.names[stiffness] in retracted(fit))
    value = float(np.exp(z[stiffness])) / problem.start.geometry.mass
    row = _combined(fit.gauge_fixed, change, value, "N/kg", lost, note)
    return row | ({"status": "scaled"} if problem.velocity_scale_free and row["status"] == "fitted" else {})


def _ratios(fit: InferenceResult) -> dict:
    """Of the strokes' velocities over the reference's."""
    problem, z, unit, states = fit.problem, fit.found.z, np.eye(fit.problem.unknowns.size), velocity_statuses(fit)
    shared, own = problem.unknowns.shared, problem.velocity
    table = {}
    for stroke, state in enumerate(states):
        at, name = shared + stroke, problem.recordings[problem.layout.stroke.index(stroke)].path
        if at != own:
            table[f"v/v_ref {stroke + 1}"] = _combined(
                fit.posterior, unit[at] - unit[own], float(np.exp(z[at] - z[own])), "1", [state, states[own - shared]],
                Path(name).name,
            )  # fmt: skip
    return table


# --- recordings and minima --------------------------------------------------------------------------------------------


def _rows(fit: InferenceResult, heard: Sequence[FittedRecording], struck: Sequence[dict]) -> list[dict]:
    """What each recording has of its own."""
    problem, layout = fit.problem, fit.problem.layout
    f0 = problem.analyses[problem.reference].f0
    return [
        recording_entry(
            each, struck[stroke], problem.calibrated, first=i == problem.reference,
            cents=float(1200 * np.log2(each.analysis.f0 / f0)), group=group, stroke=stroke,
        )
        for i, (each, stroke, group) in enumerate(zip(heard, layout.stroke, layout.group, strict=True))
    ]  # fmt: skip


def _minima(fit: InferenceResult, notes: Sequence[Sequence[Note]]) -> list[dict]:
    """Every minimum: its share, F, hammer, velocities, and the reference's path."""
    u, minima, rows = fit.problem.unknowns, fit.found.minima, []
    for b, share in enumerate(fit.posterior.share):
        log = dict(zip(u.names, fit.posterior.mean[b], strict=False))
        path = notes[b][fit.problem.reference].path
        rows.append({
            "share": float(share), "F": float(minima.F[b]),
            "parameters": {n: u.value(n, log[n]) for n in u.reported if log[n] > ABSENT},
            "velocities": np.exp(minima.people.theta[b, u.shared :]).tolist(),
            "path_db": None if path is None else path.db.tolist(),
            "path_wander": None if path is None else wander_document(path.wander),
        })  # fmt: skip
    return rows


def _diagnostics(fit: InferenceResult) -> dict:
    problem, minima = fit.problem, fit.found.minima
    (sigma, smooth, octaves, floor), (cents, *_), (decay, *_) = (np.exp(x[0]).tolist() for x in minima.people.phi)
    return {
        "F": float(minima.F[0]), "evaluations": fit.found.lanes,
        "partials": int(np.asarray(problem.observed.level.detected).sum()),
        "absent": len(problem.observed.level.censored),
        "contact_rate_Hz": float(problem.scene.rate), "modes": problem.cfg.n_modes, "steps": int(problem.scene.steps),
        "excess": {"frequency_cents": cents, "decay_relative": decay, "level_db": sigma},
        "path": {"smooth_db": smooth, "octaves": octaves} if problem.path else None,
        "floor": floor,
        "correlated": [{"pair": [a, b], "correlation": r} for a, b, r in correlated(fit)],
    } | ({} if fit.view is None else fit.view.diagnostics)  # fmt: skip


def _covariance(fit: InferenceResult) -> Covariance:
    """Of the logarithms of what this felt's law has, by name, and of the velocities."""
    names = named(fit.problem)
    return Covariance(tuple(names), fit.posterior.covariance[0][np.ix_([*names.values()], [*names.values()])])


def _draws(fit: InferenceResult, document: dict, view: IntervalResult) -> Draws:
    """The draws of a view, with those of the invariants that vary."""
    found, u = view.draws or {}, fit.problem.unknowns
    held = {name: entry["value"] for name, entry in document["parameters"].items()}

    def drawn(name: str) -> np.ndarray:
        return np.asarray(found.get(name, held[name]))

    g, strokes = fit.problem.start.geometry, {f"v/v_ref {n}": f"v_H0 {n}" for n in range(1, u.strokes + 1)}
    table = {
        "f0": drawn("c") / (2 * g.length), "B": (drawn("kappa") * np.pi / (drawn("c") * g.length)) ** 2,
        "M_H/M_S": drawn("M_H") / g.mass, "x0/L": drawn("x0") / g.length,
    } | {name: found[own] / drawn("v_H0") for name, own in strokes.items() if own in found}  # fmt: skip
    if "F/M_S" in document["invariants"]:
        stiffness, p = (drawn(u.names[i]) for i in u.force_and_exponent_index or ())
        # At the reference's velocity as it is shown, where all velocities have one open scale s: K_H s^(1-p), s v.
        scale = held["v_H0"] / drawn("v_H0") if fit.problem.velocity_scale_free else 1.0
        table["F/M_S"] = stiffness * scale ** (1 - p) * np.exp(p * u.log_reference_compression) / g.mass
    varying = {name: table[name] for name in document["invariants"] if name in table and np.ptp(table[name]) > 0}
    return Draws({**found, **varying}, tuple(varying), view.log_likelihood, view.observed)
