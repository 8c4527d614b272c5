"""What came of each of the paper's claims, by rules: numbers in, an outcome out.

A rule takes what was measured in this run, and says which parts of its claim came out, as its docstring has it; what it
takes, and what it may return beside, are the numbers of its sentence. How they are worded, and what explains a claim
that did not come out, is written once, in `claims.j2`, in blocks of the rules' names and those with `_why`. Velocities
are in m/s, times in s, energies in J, masses in kg.
"""

# What a rule does not decide by, its sentence says.
# ruff: noqa: ARG001
from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, wraps
from typing import TYPE_CHECKING, Any, ParamSpec

import numpy as np

from ...numbers import number
from ...report.kit import templates

if TYPE_CHECKING:
    from jinja2 import Template

__all__ = ["SYMBOLS", "WORDS", "Claim", "or_else"]

WORDS = {"yes": "came out", "part": "came out in part", "no": "did not come out"}
SYMBOLS = {
    "c": "c", "kappa": "κ", "b1": "b₁", "b2": "b₂", "K_H": "K_H", "mu": "μ", "p": "p", "M_H": "M_H", "v_H0": "v₀",
}  # fmt: skip
# Moved by less than this, relative, a parameter has hardly moved;
MOVED = 0.005
# of p the paper says so itself.
STILL = {"p": 0.05}
# What is near the truth, relative.
NEAR = {"c": 1e-3, "kappa": 0.05, "b1": 0.2}
# Repeated measurements give a parameter alike if the standard deviation of its logarithm is at most this.
ALIKE = 0.05

P = ParamSpec("P")
# Which parts of a claim came out; and numbers that its sentence needs beside those that the rule was given.
Parts = Sequence[Any] | tuple[Sequence[Any], dict[str, Any]]


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


def or_else(first: Claim, second: Claim) -> Claim:
    """`first`; where it did not come out whole, with what became of the same claim done otherwise."""
    return first if first.outcome == "yes" else replace(first, otherwise=second)


def rule(where: str, claim: str) -> Callable[[Callable[P, Parts]], Callable[P, Claim]]:
    """What decides a `claim` that stands at `where`: all, some or none of its parts came out."""

    def of(parts: Callable[P, Parts]) -> Callable[P, Claim]:
        @wraps(parts)
        def judged(*given: P.args, **named: P.kwargs) -> Claim:
            found = parts(*given, **named)
            came, more = found if isinstance(found, tuple) else (found, {})
            numbers = inspect.signature(parts).bind(*given, **named).arguments | more
            outcome = "yes" if all(came) else "part" if any(came) else "no"
            why = "" if outcome == "yes" else _worded(f"{parts.__name__}_why", numbers)
            return Claim(claim, where, outcome, _worded(parts.__name__, numbers), why)

        return judged

    return of


@rule("III.C, Figure 2", "The contact of hammer and string lasts about 3 ms.")
def contact_lasts(velocities: Sequence[float], contact: Sequence[float], mass: float, needed: float) -> Parts:
    """Nearer to 3 than to 2 or 4 ms; a hammer of mass `needed` would stay for 3 ms at the middle velocity."""
    return [2.5e-3 <= t < 3.5e-3 for t in contact]


@rule("III.C, Figure 2", "The contact is shorter when the hammer is faster.")
def contact_shortens(velocities: Sequence[float], contact: Sequence[float]) -> Parts:
    """Shorter from each velocity to the next."""
    return [change < 0 for change in np.diff(contact)]


@rule("III.C, Figure 2", "Reflections from the agraffe show in the force, at 2 and 4 m/s above all.")
def reflections(velocities: Sequence[float], humps: Sequence[np.ndarray], trip: float) -> Parts:
    """From 2 m/s on, the force has maxima (at `humps`) as far apart as a wave's way to the agraffe and back, ±15 %."""
    spacing = [float(np.mean(np.diff(at))) if len(at) > 1 else None for at in humps]
    seen = [s is not None and abs(s / trip - 1) <= 0.15 for v, s in zip(velocities, spacing, strict=True) if v >= 2]
    return seen, {"counts": [len(at) for at in humps], "spacing": spacing}


@rule("III.C, Figure 3", "Force over compression is a loop; its area is what the felt takes.")
def felt_loses(loop: float, balance: float, energy: float) -> Parts:
    """A `loop` ∮ F du run through clockwise, that is what hammer and string lose (`balance`) to 1e-6 of the energy."""
    return [loop > 0, abs(loop - balance) <= 1e-6 * energy]


@rule("III.C, Figure 4", "The sound is brighter when the hammer is faster.")
def brighter(velocities: Sequence[float], centroids: Sequence[float]) -> Parts:
    """A higher centroid, Hz, from each velocity to the next."""
    return [rise > 0 for rise in np.diff(centroids)]


@rule("IV.C, Table II", "A gradient in bands 1 and 2 finds the string.")
def string_found(
    true: Mapping[str, float], found: Mapping[str, float], shares: Mapping[str, Mapping[int, float]]
) -> Parts:
    """c, κ and b1 within `NEAR` of the truth; `shares`: band -> partial -> its share in the criterion."""
    off = {name: abs(found[name] / true[name] - 1) for name in NEAR}
    strongest, share = max(shares["band2"].items(), key=lambda item: item[1])
    return [off[name] <= near for name, near in NEAR.items()], {"off": off, "strongest": strongest, "share": share}


@rule(
    "V, Tables II and III",
    "The felt gets stiffer and loses more, the hammer lighter and faster, p stays; the string loses more.",
)
def changes_as_printed(initial: Mapping[str, float], printed: Mapping[str, float], found: Mapping[str, float]) -> Parts:
    """Every parameter moved from its start as in the paper: up, down, or hardly at all (`MOVED`, `STILL`)."""

    def direction(name: str, after: float) -> float:
        share = after / initial[name] - 1
        return 0.0 if abs(share) <= STILL.get(name, MOVED) else np.sign(share)

    same = {name: direction(name, found[name]) == direction(name, printed[name]) for name in printed}
    return [*same.values()], {"same": same}


@rule("IV.C", "Band 3 has local minima.")
def local_minima(in_plane: Sequence[float], in_all: Sequence[float]) -> Parts:
    """More than one minimum in the plane shown, and more than one over all five parameters; criteria at each."""
    return [len(in_plane) > 1, len(in_all) > 1]


@rule("IV.C", "A gradient alone fails from some starts where annealing does not.")
def annealing_escapes(starts: int, reached: Mapping[str, int], within: float) -> Parts:
    """The gradient fails from some starts, and the annealing from none.

    `reached`: method -> from how many starts it came `within` a factor of the lowest criterion found by any.
    """
    return [reached["gradient"] < starts, reached["annealed"] == starts]


@rule("V, Figure 6", "The first seven partials agree, those above differ.")
def high_partials_differ(low_db: float, high_db: float, excess_db: float) -> Parts:
    """Levels to the seventh agree to 1 dB rms, those above differ more, and on average by `excess_db`."""
    return [low_db <= 1.0, high_db > low_db]


@rule("V, Figure 7", "The waveform comes clearly nearer the measured one.")
def waveforms_nearer(before: float, after: float) -> Parts:
    """The difference from the measured waveform is less than half of what it was; both relative to its rms."""
    return [after < 0.5 * before]


@rule("IV.B, VI", "Three bands keep attack and brightness better than a global criterion.")
def three_bands_better(errors: Mapping[str, Mapping[str, Sequence[float]]], velocities: Sequence[float]) -> Parts:
    """Three bands nearer the measured sound than the global criterion, on average over velocities, in both measures.

    `errors`: "attack" and "centroid" -> "three bands" and "global criterion" -> relative errors [velocities].
    """
    three, whole = (
        {m: np.abs(np.asarray(by[name], float)) for m, by in errors.items()}
        for name in ("three bands", "global criterion")
    )
    return [three[m].mean() < whole[m].mean() for m in errors], {
        "three": {m: float(x.mean()) for m, x in three.items()},
        "whole": {m: float(x.mean()) for m, x in whole.items()},
        "nearer": {m: int((x < whole[m]).sum()) for m, x in three.items()},
        "of": len(velocities), "lost": float(np.mean(errors["centroid"]["global criterion"])),
    }  # fmt: skip


@rule("V", "Parameters from one velocity predict other velocities.")
def predicts(
    velocities: Sequence[float], origin: float, predicted: Sequence[float], initial: Sequence[float],
    nearest: Sequence[float],
) -> Parts:  # fmt: skip
    """The fit at `origin` meets another velocity's levels better than initial values, and than the recording itself.

    Rms errors of the partials' levels [velocities], dB; `nearest`: of the recording at `origin` taken for the other.
    """
    return [p < i and p < n for p, i, n in zip(predicted, initial, nearest, strict=True)]


@rule("V", "Repeated measurements give very similar parameters.")
def repeats(spread: Mapping[str, float], count: int) -> Parts:
    """Every parameter's standard deviation over `count` measurements, of its logarithm, is at most `ALIKE`."""
    return [share <= ALIKE for share in spread.values()]


@rule("V, VI", "What remains after the fit is what the model lacks.")
def explained(alone: Mapping[str, float], everything: float, nothing: float) -> Parts:
    """Without what the model lacks hardly anything remains (a tenth), and some effect alone leaves a tenth of it all.

    Criteria that remain after a fit: with each effect `alone`, with all, and with none.
    """
    return [nothing < 0.1 * everything, max(alone.values()) >= 0.1 * everything]


@rule("V, Table II", "The κ that is fitted is the string's.")
def bends_kappa(own: float, found: float, meant: float, points: int, rate: float) -> Parts:
    """κ `found` through the paper's grid of `points` at `rate`, Hz, is the string's `own` to 2 %, m²/s.

    `meant` is the κ of the continuous string whose partials the scheme has at `own`.
    """
    return [abs(found / own - 1) <= 0.02]


@rule("IV.B, Table II", "b2 is found in band 2.")
def b2_seen(b2: float, change: float, noise: float, remaining: float, visible: float | None, most: float) -> Parts:
    """Between no `b2` and the paper's, the criterion of band 2 changes by more than its standard deviation by noise.

    `remaining` of it is left after a fit of the full laboratory. From `visible` on, m²/s, a b2 stands out from noise;
    None if not even the largest tried does, `most`.
    """
    return [change > noise]


# --- in words --------------------------------------------------------------------------------------------------------


def _worded(block: str, numbers: dict[str, Any]) -> str:
    """A block of `claims.j2`, if there is one of that name."""
    template = _texts()
    if block not in template.blocks:
        return ""
    return " ".join("".join(template.blocks[block](template.new_context(numbers))).split())


@cache
def _texts() -> Template:
    filters = {"listed": _listed, "percent": _percent, "factor": _factor, "symbol": SYMBOLS.get}
    return templates("pianofit.paper.reproduce", filters=filters).get_template("claims.j2")


def _listed(values: Sequence[float], digits: int = 3, scale: float = 1) -> str:
    *most, last = [number(scale * float(v), digits) for v in values]
    return f"{', '.join(most)} and {last}" if most else last


def _percent(share: float) -> str:
    return f"{number(100 * share, 2)} %"


def _factor(deviation: float) -> str:
    """A standard deviation of the logarithm: a percentage while it is small, else a factor."""
    return _percent(deviation) if deviation < 0.3 else f"a factor {number(float(np.exp(min(deviation, 700.0))), 2)}"
