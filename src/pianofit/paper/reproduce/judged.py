"""The paper's claims, laid on what was found."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from . import claims
from .band3 import WITHIN
from .cases import RECIPES, rms, values_of
from .claims import Claim, or_else
from .studies import PRINTED, STRINGS, Findings, spread_of

__all__ = ["SPANS", "THREE", "WHOLE", "judge"]

SEVENTH = 7  # the paper's "first seven components"
SPANS = ((0.0, 0.015), (0.040, 0.055))  # s, of Figure 7
THREE = RECIPES["paper"]
WHOLE = RECIPES["global"]


def judge(f: Findings) -> dict[str, Claim]:
    """Every claim by the name of its rule, in the order of the page."""
    full, run = f.tables["full"], f.race
    velocity, contact, hardest = [s.velocity for s in f.strikes], [s.contact for s in f.strikes], f.strikes[-1]
    reached = {kind: run.reached(kind) for kind in ("gradient", "squares", "annealed", "polished")}
    found = {recipe: values_of(full.results[recipe]) for recipe in STRINGS}
    printed = {name: PRINTED["final"][name] for name in PRINTED["initial"]}
    return {
        "contact_lasts": claims.contact_lasts(velocity, contact, f.hammer_mass, f.needed_mass),
        "contact_shortens": claims.contact_shortens(velocity, contact),
        "reflections": claims.reflections(velocity, [s.humps for s in f.strikes], f.trip),
        "felt_loses": claims.felt_loses(hardest.loop, hardest.balance, hardest.hammer_energy),
        "brighter": claims.brighter(velocity, [s.centroid for s in f.strikes]),
        "string_found": claims.string_found(full.true, found["paper"], f.origin.case.shares()),
        "changes_as_printed": _either(lambda r: claims.changes_as_printed(PRINTED["initial"], printed, found[r])),
        "local_minima": claims.local_minima([m.cost for m in f.plane.minima], [m.cost for m in run.minima]),
        "annealing_escapes": claims.annealing_escapes(len(run.start), reached, WITHIN),
        "high_partials_differ": _either(lambda recipe: _partials(f, RECIPES[recipe])),
        "waveforms_nearer": _either(lambda recipe: _waveform(f, RECIPES[recipe])),
        "three_bands_better": _either(lambda recipe: _kept(f, RECIPES[recipe])),
        "predicts": _either(lambda recipe: _predicts(f, recipe)),
        "repeats": _either(lambda recipe: claims.repeats(spread_of(f.repeated[recipe]), f.plan.repeats)),
        "explained": _either(lambda recipe: _explained(f, recipe)),
        "bends_kappa": _kappa(f),
        "b2_seen": _b2(f),
    }


def _either(claim: Callable[[str], Claim]) -> Claim:
    """By the three bands, or else with the string read."""
    return or_else(*(claim(recipe) for recipe in STRINGS))


def _partials(f: Findings, name: str) -> Claim:
    """What Figure 6 shows, of one of the sounds."""
    partial, off = f.origin.case.level_differences(f.origin.sounds[name])
    high = off[partial > SEVENTH]
    return claims.high_partials_differ(rms(off[partial <= SEVENTH]), rms(high), float(high.mean()))


def _waveform(f: Findings, name: str) -> Claim:
    """What Figure 7 shows, of one of the sounds."""
    wave = f.at(f.plan.waveform)
    shown = int(SPANS[-1][1] * wave.case.recording.rate)
    measured, initial, fitted = (wave.sounds[n][:shown] for n in ("measured", "initial", name))
    return claims.waveforms_nearer(*(rms(x - measured) / rms(measured) for x in (initial, fitted)))


def _kept(f: Findings, three: str) -> Claim:
    """Relative errors of attack time and centroid over velocities, of a three-band fit and of the global criterion."""

    def off(measure: str, name: str) -> list[float]:
        return [getattr(s.closeness[name], measure) / getattr(s.closeness["measured"], measure) - 1 for s in f.strokes]

    errors = {measure: {THREE: off(measure, three), WHOLE: off(measure, WHOLE)} for measure in ("attack", "centroid")}
    return claims.three_bands_better(errors, [stroke.case.velocity for stroke in f.strokes])


def _predicts(f: Findings, recipe: str) -> Claim:
    errors = ([p.closeness[kind].level_db for p in f.predictions] for kind in (recipe, "initial", "nearest"))
    return claims.predicts([p.velocity for p in f.predictions], f.plan.origin, *errors)


def _explained(f: Findings, recipe: str) -> Claim:
    left = {one.name: one.closeness[recipe].criterion["band3"] for one in f.effects}
    everything, nothing = left.pop("all"), left.pop("none")
    return claims.explained(left, everything, nothing)


def _kappa(f: Findings) -> Claim:
    worst = f.bends["fitted to band 2"][0]
    return claims.bends_kappa(worst.kappa_true, worst.kappa, f.inverse.kappa, worst.points, worst.rate)


def _b2(f: Findings) -> Claim:
    seen, band = f.blindness, "band2"
    curve, noise = seen.criterion[band], seen.spread[band]
    at = float(np.interp(np.log(seen.true), np.log(seen.b2), curve))
    above = np.flatnonzero((curve - at > noise) & (seen.b2 > seen.true))
    visible = float(seen.b2[above[0]]) if above.size else None
    remains = f.origin.closeness[THREE].criterion[band]
    return claims.b2_seen(seen.true, abs(at - float(curve[0])), noise, remains, visible, float(seen.b2[-1]))
