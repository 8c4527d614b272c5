"""The quantities that a fit reports: parameters, velocities and invariants with intervals and statuses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..inference import LOG_ABSENT_LOSS, InferenceResult, InitialValues, Interval, Posterior
from ..parameters import FIT_NAMES
from ..schema.quantities import UNITS, Quantities, Quantity, Status, meaning_of, unit_of
from .statement import felt_force_name
from .statuses import invariant_status, scaled_parameters, unidentifiable_parameters, velocity_statuses

# Parameters in the paper's order, then those of the contact. Parameters of other felt laws follow.
PARAMETER_ORDER = (*FIT_NAMES, "x0", "width")


def _with_interval(quantity: Quantity, interval: Interval | None) -> Quantity:
    """The quantity with an interval; unchanged without one."""
    if interval is None:
        return quantity
    ends, unbounded = (interval.low, interval.high), interval.unbounded
    return replace(quantity, interval=ends, interval_method=interval.method, interval_unbounded=unbounded)


def stroke_velocities(fit: InferenceResult) -> list[Quantity]:
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
        interval = fit.posterior.value_interval(np.eye(u.size)[at], value, u.range(at))
        if at == problem.reference_velocity_index:
            interval = fit.alternative_interval("v_H0") or interval
        table.append(_with_interval(quantity, interval))
    return table


def parameters(fit: InferenceResult, states: Mapping[str, Status], velocity: Quantity) -> Quantities:
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
        interval = fit.posterior.value_interval(np.eye(u.size)[i], value, u.range(i))
        quantity = Quantity(name, value, unit, None, states[name], meaning, note, float(start.initial[name]))
        table[name] = _with_interval(quantity, fit.alternative_interval(name) or interval)
    last = len(PARAMETER_ORDER)
    order = sorted(table, key=lambda name: PARAMETER_ORDER.index(name) if name in PARAMETER_ORDER else last)
    return Quantities.of([*(table[name] for name in order), *sizes(start)])


def invariants(fit: InferenceResult, states: Mapping[str, Status]) -> Quantities:
    """Quantities that do not depend on an assumed length or mass.

    They do not depend on the velocity scale either, except the felt force at a compression, whose status is `scaled`.
    """
    u, g = fit.problem.parametrisation, fit.problem.initial_values.geometry
    c, kappa = (u.index_of(name) for name in ("c", "kappa"))
    B = float(np.exp(fit.posterior.mean[0, kappa] - fit.posterior.mean[0, c]) * np.pi / g.length) ** 2
    unit = np.eye(u.size)
    table = [
        _ratio(fit, states, "f0", "c", 2 * g.length, "Hz"),
        _combined("B", fit.gauge_fixed, 2 * (unit[kappa] - unit[c]), B, "1", (states["c"], states["kappa"])),
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
    return _with_interval(quantity, posterior.value_interval(direction, value))


def _ratio(
    fit: InferenceResult, states: Mapping[str, Status], name: str, of: str, divisor: float, unit: str = "1"
) -> Quantity:
    """The parameter `of` over a fixed size, with the interval by the other method if there is one."""
    at, other = fit.problem.parametrisation.index_of(of), fit.alternative_interval(of)
    value = float(np.exp(fit.posterior.mean[0, at])) / divisor
    direction = np.eye(fit.problem.parametrisation.size)[at]
    quantity = _combined(name, fit.gauge_fixed, direction, value, unit, [states[of]])
    if other is None:
        return quantity
    return _with_interval(quantity, replace(other, low=other.low / divisor, high=other.high / divisor))


def _static_force(fit: InferenceResult, states: Mapping[str, Status], stiffness: int, p: int) -> Quantity:
    """The static felt force at the reference compression over the string mass."""
    problem, u, z = fit.problem, fit.problem.parametrisation, fit.estimate.theta
    force, geometry = float(np.exp(z[stiffness])), problem.initial_values.geometry
    size = "assumed" if "mass" in problem.initial_values.assumed else "given"
    note = f"{felt_force_name(u)}, {force:.3g} N with the {size} string mass"
    note += ", at the reference velocity shown" if problem.velocity_scale_free else ""
    decisive: dict[Status, bool] = {
        "at-bound": "at-bound" in (states[u.names[stiffness]], states[u.names[p]]),
        "not-identifiable": u.names[stiffness] in unidentifiable_parameters(fit),
    }
    factors: list[Status] = [status for status, holds in decisive.items() if holds]
    direction = u.force_direction(z)
    quantity = _combined("F/M_S", fit.gauge_fixed, direction, force / geometry.mass, "N/kg", factors, note)
    is_scaled = problem.velocity_scale_free and quantity.status == "fitted"
    return replace(quantity, status="scaled") if is_scaled else quantity


def _velocity_ratios(fit: InferenceResult) -> list[Quantity]:
    """The velocities of the strokes over that of the reference stroke."""
    problem, z, states = fit.problem, fit.estimate.theta, velocity_statuses(fit)
    unit, shared = np.eye(problem.parametrisation.size), problem.parametrisation.shared
    reference, table = problem.reference_velocity_index, []
    for stroke, state in enumerate(states):
        if (at := shared + stroke) != reference:
            name, file = f"v/v_ref {stroke + 1}", problem.recordings[problem.structure.stroke.index(stroke)].path
            value, direction = float(np.exp(z[at] - z[reference])), unit[at] - unit[reference]
            factors: list[Status] = [state, states[reference - shared]]
            table.append(_combined(name, fit.posterior, direction, value, "1", factors, Path(file).name))
    return table


def fixed_quantity(name: str, value: float, status: Status) -> Quantity:
    """A parameter that was not fitted."""
    return Quantity(name, float(value), UNITS[name], None, status, meaning_of(name), initial=float(value))


def sizes(start: InitialValues) -> list[Quantity]:
    """String mass, string length, and the position of the pickup if it is on the string."""
    g = start.geometry
    table = [
        fixed_quantity(name, value, "assumed" if key in start.assumed else "given")
        for name, value, key in (("M_S", g.mass, "mass"), ("L", g.length, "length"))
    ]
    on_string = start.quantity in ("velocity", "displacement")
    return [*table, fixed_quantity("pickup", g.pickup, "given")] if on_string else table
