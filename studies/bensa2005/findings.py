"""All computations of the page: fits of synthetic measurements (paper V), and the other studies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from pianofit.parameters import FIT_NAMES

from .direct import VELOCITIES, Strike, mass_for_contact, strike
from .hammer_search import CriterionPlane, SearchComparison, criterion_plane, hammer_search, search_comparison
from .laboratory import FINAL, INITIAL, SyntheticMeasurement, values_by_name
from .limits import (
    ALL,
    BAND2,
    B2Sensitivity,
    DispersionError,
    b2_sensitivity,
    dispersion_errors,
    inverse_dispersion_error,
)
from .strokes import Stroke, fitted, measured, values_of

__all__ = ["FULL", "PRINTED", "QUICK", "STRINGS", "Findings", "Plan", "compute", "spread_of"]

# The paper's three steps, and its third step on a string determined from the partials.
STRINGS = ("paper", "read")
LONG = 3e-3  # duration of the contact that the paper gives, s
NOISE_DB = 60.0  # the default of the laboratory, also for the ideal one
# Effects that the paper's model does not describe. Each is added alone to the noise.
EFFECTS: dict[str, dict[str, Any]] = {
    "none": {},
    "second polarisation": {"polarisation": True},
    "compliant bridge": {"bridge": True},
    "relaxing felt": {"felt": "memory"},
}
# Tables II and III as printed. The paper gives no initial κ.
PRINTED = {
    "initial": {name: value for name, value in values_by_name(INITIAL).items() if name != "kappa"},
    "final": values_by_name(FINAL),
}


@dataclass(frozen=True)
class Plan:
    """Sizes of the studies. Velocities in m/s."""

    # The paper's Figure 6 is at 0.84 and Figure 7 at 1.1; its authors' page has 0.618, 0.844 and 1.299; its recordings
    # end at 2.3.
    velocities: tuple[float, ...] = (0.618, 0.844, 1.1, 1.299, 2.3)
    origin: float = 0.844  # from which the others are predicted
    waveform: float = 1.1
    listening: tuple[float, ...] = (0.618, 0.844, 1.299)  # velocities of the listening test
    repeats: int = 4
    effects: tuple[str, ...] = tuple(EFFECTS)
    effect_recipes: tuple[str, ...] = (*STRINGS, "default")
    annealing: int | None = None  # evaluations of the recipe `paper`; its default if None
    tries: int = 2  # annealings per fit, of which the best is used; 1 for repeated measurements
    # Band 3: points of the landscape along each side, starts, iterations of the gradient, evaluations of an annealing.
    grid: int = 49
    starts: int = 12
    iterations: int = 400
    evaluations: int = 10_000
    noises: int = 5  # measurements for b2 that differ only in their noise
    losses: int = 36  # values of b2
    seconds: float = SyntheticMeasurement.seconds  # length of a measurement, s
    contact_rate: float = SyntheticMeasurement.contact_rate  # Hz

    @property
    def laboratory(self) -> SyntheticMeasurement:
        """The laboratory with all effects."""
        return SyntheticMeasurement(noise_db=NOISE_DB, seconds=self.seconds, contact_rate=self.contact_rate)

    def ideal(self, **switches: Any) -> SyntheticMeasurement:
        """Return the paper's own model with noise and with only the effects in `switches`."""
        return SyntheticMeasurement.ideal(
            noise_db=NOISE_DB, seconds=self.seconds, contact_rate=self.contact_rate, **switches
        )


FULL = Plan()
QUICK = Plan(
    velocities=(0.844, 1.1),
    listening=(0.844,),
    repeats=2,
    effects=("none", "relaxing felt"),
    effect_recipes=STRINGS,
    grid=13,
    starts=2,
    iterations=10,
    evaluations=640,
    noises=2,
    losses=8,
    annealing=500,
    tries=1,
    seconds=1.0,
    contact_rate=2e5,
)


@dataclass(frozen=True)
class Findings:
    """Results of all studies."""

    seed: int
    plan: Plan
    strikes: list[Strike]
    needed_mass: float  # hammer mass for a contact of `LONG`, kg
    tables: dict[str, Stroke]  # II and III: laboratory -> measurement with the paper's final values, and its fits
    strokes: dict[float, Stroke]  # at the velocities of the plan
    # Predictions from the fits at `plan.origin`. The sound `nearest` is the recording at `plan.origin`.
    predictions: dict[float, Stroke]
    repeated: dict[str, list[dict[str, float]]]  # recipe -> fitted values of each measurement
    effects: dict[str, Stroke]  # laboratory with this effect only
    plane: CriterionPlane
    search_comparison: SearchComparison
    dispersion_errors: dict[str, list[DispersionError]]
    inverse: DispersionError
    b2_sensitivity: B2Sensitivity

    @property
    def true(self) -> dict[str, float]:
        """True parameters, the paper's final values; without μ for a relaxing felt."""
        return self.tables["full"].measurement.true

    @property
    def origin(self) -> Stroke:
        """The velocity from which others are predicted."""
        return self.strokes[self.plan.origin]


def compute(plan: Plan, seed: int, progress: Callable[[str, float], None]) -> Findings:
    """Run all studies. The same seed gives the same findings."""
    done, count = 0, 7 + len(plan.velocities) + plan.repeats + len(plan.effects)

    def tick(stage: str) -> None:
        nonlocal done
        progress(stage, min(done / count, 0.99))
        done += 1

    def fits(stage: str, lab: SyntheticMeasurement, velocity: float, recipes: tuple[str, ...], *start: float) -> Stroke:
        tick(stage)
        stroke = measured(lab, velocity, seed, *start)
        results = {recipe: fitted(stroke, recipe, seed, plan.annealing, plan.tries) for recipe in recipes}
        notes = {"initial": results[recipes[0]].initial.note} | {r: fit.fitted.note for r, fit in results.items()}
        return stroke.with_sounds({name: stroke.played(note) for name, note in notes.items()}, **results)

    tick("the direct problem")
    struck, needed = [strike(v) for v in VELOCITIES], mass_for_contact(LONG, VELOCITIES[len(VELOCITIES) // 2])
    tick("bias of κ by the grid")
    by_partials = {"fitted to band 2": BAND2, f"fitted to partials 1 to {ALL[-1]}": ALL}
    biased = {label: dispersion_errors(number) for label, number in by_partials.items()}
    tick("the criterion over b2")
    blind = b2_sensitivity(plan.ideal(), seed, repeats=plan.noises, values=plan.losses)
    all_recipes, printed = (*STRINGS, "global", "default"), (PRINTED["final"]["v_H0"], PRINTED["initial"]["v_H0"])
    by_table = {
        name: fits(f"tables: {name} laboratory", lab, printed[0], recipes, printed[1])
        for name, lab, recipes in (
            ("ideal", plan.ideal(), ("paper", "default")),
            ("full", plan.laboratory, all_recipes),
        )
    }
    strokes = {
        v: fits(f"a stroke of {v:g} m/s", plan.laboratory, v, all_recipes if v == plan.origin else all_recipes[:-1])
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
    problem = hammer_search(origin)
    plane = criterion_plane(problem, plan.grid)
    tick("band 3, the searches")
    return Findings(
        seed=seed,
        plan=plan,
        strikes=struck,
        needed_mass=needed,
        tables=by_table,
        strokes=strokes,
        predictions={v: _predicted(origin, stroke) for v, stroke in strokes.items() if stroke is not origin},
        repeated=repeated,
        effects=effects | {"all": origin},
        plane=plane,
        search_comparison=search_comparison(
            problem, plan.starts, seed, iterations=plan.iterations, evaluations=plan.evaluations
        ),
        dispersion_errors=biased,
        inverse=inverse_dispersion_error(BAND2),
        b2_sensitivity=blind,
    )


def _predicted(origin: Stroke, other: Stroke) -> Stroke:
    """Return the three-band fits at `origin`, with the sensor's reading of the other velocity."""
    nearest, size = origin.sounds["measured"], len(other.sounds["measured"])
    notes = {r: origin.results[r].fitted.note.with_velocity(other.measurement.nominal_velocity) for r in STRINGS}
    sounds = {recipe: other.played(note) for recipe, note in notes.items()} | {"initial": other.sounds["initial"]}
    return other.with_sounds(sounds | {"nearest": np.pad(nearest, (0, max(size - len(nearest), 0)))[:size]})


def spread_of(rows: list[dict[str, float]]) -> dict[str, float]:
    """Return the relative standard deviation of each parameter over repeated fits."""
    return {name: float(np.std(np.log([row[name] for row in rows]), ddof=1)) for name in FIT_NAMES}
