"""The paper's results (V), again: fits of the laboratory's measurements, and what the claims are tested on."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ..inference import Result
from ..laboratory import Laboratory
from ..laboratory.chosen import FINAL, INITIAL
from ..parameters import FIT_NAMES
from .fits import RECIPES, Case, Closeness, closeness, fitted, make_case, played, values_of
from .plan import EFFECTS, Plan

__all__ = [
    "STRINGS", "Blow", "Effect", "Prediction", "Tables", "blow_at", "effects", "predictions", "repeated",
    "spread_of", "tables",
]  # fmt: skip

# The paper's process as printed, and its third step on a string that was read.
STRINGS = ("paper", "read")

Tick = Callable[[str], None]


class Tables(NamedTuple):
    """Tables II and III: values by name in each column."""

    printed_initial: dict[str, float]  # no κ: the paper has none
    printed_final: dict[str, float]
    true: dict[str, float]  # no μ: the laboratory's felt has memory instead
    found: dict[str, dict[str, float]]  # column -> values
    intervals: dict[str, dict[str, tuple[float, float] | None]]  # of the default recipe's columns
    case: Case  # the full laboratory's


class Blow(NamedTuple):
    """One velocity: its measurement, fits by recipe, and the sounds by the names of `RECIPES`."""

    case: Case
    results: dict[str, Result]
    sounds: dict[str, np.ndarray]  # m/s, from the onset on; `measured` and `initial` too
    closeness: dict[str, Closeness]


class Prediction(NamedTuple):
    """A velocity that was not fitted."""

    velocity: float
    predicted: dict[str, Closeness]  # recipe -> by its fit at another velocity
    initial: Closeness
    nearest: Closeness  # the recording at that other velocity, in its place
    sounds: dict[str, np.ndarray]  # recipe -> m/s


class Effect(NamedTuple):
    """What remains after a fit of a laboratory with this and no other effect."""

    name: str
    remains: dict[str, dict[str, float]]  # recipe -> band -> criterion
    level_db: dict[str, float]  # recipe -> rms error of the partials' levels


def tables(plan: Plan, seed: int, tick: Tick) -> Tables:
    """The string and hammer of the paper's final values, measured and fitted from its initial ones."""
    velocity, start = float(FINAL.hammer.v_H0), float(INITIAL.hammer.v_H0)
    found, intervals = {}, {}
    full = make_case(plan.laboratory(), velocity, seed, start=start)
    ideal = make_case(plan.ideal(), velocity, seed, start=start)
    for case, place in ((ideal, "ideal"), (full, "full")):
        for recipe in ("paper", "default") if case is ideal else ("paper", "read", "global", "default"):
            tick(f"tables: {place} laboratory, {RECIPES[recipe]}")
            result = fitted(case, recipe, seed, plan.annealing, plan.tries)
            column = f"{place}: {RECIPES[recipe]}"
            found[column] = values_of(result)
            if recipe == "default":
                table = result.document["parameters"]
                intervals[column] = {name: table[name]["interval"] for name in FIT_NAMES}
    printed = {name: float(v) for part in (INITIAL.string, INITIAL.hammer) for name, v in part._asdict().items()}
    return Tables(
        printed_initial={name: v for name, v in printed.items() if name != "kappa"},
        printed_final={name: float(v) for part in (FINAL.string, FINAL.hammer) for name, v in part._asdict().items()},
        true={name: v for name, v in full.measurement.true.items() if name in FIT_NAMES},
        found=found,
        intervals=intervals,
        case=full,
    )


def blow_at(plan: Plan, lab: Laboratory, velocity: float, seed: int, recipes: tuple[str, ...]) -> Blow:
    """Measure at one velocity, fit by `recipes`, and listen."""
    case = make_case(lab, velocity, seed)
    results = {recipe: fitted(case, recipe, seed, plan.annealing, plan.tries) for recipe in recipes}
    first = next(iter(results.values()))
    sounds = {"measured": case.heard, "initial": played(first.initial.note, case)}
    sounds |= {RECIPES[recipe]: played(result.fitted.note, case) for recipe, result in results.items()}
    return Blow(case, results, sounds, {name: closeness(sound, case) for name, sound in sounds.items()})


def predictions(origin: Blow, others: list[Blow]) -> list[Prediction]:
    """The three-band fits at one velocity, struck as the sensor read it at the others."""
    done = []
    for blow in others:
        struck = blow.case.measurement.nominal_velocity
        sounds = {r: played(origin.results[r].fitted.note, blow.case, struck) for r in STRINGS}
        heard = origin.case.heard
        place = np.pad(heard, (0, max(len(blow.case.heard) - len(heard), 0)))[: len(blow.case.heard)]
        done.append(
            Prediction(
                velocity=blow.case.velocity,
                predicted={r: closeness(sound, blow.case) for r, sound in sounds.items()},
                initial=blow.closeness["initial"],
                nearest=closeness(place, blow.case),
                sounds=sounds,
            )
        )
    return done


def repeated(plan: Plan, seed: int, tick: Tick) -> dict[str, list[dict[str, float]]]:
    """The same blow again and again, each with noise and a search of its own: recipe -> the fits' values."""
    rows = {recipe: [] for recipe in STRINGS}
    for n in range(1, plan.repeats + 1):
        tick(f"repeated measurement {n} of {plan.repeats}")
        case = make_case(plan.laboratory(), plan.origin, seed + n)
        for recipe, values in rows.items():
            values.append(values_of(fitted(case, recipe, seed + n, plan.annealing)))
    return rows


def spread_of(rows: list[dict[str, float]]) -> dict[str, float]:
    """Standard deviation of each parameter over repeated fits, relative."""
    return {name: float(np.std(np.log([row[name] for row in rows]), ddof=1)) for name in FIT_NAMES}


def effects(plan: Plan, seed: int, full: Blow, tick: Tick) -> list[Effect]:
    """No effect but noise; each alone; all of them."""
    done = []
    for name in ("none", *plan.effects):
        tick(f"effects: {name}")
        lab = plan.ideal(**EFFECTS.get(name, {}))
        blow = blow_at(plan, lab, plan.origin, seed, plan.effect_recipes)
        done.append(_effect(name, blow, plan.effect_recipes))
    return [*done, _effect("all", full, plan.effect_recipes)]


def _effect(name: str, blow: Blow, recipes: tuple[str, ...]) -> Effect:
    by = {recipe: blow.closeness[RECIPES[recipe]] for recipe in recipes}
    return Effect(name, {r: c.criterion for r, c in by.items()}, {r: c.level_db for r, c in by.items()})
