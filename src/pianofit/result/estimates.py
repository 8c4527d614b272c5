"""The quantities that a fit reports: parameters, velocities and invariants with intervals and statuses."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..inference import LOG_ABSENT_LOSS, InferenceResult, InitialValues, Interval, Parametrisation, Posterior
from ..parameters import FIT_NAMES
from ..schema.dependencies import FELT, derived_status
from ..schema.quantities import UNITS, Quantities, Quantity, Status, meaning_of, unit_of
from ..transducer import TRANSDUCERS
from .statuses import Statuses, force_direction

# Parameters in the paper's order, then those of the contact. Parameters of other felt laws follow.
PARAMETER_ORDER = (*FIT_NAMES, "x0", "width")
# Statuses of two velocities, the one that decides about their ratio last.
SEVERITY: tuple[Status, ...] = ("given", "assumed", "scaled", "fitted", "at-bound", "not-identifiable")


def _with_interval(quantity: Quantity, interval: Interval | None) -> Quantity:
    """The quantity with an interval; unchanged without one."""
    if interval is None:
        return quantity
    ends, unbounded = (interval.low, interval.high), interval.unbounded
    return replace(quantity, interval=ends, interval_method=interval.method, interval_unbounded=unbounded)


def stroke_velocities(fit: InferenceResult, states: Statuses) -> list[Quantity]:
    """The velocity of every stroke."""
    problem, u = fit.problem, fit.problem.parametrisation
    table, stroke = [], u.law.stroke
    for at, measured, status in zip(
        range(u.size)[u.velocities], problem.measured_velocity, states.velocities, strict=True
    ):
        value = float(np.exp(fit.estimate.theta[at])) if measured is None or u.free[at] else float(measured)
        scale = "its scale comes from the prior" if problem.velocity_scale_open else "scales with the assumed L"
        note, initial = scale if status == "scaled" else "", float(np.exp(fit.initial_theta[at]))
        quantity = Quantity(stroke.name, value, stroke.unit, None, status, stroke.meaning, note, initial)
        table.append(_with_interval(quantity, _stroke_interval(fit, at, value)))
    return table


def _stroke_interval(fit: InferenceResult, at: int, value: float) -> Interval | None:
    """The interval of the parameter of a stroke, the entry `at` of θ."""
    name = fit.problem.parametrisation.law.stroke.name if at == fit.problem.reference_velocity_index else ""
    return _own_interval(fit, name, at, value)


def _own_interval(fit: InferenceResult, name: str, i: int, value: float) -> Interval | None:
    """The interval of a parameter, entry `i` of θ: by a profile or a sampler if there is one, within its bounds."""
    u = fit.problem.parametrisation
    return fit.alternative_interval(name) or fit.posterior.value_interval(np.eye(u.size)[i], value, u.range(i))


def parameters(fit: InferenceResult, states: Statuses, velocity: Quantity) -> Quantities:
    """Every parameter; `velocity` is that of the reference stroke."""
    u, start = fit.problem.parametrisation, fit.problem.initial_values
    log, table = fit.posterior.mean[0], {velocity.name: velocity}
    for name in u.reported:
        i = u.index_of(name)
        unit, meaning = unit_of(name, u.law), meaning_of(name, u.law)
        if log[i] <= LOG_ABSENT_LOSS:
            note = f"not a parameter of the felt law {u.law.name}"
            table[name] = Quantity(name, 0.0, unit, None, "given", meaning, note, 0.0)
            continue
        scales = [f"the assumed {size}" for size in start.assumptions.get(name, ())]
        scales += ["the velocities"] * (name in states.scaled)
        status = states.parameters[name]
        note = f"scales with {' and '.join(scales)}" if status == "scaled" else ""
        if name == "width" and u.free[i]:
            note = "effective width: a raised cosine of this width acts like the unknown contact window"
        # A fixed value is shown exactly as it was given.
        value = u.value(name, log[i]) if u.free[i] else float(start.values[name])
        # An assumed value has no interval, although its part that scales with an uncertain length varies.
        interval = _own_interval(fit, name, i, value) if u.free[i] else None
        quantity = Quantity(name, value, unit, None, status, meaning, note, float(start.initial[name]))
        table[name] = _with_interval(quantity, interval)
    ordered = [table[name] for name in dict.fromkeys((*PARAMETER_ORDER, *table)) if name in table]
    return Quantities.of([*ordered, *(_size(fit, size) for size in sizes(start) if size.name not in table)])


def _size(fit: InferenceResult, quantity: Quantity) -> Quantity:
    """A size; with its posterior value and interval if it was given with a standard deviation."""
    u, name = fit.problem.parametrisation, quantity.name
    if name not in u.sizes:
        return quantity
    value = _size_value(fit, name)
    interval = fit.alternative_interval(name) or fit.posterior.value_interval(_unit(u, name), value)
    return _with_interval(replace(quantity, value=value), interval)


def invariants(fit: InferenceResult, states: Statuses) -> Quantities:
    """Quantities that do not depend on an assumed length or mass.

    They do not depend on the velocity scale either, except the felt force at a compression, whose status is `scaled`.
    """
    u = fit.problem.parametrisation
    c, kappa = (u.index_of(name) for name in ("c", "kappa"))
    direction = 2 * (_unit(u, "kappa") - _unit(u, "L") - _unit(u, "c"))
    B = float(np.exp(fit.posterior.mean[0, kappa] - fit.posterior.mean[0, c]) * np.pi / _size_value(fit, "L")) ** 2
    table = [
        _ratio(fit, states, "f0", "c", "L", 2.0, "Hz"),
        _combined("B", fit.posterior, direction, B, "1", states.parameters),
    ]
    if not u.law.has_contact:
        return Quantities.of([*table, *_places(fit, states)])
    table += [_ratio(fit, states, "M_H/M_S", "M_H", "M_S"), _ratio(fit, states, "x0/L", "x0", "L")]
    if (direction := force_direction(fit)) is not None:
        table.append(_static_force(fit, states, direction))
    return Quantities.of([*table, *_velocity_ratios(fit, states.velocities)])


def _places(fit: InferenceResult, states: Statuses) -> list[Quantity]:
    """The plucking position of every stroke, that of the pickup, and the width, over the string length."""
    problem, u = fit.problem, fit.problem.parametrisation
    length, over = _size_value(fit, "L"), _unit(u, "L")
    table = []
    for stroke, state in enumerate(states.velocities):
        at = u.shared + stroke
        file = Path(problem.recordings[problem.structure.stroke.index(stroke)].path).name
        name = "x0/L" if at == problem.reference_velocity_index else f"x0/L {stroke + 1}"
        value = float(np.exp(fit.posterior.mean[0, at]))
        note = file if u.strokes > 1 else ""
        quantity = _combined(name, fit.posterior, np.eye(u.size)[at] - over, value / length, "1", {"x0": state}, note)
        if "L" not in u.sizes:
            quantity = _with_interval(quantity, _over(_stroke_interval(fit, at, value), length))
        table.append(replace(quantity, meaning=f"{u.law.words.stroke} over string length"))
    table.sort(key=lambda quantity: quantity.name)
    return [*table, *(_ratio(fit, states, f"{n}/L", n, "L") for n in ("pickup", "width") if n in u.reported)]


def _unit(u: Parametrisation, name: str) -> np.ndarray:
    """The direction of one logarithm [size]; 0 for an exact size."""
    return np.eye(u.size)[u.index_of(name)] if name in (*u.names, *u.sizes) else np.zeros(u.size)


def _size_value(fit: InferenceResult, size: str) -> float:
    """The string length L, m, or mass M_S, kg: as given, or at the best minimum if it is uncertain."""
    u = fit.problem.parametrisation
    if size in u.sizes:
        return float(np.exp(fit.posterior.mean[0, u.index_of(size)]))
    return fit.problem.initial_values.size_value(size)


def _combined(
    name: str,
    posterior: Posterior,
    direction: np.ndarray,
    value: float,
    unit: str,
    states: Mapping[str, Status],
    note: str = "",
) -> Quantity:
    """A product of powers, with exponents `direction` [size]; `states` are the statuses of all that it stands on."""
    status = derived_status(name, states, posterior.sd(direction))
    quantity = Quantity(name, value, unit, None, status, meaning_of(name), note)
    return _with_interval(quantity, posterior.value_interval(direction, value))


def _ratio(
    fit: InferenceResult, states: Statuses, name: str, of: str, size: str, factor: float = 1.0, unit: str = "1"
) -> Quantity:
    """The parameter `of` over `factor` times a size.

    With an exact size the interval is that of the parameter. A profile follows one parameter, not a ratio, so with an
    uncertain size it has none. `derived_table` has the intervals of a sampler for uncertain sizes.
    """
    u = fit.problem.parametrisation
    i, divisor = u.index_of(of), factor * _size_value(fit, size)
    value = float(np.exp(fit.posterior.mean[0, i]))
    below = dict(states.parameters)
    if below[of] == "given" and {"L": "length", "M_S": "mass"}[size] in fit.problem.initial_values.assumed:
        below[of] = "assumed"
    quantity = _combined(name, fit.posterior, _unit(u, of) - _unit(u, size), value / divisor, unit, below)
    return quantity if size in u.sizes else _with_interval(quantity, _over(_own_interval(fit, of, i, value), divisor))


def _over(interval: Interval | None, divisor: float) -> Interval | None:
    """The interval of a value over an exact divisor."""
    return interval and replace(interval, low=interval.low / divisor, high=interval.high / divisor)


def _static_force(fit: InferenceResult, states: Statuses, direction: np.ndarray) -> Quantity:
    """The static felt force at the reference compression over the string mass."""
    problem, u, z = fit.problem, fit.problem.parametrisation, fit.estimate.theta
    stiffness, p = u.force_and_exponent_index or (0, 0)
    force = float(np.exp(z[stiffness]))
    size = "assumed" if "mass" in problem.initial_values.assumed else "given"
    note = f"F is the {u.felt_force_name}: {force:.3g} N with the {size} string mass"
    note += " and the reference velocity shown" if problem.velocity_scale_open else ""
    # K_H and p can be wide while the force is not: only their bounds and the felt as a whole count.
    felt: dict[str, Status] = {}
    if u.names[stiffness] in states.unidentifiable:
        felt[FELT] = "not-identifiable"
    elif "at-bound" in (states.parameters[u.names[stiffness]], states.parameters[u.names[p]]):
        felt[FELT] = "at-bound"
    value = force / problem.initial_values.geometry.mass  # θ belongs to the given mass
    quantity = _combined("F/M_S", fit.gauge_fixed, direction, value, "N/kg", felt, note)
    is_scaled = problem.velocity_scale_open and quantity.status == "fitted"
    return replace(quantity, status="scaled") if is_scaled else quantity


def _velocity_ratios(fit: InferenceResult, states: Sequence[Status]) -> list[Quantity]:
    """The velocities of the strokes over that of the reference stroke."""
    problem, z = fit.problem, fit.estimate.theta
    unit, shared = np.eye(problem.parametrisation.size), problem.parametrisation.shared
    reference, table = problem.reference_velocity_index, []
    for stroke, state in enumerate(states):
        if (at := shared + stroke) != reference:
            name, file = f"v/v_ref {stroke + 1}", problem.recordings[problem.structure.stroke.index(stroke)].path
            value, direction = float(np.exp(z[at] - z[reference])), unit[at] - unit[reference]
            both = SEVERITY[max(map(SEVERITY.index, (state, states[reference - shared])))]
            table.append(_combined(name, fit.posterior, direction, value, "1", {"v_H0": both}, Path(file).name))
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
    on_string = TRANSDUCERS[start.quantity].on_string
    return [*table, fixed_quantity("pickup", g.pickup, "given")] if on_string else table
