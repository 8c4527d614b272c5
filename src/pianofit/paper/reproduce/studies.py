"""Everything that the page says, computed: fits of the laboratory's measurements (paper V), and the studies beside."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ...inference import Result
from ...parameters import FIT_NAMES
from ...published import preset
from ..laboratory import FINAL, INITIAL, Laboratory, chosen
from .band3 import Landscape, Race, hammers, landscape, race
from .cases import RECIPES, Case, Closeness, fitted, make_case, values_of
from .direct import NOTE, VELOCITIES, Strike, mass_for_contact, round_trip, strikes
from .limits import ALL, BAND2, Bend, Blindness, bends, blindness, inverse_bend

__all__ = [
    "FULL",
    "PRINTED",
    "QUICK",
    "STRINGS",
    "Effect",
    "Findings",
    "Plan",
    "Prediction",
    "Stroke",
    "compute",
    "spread_of",
]

# The paper's process as printed, and its third step on a string that was read.
STRINGS = ("paper", "read")
ALL_RECIPES = (*STRINGS, "global", "default")
LONG = 3e-3  # s, the contact that the paper names
NOISE_DB = 60.0  # the laboratory's own, and left in the ideal one
# What the laboratory has and the paper's model has not, each to be tried alone beside the noise.
EFFECTS: dict[str, dict[str, Any]] = {
    "second polarisation": {"polarisation": True},
    "yielding bridge": {"bridge": True},
    "relaxing felt": {"felt": "memory"},
}

# Tables II and III as printed; initially the paper has no κ.
PRINTED = {
    column: {n: float(v) for n, v in zip(FIT_NAMES, (*it.string, *it.hammer), strict=True) if n not in missing}
    for column, it, missing in (("initial", INITIAL, ("kappa",)), ("final", FINAL, ()))
}

Tick = Callable[[str], None]


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
    effect_recipes: tuple[str, ...] = ("paper", "read", "default")
    annealing: int | None = None  # evaluations of the paper's recipe; its own number if None
    tries: int = 2  # annealings for a fit, of which the best counts, but for repeated measurements
    # Band 3: points of the landscape along each side, starts, iterations of the gradient, evaluations of an annealing.
    grid: int = 49
    starts: int = 12
    iterations: int = 400
    evaluations: int = 10_000
    noises: int = 5  # measurements that differ in their noise alone, for b2
    losses: int = 36  # values of b2
    seconds: float = chosen.SECONDS  # of a measurement
    contact_rate: float = chosen.CONTACT_RATE  # Hz

    def laboratory(self) -> Laboratory:
        """The full one."""
        return Laboratory(noise_db=NOISE_DB, seconds=self.seconds, contact_rate=self.contact_rate)

    def ideal(self, **switches: Any) -> Laboratory:
        """The paper's own model and noise, but for `switches`."""
        return Laboratory.ideal(noise_db=NOISE_DB, seconds=self.seconds, contact_rate=self.contact_rate, **switches)


FULL = Plan()
QUICK = Plan(
    velocities=(0.844, 1.1), heard=(0.844,), repeats=2, effects=("relaxing felt",), effect_recipes=("paper", "read"),
    grid=13, starts=2, iterations=10, evaluations=640, noises=2, losses=8, annealing=500, tries=1, seconds=1.0,
    contact_rate=2e5,
)  # fmt: skip


class Stroke(NamedTuple):
    """One velocity: its measurement, fits by recipe, and the sounds by the names of `RECIPES`."""

    case: Case
    results: dict[str, Result]
    sounds: dict[str, np.ndarray]  # m/s, from the onset on; `measured` and `initial` too
    closeness: dict[str, Closeness]

    @property
    def true(self) -> dict[str, float]:
        """Those of the nine parameters that the laboratory has: a relaxing felt has no μ."""
        return {name: v for name, v in self.case.measurement.true.items() if name in FIT_NAMES}


class Prediction(NamedTuple):
    """A velocity that was not fitted, by the recipe of a fit at another one.

    `initial`: by the initial values; `nearest`: the recording at that other velocity, in its place.
    """

    velocity: float
    closeness: dict[str, Closeness]
    sounds: dict[str, np.ndarray]  # m/s


class Effect(NamedTuple):
    """What remains after a fit, by recipe, of a laboratory with this and no other effect."""

    name: str
    closeness: dict[str, Closeness]


@dataclass(frozen=True)
class Findings:
    """What was computed."""

    seed: int
    plan: Plan
    strikes: list[Strike]
    trip: float  # of the wave to the agraffe and back, s
    hammer_mass: float  # kg
    needed_mass: float  # for a contact of `LONG`, kg
    tables: dict[str, Stroke]  # II and III: laboratory -> the paper's final values, measured and fitted
    strokes: list[Stroke]  # the plan's velocities
    predictions: list[Prediction]
    repeated: dict[str, list[dict[str, float]]]
    effects: list[Effect]
    plane: Landscape
    race: Race
    bends: dict[str, list[Bend]]
    inverse: Bend
    blindness: Blindness

    @property
    def origin(self) -> Stroke:
        """The velocity from which others are predicted."""
        return self.at(self.plan.origin)

    def at(self, velocity: float) -> Stroke:
        """One of the plan's velocities, m/s."""
        return next(stroke for stroke in self.strokes if stroke.case.velocity == velocity)


def compute(plan: Plan, seed: int, progress: Callable[[str, float], None]) -> Findings:
    """Run all studies; the same seed gives the same findings."""
    done = 0
    count = 3 + 2 + len(plan.velocities) + plan.repeats + len(plan.effects) + 1 + 2

    def tick(stage: str) -> None:
        nonlocal done
        progress(stage, min(done / count, 0.99))
        done += 1

    tick("the direct problem")
    struck, needed = strikes(), mass_for_contact(LONG, sorted(VELOCITIES)[len(VELOCITIES) // 2])
    tick("κ through the grid")
    bent = {"fitted to band 2": bends(BAND2), f"fitted to partials 1 to {ALL[-1]}": bends(ALL)}
    tick("the criterion over b2")
    blind = blindness(plan.ideal(), seed, repeats=plan.noises, values=plan.losses)
    by_table = {}
    for name, lab, recipes in (("ideal", plan.ideal(), ("paper", "default")), ("full", plan.laboratory(), ALL_RECIPES)):
        tick(f"tables: {name} laboratory")
        case = make_case(lab, PRINTED["final"]["v_H0"], seed, start=PRINTED["initial"]["v_H0"])
        by_table[name] = _fits(plan, case, seed, recipes)
    strokes = []
    for velocity in plan.velocities:
        tick(f"a stroke of {velocity:g} m/s")
        recipes = ALL_RECIPES if velocity == plan.origin else ALL_RECIPES[:-1]
        strokes.append(_fits(plan, make_case(plan.laboratory(), velocity, seed), seed, recipes))
    origin = next(stroke for stroke in strokes if stroke.case.velocity == plan.origin)
    again = _repeated(plan, seed, tick)
    one_by_one = _effects(plan, seed, origin, tick)
    tick("band 3, the landscape")
    problem = hammers(origin.case)
    seen = landscape(problem, plan.grid)
    tick("band 3, the searches")
    run = race(problem, plan.starts, seed, iterations=plan.iterations, evaluations=plan.evaluations)
    return Findings(
        seed=seed, plan=plan, strikes=struck, trip=round_trip(), hammer_mass=float(preset(NOTE).hammer.M_H),
        needed_mass=needed, tables=by_table, strokes=strokes,
        predictions=[_prediction(origin, stroke) for stroke in strokes if stroke is not origin], repeated=again,
        effects=one_by_one, plane=seen, race=run, bends=bent, inverse=inverse_bend(BAND2), blindness=blind,
    )  # fmt: skip


def _fits(plan: Plan, case: Case, seed: int, recipes: tuple[str, ...]) -> Stroke:
    """Fit one measurement by `recipes`, and listen."""
    results = {recipe: fitted(case, recipe, seed, plan.annealing, plan.tries) for recipe in recipes}
    first = next(iter(results.values()))
    sounds = {"measured": case.heard, "initial": case.played(first.initial.note)}
    sounds |= {RECIPES[recipe]: case.played(result.fitted.note) for recipe, result in results.items()}
    return Stroke(case, results, sounds, {name: case.closeness(sound) for name, sound in sounds.items()})


def _prediction(origin: Stroke, other: Stroke) -> Prediction:
    """The three-band fits at `origin`, struck as the sensor read it at the other velocity."""
    case, heard, size = other.case, origin.case.heard, len(other.case.heard)
    struck = case.measurement.nominal_velocity
    sounds = {r: case.played(origin.results[r].fitted.note, struck) for r in STRINGS}
    sounds["nearest"] = np.pad(heard, (0, max(size - len(heard), 0)))[:size]
    closeness = {name: case.closeness(sound) for name, sound in sounds.items()}
    return Prediction(case.velocity, closeness | {"initial": other.closeness["initial"]}, sounds)


def _repeated(plan: Plan, seed: int, tick: Tick) -> dict[str, list[dict[str, float]]]:
    """The same stroke again and again, each with noise and a search of its own: recipe -> the fits' values."""
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


def _effects(plan: Plan, seed: int, full: Stroke, tick: Tick) -> list[Effect]:
    """No effect but noise; each alone; all of them."""
    strokes = {}
    for name in ("none", *plan.effects):
        tick(f"effects: {name}")
        case = make_case(plan.ideal(**EFFECTS.get(name, {})), plan.origin, seed)
        strokes[name] = _fits(plan, case, seed, plan.effect_recipes)
    return [
        Effect(name, {recipe: stroke.closeness[RECIPES[recipe]] for recipe in plan.effect_recipes})
        for name, stroke in (strokes | {"all": full}).items()
    ]
