"""Everything that the page says, computed: one study after the other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ...published import preset
from .band3 import Landscape, Race, hammers, landscape, race
from .direct import NOTE, VELOCITIES, Strike, mass_for_contact, round_trip, strikes
from .limits import ALL, BAND2, Bend, Blindness, bends, blindness, inverse_bend
from .plan import Plan
from .studies import STRINGS, Blow, Effect, Prediction, Tables, blow_at, effects, predictions, repeated, tables

__all__ = ["LONG", "Findings", "compute"]

LONG = 3e-3  # s, the contact that the paper names


@dataclass(frozen=True)
class Findings:
    """What was computed."""

    seed: int
    plan: Plan
    strikes: list[Strike]
    trip: float  # of the wave to the agraffe and back, s
    hammer_mass: float  # kg
    needed_mass: float  # for a contact of `LONG`, kg
    tables: Tables
    blows: list[Blow]  # the plan's velocities
    predictions: list[Prediction]
    repeated: dict[str, list[dict[str, float]]]
    effects: list[Effect]
    plane: Landscape
    race: Race
    bends: dict[str, list[Bend]]
    inverse: Bend
    blindness: Blindness

    @property
    def origin(self) -> Blow:
        """The velocity from which others are predicted."""
        return next(blow for blow in self.blows if blow.case.velocity == self.plan.origin)

    @property
    def waveform(self) -> Blow:
        """The velocity whose waveforms are shown."""
        return next(blow for blow in self.blows if blow.case.velocity == self.plan.waveform)


def compute(plan: Plan, seed: int, progress: Callable[[str, float], None]) -> Findings:
    """Run all studies; the same seed gives the same findings."""
    done = 0
    count = 3 + 6 + len(plan.velocities) + plan.repeats + len(plan.effects) + 1 + 2

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
    by_table = tables(plan, seed, tick)
    blows = []
    for velocity in plan.velocities:
        tick(f"a blow of {velocity:g} m/s")
        recipes = (*STRINGS, "global", "default") if velocity == plan.origin else (*STRINGS, "global")
        blows.append(blow_at(plan, plan.laboratory(), velocity, seed, recipes))
    origin = next(blow for blow in blows if blow.case.velocity == plan.origin)
    again = repeated(plan, seed, tick)
    one_by_one = effects(plan, seed, origin, tick)
    tick("band 3, the landscape")
    problem = hammers(origin.case)
    seen = landscape(problem, plan.grid)
    tick("band 3, the searches")
    run = race(problem, plan.starts, seed, iterations=plan.iterations, evaluations=plan.evaluations)
    return Findings(
        seed=seed, plan=plan, strikes=struck, trip=round_trip(), hammer_mass=float(preset(NOTE).hammer.M_H),
        needed_mass=needed, tables=by_table, blows=blows,
        predictions=predictions(origin, [blow for blow in blows if blow is not origin]), repeated=again,
        effects=one_by_one, plane=seen, race=run, bends=bent, inverse=inverse_bend(BAND2), blindness=blind,
    )  # fmt: skip
