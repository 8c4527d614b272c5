"""The paper's claims, laid on what was found."""

from __future__ import annotations

import numpy as np

from . import claims
from .band3 import WITHIN
from .cases import RECIPES, rms
from .claims import Claim, or_else
from .studies import STRINGS, Findings, spread_of

__all__ = ["SPANS", "THREE", "WHOLE", "judge"]

SEVENTH = 7  # the paper's "first seven components"
SPANS = ((0.0, 0.015), (0.040, 0.055))  # s, of Figure 7
THREE = RECIPES["paper"]
WHOLE = RECIPES["global"]


def judge(f: Findings) -> dict[str, Claim]:
    """Every claim by the name of its rule, in the order of the page."""
    return _direct(f) | _searches(f) | _results(f) | _limits(f)


def _direct(f: Findings) -> dict[str, Claim]:
    velocity, contact = [s.velocity for s in f.strikes], [s.contact for s in f.strikes]
    hardest = f.strikes[-1]
    return {
        "contact_lasts": claims.contact_lasts(velocity, contact, f.hammer_mass, f.needed_mass),
        "contact_shortens": claims.contact_shortens(velocity, contact),
        "reflections": claims.reflections(velocity, [s.humps for s in f.strikes], f.trip),
        "felt_loses": claims.felt_loses(hardest.loop, hardest.balance, hardest.hammer_energy),
        "brighter": claims.brighter(velocity, [s.centroid for s in f.strikes]),
    }


def _searches(f: Findings) -> dict[str, Claim]:
    t, run = f.tables, f.race
    found = [t.found[f"full: {RECIPES[recipe]}"] for recipe in STRINGS]
    printed = {name: value for name, value in t.printed_final.items() if name in t.printed_initial}
    reached = {kind: run.reached(kind) for kind in ("gradient", "squares", "annealed", "polished")}
    return {
        "string_found": claims.string_found(t.true, found[0], f.origin.case.shares()),
        "changes_as_printed": or_else(*(claims.changes_as_printed(t.printed_initial, printed, x) for x in found)),
        "local_minima": claims.local_minima([m.cost for m in f.plane.minima], [m.cost for m in run.minima]),
        "annealing_escapes": claims.annealing_escapes(len(run.start), reached, WITHIN),
    }


def _results(f: Findings) -> dict[str, Claim]:
    """Each by the three bands, or else with the string read."""
    both = [(recipe, RECIPES[recipe]) for recipe in STRINGS]
    velocities = [stroke.case.velocity for stroke in f.strokes]
    return {
        "high_partials_differ": or_else(*(_partials(f, name) for _, name in both)),
        "waveforms_nearer": or_else(*(_waveform(f, name) for _, name in both)),
        "three_bands_better": or_else(*(claims.three_bands_better(_errors(f, name), velocities) for _, name in both)),
        "predicts": or_else(*(_predicts(f, recipe) for recipe, _ in both)),
        "repeats": or_else(*(claims.repeats(spread_of(f.repeated[recipe]), f.plan.repeats) for recipe, _ in both)),
        "explained": or_else(*(_explained(f, recipe) for recipe, _ in both)),
    }


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


def _errors(f: Findings, three: str) -> dict[str, dict[str, list[float]]]:
    """Relative errors of attack time and centroid over velocities, of a three-band fit and of the global criterion."""

    def off(measure: str, name: str) -> list[float]:
        return [getattr(s.closeness[name], measure) / getattr(s.closeness["measured"], measure) - 1 for s in f.strokes]

    return {measure: {THREE: off(measure, three), WHOLE: off(measure, WHOLE)} for measure in ("attack", "centroid")}


def _predicts(f: Findings, recipe: str) -> Claim:
    rows = [(p.predicted[recipe].level_db, p.initial.level_db, p.nearest.level_db) for p in f.predictions]
    return claims.predicts([p.velocity for p in f.predictions], f.plan.origin, *zip(*rows, strict=True))


def _explained(f: Findings, recipe: str) -> Claim:
    left = {one.name: one.closeness[recipe].criterion["band3"] for one in f.effects}
    everything, nothing = left.pop("all"), left.pop("none")
    return claims.explained(left, everything, nothing)


def _limits(f: Findings) -> dict[str, Claim]:
    worst, seen, band = f.bends["fitted to band 2"][0], f.blindness, "band2"
    curve, noise = seen.criterion[band], seen.spread[band]
    at = float(np.interp(np.log(seen.true), np.log(seen.b2), curve))
    above = np.flatnonzero((curve - at > noise) & (seen.b2 > seen.true))
    visible = float(seen.b2[above[0]]) if above.size else None
    remains = f.origin.closeness[THREE].criterion[band]
    return {
        "bends_kappa": claims.bends_kappa(worst.kappa_true, worst.kappa, f.inverse.kappa, worst.points, worst.rate),
        "b2_seen": claims.b2_seen(seen.true, abs(at - float(curve[0])), noise, remains, visible, float(seen.b2[-1])),
    }
