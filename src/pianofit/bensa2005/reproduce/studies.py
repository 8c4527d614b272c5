"""Everything that the page says, computed: fits of the laboratory's measurements (paper V), and the studies beside."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...parameters import FIT_NAMES
from ..laboratory import FINAL, INITIAL, SyntheticMeasurement, chosen
from .band3 import Landscape, Race, hammers, landscape, race
from .direct import VELOCITIES, Strike, mass_for_contact, strike
from .limits import ALL, BAND2, B2Sensitivity, DispersionError, bends, blindness, inverse_bend
from .strokes import Stroke, fitted, measured, values_of

__all__ = ["FULL", "PRINTED", "QUICK", "STRINGS", "Findings", "Plan", "compute", "spread_of"]

# The paper's process as printed, and its third step on a string that was read.
STRINGS = ("paper", "read")
LONG = 3e-3  # s, the contact that the paper names
NOISE_DB = 60.0  # the laboratory's own, and left in the ideal one
# What the laboratory has and the paper's model has not, each to be tried alone beside the noise.
EFFECTS: dict[str, dict[str, Any]] = {
    "none": {}, "second polarisation": {"polarisation": True}, "yielding bridge": {"bridge": True},
    "relaxing felt": {"felt": "memory"},
}  # fmt: skip
# Tables II and III as printed; initially the paper has no κ.
PRINTED = {
    column: {name: value for name, value in chosen.by_name(it).items() if name not in missing}
    for column, it, missing in (("initial", INITIAL, ("kappa",)), ("final", FINAL, ()))
}


@dataclass(frozen=True)
class Plan:
    """Sizes of the studies. Velocities in m/s."""

    # The paper's Figure 6 is at 0.84 and Figure 7 at 1.1; its authors' page has 0.618, 0.844 and 1.299; its recordings
    # end at 2.3.
    velocities: tuple[float, ...] = (0.618, 0.844, 1.1, 1.299, 2.3)
    origin: float = 0.844  # from which the others are predicted
    waveform: float = 1.1
    heard: tuple[float, ...] = (0.618, 0.844, 1.299)  # in the listening test
    repeats: int = 4
    effects: tuple[str, ...] = tuple(EFFECTS)
    effect_recipes: tuple[str, ...] = (*STRINGS, "default")
    annealing: int | None = None  # evaluations of the paper's recipe; its own number if None
    tries: int = 2  # annealings for a fit, of which the best counts, but for repeated measurements
    # Band 3: points of the landscape along each side, starts, iterations of the gradient, evaluations of an annealing.
    grid: int = 49
    starts: int = 12
    iterations: int = 400
    evaluations: int = 10_000
    noises: int = 5  # measurements that differ in their noise alone, for b2
    losses: int = 36  # values of b2
    seconds: float = SyntheticMeasurement.seconds  # of a measurement
    contact_rate: float = SyntheticMeasurement.contact_rate  # Hz

    @property
    def laboratory(self) -> SyntheticMeasurement:
        """The full one."""
        return SyntheticMeasurement(noise_db=NOISE_DB, seconds=self.seconds, contact_rate=self.contact_rate)

    def ideal(self, **switches: Any) -> SyntheticMeasurement:
        """The paper's own model and noise, but for `switches`."""
        return SyntheticMeasurement.ideal(
            noise_db=NOISE_DB, seconds=self.seconds, contact_rate=self.contact_rate, **switches
        )


FULL = Plan()
QUICK = Plan(
    velocities=(0.844, 1.1), heard=(0.844,), repeats=2, effects=("none", "relaxing felt"), effect_recipes=STRINGS,
    grid=13, starts=2, iterations=10, evaluations=640, noises=2, losses=8, annealing=500, tries=1, seconds=1.0,
    contact_rate=2e5,
)  # fmt: skip


@dataclass(frozen=True)
class Findings:
    """What was computed."""

    seed: int
    plan: Plan
    strikes: list[Strike]
    needed_mass: float  # for a contact of `LONG`, kg
    tables: dict[str, Stroke]  # II and III: laboratory -> the paper's final values, measured and fitted
    strokes: dict[float, Stroke]  # at the plan's velocities
    # Velocities that were not fitted, by the fits at `plan.origin`; `nearest` is the recording there, in their place.
    predictions: dict[float, Stroke]
    repeated: dict[str, list[dict[str, float]]]  # recipe -> what was found, each time
    effects: dict[str, Stroke]  # a laboratory with this and no other effect
    plane: Landscape
    race: Race
    bends: dict[str, list[DispersionError]]
    inverse: DispersionError
    blindness: B2Sensitivity

    @property
    def true(self) -> dict[str, float]:
        """Of the nine parameters, at the paper's final values: a relaxing felt has no μ."""
        return self.tables["full"].measurement.true

    @property
    def origin(self) -> Stroke:
        """The velocity from which others are predicted."""
        return self.strokes[self.plan.origin]


def compute(plan: Plan, seed: int, progress: Callable[[str, float], None]) -> Findings:
    """Run all studies; the same seed gives the same findings."""
    done, count = 0, 7 + len(plan.velocities) + plan.repeats + len(plan.effects)

    def tick(stage: str) -> None:
        nonlocal done
        progress(stage, min(done / count, 0.99))
        done += 1

    def fits(stage: str, lab: SyntheticMeasurement, velocity: float, recipes: tuple[str, ...], *start: float) -> Stroke:
        tick(stage)
        stroke = measured(lab, velocity, seed, *start)
        results = {recipe: fitted(stroke, recipe, seed, plan.annealing, plan.tries) for recipe in recipes}
        notes = {"initial": results[recipes[0]].initial.note} | {r: one.fitted.note for r, one in results.items()}
        return stroke.with_sounds({name: stroke.played(note) for name, note in notes.items()}, **results)

    tick("the direct problem")
    struck, needed = [strike(v) for v in VELOCITIES], mass_for_contact(LONG, VELOCITIES[len(VELOCITIES) // 2])
    tick("κ through the grid")
    bent = {"fitted to band 2": bends(BAND2), f"fitted to partials 1 to {ALL[-1]}": bends(ALL)}
    tick("the criterion over b2")
    blind = blindness(plan.ideal(), seed, repeats=plan.noises, values=plan.losses)
    every, printed = (*STRINGS, "global", "default"), (PRINTED["final"]["v_H0"], PRINTED["initial"]["v_H0"])
    by_table = {
        name: fits(f"tables: {name} laboratory", lab, printed[0], recipes, printed[1])
        for name, lab, recipes in (("ideal", plan.ideal(), ("paper", "default")), ("full", plan.laboratory, every))
    }
    strokes = {
        v: fits(f"a stroke of {v:g} m/s", plan.laboratory, v, every if v == plan.origin else every[:-1])
        for v in plan.velocities
    }
    origin, repeated = strokes[plan.origin], {recipe: [] for recipe in STRINGS}
    for n in range(1, plan.repeats + 1):
        tick(f"repeated measurement {n} of {plan.repeats}")
        stroke = measured(plan.laboratory, plan.origin, seed + n)
        for recipe, rows in repeated.items():
            rows.append(values_of(fitted(stroke, recipe, seed + n, plan.annealing)))
    effects = {
        name: fits(f"effects: {name}", plan.ideal(**EFFECTS[name]), plan.origin, plan.effect_recipes)
        for name in plan.effects
    }
    tick("band 3, the landscape")
    problem = hammers(origin)
    plane = landscape(problem, plan.grid)
    tick("band 3, the searches")
    return Findings(
        seed=seed, plan=plan, strikes=struck, needed_mass=needed, tables=by_table, strokes=strokes,
        predictions={v: _predicted(origin, stroke) for v, stroke in strokes.items() if stroke is not origin},
        repeated=repeated, effects=effects | {"all": origin}, plane=plane,
        race=race(problem, plan.starts, seed, iterations=plan.iterations, evaluations=plan.evaluations),
        bends=bent, inverse=inverse_bend(BAND2), blindness=blind,
    )  # fmt: skip


def _predicted(origin: Stroke, other: Stroke) -> Stroke:
    """The three-band fits at `origin`, struck as the sensor read it at the other velocity."""
    nearest, size = origin.sounds["measured"], len(other.sounds["measured"])
    notes = {r: origin.results[r].fitted.note.with_velocity(other.measurement.nominal_velocity) for r in STRINGS}
    sounds = {recipe: other.played(note) for recipe, note in notes.items()} | {"initial": other.sounds["initial"]}
    return other.with_sounds(sounds | {"nearest": np.pad(nearest, (0, max(size - len(nearest), 0)))[:size]})


def spread_of(rows: list[dict[str, float]]) -> dict[str, float]:
    """Standard deviation of each parameter over repeated fits, relative."""
    return {name: float(np.std(np.log([row[name] for row in rows]), ddof=1)) for name in FIT_NAMES}
