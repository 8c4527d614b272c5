"""The paper's claims, laid on what was found; where the string matters, also with the string read off its partials."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from . import claims
from .band3 import WITHIN
from .cases import rms, values_of
from .claims import Claim, or_else
from .direct import NOTE, ROUND_TRIP
from .studies import PRINTED, STRINGS, Findings, spread_of

__all__ = ["SPANS", "judge"]

SEVENTH = 7  # the paper's "first seven components"
SPANS = ((0.0, 0.015), (0.040, 0.055))  # s, of Figure 7


def judge(f: Findings) -> dict[str, Claim]:
    """Every claim by the name of its rule, in the order of the page."""
    velocity, contact, hardest = [s.velocity for s in f.strikes], [s.contact for s in f.strikes], f.strikes[-1]
    found = {recipe: values_of(f.tables["full"].results[recipe]) for recipe in STRINGS}
    printed = {name: PRINTED["final"][name] for name in PRINTED["initial"]}
    bent = f.bends["fitted to band 2"][0]
    reached = {method: f.race.reached(method) for method in f.race.ends}
    return {
        "contact_lasts": claims.contact_lasts(velocity, contact, float(NOTE.hammer.M_H), f.needed_mass),
        "contact_shortens": claims.contact_shortens(velocity, contact),
        "reflections": claims.reflections(velocity, [s.humps for s in f.strikes], ROUND_TRIP),
        "felt_loses": claims.felt_loses(hardest.loop, hardest.balance, hardest.hammer_energy),
        "brighter": claims.brighter(velocity, [s.centroid for s in f.strikes]),
        "string_found": claims.string_found(f.true, found["paper"], f.origin.case.shares()),
        "changes_as_printed": _either(lambda r: claims.changes_as_printed(PRINTED["initial"], printed, found[r])),
        "local_minima": claims.local_minima([m.cost for m in f.plane.minima], [m.cost for m in f.race.minima]),
        "annealing_escapes": claims.annealing_escapes(f.plan.starts, reached, WITHIN),
        "high_partials_differ": _either(lambda recipe: _partials(f, recipe)),
        "waveforms_nearer": _either(lambda recipe: _waveform(f, recipe)),
        "three_bands_better": _either(lambda recipe: _kept(f, recipe)),
        "predicts": _either(lambda recipe: _predicts(f, recipe)),
        "repeats": _either(lambda recipe: claims.repeats(spread_of(f.repeated[recipe]), f.plan.repeats)),
        "explained": _either(lambda recipe: _explained(f, recipe)),
        "bends_kappa": claims.bends_kappa(bent.kappa_true, bent.kappa, f.inverse.kappa, bent.points, bent.rate),
        "b2_seen": _b2(f),
    }


def _either(claim: Callable[[str], Claim]) -> Claim:
    """By the three bands, or else with the string read."""
    return or_else(*(claim(recipe) for recipe in STRINGS))


def _partials(f: Findings, recipe: str) -> Claim:
    """What Figure 6 shows."""
    partial, off = f.origin.case.level_differences(f.origin.sounds[recipe])
    high = off[partial > SEVENTH]
    return claims.high_partials_differ(rms(off[partial <= SEVENTH]), rms(high), float(high.mean()))


def _waveform(f: Findings, recipe: str) -> Claim:
    """What Figure 7 shows."""
    wave = f.strokes[f.plan.waveform]
    shown = int(SPANS[-1][1] * wave.case.recording.rate)
    measured, initial, fitted = (wave.sounds[name][:shown] for name in ("measured", "initial", recipe))
    return claims.waveforms_nearer(*(rms(x - measured) / rms(measured) for x in (initial, fitted)))


def _kept(f: Findings, three: str) -> Claim:
    """Relative errors of attack time and centroid over velocities, of a three-band fit and of the global criterion."""
    near = [stroke.closeness for stroke in f.strokes.values()]
    errors = {
        measure: {
            name: [getattr(one[recipe], measure) / getattr(one["measured"], measure) - 1 for one in near]
            for name, recipe in (("three bands", three), ("global criterion", "global"))
        }
        for measure in ("attack", "centroid")
    }
    return claims.three_bands_better(errors, [*f.strokes])


def _predicts(f: Findings, recipe: str) -> Claim:
    near = [stroke.closeness for stroke in f.predictions.values()]
    errors = ([one[kind].level_db for one in near] for kind in (recipe, "initial", "nearest"))
    return claims.predicts([*f.predictions], f.plan.origin, *errors)


def _explained(f: Findings, recipe: str) -> Claim:
    left = {name: stroke.closeness[recipe].criterion["band3"] for name, stroke in f.effects.items()}
    everything, nothing = left.pop("all"), left.pop("none")
    return claims.explained(left, everything, nothing)


def _b2(f: Findings) -> Claim:
    seen = f.blindness
    curve, noise = seen.criterion["band2"], seen.spread["band2"]
    at = float(np.interp(np.log(seen.true), np.log(seen.b2), curve))
    above = seen.b2[(curve - at > noise) & (seen.b2 > seen.true)].tolist()
    remains = f.origin.closeness["paper"].criterion["band2"]
    return claims.b2_seen(seen.true, abs(at - float(curve[0])), noise, remains, (*above, None)[0], float(seen.b2[-1]))
