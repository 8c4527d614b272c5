"""Assembly of a `Result` from an inference: sounds, tables and sentences in one document."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..analysis import cents_above
from ..inference.intervals import IntervalResult, parameter_indices
from ..inference.laplace import Posterior
from ..inference.parametrisation import LOG_ABSENT_LOSS
from ..inference.pipeline import InferenceResult
from ..model.note import Note
from ..parameters import FIT_NAMES
from ..threads import one_blas_thread
from .comparison import compare_recordings, pool_level_errors, worse_bands
from .draws import Draws
from .fitted_recording import FittedRecording
from .identifiability import (
    identifiability_statement,
    invariant_status,
    scaled_parameters,
    statuses,
    strong_correlations,
    unidentifiable_parameters,
    velocity_statuses,
    warnings,
)
from .minima_notes import notes_of
from .quantities import UNITS, Covariance
from .result import Result
from .serialise import (
    no_interval,
    parameter_row,
    recording_row,
    sizes,
    to_document,
    unit_and_meaning,
    velocity_discrepancy_document,
)

__all__ = ["build_result"]

# Logarithm of the largest number that can be written.
LARGEST_LOG = 700.0
# Parameters in the paper's order, then those of the contact. Parameters of other felt laws follow.
PARAMETER_ORDER = (*FIT_NAMES, "x0", "width")


@one_blas_thread()
def build_result(fit: InferenceResult) -> Result:
    """Build sounds, tables and sentences from an inference.

    Raises
    ------
    FitError
        If an initial or a final contact does not end.
    """
    problem, found = fit.problem, fit.estimate
    by_minimum = [notes_of(problem, found.minima, which) for which in range(len(found.minima.nll))]
    recordings = compare_recordings(fit, by_minimum[0])
    notes = tuple(
        tuple(note._replace(gain=recording.fitted.note.gain) for note, recording in zip(own, recordings, strict=True))
        for own in by_minimum
    )
    states, velocities = statuses(fit), _velocities(fit)
    levels = pool_level_errors([recording.levels for recording in recordings])
    document = to_document(
        problem.initial_values, recordings, problem.reference, _rows(fit, recordings, velocities), _covariance(fit),
        recipe="default",
        seed=fit.seed, converged=bool(found.minima.converged[0]), claims=identifiability_statement(fit, states, levels),
        messages=warnings(
            fit, states, worse_bands(recordings[problem.reference].criterion),
            [recording.levels["fitted_db"] for recording in recordings],
        ),
        invariants=_invariants(fit, states),
        parameters=_parameters(fit, states, velocities[problem.structure.stroke[problem.reference]]),
        minima=_minima(fit, notes), diagnostics=_diagnostics(fit),
    )  # fmt: skip
    draws = None if fit.alternative is None or fit.alternative.draws is None else _draws(fit, document, fit.alternative)
    return Result(document, recordings, problem.reference, notes, tuple(found.posterior.weight.tolist()), draws)


# --- tables -----------------------------------------------------------------------------------------------------------


def _interval(
    posterior: Posterior, direction: np.ndarray, value: float, box: tuple[float, float] = (-np.inf, np.inf)
) -> dict:
    """95 % interval of exp(direction · log θ) about the value shown, clipped to `box` (logarithms)."""
    interval = posterior.interval(direction)
    if interval is None:
        return no_interval()
    ends = np.clip(np.add(interval, np.log(value) - float(posterior.mean[0] @ direction)), *box)
    return {
        "interval": np.exp(np.minimum(ends, LARGEST_LOG)).tolist(),
        "interval_by": "laplace",
        "interval_open": [side for side, end, edge in zip(("low", "high"), ends, box, strict=True) if end == edge],
    }


def _velocities(fit: InferenceResult) -> list[dict]:
    """The velocity of every stroke, as an entry of `parameters`."""
    problem, u = fit.problem, fit.problem.parametrisation
    rows = []
    for at, measured, status in zip(
        range(u.shared, u.size), problem.measured_velocity, velocity_statuses(fit), strict=True
    ):
        value = float(np.exp(fit.estimate.theta[at])) if measured is None else float(measured)
        note = "its scale comes from the prior" if status == "scaled" else ""
        span = _interval(fit.posterior, np.eye(u.size)[at], value, u.range(at))
        initial = float(np.exp(fit.initial_theta[at]))
        rows.append(parameter_row(value, {"unit": UNITS["v_H0"]}, status, initial, note, span))
    rows[problem.reference_velocity_index - u.shared] |= fit.alternative_interval("v_H0")
    return rows


def _parameters(fit: InferenceResult, states: dict[str, str], velocity: dict) -> dict[str, dict]:
    """Every parameter with value, unit, interval and status; `velocity` is the entry of the reference stroke."""
    u, start = fit.problem.parametrisation, fit.problem.initial_values
    log, table = fit.posterior.mean[0], {"v_H0": velocity}
    for name in u.reported:
        i = u.index_of(name)
        if log[i] <= LOG_ABSENT_LOSS:
            unit = {"unit": UNITS[name]}
            table[name] = parameter_row(0.0, unit, "given", 0.0, f"not a parameter of the felt law {u.law.name}")
            continue
        scales = [f"the assumed {size}" for size in start.assumptions.get(name, ())]
        scales += ["the velocities"] * (name in scaled_parameters(fit))
        note = f"scales with {' and '.join(scales)}" if states[name] == "scaled" else ""
        if name == "width" and u.free[i]:
            note = "effective width: a raised cosine of this width acts like the unknown contact window"
        # A fixed value is shown exactly as it was given.
        value = u.value(name, log[i]) if u.free[i] else float(start.values[name])
        initial = float(start.initial[name])
        span = _interval(fit.posterior, np.eye(u.size)[i], value, u.range(i)) | fit.alternative_interval(name)
        table[name] = parameter_row(value, unit_and_meaning(name, u.law), states[name], initial, note, span)
    order = [
        *(name for name in PARAMETER_ORDER if name in table),
        *(name for name in table if name not in PARAMETER_ORDER),
    ]
    return {name: table[name] for name in order} | sizes(start)


def _invariants(fit: InferenceResult, states: dict[str, str]) -> dict:
    """Quantities that do not depend on an assumed length or mass: value, unit, 95 % interval and status by name.

    They do not depend on the velocity scale either, except the felt force at a compression, whose status is `scaled`.
    """
    u, g = fit.problem.parametrisation, fit.problem.initial_values.geometry
    direction, values = (
        np.eye(u.size)[u.index_of("kappa")] - np.eye(u.size)[u.index_of("c")],
        np.exp(fit.posterior.mean[0]),
    )
    B = (values[u.index_of("kappa")] * np.pi / (values[u.index_of("c")] * g.length)) ** 2
    table = {
        "f0": _ratio(fit, states, "c", 2 * g.length, "Hz"),
        "B": _combined(fit.gauge_fixed, 2 * direction, B, "1", [states["c"], states["kappa"]]),
        "M_H/M_S": _ratio(fit, states, "M_H", g.mass),
        "x0/L": _ratio(fit, states, "x0", g.length),
    }
    if u.force_and_exponent_index and u.free[u.force_and_exponent_index[0]]:  # a given K_H has no reference compression
        table["F/M_S"] = _static_force(fit, states, *u.force_and_exponent_index)
    return table | _velocity_ratios(fit)


def _combined(
    posterior: Posterior, direction: np.ndarray, value: float, unit: str, factors: list[str], note: str = ""
) -> dict:
    """Entry of a product of powers, with exponents `direction` [size]; `factors` are the statuses of its factors."""
    status = invariant_status(factors, posterior.sd(direction))
    interval = _interval(posterior, direction, value)
    return {"value": value, "unit": unit, **interval, "note": note, "status": status}


def _ratio(fit: InferenceResult, states: dict[str, str], name: str, divisor: float, unit: str = "1") -> dict:
    """Entry of one parameter over a fixed size, with the alternative interval if there is one."""
    at, alternative = fit.problem.parametrisation.index_of(name), fit.alternative_interval(name)
    value = float(np.exp(fit.posterior.mean[0, at])) / divisor
    row = _combined(fit.gauge_fixed, np.eye(fit.problem.parametrisation.size)[at], value, unit, [states[name]])
    scaled = {"interval": [end / divisor for end in alternative["interval"]]} if alternative else {}
    return row | alternative | scaled


def _static_force(fit: InferenceResult, states: dict[str, str], stiffness: int, p: int) -> dict:
    """Entry of the static felt force at the reference compression over the string mass."""
    problem, u, z = fit.problem, fit.problem.parametrisation, fit.estimate.theta
    direction = np.eye(u.size)[stiffness] + float(np.exp(z[p])) * u.log_reference_compression * np.eye(u.size)[p]
    note = f"static felt force at {1e3 * np.exp(u.log_reference_compression):.3g} mm"
    note += ", at the reference velocity shown" if problem.velocity_scale_free else ""
    unidentifiable = u.names[stiffness] in unidentifiable_parameters(fit)
    factors = ["at-bound"] * ("at-bound" in [states[u.names[i]] for i in (stiffness, p)])
    factors += ["not-identifiable"] * unidentifiable
    value = float(np.exp(z[stiffness])) / problem.initial_values.geometry.mass
    row = _combined(fit.gauge_fixed, direction, value, "N/kg", factors, note)
    return row | ({"status": "scaled"} if problem.velocity_scale_free and row["status"] == "fitted" else {})


def _velocity_ratios(fit: InferenceResult) -> dict:
    """Entries of the velocities of the strokes over that of the reference stroke."""
    problem, z, unit, states = (
        fit.problem,
        fit.estimate.theta,
        np.eye(fit.problem.parametrisation.size),
        velocity_statuses(fit),
    )
    shared, reference = problem.parametrisation.shared, problem.reference_velocity_index
    table = {}
    for stroke, state in enumerate(states):
        at, name = shared + stroke, problem.recordings[problem.structure.stroke.index(stroke)].path
        if at != reference:
            table[f"v/v_ref {stroke + 1}"] = _combined(
                fit.posterior, unit[at] - unit[reference], float(np.exp(z[at] - z[reference])), "1",
                [state, states[reference - shared]],
                Path(name).name,
            )  # fmt: skip
    return table


# --- recordings and minima --------------------------------------------------------------------------------------------


def _rows(fit: InferenceResult, recordings: Sequence[FittedRecording], velocities: Sequence[dict]) -> list[dict]:
    """One row of `recordings` for each recording."""
    problem, layout = fit.problem, fit.problem.structure
    f0 = problem.analyses[problem.reference].f0
    return [
        recording_row(
            recording, velocities[stroke], problem.calibrated, first=i == problem.reference,
            cents=cents_above(recording.analysis.f0, f0), group=group, stroke=stroke,
        )
        for i, (recording, stroke, group) in enumerate(zip(recordings, layout.stroke, layout.group, strict=True))
    ]  # fmt: skip


def _minima(fit: InferenceResult, notes: Sequence[Sequence[Note]]) -> list[dict]:
    """Every minimum: posterior weight, F, parameters, velocities, and output path of the reference recording."""
    u, minima, rows = fit.problem.parametrisation, fit.estimate.minima, []
    for b, weight in enumerate(fit.posterior.weight):
        log = dict(zip(u.names, fit.posterior.mean[b], strict=False))
        path = notes[b][fit.problem.reference].path
        rows.append({
            "share": float(weight), "F": float(minima.nll[b]),
            "parameters": {n: u.value(n, log[n]) for n in u.reported if log[n] > LOG_ABSENT_LOSS},
            "velocities": np.exp(minima.candidates.theta[b, u.shared :]).tolist(),
            "path_db": None if path is None else path.db.tolist(),
            "path_wander": None if path is None else velocity_discrepancy_document(path.velocity_discrepancy),
        })  # fmt: skip
    return rows


def _diagnostics(fit: InferenceResult) -> dict:
    problem, minima = fit.problem, fit.estimate.minima
    (sigma, smooth, octaves, floor), (cents, *_), (decay, *_) = (np.exp(x[0]).tolist() for x in minima.candidates.phi)
    return {
        "F": float(minima.nll[0]),
        "evaluations": fit.estimate.n_strokes_computed,
        "partials": int(np.asarray(problem.observed.level.detected).sum()),
        "absent": len(problem.observed.level.censored),
        "contact_rate_Hz": float(problem.model_inputs.rate),
        "modes": problem.cfg.n_modes,
        "steps": int(problem.model_inputs.steps),
        "excess": {"frequency_cents": cents, "decay_relative": decay, "level_db": sigma},
        "path": {"smooth_db": smooth, "octaves": octaves} if problem.path else None,
        "floor": floor,
        "correlated": [{"pair": [a, b], "correlation": r} for a, b, r in strong_correlations(fit)],
    } | ({} if fit.alternative is None else fit.alternative.diagnostics)


def _covariance(fit: InferenceResult) -> Covariance:
    """Covariance of the logarithms of the parameters and velocities, by name."""
    names = parameter_indices(fit.problem)
    return Covariance(tuple(names), fit.posterior.covariance[0][np.ix_([*names.values()], [*names.values()])])


def _draws(fit: InferenceResult, document: dict, view: IntervalResult) -> Draws:
    """The posterior draws, with those of the invariants that vary."""
    draws, u = view.draws or {}, fit.problem.parametrisation
    shown = {name: entry["value"] for name, entry in document["parameters"].items()}

    def drawn(name: str) -> np.ndarray:
        return np.asarray(draws.get(name, shown[name]))

    g, strokes = fit.problem.initial_values.geometry, {f"v/v_ref {n}": f"v_H0 {n}" for n in range(1, u.strokes + 1)}
    table = {
        "f0": drawn("c") / (2 * g.length), "B": (drawn("kappa") * np.pi / (drawn("c") * g.length)) ** 2,
        "M_H/M_S": drawn("M_H") / g.mass, "x0/L": drawn("x0") / g.length,
    } | {name: draws[own] / drawn("v_H0") for name, own in strokes.items() if own in draws}  # fmt: skip
    if "F/M_S" in document["invariants"]:
        stiffness, p = (drawn(u.names[i]) for i in u.force_and_exponent_index or ())
        # At the reference velocity shown. If a common scale s of the velocities is unknown: K_H s^(1-p), s v.
        scale = shown["v_H0"] / drawn("v_H0") if fit.problem.velocity_scale_free else 1.0
        table["F/M_S"] = stiffness * scale ** (1 - p) * np.exp(p * u.log_reference_compression) / g.mass
    varying = {name: table[name] for name in document["invariants"] if name in table and np.ptp(table[name]) > 0}
    return Draws({**draws, **varying}, tuple(varying), view.log_likelihood, view.observed)
