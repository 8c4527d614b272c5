"""What came of each of the paper's claims, by rules: what this run found in, an outcome out.

A rule says which parts of its claim came out, as its docstring has it, and beside them the numbers that it had to
compute. How they are worded, and what explains a claim that did not come out, is written once, in `claims.j2`, in
blocks of the rules' names and those with `_why`, for which the findings are `f`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cache, wraps
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from ...io.number_format import format_relative_uncertainty, number
from ...report.html import templates
from .band3 import WITHIN
from .direct import NOTE, ROUND_TRIP
from .strokes import rms, values_of
from .studies import PRINTED, STRINGS, Findings, spread_of

if TYPE_CHECKING:
    from jinja2 import Template

__all__ = ["SPANS", "SYMBOLS", "WORDS", "Claim", "judge"]

WORDS = {"yes": "came out", "part": "came out in part", "no": "did not come out"}
SYMBOLS = {
    "c": "c", "kappa": "κ", "b1": "b₁", "b2": "b₂", "K_H": "K_H", "mu": "μ", "p": "p", "M_H": "M_H", "v_H0": "v₀",
}  # fmt: skip
SPANS = ((0.0, 0.015), (0.040, 0.055))  # s, of Figure 7
SEVENTH = 7  # the paper's "first seven components"
# Moved by less than this, relative, a parameter has hardly moved;
MOVED = 0.005
# of p the paper says so itself.
STILL = {"p": 0.05}
# What is near the truth, relative.
NEAR = {"c": 1e-3, "kappa": 0.05, "b1": 0.2}
# Repeated measurements give a parameter alike if the standard deviation of its logarithm is at most this.
ALIKE = 0.05


@dataclass(frozen=True)
class Claim:
    """One claim of the paper, and what came of it."""

    claim: str
    where: str  # in the paper
    outcome: str  # a key of `WORDS`
    sentence: str  # by these numbers
    why: str  # not, where it did not come out whole
    otherwise: Claim | None = None  # with the string read off its partials, where that is another question

    @property
    def word(self) -> str:
        """The outcome in words."""
        return WORDS[self.outcome]

    @property
    def instead(self) -> str:
        """What became of it otherwise, in a few words."""
        return "" if self.otherwise is None else f"string read: {self.otherwise.word}"


RULES: dict[str, Callable[..., Claim]] = {}  # in the order of the page
# Which parts of a claim came out; and numbers that its sentence needs beside the findings.
Parts = tuple[list[Any], dict[str, Any]]


def judge(f: Findings) -> dict[str, Claim]:
    """Every claim by the name of its rule."""
    return {name: decide(f) for name, decide in RULES.items()}


def rule(where: str, claim: str, recipes: tuple[str, ...] = ()) -> Callable:
    """Enter in `RULES` what decides a `claim` that stands at `where`: all, some or none of its parts came out.

    `recipes`: of two that it can be asked of, the second counts only where it does not come out whole by the first.
    """

    def of(parts: Callable[..., Parts]) -> Callable[..., Claim]:
        @wraps(parts)
        def decided(f: Findings, *recipe: str) -> Claim:
            if recipes and not recipe:
                first, second = (decided(f, each) for each in recipes)
                return first if first.outcome == "yes" else replace(first, otherwise=second)
            came, numbers = parts(f, *recipe)
            outcome = "yes" if all(came) else "part" if any(came) else "no"
            why = "" if outcome == "yes" else _worded(f"{parts.__name__}_why", f, numbers)
            return Claim(claim, where, outcome, _worded(parts.__name__, f, numbers), why)

        RULES[parts.__name__] = decided
        return decided

    return of


@rule("III.C, Figure 2", "The contact of hammer and string lasts about 3 ms.")
def contact_lasts(f: Findings) -> Parts:
    """Nearer to 3 than to 2 or 4 ms."""
    return [2.5e-3 <= stroke.contact < 3.5e-3 for stroke in f.strikes], {}


@rule("III.C, Figure 2", "The contact is shorter when the hammer is faster.")
def contact_shortens(f: Findings) -> Parts:
    """Shorter from each velocity to the next."""
    return [after.contact < before.contact for before, after in pairwise(f.strikes)], {}


@rule("III.C, Figure 2", "Reflections from the agraffe show in the force, at 2 and 4 m/s above all.")
def reflections(f: Findings) -> Parts:
    """From 2 m/s on, the force has maxima as far apart as a wave's way to the agraffe and back, ±15 %."""
    spacing = [float(np.mean(np.diff(s.humps))) if len(s.humps) > 1 else None for s in f.strikes]
    fast = [apart for stroke, apart in zip(f.strikes, spacing, strict=True) if stroke.velocity >= 2]
    seen = [apart is not None and abs(apart / ROUND_TRIP - 1) <= 0.15 for apart in fast]
    return seen, {"counts": [len(stroke.humps) for stroke in f.strikes], "spacing": spacing}


@rule("III.C, Figure 3", "Force over compression is a loop; its area is what the felt takes.")
def felt_loses(f: Findings) -> Parts:
    """A loop ∮ F du run through clockwise, that is what hammer and string lose to 1e-6 of the energy."""
    hardest = f.strikes[-1]
    return [hardest.loop > 0, abs(hardest.loop - hardest.balance) <= 1e-6 * hardest.hammer_energy], {}


@rule("III.C, Figure 4", "The sound is brighter when the hammer is faster.")
def brighter(f: Findings) -> Parts:
    """A higher centroid from each velocity to the next."""
    return [after.centroid > before.centroid for before, after in pairwise(f.strikes)], {}


@rule("IV.C, Table II", "A gradient in bands 1 and 2 finds the string.")
def string_found(f: Findings) -> Parts:
    """c, κ and b1 within `NEAR` of the truth."""
    found = values_of(f.tables["full"].results["paper"])
    off = {name: abs(found[name] / f.true[name] - 1) for name in NEAR}
    strongest, share = max(f.origin.shares()["band2"].items(), key=lambda item: item[1])
    return [off[name] <= near for name, near in NEAR.items()], {"off": off, "strongest": strongest, "share": share}


@rule(
    "V, Tables II and III",
    "The felt gets stiffer and loses more, the hammer lighter and faster, p stays; the string loses more.",
    STRINGS,
)
def changes_as_printed(f: Findings, recipe: str) -> Parts:
    """Every parameter moved from its start as in the paper: up, down, or hardly at all (`MOVED`, `STILL`)."""
    initial, printed, found = PRINTED["initial"], PRINTED["final"], values_of(f.tables["full"].results[recipe])

    def direction(name: str, after: float) -> float:
        share = after / initial[name] - 1
        return 0.0 if abs(share) <= STILL.get(name, MOVED) else np.sign(share)

    same = {name: direction(name, found[name]) == direction(name, printed[name]) for name in initial}
    return [*same.values()], {"same": same, "initial": initial, "printed": printed, "found": found}


@rule("IV.C", "Band 3 has local minima.")
def local_minima(f: Findings) -> Parts:
    """More than one minimum in the plane shown, and more than one over all five parameters."""
    return [len(f.plane.minima) > 1, len(f.race.minima) > 1], {}


@rule("IV.C", "A gradient alone fails from some starts where annealing does not.")
def annealing_escapes(f: Findings) -> Parts:
    """The gradient fails from some starts, and the annealing from none.

    A search fails that does not come `WITHIN` a factor of the lowest criterion found by any.
    """
    return [f.race.reached("gradient") < f.plan.starts, f.race.reached("annealed") == f.plan.starts], {}


@rule("V, Figure 6", "The first seven partials agree, those above differ.", STRINGS)
def high_partials_differ(f: Findings, recipe: str) -> Parts:
    """Levels to the seventh agree to 1 dB rms, and those above differ more."""
    partial, off = f.origin.levels_off(f.origin.sounds[recipe])
    high = off[partial > SEVENTH]
    low_db, high_db = rms(off[partial <= SEVENTH]), rms(high)
    return [low_db <= 1.0, high_db > low_db], {"low_db": low_db, "high_db": high_db, "excess_db": float(high.mean())}


@rule("V, Figure 7", "The waveform comes clearly nearer the measured one.", STRINGS)
def waveforms_nearer(f: Findings, recipe: str) -> Parts:
    """The difference from the measured waveform is less than half of what it was; both relative to its rms."""
    wave = f.strokes[f.plan.waveform]
    shown = int(SPANS[-1][1] * wave.recording.rate)
    measured, initial, fitted = (wave.sounds[name][:shown] for name in ("measured", "initial", recipe))
    before, after = (rms(x - measured) / rms(measured) for x in (initial, fitted))
    return [after < 0.5 * before], {"before": before, "after": after}


@rule("IV.B, VI", "Three bands keep attack and brightness better than a global criterion.", STRINGS)
def three_bands_better(f: Findings, recipe: str) -> Parts:
    """Three bands nearer the measured sound than the global criterion, on average over velocities, in both measures."""
    near = [stroke.closeness for stroke in f.strokes.values()]

    def errors(sound: str, measure: str) -> np.ndarray:
        return np.array([getattr(one[sound], measure) / getattr(one["measured"], measure) - 1 for one in near])

    three, whole = ({m: np.abs(errors(x, m)) for m in ("attack", "centroid")} for x in (recipe, "global"))
    lost = float(errors("global", "centroid").mean())
    return [three[m].mean() < whole[m].mean() for m in three], {"three": three, "whole": whole, "lost": lost}


@rule("V", "Parameters from one velocity predict other velocities.", STRINGS)
def predicts(f: Findings, recipe: str) -> Parts:
    """The fit at one velocity meets another's levels better than initial values, and than the recording itself.

    The errors are rms of the partials' levels, dB; `nearest` is the recording at the fitted velocity for the other.
    """
    predicted, initial, nearest = (
        [one.closeness[kind].level_db for one in f.predictions.values()] for kind in (recipe, "initial", "nearest")
    )
    met = [p < i and p < n for p, i, n in zip(predicted, initial, nearest, strict=True)]
    return met, {"predicted": predicted, "initial": initial, "nearest": nearest}


@rule("V", "Repeated measurements give very similar parameters.", STRINGS)
def repeats(f: Findings, recipe: str) -> Parts:
    """Every parameter's standard deviation over the measurements, of its logarithm, is at most `ALIKE`."""
    spread = spread_of(f.repeated[recipe])
    return [share <= ALIKE for share in spread.values()], {"spread": spread}


@rule("V, VI", "What remains after the fit is what the model lacks.", STRINGS)
def explained(f: Findings, recipe: str) -> Parts:
    """Without what the model lacks hardly anything remains (a tenth), and some effect alone leaves a tenth of it all.

    What remains is the criterion in band 3 after a fit.
    """
    left = {name: stroke.closeness[recipe].criterion["band3"] for name, stroke in f.effects.items()}
    everything, nothing = left.pop("all"), left.pop("none")
    came = [nothing < 0.1 * everything, max(left.values()) >= 0.1 * everything]
    return came, {"alone": left, "everything": everything, "nothing": nothing}


@rule("V, Table II", "The κ that is fitted is the string's.")
def bends_kappa(f: Findings) -> Parts:
    """κ through the paper's grid is the string's own to 2 %."""
    bent = f.bends["fitted to band 2"][0]
    return [abs(bent.off) <= 0.02], {"bent": bent}


@rule("IV.B, Table II", "b2 is found in band 2.")
def b2_seen(f: Findings) -> Parts:
    """Between no b2 and the paper's, the criterion of band 2 changes by more than its standard deviation by noise."""
    seen = f.blindness
    curve, noise = seen.criterion["band2"], seen.spread["band2"]
    at = float(np.interp(np.log(seen.true), np.log(seen.b2), curve))
    change, above = abs(at - float(curve[0])), seen.b2[(curve - at > noise) & (seen.b2 > seen.true)].tolist()
    return [change > noise], {"change": change, "noise": noise, "visible": (*above, None)[0]}


# --- in words --------------------------------------------------------------------------------------------------------


def _worded(block: str, f: Findings, numbers: dict[str, Any]) -> str:
    """A block of `claims.j2`, if there is one of that name."""
    template = _texts()
    if block not in template.blocks:
        return ""
    context = template.new_context({"f": f, "note": NOTE, "trip": ROUND_TRIP, "within": WITHIN} | numbers)
    return " ".join("".join(template.blocks[block](context)).split())


@cache
def _texts() -> Template:
    filters = {"listed": _listed, "percent": _percent, "factor": _spread, "symbol": SYMBOLS.get}
    return templates("pianofit.bensa2005.reproduce", filters=filters).get_template("claims.j2")


def _listed(values: Iterable[float], digits: int = 3, scale: float = 1) -> str:
    *most, last = [number(scale * float(v), digits) for v in values]
    return f"{', '.join(most)} and {last}" if most else last


def _percent(share: float) -> str:
    return f"{number(100 * share, 2)} %"


def _spread(deviation: float) -> str:
    """A standard deviation of the logarithm."""
    return format_relative_uncertainty(deviation, "a factor {}").removeprefix("± ")
