"""Rules that decide from the findings of one run whether each claim of the paper is confirmed.

A rule returns one truth value for each part of its claim, as its docstring defines, and the numbers for its text. The
texts are blocks of `claims.j2`. The block with the name of the rule states the numbers. The block with the suffix
`_why` explains a claim that is not confirmed. The findings are `f` in both.
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

WORDS = {"yes": "confirmed", "part": "confirmed in part", "no": "not confirmed"}
SYMBOLS = {
    "c": "c", "kappa": "κ", "b1": "b₁", "b2": "b₂", "K_H": "K_H", "mu": "μ", "p": "p", "M_H": "M_H", "v_H0": "v₀",
}  # fmt: skip
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
class Claim:
    """One claim of the paper and its outcome."""

    claim: str
    where: str  # section, figure or table of the paper
    outcome: str  # a key of `WORDS`
    sentence: str  # the numbers
    why: str  # explanation; empty for a confirmed claim
    otherwise: Claim | None = None  # outcome with the string determined from the partials, where tested

    @property
    def word(self) -> str:
        """Outcome in words."""
        return WORDS[self.outcome]

    @property
    def instead(self) -> str:
        """Outcome of `otherwise` in words."""
        return "" if self.otherwise is None else f"string read: {self.otherwise.word}"


RULES: dict[str, Callable[..., Claim]] = {}  # in the order of the page
# Truth values of the parts of a claim, and the numbers for its text.
Parts = tuple[list[Any], dict[str, Any]]


def judge(f: Findings) -> dict[str, Claim]:
    """Return every claim by the name of its rule."""
    return {name: decide(f) for name, decide in RULES.items()}


def rule(
    where: str, claim: str, recipes: tuple[str, ...] = ()
) -> Callable[[Callable[..., Parts]], Callable[..., Claim]]:
    """Register a rule for a `claim` at `where` in the paper: all, some or none of its parts are confirmed.

    With two `recipes` the claim is tested with the first. If that does not confirm it, the second outcome is added.
    """

    def register(parts: Callable[..., Parts]) -> Callable[..., Claim]:
        @wraps(parts)
        def decided(f: Findings, *recipe: str) -> Claim:
            if recipes and not recipe:
                first, second = (decided(f, name) for name in recipes)
                return first if first.outcome == "yes" else replace(first, otherwise=second)
            confirmed, numbers = parts(f, *recipe)
            outcome = "yes" if all(confirmed) else "part" if any(confirmed) else "no"
            why = "" if outcome == "yes" else _worded(f"{parts.__name__}_why", f, numbers)
            return Claim(claim, where, outcome, _worded(parts.__name__, f, numbers), why)

        RULES[parts.__name__] = decided
        return decided

    return register


@rule("III.C, Figure 2", "The contact of hammer and string lasts about 3 ms.")
def contact_lasts(f: Findings) -> Parts:
    """Nearer to 3 than to 2 or 4 ms."""
    return [2.5e-3 <= stroke.contact < 3.5e-3 for stroke in f.strikes], {}


@rule("III.C, Figure 2", "The contact is shorter when the hammer is faster.")
def contact_shortens(f: Findings) -> Parts:
    """Each contact is shorter than that at the next lower velocity."""
    return [after.contact < before.contact for before, after in pairwise(f.strikes)], {}


@rule("III.C, Figure 2", "Reflections from the agraffe show in the force, at 2 and 4 m/s above all.")
def reflections(f: Findings) -> Parts:
    """At 2 m/s and above, the maxima of the force are 2 x0/c apart, the travel time to the agraffe and back, ±15 %."""
    spacing = [float(np.mean(np.diff(s.maxima))) if len(s.maxima) > 1 else None for s in f.strikes]
    fast = [period for stroke, period in zip(f.strikes, spacing, strict=True) if stroke.velocity >= 2]
    visible = [period is not None and abs(period / ROUND_TRIP - 1) <= 0.15 for period in fast]
    return visible, {"counts": [len(stroke.maxima) for stroke in f.strikes], "spacing": spacing}


@rule("III.C, Figure 3", "Force over compression is a loop; its area is the energy lost in the felt.")
def felt_loses(f: Findings) -> Parts:
    """The loop ∮ F du is clockwise and equals the energy lost by hammer and string, to 1e-6 of the energy."""
    hardest = f.strikes[-1]
    return [hardest.loop > 0, abs(hardest.loop - hardest.balance) <= 1e-6 * hardest.hammer_energy], {}


@rule("III.C, Figure 4", "The sound is brighter when the hammer is faster.")
def brighter(f: Findings) -> Parts:
    """Each centroid is higher than that at the next lower velocity."""
    return [after.centroid > before.centroid for before, after in pairwise(f.strikes)], {}


@rule("IV.C, Table II", "A gradient in bands 1 and 2 finds the string.")
def string_found(f: Findings) -> Parts:
    """c, κ and b1 lie within `NEAR` of the true values."""
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
    """Every parameter changed from its start as in the paper: up, down, or hardly at all (`MOVED`, `STILL`)."""
    initial, printed, found = PRINTED["initial"], PRINTED["final"], values_of(f.tables["full"].results[recipe])

    def direction(name: str, after: float) -> float:
        share = after / initial[name] - 1
        return 0.0 if abs(share) <= STILL.get(name, MOVED) else np.sign(share)

    same = {name: direction(name, found[name]) == direction(name, printed[name]) for name in initial}
    return [*same.values()], {"same": same, "initial": initial, "printed": printed, "found": found}


@rule("IV.C", "Band 3 has local minima.")
def local_minima(f: Findings) -> Parts:
    """There is more than one minimum in the plane shown, and more than one over all five parameters."""
    return [len(f.plane.minima) > 1, len(f.search_comparison.minima) > 1], {}


@rule("IV.C", "A gradient alone fails from some starts where annealing does not.")
def annealing_escapes(f: Findings) -> Parts:
    """The gradient fails from some starts, and the annealing from none.

    A search fails if it does not end within the factor `WITHIN` of the lowest criterion of all searches.
    """
    gradient, annealed = (f.search_comparison.successes(method) for method in ("gradient", "annealed"))
    return [gradient < f.plan.starts, annealed == f.plan.starts], {}


@rule("V, Figure 6", "The first seven partials agree, those above differ.", STRINGS)
def high_partials_differ(f: Findings, recipe: str) -> Parts:
    """The levels of the first seven partials agree to 1 dB rms, and those above differ more."""
    partial, off = f.origin.level_differences(f.origin.sounds[recipe])
    high = off[partial > SEVENTH]
    low_db, high_db = rms(off[partial <= SEVENTH]), rms(high)
    return [low_db <= 1.0, high_db > low_db], {"low_db": low_db, "high_db": high_db, "excess_db": float(high.mean())}


@rule("V, Figure 7", "The waveform comes clearly nearer the measured one.", STRINGS)
def waveforms_nearer(f: Findings, recipe: str) -> Parts:
    """The fit more than halves the difference from the measured waveform, relative to the rms of that waveform."""
    wave = f.strokes[f.plan.waveform]
    shown = int(SPANS[-1][1] * wave.recording.rate)
    measured, initial, fitted = (wave.sounds[name][:shown] for name in ("measured", "initial", recipe))
    before, after = (rms(x - measured) / rms(measured) for x in (initial, fitted))
    return [after < 0.5 * before], {"before": before, "after": after}


@rule("IV.B, VI", "Three bands keep attack and brightness better than a global criterion.", STRINGS)
def three_bands_better(f: Findings, recipe: str) -> Parts:
    """In both measures, three bands have a smaller mean error over the velocities than the global criterion."""
    sounds = [stroke.closeness for stroke in f.strokes.values()]

    def errors(sound: str, measure: str) -> np.ndarray:
        return np.array([getattr(c[sound], measure) / getattr(c["measured"], measure) - 1 for c in sounds])

    three, whole = ({m: np.abs(errors(x, m)) for m in ("attack", "centroid")} for x in (recipe, "global"))
    lost = float(errors("global", "centroid").mean())
    return [three[m].mean() < whole[m].mean() for m in three], {"three": three, "whole": whole, "lost": lost}


@rule("V", "Parameters from one velocity predict other velocities.", STRINGS)
def predicts(f: Findings, recipe: str) -> Parts:
    """At each other velocity, the fit predicts the levels better than the initial values and than `nearest` do.

    The errors are the rms differences of the partials' levels, dB. `nearest` is the recording at the fitted velocity.
    """
    predicted, initial, nearest = (
        [stroke.closeness[sound].level_db for stroke in f.predictions.values()]
        for sound in (recipe, "initial", "nearest")
    )
    better = [p < i and p < n for p, i, n in zip(predicted, initial, nearest, strict=True)]
    return better, {"predicted": predicted, "initial": initial, "nearest": nearest}


@rule("V", "Repeated measurements give very similar parameters.", STRINGS)
def repeats(f: Findings, recipe: str) -> Parts:
    """The standard deviation of the logarithm over the measurements is at most `ALIKE` for every parameter."""
    spread = spread_of(f.repeated[recipe])
    return [share <= ALIKE for share in spread.values()], {"spread": spread}


@rule("V, VI", "The residual after the fit comes from effects that the model does not describe.", STRINGS)
def explained(f: Findings, recipe: str) -> Parts:
    """Without effects the residual is below a tenth of that with all effects, and one effect alone causes a tenth.

    The residual is the criterion in band 3 after a fit.
    """
    residuals = {name: stroke.closeness[recipe].criterion["band3"] for name, stroke in f.effects.items()}
    everything, nothing = residuals.pop("all"), residuals.pop("none")
    confirmed = [nothing < 0.1 * everything, max(residuals.values()) >= 0.1 * everything]
    return confirmed, {"alone": residuals, "everything": everything, "nothing": nothing}


@rule("V, Table II", "The fitted κ is that of the string.")
def kappa_of_string(f: Findings) -> Parts:
    """κ fitted with the paper's grid equals that of the string to 2 %."""
    error = f.dispersion_errors["fitted to band 2"][0]
    return [abs(error.off) <= 0.02], {"biased": error}


@rule("IV.B, Table II", "b2 is found in band 2.")
def b2_found(f: Findings) -> Parts:
    """From no b2 to the paper's, the criterion of band 2 changes by more than its standard deviation by noise."""
    b2, true = f.b2_sensitivity.b2, f.b2_sensitivity.true
    curve, noise = f.b2_sensitivity.criterion["band2"], f.b2_sensitivity.spread["band2"]
    at_true = float(np.interp(np.log(true), np.log(b2), curve))
    change, above = abs(at_true - float(curve[0])), b2[(curve - at_true > noise) & (b2 > true)].tolist()
    return [change > noise], {"change": change, "noise": noise, "visible": (*above, None)[0]}


# --- text ------------------------------------------------------------------------------------------------------------


def _worded(block: str, f: Findings, numbers: dict[str, Any]) -> str:
    """Render a block of `claims.j2`; empty if it does not exist."""
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
    """Format a standard deviation of the logarithm."""
    return format_relative_uncertainty(deviation, "a factor {}").removeprefix("± ")
