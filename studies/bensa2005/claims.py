"""Rules that decide from the findings of one run whether each claim of the paper is confirmed.

A rule returns one truth value for each part of its claim, as its docstring defines, and the numbers that the page
shows with it. The text of the page is in `index.html.j2`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from .direct import ROUND_TRIP
from .findings import PRINTED, STRINGS, Findings, spread_of
from .strokes import rms, values_of

__all__ = ["CLAIMS", "SPANS", "WORDS", "Claim", "Verdict", "judge"]

WORDS = {"yes": "confirmed", "part": "confirmed in part", "no": "not confirmed"}
SPANS = ((0.0, 0.015), (0.040, 0.055))  # s, of Figure 7
SEVENTH = 7  # the paper's "first seven components"
# A parameter with at most this relative change counts as unchanged;
MOVED = 0.005
# for p the paper itself says that it hardly changed.
STILL = {"p": 0.05}
# Largest relative error of a fitted string parameter that counts as found.
NEAR = {"c": 1e-3, "kappa": 0.05, "b1": 0.2}
# Largest standard deviation of a parameter's logarithm over repeated measurements that counts as similar.
ALIKE = 0.05


@dataclass(frozen=True)
class Verdict:
    """Outcome of one rule."""

    parts: list[Any]  # truth value of each part of the claim
    numbers: dict[str, Any] = field(default_factory=dict)

    @property
    def outcome(self) -> str:
        """A key of `WORDS`."""
        return "yes" if all(self.parts) else "part" if any(self.parts) else "no"

    @property
    def word(self) -> str:
        """Outcome in words."""
        return WORDS[self.outcome]


class Claim(NamedTuple):
    """One claim of the paper and its outcome."""

    text: str
    where: str  # section, figure or table of the paper
    verdict: Verdict
    read: Verdict | None  # with the string determined from the partials, if tested and the first is not confirmed


def judge(f: Findings) -> dict[str, Claim]:
    """Return every claim by the name of its rule.

    A claim about fits is tested with the three steps of the paper. If they do not confirm it, the outcome on the string
    that was determined from the partials is added.
    """
    claims = {}
    for rule, (where, text) in CLAIMS.items():
        by_fit = rule in OF_FITS
        verdict = rule(f, STRINGS[0]) if by_fit else rule(f)
        read = rule(f, STRINGS[1]) if by_fit and verdict.outcome != "yes" else None
        claims[rule.__name__] = Claim(text, where, verdict, read)
    return claims


# --- the direct problem -----------------------------------------------------------------------------------------------


def contact_lasts(f: Findings) -> Verdict:
    """Nearer to 3 than to 2 or 4 ms."""
    return Verdict([2.5e-3 <= stroke.contact < 3.5e-3 for stroke in f.strikes])


def contact_shortens(f: Findings) -> Verdict:
    """Each contact is shorter than that at the next lower velocity."""
    return Verdict([after.contact < before.contact for before, after in pairwise(f.strikes)])


def reflections(f: Findings) -> Verdict:
    """At 2 m/s and above, the maxima of the force are 2 x0/c apart, the travel time to the agraffe and back, ±15 %."""
    spacing = [float(np.mean(np.diff(s.maxima))) if len(s.maxima) > 1 else None for s in f.strikes]
    fast = [period for stroke, period in zip(f.strikes, spacing, strict=True) if stroke.velocity >= 2]
    visible = [period is not None and abs(period / ROUND_TRIP - 1) <= 0.15 for period in fast]
    return Verdict(visible, {"spacing": spacing})


def felt_loses(f: Findings) -> Verdict:
    """The loop ∮ F du is clockwise and equals the energy lost by hammer and string, to 1e-6 of the energy."""
    hardest = f.strikes[-1]
    return Verdict([hardest.loop > 0, abs(hardest.loop - hardest.balance) <= 1e-6 * hardest.hammer_energy])


def brighter(f: Findings) -> Verdict:
    """Each centroid is higher than that at the next lower velocity."""
    return Verdict([after.centroid > before.centroid for before, after in pairwise(f.strikes)])


# --- the fits ---------------------------------------------------------------------------------------------------------


def string_found(f: Findings) -> Verdict:
    """c, κ and b1 lie within `NEAR` of the true values."""
    found = values_of(f.tables["full"].results["paper"])
    off = {name: abs(found[name] / f.true[name] - 1) for name in NEAR}
    strongest, share = max(f.origin.shares()["band2"].items(), key=lambda item: item[1])
    numbers = {"off": off, "strongest": strongest, "share": share}
    return Verdict([off[name] <= near for name, near in NEAR.items()], numbers)


def changes_as_printed(f: Findings, recipe: str) -> Verdict:
    """Every parameter changed from its start as in the paper: up, down, or hardly at all (`MOVED`, `STILL`)."""
    initial, printed, found = PRINTED["initial"], PRINTED["final"], values_of(f.tables["full"].results[recipe])

    def direction(name: str, after: float) -> float:
        share = after / initial[name] - 1
        return 0.0 if abs(share) <= STILL.get(name, MOVED) else np.sign(share)

    same = {name: direction(name, found[name]) == direction(name, printed[name]) for name in initial}
    return Verdict([*same.values()], {"same": same, "initial": initial, "printed": printed, "found": found})


def local_minima(f: Findings) -> Verdict:
    """There is more than one minimum in the plane shown, and more than one over all five parameters."""
    return Verdict([len(f.plane.minima) > 1, len(f.search_comparison.minima) > 1])


def annealing_escapes(f: Findings) -> Verdict:
    """The gradient fails from some starts, and the annealing from none.

    A search fails if it does not end within the factor `WITHIN` of the lowest criterion of all searches.
    """
    gradient, annealed = (f.search_comparison.successes(method) for method in ("gradient", "annealed"))
    return Verdict([gradient < f.plan.starts, annealed == f.plan.starts])


def high_partials_differ(f: Findings, recipe: str) -> Verdict:
    """The levels of the first seven partials agree to 1 dB rms, and those above differ more."""
    partial, off = f.origin.level_differences(f.origin.sounds[recipe])
    low, high = off[partial <= SEVENTH], off[partial > SEVENTH]
    numbers = {"low_db": rms(low), "high_db": rms(high), "excess_db": float(high.mean())}
    return Verdict([rms(low) <= 1.0, rms(high) > rms(low)], numbers)


def waveforms_nearer(f: Findings, recipe: str) -> Verdict:
    """The fit more than halves the difference from the measured waveform, relative to the rms of that waveform."""
    wave = f.strokes[f.plan.waveform]
    shown = int(SPANS[-1][1] * wave.recording.rate)
    measured, initial, fitted = (wave.sounds[name][:shown] for name in ("measured", "initial", recipe))
    before, after = (rms(x - measured) / rms(measured) for x in (initial, fitted))
    return Verdict([after < 0.5 * before], {"before": before, "after": after})


def three_bands_better(f: Findings, recipe: str) -> Verdict:
    """In both measures, three bands have a smaller mean error over the velocities than the global criterion."""
    sounds = [stroke.closeness for stroke in f.strokes.values()]

    def errors(sound: str, measure: str) -> np.ndarray:
        return np.array([getattr(c[sound], measure) / getattr(c["measured"], measure) - 1 for c in sounds])

    three, whole = ({m: np.abs(errors(x, m)) for m in ("attack", "centroid")} for x in (recipe, "global"))
    numbers = {"three": three, "whole": whole, "lost": float(errors("global", "centroid").mean())}
    return Verdict([three[m].mean() < whole[m].mean() for m in three], numbers)


def predicts(f: Findings, recipe: str) -> Verdict:
    """At each other velocity, the fit predicts the levels better than the initial values and than `nearest` do.

    The errors are the rms differences of the partials' levels, dB. `nearest` is the recording at the fitted velocity.
    """
    predicted, initial, nearest = (
        [stroke.closeness[sound].level_db for stroke in f.predictions.values()]
        for sound in (recipe, "initial", "nearest")
    )
    better = [p < i and p < n for p, i, n in zip(predicted, initial, nearest, strict=True)]
    return Verdict(better, {"predicted": predicted, "initial": initial, "nearest": nearest})


def repeats(f: Findings, recipe: str) -> Verdict:
    """The standard deviation of the logarithm over the measurements is at most `ALIKE` for every parameter."""
    spread = spread_of(f.repeated[recipe])
    return Verdict([share <= ALIKE for share in spread.values()], {"spread": spread})


def explained(f: Findings, recipe: str) -> Verdict:
    """Without effects the residual is below a tenth of that with all effects, and one effect alone causes a tenth.

    The residual is the criterion in band 3 after a fit.
    """
    residuals = {name: stroke.closeness[recipe].criterion["band3"] for name, stroke in f.effects.items()}
    everything, nothing = residuals.pop("all"), residuals.pop("none")
    confirmed = [nothing < 0.1 * everything, max(residuals.values()) >= 0.1 * everything]
    return Verdict(confirmed, {"alone": residuals, "everything": everything, "nothing": nothing})


# --- limits -----------------------------------------------------------------------------------------------------------


def kappa_of_string(f: Findings) -> Verdict:
    """κ fitted with the paper's grid equals that of the string to 2 %."""
    error = f.dispersion_errors["fitted to band 2"][0]
    return Verdict([abs(error.off) <= 0.02], {"biased": error})


def b2_found(f: Findings) -> Verdict:
    """From no b2 to the paper's, the criterion of band 2 changes by more than its standard deviation by noise."""
    b2, true = f.b2_sensitivity.b2, f.b2_sensitivity.true
    curve, noise = f.b2_sensitivity.criterion["band2"], f.b2_sensitivity.spread["band2"]
    at_true = float(np.interp(np.log(true), np.log(b2), curve))
    change, above = abs(at_true - float(curve[0])), b2[(curve - at_true > noise) & (b2 > true)].tolist()
    return Verdict([change > noise], {"change": change, "noise": noise, "visible": (*above, None)[0]})


# Rule -> place in the paper, and claim, in the order of the page.
CLAIMS: dict[Callable[..., Verdict], tuple[str, str]] = {
    contact_lasts: ("III.C, Figure 2", "The contact of hammer and string lasts about 3 ms."),
    contact_shortens: ("III.C, Figure 2", "The contact is shorter when the hammer is faster."),
    reflections: ("III.C, Figure 2", "Reflections from the agraffe show in the force, at 2 and 4 m/s above all."),
    felt_loses: ("III.C, Figure 3", "Force over compression is a loop; its area is the energy lost in the felt."),
    brighter: ("III.C, Figure 4", "The sound is brighter when the hammer is faster."),
    string_found: ("IV.C, Table II", "A gradient in bands 1 and 2 finds the string."),
    changes_as_printed: (
        "V, Tables II and III",
        "The felt gets stiffer and loses more, the hammer lighter and faster, p stays; the string loses more.",
    ),
    local_minima: ("IV.C", "Band 3 has local minima."),
    annealing_escapes: ("IV.C", "A gradient alone fails from some starts where annealing does not."),
    high_partials_differ: ("V, Figure 6", "The first seven partials agree, those above differ."),
    waveforms_nearer: ("V, Figure 7", "The waveform comes clearly nearer the measured one."),
    three_bands_better: ("IV.B, VI", "Three bands keep attack and brightness better than a global criterion."),
    predicts: ("V", "Parameters from one velocity predict other velocities."),
    repeats: ("V", "Repeated measurements give very similar parameters."),
    explained: ("V, VI", "The residual after the fit comes from effects that the model does not describe."),
    kappa_of_string: ("V, Table II", "The fitted κ is that of the string."),
    b2_found: ("IV.B, Table II", "b2 is found in band 2."),
}
# Rules that take the fits of one of `STRINGS`.
OF_FITS = {changes_as_printed, high_partials_differ, waveforms_nearer, three_bands_better, predicts, repeats, explained}
