"""From an estimate to a result: sounds, tables, statuses and sentences."""

from __future__ import annotations

import numpy as np

from ..analysis import Partials
from ..io import FIT_SCHEMA
from ..model.note import Note
from ..model.path import OutputPath
from ..parameters import FIT_NAMES, Geometry
from .align import laid
from .coordinates import STRING_SIZE
from .entries import absent, derived, described, path_document, sizes, versions, wander_document
from .estimate import Estimate, beginning
from .listener import Listener, level_errors, together, worse_bands
from .notes import latents, notes_of
from .posterior import Posterior
from .problem import Problem
from .quantities import UNITS, Covariance
from .reports import latent
from .result import FittedRecording, Result
from .statements import (
    claims,
    correlated,
    invariant_status,
    messages,
    statuses,
    taken_back,
    velocity_statuses,
)
from .views import View

__all__ = ["conclude"]

DB = 20 / np.log(10)
# A value below is that of a parameter that the felt's law does not have.
ABSENT = 1e-100
# In the paper's order, then what lies between hammer and string; last what only some felts have.
PARAMETERS_FIRST = (*FIT_NAMES, "x0", "width")


def conclude(problem: Problem, found: Estimate, seed: int, view: View | None = None) -> Result:
    """Put an estimate into sounds, numbers and words.

    Parameters
    ----------
    view : intervals by another view of F than Laplace's.

    Raises
    ------
    FitError
        If an initial or a final contact does not end.
    """
    played = [notes_of(problem, found.minima, which) for which in range(len(found.minima.F))]
    fitted = tuple(_heard(problem, found, i, note) for i, note in enumerate(played[0]))
    states = statuses(problem, found)
    levels = together([t.levels for t in fitted])
    reference = fitted[problem.reference]
    worse = worse_bands(reference.criterion)
    parameters = _parameters(problem, found, states)
    said = messages(problem, found, states, worse, "laplace" if view is None else view.means)
    diagnostics = _diagnostics(problem, found)
    table = invariants(problem, found, states)
    rows = [_row(problem, found, i, heard) for i, heard in enumerate(fitted)]
    if view is not None:
        parameters = {name: entry | view.entries.get(name, {}) for name, entry in parameters.items()}
        table = {name: entry | _seen(view, name, problem.start.geometry) for name, entry in table.items()}
        if "v_H0" in view.entries:
            rows[problem.reference]["v_H0_interval"] = view.entries["v_H0"]["interval"]
        said, diagnostics = [*said, *view.messages], diagnostics | view.diagnostics
    notes = tuple(
        tuple(note._replace(gain=heard.fitted.note.gain) for note, heard in zip(each, fitted, strict=True))
        for each in played
    )
    covariance = _covariance(problem, found)
    document = {
        "schema": FIT_SCHEMA, "program": "pianofit", "recipe": "default", "felt": problem.start.law.name, "seed": seed,
        "converged": bool(found.minima.converged[0]), "claims": claims(problem, found, states, levels),
        "messages": said,
        "invariants": table,
        "parameters": parameters,
        "recordings": rows,
        "pickup": {"quantity": problem.start.quantity, "path": path_document(reference.fitted.note.path)},
        "minima": _minima(problem, found, notes),
        "covariance": covariance.document(),
        "derived": derived(reference.fitted.note, reference.fitted.simulation, problem.analyses[problem.reference]),
        "criterion": reference.criterion,
        "levels": levels,
        "diagnostics": diagnostics,
        "versions": versions(),
    }  # fmt: skip
    return Result(
        document, fitted, problem.reference, covariance, notes,
        tuple(found.posterior.share.tolist()), None if view is None else view.draws,
    )  # fmt: skip


# --- sounds -----------------------------------------------------------------------------------------------------------


def _heard(problem: Problem, found: Estimate, i: int, fitted: Note) -> FittedRecording:
    """One recording before and after, on the criterion and in its levels."""
    recording, analysis = problem.recordings[i], problem.analyses[i]
    listener = Listener.of(recording, analysis)
    unit = 0.0 if problem.start.scale is None else DB * np.log(problem.start.scale)
    gain = None if problem.start.scale is None else 1.0 / problem.start.scale
    first = beginning(problem, found.z[:STRING_SIZE])
    fitted_level, integrated = _fitted_level(problem, found, i)
    initial = _initial_note(problem, first, i)
    begins = None if gain is None else round(laid(fitted._replace(gain=gain), problem.recordings[i]))
    if gain is None:
        gain = 10 ** (_gain_db(integrated, i) / 20)
    after = listener.play(fitted, gain, begins, fitted_level)
    # The criterion's own gain on the initial sound: its level is not what is judged.
    before = listener.play(initial, gain if problem.calibrated else None, begins, _level(problem, found, first, i))
    measured = analysis.partials.level + unit
    literature = None if problem.calibrated else _literature_level(problem, found, first, i)
    levels = {
        name: None if level is None else _in_noise(level, analysis.partials, measured)
        for name, level in (("initial_db", before.level), ("fitted_db", after.level), ("path_only_db", literature))
    }
    return FittedRecording(
        before, after, measured, recording, analysis, listener.criterion(before, after, problem.calibrated),
        level_errors(levels, analysis.partials, measured),
    )  # fmt: skip


def _in_noise(level: np.ndarray, p: Partials, measured: np.ndarray) -> np.ndarray:
    """Levels, dB, with the energy of the noise that the recording's were read through: a node is not silent."""
    return 10 / np.log(10) * np.logaddexp(level * np.log(10) / 10, (measured - p.snr) * np.log(10) / 10)


def _initial_note(problem: Problem, z: np.ndarray, i: int) -> Note:
    """What the starting values give, before any fit."""
    u = problem.unknowns
    hammer = u.hammer(z, problem.layout.stroke[i])
    start = problem.start
    string = u.string(z)._replace(**{n: start.initial[n] for n in ("c", "kappa", "b1", "b2") if n in start.initial})
    return Note(string, hammer, u.struck(z), start.quantity, 1.0, None)


def _columns(problem: Problem, i: int) -> np.ndarray:
    """Where a recording's partials stand in the table of levels; -1 for those above its top."""
    number = problem.observed.number
    by_number = np.full(max(number.max(), problem.analyses[i].partials.number.max()) + 1, -1)
    by_number[number] = np.arange(len(number))
    return by_number[problem.analyses[i].partials.number]


def _spread_out(problem: Problem, i: int, values: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    """Values of the table's columns at a recording's partials."""
    at = _columns(problem, i)
    return np.where(at >= 0, values[at], otherwise)


def _fitted_level(problem: Problem, found: Estimate, i: int):
    """Levels of a recording's partials through gain and path, dB [partials], and what was integrated out."""
    integrated = latents(found.minima, 0)
    table = found.minima.descent.table
    level = np.asarray(table.value)[i] - integrated.own[i]
    unit = 0.0 if problem.start.scale is None else DB * np.log(problem.start.scale)
    return _spread_out(problem, i, level, problem.analyses[i].partials.level + unit), integrated


def _gain_db(integrated, i: int) -> float:
    """A recording's own gain, dB: the level of its columns where the onset's share is least."""
    return float(integrated.columns[i][0])  # the lowest partial decays least


def _level(problem: Problem, found: Estimate, z: np.ndarray, i: int) -> np.ndarray:
    """Levels of a recording's partials at `z` [size] by the model alone, dB."""
    level = found.minima.descent.level(z)
    return level[problem.layout.stroke[i], problem.analyses[i].partials.number.clip(max=problem.cfg.rows) - 1]


def _literature_level(problem: Problem, found: Estimate, first: np.ndarray, i: int) -> np.ndarray:
    """Levels that the initial hammer gives at the fitted velocities, through gain and path that suit it, dB."""
    descent, people = found.minima.descent, found.minima.people
    z = first.copy()
    shared = problem.unknowns.shared
    z[shared:] = found.z[shared:]
    residual, _, good = descent.model(z[None])
    if not good[0]:
        return np.full(len(problem.analyses[i].partials), -300.0)
    integrated = latent(descent.table, residual[0], people.phi[0], people.w[0])
    level = np.asarray(descent.table.value)[i] - integrated.own[i]
    return _spread_out(problem, i, level, problem.analyses[i].partials.level)


# --- tables -----------------------------------------------------------------------------------------------------------


def _covariance(problem: Problem, found: Estimate) -> Covariance:
    """Of all logarithms by name; `v_H0` is the reference stroke's velocity, `v_H0 N` that of stroke N."""
    reference = problem.layout.stroke[problem.reference]
    strokes = ("v_H0" if i == reference else f"v_H0 {i + 1}" for i in range(problem.layout.strokes))
    return Covariance((*problem.unknowns.names, *strokes), found.posterior.covariance[0])


def _parameters(problem: Problem, found: Estimate, states: dict[str, str]) -> dict:
    """Every parameter with value, unit, interval and status."""
    u, start = problem.unknowns, problem.start
    log, initial = found.posterior.mean[0], np.exp(u.log_values(beginning(problem, found.z[:STRING_SIZE])))
    reference = problem.layout.stroke[problem.reference]
    unscaled = not problem.calibrated and all(v is None for v in problem.speed)
    moving = u.law.scaling("N m") if unscaled else ()
    table: dict[str, dict] = {}
    for name in u.reported:
        i = u.at(name)
        if name == "x0":
            table["v_H0"] = _velocity(problem, found, reference) | {"initial": float(initial[u.shared + reference])}
        if np.exp(log[i]) < ABSENT:
            table[name] = absent(name, u.law.name)
            continue
        rests = [f"the assumed {x}" for x in start.rests_on.get(name, ())]
        rests += ["the velocities"] * (name in moving)
        note = f"scales with {' and '.join(rests)}" if rests and states[name] == "scaled" else ""
        if name == "width" and u.free[i]:
            note = "effective: of the raised cosine that acts as the felt's own window does"
        # What is held is shown as it was given, to the last digit.
        value = u.value(name, log[i]) if u.free[i] else float(start.values[name])
        table[name] = _entry(
            found.posterior, np.eye(u.size)[i], value, described(name, u.law), states[name],
            float(start.initial[name] if name in start.initial else initial[i]), note, u.range(i),
        )  # fmt: skip
    order = [n for n in PARAMETERS_FIRST if n in table]
    return {n: table[n] for n in order} | {n: e for n, e in table.items() if n not in order} | sizes(start)


def _entry(
    posterior: Posterior, change: np.ndarray, value: float, said: dict[str, str], status: str, initial: float,
    note: str, box: tuple[float, float] = (-np.inf, np.inf),
) -> dict:  # fmt: skip
    """A row of a table; an interval ends at the `box` of logarithms, and says where."""
    span = posterior.interval(change)
    # The interval of a sum of logarithms about the value that is shown.
    offset = np.log(value) - float(posterior.mean[0] @ change)
    interval, sides = None, []
    if span is not None:
        ends = np.clip(np.add(span, offset), *box)
        interval = np.exp(np.minimum(ends, 700.0)).tolist()
        sides = [side for side, end, edge in zip(("low", "high"), ends, box, strict=True) if end == edge]
    return {
        "value": value, **said, "interval": interval, "interval_by": None if span is None else "laplace",
        "interval_open": sides, "status": status, "initial": initial, "note": note,
    }  # fmt: skip


def _velocity(problem: Problem, found: Estimate, stroke: int) -> dict:
    at = problem.unknowns.shared + stroke
    measured = problem.speed[stroke]
    value = float(np.exp(found.z[at])) if measured is None else float(measured)
    status = velocity_statuses(problem, found)[stroke]
    note = "its scale is the prior's" if status == "scaled" else ""
    return _entry(
        found.posterior, np.eye(problem.unknowns.size)[at], value, {"unit": UNITS["v_H0"]}, status, value, note,
        problem.unknowns.range(at),
    )  # fmt: skip


def _seen(view: View, name: str, geometry: Geometry) -> dict:
    """What another view says of an invariant that is one parameter over something known; of others nothing."""
    of, over = {
        "f0": ("c", 2 * geometry.length), "M_H/M_S": ("M_H", geometry.mass), "x0/L": ("x0", geometry.length),
    }.get(name, ("", 1.0))  # fmt: skip
    entry = view.entries.get(of)
    return {} if entry is None else entry | {"interval": [float(end / over) for end in entry["interval"]]}


def invariants(problem: Problem, found: Estimate, states: dict[str, str]) -> dict:
    """What no assumed length or mass enters: value, unit, 95 % interval and status by name.

    Nor does the scale of the velocities, but for the felt's force at a compression, whose status then is `scaled`.
    """
    u, g = problem.unknowns, problem.start.geometry
    unit = np.eye(u.size)
    c, kappa, mass, at = (unit[u.at(n)] for n in ("c", "kappa", "M_H", "x0"))
    stroke = problem.layout.stroke[problem.reference]
    scaled = not problem.calibrated and all(v is None for v in problem.speed)
    held = found.posterior.given(unit[u.shared + stroke]) if scaled else found.posterior
    z, log = found.z, found.posterior.mean[0]
    string = np.exp(log[:STRING_SIZE])

    def entry(
        change: np.ndarray, value: float, its_unit: str, own: list[str], note: str = "", by: Posterior = held
    ) -> dict:
        status = invariant_status(own, by.spread(change))
        whole = _entry(by, change, value, {"unit": its_unit}, status, 0.0, note)
        return {k: whole[k] for k in ("value", "unit", "interval", "interval_by", "interval_open", "note", "status")}

    table = {
        "f0": entry(c, string[0] / (2 * g.length), "Hz", [states["c"]]),
        "B": entry(
            2 * kappa - 2 * c, (string[1] * np.pi / (string[0] * g.length)) ** 2, "1", [states["c"], states["kappa"]]
        ),
        "M_H/M_S": entry(mass, float(np.exp(log @ mass)) / g.mass, "1", [states["M_H"]]),
        "x0/L": entry(at, float(np.exp(log @ at)) / g.length, "1", [states["x0"]]),
    }
    if u.power and u.free[u.power[0]]:  # a given K_H has no compression of reference
        stiffness, p = u.power
        lost = u.names[stiffness] in taken_back(problem, found)
        table["F/M_S"] = entry(
            unit[stiffness] + float(np.exp(z[p])) * u.log_u * unit[p], float(np.exp(z[stiffness])) / g.mass, "N/kg",
            ["not-identifiable"] * lost,
            f"static force of the felt at {1e3 * np.exp(u.log_u):.3g} mm"
            + (", at the reference velocity shown" if scaled else ""),
        )  # fmt: skip
        if scaled and table["F/M_S"]["status"] == "fitted":
            table["F/M_S"]["status"] = "scaled"
    velocities = velocity_statuses(problem, found)
    for other in range(problem.layout.strokes):
        if other != stroke:
            ratio = unit[u.shared + other] - unit[u.shared + stroke]
            name = problem.recordings[problem.layout.stroke.index(other)].path
            table[f"v/v_ref {other + 1}"] = entry(
                ratio, float(np.exp(z @ ratio)), "1", [velocities[other], velocities[stroke]], name, found.posterior
            )
    return table


def _row(problem: Problem, found: Estimate, i: int, heard: FittedRecording) -> dict:
    """What one recording has of its own."""
    recording, stroke = problem.recordings[i], problem.layout.stroke[i]
    speed = _velocity(problem, found, stroke)
    cents = 1200 * np.log2(problem.analyses[i].f0 / problem.analyses[problem.reference].f0)
    return {
        "file": recording.path, "sha256": recording.sha256, "channel": recording.channel, "rate": recording.rate,
        "onset_s": recording.onset / recording.rate, "v_H0": speed["value"], "v_H0_interval": speed["interval"],
        "v_H0_status": speed["status"], "gain": heard.fitted.note.gain,
        "gain_status": "fitted" if problem.start.scale is None else "given", "first": i == problem.reference,
        "cents": float(cents), "group": problem.layout.group[i], "stroke": stroke,
        "criterion": heard.criterion, "levels": heard.levels,
    }  # fmt: skip


def _minima(problem: Problem, found: Estimate, notes) -> list[dict]:
    """Every minimum: its share, F, hammer, velocities, and the reference's path."""
    u = problem.unknowns
    rows = []
    for b, share in enumerate(found.posterior.share):
        log = dict(zip(u.names, found.posterior.mean[b, : u.shared], strict=True))
        values = {n: u.value(n, log[n]) for n in u.reported if np.exp(log[n]) > ABSENT}
        path: OutputPath | None = notes[b][problem.reference].path
        rows.append({
            "share": float(share), "F": float(found.minima.F[b]), "parameters": values,
            "velocities": np.exp(found.minima.people.z[b, u.shared :]).tolist(),
            "path_db": None if path is None else path.db.tolist(),
            "path_wander": None if path is None else wander_document(path.wander),
        })  # fmt: skip
    return rows


def _diagnostics(problem: Problem, found: Estimate) -> dict:
    phi, strings = np.exp(found.minima.people.phi[0]), found.minima.strings[0]
    return {
        "F": float(found.minima.F[0]), "evaluations": found.lanes,
        "partials": int(np.asarray(problem.observed.level.found).sum()),
        "absent": len(problem.observed.level.absent),
        "contact_rate_Hz": float(problem.scene.rate), "modes": problem.cfg.n_modes, "steps": int(problem.scene.steps),
        "excess": {"frequency_cents": float(np.exp(strings.phi[0][0])),
                   "decay_relative": float(np.exp(strings.phi[1][0])), "level_db": float(phi[0])},
        "path": {"smooth_db": float(phi[1]), "octaves": float(phi[2])} if problem.path else None,
        "floor": float(phi[3]),
        "correlated": [{"pair": [a, b], "correlation": r} for a, b, r in correlated(problem, found.posterior)],
    }  # fmt: skip
