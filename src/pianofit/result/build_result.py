"""Assembly of a `Result` from an inference: sounds, quantities and sentences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..analysis import cents_above
from ..inference.intervals import IntervalResult, parameter_indices
from ..inference.laplace import Posterior
from ..inference.parametrisation import LOG_ABSENT_LOSS
from ..inference.pipeline import InferenceResult
from ..model.note import Note
from ..parameters import FIT_NAMES
from ..schema.decode import convert
from ..schema.fit import (
    Correlation,
    Diagnostics,
    ExcessSd,
    Fit,
    Minimum,
    PathPrior,
    PosteriorDiagnostics,
    ProfileCurve,
    RecordingFit,
    VelocityDiscrepancyEntry,
    package_versions,
)
from ..schema.quantities import UNITS, Covariance, Quantities, Quantity, Status, meaning_of, unit_of
from ..threads import one_blas_thread
from .comparison import compare_recordings, pool_level_errors, worse_bands
from .draws import Draws
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
from .records import derived_of, pickup_of, record_of, sizes
from .result import FittedRecording, Result

__all__ = ["build_result"]

# Logarithm of the largest number that can be written.
LARGEST_LOG = 700.0
# Parameters in the paper's order, then those of the contact. Parameters of other felt laws follow.
PARAMETER_ORDER = (*FIT_NAMES, "x0", "width")


@one_blas_thread()
def build_result(fit: InferenceResult) -> Result:
    """Build sounds, quantities and sentences from an inference.

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
    reference = recordings[problem.reference]
    records = _records(fit, recordings, velocities)
    record = Fit(
        recipe="default",
        felt=problem.initial_values.law.name,
        seed=fit.seed,
        converged=bool(found.minima.converged[0]),
        identifiability_statement=identifiability_statement(fit, states, levels),
        warnings=tuple(
            warnings(
                fit,
                states,
                worse_bands(reference.criterion),
                [recording.levels.fitted_db for recording in recordings],
            )
        ),
        invariants=_invariants(fit, states),
        parameters=_parameters(fit, states, velocities[problem.structure.stroke[problem.reference]]),
        recordings=records,
        pickup=pickup_of(problem.initial_values.quantity, recordings, records),
        minima=_minima(fit, notes),
        covariance=_covariance(fit),
        derived=derived_of(reference),
        criterion=reference.criterion,
        levels=levels,
        diagnostics=_diagnostics(fit),
        versions=package_versions(),
    )
    draws = None if fit.alternative is None or fit.alternative.draws is None else _draws(fit, record, fit.alternative)
    return Result(record, recordings, notes, draws)


# --- quantities -------------------------------------------------------------------------------------------------------


class Interval(NamedTuple):
    """A 95 % interval."""

    low: float
    high: float
    method: str
    unbounded: tuple[str, ...] = ()


def _laplace_interval(
    posterior: Posterior, direction: np.ndarray, value: float, box: tuple[float, float] = (-np.inf, np.inf)
) -> Interval | None:
    """Interval of exp(direction · log θ) about the value shown, clipped to `box` (logarithms); None if it is fixed."""
    interval = posterior.interval(direction)
    if interval is None:
        return None
    ends = np.clip(np.add(interval, np.log(value) - float(posterior.mean[0] @ direction)), *box)
    low, high = np.exp(np.minimum(ends, LARGEST_LOG)).tolist()
    unbounded = [side for side, end, edge in zip(("low", "high"), ends, box, strict=True) if end == edge]
    return Interval(low, high, "laplace", tuple(unbounded))


def _other_interval(fit: InferenceResult, name: str) -> Interval | None:
    """Interval of a parameter by the method that was asked for, if it is not Laplace's approximation."""
    entry = fit.alternative_interval(name)
    return Interval(*entry["interval"], entry["interval_by"], tuple(entry["interval_open"])) if entry else None


def _with_interval(quantity: Quantity, interval: Interval | None) -> Quantity:
    """The quantity with an interval; unchanged without one."""
    if interval is None:
        return quantity
    low, high, method, unbounded = interval
    return replace(quantity, interval=(low, high), interval_method=method, interval_unbounded=unbounded)


def _velocities(fit: InferenceResult) -> list[Quantity]:
    """The velocity of every stroke."""
    problem, u = fit.problem, fit.problem.parametrisation
    table = []
    for at, measured, status in zip(
        range(u.shared, u.size), problem.measured_velocity, velocity_statuses(fit), strict=True
    ):
        value = float(np.exp(fit.estimate.theta[at])) if measured is None else float(measured)
        note = "its scale comes from the prior" if status == "scaled" else ""
        quantity = Quantity(
            "v_H0", value, UNITS["v_H0"], None, status, meaning_of("v_H0"), note, float(np.exp(fit.initial_theta[at]))
        )
        table.append(_with_interval(quantity, _laplace_interval(fit.posterior, np.eye(u.size)[at], value, u.range(at))))
    reference = problem.reference_velocity_index - u.shared
    table[reference] = _with_interval(table[reference], _other_interval(fit, "v_H0"))
    return table


def _parameters(fit: InferenceResult, states: Mapping[str, Status], velocity: Quantity) -> Quantities:
    """Every parameter; `velocity` is that of the reference stroke."""
    u, start = fit.problem.parametrisation, fit.problem.initial_values
    log, table = fit.posterior.mean[0], {"v_H0": velocity}
    for name in u.reported:
        i = u.index_of(name)
        unit, meaning = unit_of(name, u.law), meaning_of(name, u.law)
        if log[i] <= LOG_ABSENT_LOSS:
            note = f"not a parameter of the felt law {u.law.name}"
            table[name] = Quantity(name, 0.0, unit, None, "given", meaning, note, 0.0)
            continue
        scales = [f"the assumed {size}" for size in start.assumptions.get(name, ())]
        scales += ["the velocities"] * (name in scaled_parameters(fit))
        note = f"scales with {' and '.join(scales)}" if states[name] == "scaled" else ""
        if name == "width" and u.free[i]:
            note = "effective width: a raised cosine of this width acts like the unknown contact window"
        # A fixed value is shown exactly as it was given.
        value = u.value(name, log[i]) if u.free[i] else float(start.values[name])
        interval = _other_interval(fit, name) or _laplace_interval(fit.posterior, np.eye(u.size)[i], value, u.range(i))
        quantity = Quantity(name, value, unit, None, states[name], meaning, note, float(start.initial[name]))
        table[name] = _with_interval(quantity, interval)
    order = [
        *(name for name in PARAMETER_ORDER if name in table),
        *(name for name in table if name not in PARAMETER_ORDER),
    ]
    return Quantities.of([*(table[name] for name in order), *sizes(start)])


def _invariants(fit: InferenceResult, states: Mapping[str, Status]) -> Quantities:
    """Quantities that do not depend on an assumed length or mass.

    They do not depend on the velocity scale either, except the felt force at a compression, whose status is `scaled`.
    """
    u, g = fit.problem.parametrisation, fit.problem.initial_values.geometry
    direction, values = (
        np.eye(u.size)[u.index_of("kappa")] - np.eye(u.size)[u.index_of("c")],
        np.exp(fit.posterior.mean[0]),
    )
    B = (values[u.index_of("kappa")] * np.pi / (values[u.index_of("c")] * g.length)) ** 2
    table = [
        _ratio(fit, states, "f0", "c", 2 * g.length, "Hz"),
        _combined("B", fit.gauge_fixed, 2 * direction, float(B), "1", [states["c"], states["kappa"]]),
        _ratio(fit, states, "M_H/M_S", "M_H", g.mass),
        _ratio(fit, states, "x0/L", "x0", g.length),
    ]
    if u.force_and_exponent_index and u.free[u.force_and_exponent_index[0]]:  # a given K_H has no reference compression
        table.append(_static_force(fit, states, *u.force_and_exponent_index))
    return Quantities.of([*table, *_velocity_ratios(fit)])


def _combined(
    name: str,
    posterior: Posterior,
    direction: np.ndarray,
    value: float,
    unit: str,
    factors: Sequence[Status],
    note: str = "",
) -> Quantity:
    """A product of powers, with exponents `direction` [size]; `factors` are the statuses of its factors."""
    status = invariant_status(factors, posterior.sd(direction))
    quantity = Quantity(name, value, unit, None, status, meaning_of(name), note)
    return _with_interval(quantity, _laplace_interval(posterior, direction, value))


def _ratio(
    fit: InferenceResult, states: Mapping[str, Status], name: str, of: str, divisor: float, unit: str = "1"
) -> Quantity:
    """The parameter `of` over a fixed size, with the interval by the other method if there is one."""
    at, other = fit.problem.parametrisation.index_of(of), _other_interval(fit, of)
    value = float(np.exp(fit.posterior.mean[0, at])) / divisor
    direction = np.eye(fit.problem.parametrisation.size)[at]
    quantity = _combined(name, fit.gauge_fixed, direction, value, unit, [states[of]])
    scaled = None if other is None else other._replace(low=other.low / divisor, high=other.high / divisor)
    return _with_interval(quantity, scaled)


def _static_force(fit: InferenceResult, states: Mapping[str, Status], stiffness: int, p: int) -> Quantity:
    """The static felt force at the reference compression over the string mass."""
    problem, u, z = fit.problem, fit.problem.parametrisation, fit.estimate.theta
    direction = np.eye(u.size)[stiffness] + float(np.exp(z[p])) * u.log_reference_compression * np.eye(u.size)[p]
    note = f"static felt force at {1e3 * np.exp(u.log_reference_compression):.3g} mm"
    note += ", at the reference velocity shown" if problem.velocity_scale_free else ""
    unidentifiable = u.names[stiffness] in unidentifiable_parameters(fit)
    factors: list[Status] = ["at-bound"] * ("at-bound" in [states[u.names[i]] for i in (stiffness, p)])
    factors += ["not-identifiable"] * unidentifiable
    value = float(np.exp(z[stiffness])) / problem.initial_values.geometry.mass
    quantity = _combined("F/M_S", fit.gauge_fixed, direction, value, "N/kg", factors, note)
    is_scaled = problem.velocity_scale_free and quantity.status == "fitted"
    return replace(quantity, status="scaled") if is_scaled else quantity


def _velocity_ratios(fit: InferenceResult) -> list[Quantity]:
    """The velocities of the strokes over that of the reference stroke."""
    problem, z, states = fit.problem, fit.estimate.theta, velocity_statuses(fit)
    unit = np.eye(problem.parametrisation.size)
    shared, reference = problem.parametrisation.shared, problem.reference_velocity_index
    table = []
    for stroke, state in enumerate(states):
        at, file = shared + stroke, problem.recordings[problem.structure.stroke.index(stroke)].path
        if at != reference:
            value = float(np.exp(z[at] - z[reference]))
            factors = [state, states[reference - shared]]
            table.append(
                _combined(
                    f"v/v_ref {stroke + 1}",
                    fit.posterior,
                    unit[at] - unit[reference],
                    value,
                    "1",
                    factors,
                    Path(file).name,
                )
            )
    return table


# --- recordings and minima --------------------------------------------------------------------------------------------


def _records(
    fit: InferenceResult, recordings: Sequence[FittedRecording], velocities: Sequence[Quantity]
) -> tuple[RecordingFit, ...]:
    problem, layout = fit.problem, fit.problem.structure
    f0 = problem.analyses[problem.reference].f0
    return tuple(
        record_of(
            recording,
            velocities[stroke],
            problem.calibrated,
            is_reference=i == problem.reference,
            pitch_offset_cents=cents_above(recording.analysis.f0, f0),
            path_group=group,
            stroke=stroke,
        )
        for i, (recording, stroke, group) in enumerate(zip(recordings, layout.stroke, layout.group, strict=True))
    )


def _minima(fit: InferenceResult, notes: Sequence[Sequence[Note]]) -> tuple[Minimum, ...]:
    """Every minimum; output paths are those of the reference recording."""
    u, minima, records = fit.problem.parametrisation, fit.estimate.minima, []
    for b, weight in enumerate(fit.posterior.weight):
        log = dict(zip(u.names, fit.posterior.mean[b], strict=False))
        path = notes[b][fit.problem.reference].path
        records.append(
            Minimum(
                weight=float(weight),
                negative_log_posterior=float(minima.nll[b]),
                parameters={n: u.value(n, log[n]) for n in u.reported if log[n] > LOG_ABSENT_LOSS},
                velocities=np.exp(minima.candidates.theta[b, u.shared :]),
                path_db=None if path is None else path.db,
                path_velocity_discrepancy=None
                if path is None
                else VelocityDiscrepancyEntry.of(path.velocity_discrepancy),
            )
        )
    return tuple(records)


def _diagnostics(fit: InferenceResult) -> Diagnostics:
    problem, minima = fit.problem, fit.estimate.minima
    (sigma, smooth, octaves, floor), (cents, *_), (decay, *_) = (np.exp(x[0]).tolist() for x in minima.candidates.phi)
    other: dict[str, Any] = {} if fit.alternative is None else fit.alternative.diagnostics
    where = ("diagnostics", "this is an error in pianofit")
    return Diagnostics(
        evaluations=fit.estimate.n_strokes_computed,
        partials=int(np.asarray(problem.observed.level.detected).sum()),
        correlated=tuple(Correlation((a, b), r) for a, b, r in strong_correlations(fit)),
        negative_log_posterior=float(minima.nll[0]),
        censored=len(problem.observed.level.censored),
        contact_rate_Hz=float(problem.model_inputs.rate),
        modes=problem.cfg.n_modes,
        steps=int(problem.model_inputs.steps),
        excess_sd=ExcessSd(frequency_cents=cents, decay_relative=decay, level_db=sigma),
        path=PathPrior(smooth, octaves) if problem.path else None,
        interference_ratio=floor,
        profile=convert(other["profile"], dict[str, ProfileCurve], *where) if "profile" in other else None,
        posterior=convert(other["posterior"], PosteriorDiagnostics, *where) if "posterior" in other else None,
    )


def _covariance(fit: InferenceResult) -> Covariance:
    """Covariance of the logarithms of the parameters and velocities, by name."""
    names = parameter_indices(fit.problem)
    return Covariance(tuple(names), fit.posterior.covariance[0][np.ix_([*names.values()], [*names.values()])])


def _draws(fit: InferenceResult, record: Fit, view: IntervalResult) -> Draws:
    """The posterior draws, with those of the invariants that vary."""
    draws, u, g = view.draws or {}, fit.problem.parametrisation, fit.problem.initial_values.geometry

    def drawn(name: str) -> np.ndarray:
        return np.asarray(draws[name] if name in draws else record.parameters[name].value)

    table = {
        "f0": drawn("c") / (2 * g.length),
        "B": (drawn("kappa") * np.pi / (drawn("c") * g.length)) ** 2,
        "M_H/M_S": drawn("M_H") / g.mass,
        "x0/L": drawn("x0") / g.length,
    }
    strokes = {f"v/v_ref {n}": f"v_H0 {n}" for n in range(1, u.strokes + 1)}
    table |= {name: draws[own] / drawn("v_H0") for name, own in strokes.items() if own in draws}
    if "F/M_S" in record.invariants:
        stiffness, p = (drawn(u.names[i]) for i in u.force_and_exponent_index or ())
        # At the reference velocity shown. If a common scale s of the velocities is unknown: K_H s^(1-p), s v.
        scale = record.parameters["v_H0"].value / drawn("v_H0") if fit.problem.velocity_scale_free else 1.0
        table["F/M_S"] = stiffness * scale ** (1 - p) * np.exp(p * u.log_reference_compression) / g.mass
    varying = {name: table[name] for name in record.invariants if name in table and np.ptp(table[name]) > 0}
    return Draws({**draws, **varying}, tuple(varying), view.log_likelihood, view.observed)
