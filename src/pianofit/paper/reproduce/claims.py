"""What came of each of the paper's claims, by rules: numbers in, an outcome out.

Every function takes what was measured in this run, and nothing else, and decides by the rule in its docstring. A claim
made of several parts comes out in part when only some of them do. How the numbers are worded, and what explains a claim
that did not come out, is written once, in `claims.j2`, in blocks of the functions' names and those with `_why`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from ...report.kit import templates
from ...report.words import number

if TYPE_CHECKING:
    from jinja2 import Template

__all__ = ["READ_INSTEAD", "SYMBOLS", "WORDS", "Claim", "or_else"]

WORDS = {"yes": "came out", "part": "came out in part", "no": "did not come out"}
READ_INSTEAD = "string read"
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
        return "" if self.otherwise is None else f"{READ_INSTEAD}: {self.otherwise.word}"


def or_else(first: Claim, second: Claim) -> Claim:
    """`first`; where it did not come out whole, with what became of the same claim done otherwise."""
    return first if first.outcome == "yes" else replace(first, otherwise=second)


def contact_lasts(velocities: Sequence[float], contact: Sequence[float], mass: float, needed: float) -> Claim:
    """Contact near 3 ms, that is nearer to 3 than to 2 or 4 ms.

    Parameters
    ----------
    velocities, contact : m/s and s [strokes].
    mass, needed : of the hammer, and of one that would stay for 3 ms at the middle velocity, kg.
    """
    return _judged(
        "contact_lasts", "The contact of hammer and string lasts about 3 ms.", "III.C, Figure 2",
        [2.5e-3 <= t < 3.5e-3 for t in contact],
        velocities=velocities, contact=contact, mass=mass, needed=needed,
    )  # fmt: skip


def contact_shortens(velocities: Sequence[float], contact: Sequence[float]) -> Claim:
    """Contact, s, shorter from each velocity, m/s, to the next."""
    return _judged(
        "contact_shortens", "The contact is shorter when the hammer is faster.", "III.C, Figure 2",
        [change < 0 for change in np.diff(contact)], velocities=velocities, contact=contact,
    )  # fmt: skip


def reflections(velocities: Sequence[float], humps: Sequence[np.ndarray], trip: float) -> Claim:
    """From 2 m/s on, two or more maxima of the force, as far apart as the wave's way to the agraffe and back (± 15 %).

    Parameters
    ----------
    humps : when the force has its maxima, s, for each velocity.
    trip : the wave's time to the agraffe and back, s.
    """
    spacing = [float(np.mean(np.diff(at))) if len(at) > 1 else None for at in humps]
    return _judged(
        "reflections", "Reflections from the agraffe show in the force, at 2 and 4 m/s above all.", "III.C, Figure 2",
        [s is not None and abs(s / trip - 1) <= 0.15 for v, s in zip(velocities, spacing, strict=True) if v >= 2],
        velocities=velocities, counts=[len(at) for at in humps], spacing=spacing, trip=trip,
    )  # fmt: skip


def felt_loses(loop: float, balance: float, energy: float) -> Claim:
    """A loop run through clockwise, whose area is what hammer and string lose, to 1e-6 of the hammer's energy.

    Parameters
    ----------
    loop : ∮ F du, J.
    balance : the hammer's energy before, less that after and the work done on the string, J.
    energy : of the hammer before, J.
    """
    return _judged(
        "felt_loses", "Force over compression is a loop; its area is what the felt takes.", "III.C, Figure 3",
        [loop > 0, abs(loop - balance) <= 1e-6 * energy], loop=loop, balance=balance, energy=energy,
    )  # fmt: skip


def brighter(velocities: Sequence[float], centroids: Sequence[float]) -> Claim:
    """A higher centroid, Hz, from each velocity, m/s, to the next."""
    return _judged(
        "brighter", "The sound is brighter when the hammer is faster.", "III.C, Figure 4",
        [rise > 0 for rise in np.diff(centroids)], velocities=velocities, centroids=centroids,
    )  # fmt: skip


def bends_kappa(true: float, found: float, meant: float, points: int, rate: float) -> Claim:
    """κ fitted through the paper's grid is the string's own, to 2 %.

    Parameters
    ----------
    true : κ of a continuous string, m²/s.
    found : the κ with which the paper's scheme has the same partials.
    meant : κ of the continuous string whose partials the scheme has at `true`.
    points, rate : N and Hz of the scheme.
    """
    return _judged(
        "bends_kappa", "The κ that is fitted is the string's.", "V, Table II", [abs(found / true - 1) <= 0.02],
        own=true, found=found, meant=meant, points=points, rate=rate,
    )  # fmt: skip


def b2_seen(b2: float, change: float, noise: float, remaining: float, visible: float | None, most: float) -> Claim:
    """Between no b2 and the paper's, the criterion of band 2 changes by more than noise alone does.

    Parameters
    ----------
    b2 : the paper's, m²/s.
    change : of the criterion between the smallest b2 tried and the paper's.
    noise : standard deviation of the criterion over measurements that differ in their noise alone.
    remaining : of the criterion after a fit of the full laboratory.
    visible : the b2 from which on the criterion rises by more than `noise`, m²/s; None if none of those tried.
    most : the largest b2 tried, m²/s.
    """
    return _judged(
        "b2_seen", "b2 is found in band 2.", "IV.B, Table II", [change > noise], b2=b2, change=change, noise=noise,
        remaining=remaining, visible=visible, most=most,
    )  # fmt: skip


def local_minima(in_plane: Sequence[float], in_all: Sequence[float]) -> Claim:
    """More than one minimum in the plane shown, and more than one over all five parameters; criteria at each."""
    return _judged(
        "local_minima", "Band 3 has local minima.", "IV.C", [len(in_plane) > 1, len(in_all) > 1],
        in_plane=in_plane, in_all=in_all,
    )  # fmt: skip


def annealing_escapes(starts: int, reached: Mapping[str, int], within: float) -> Claim:
    """The gradient fails from some starts, and the annealing from none.

    Parameters
    ----------
    reached : `gradient`, `squares`, `annealed` and `polished` -> from how many starts it reached the deepest minimum.
    within : of the lowest criterion found by any, a factor.
    """
    return _judged(
        "annealing_escapes", "A gradient alone fails from some starts where annealing does not.", "IV.C",
        [reached["gradient"] < starts, reached["annealed"] == starts], starts=starts, reached=reached, within=within,
    )  # fmt: skip


def three_bands_better(errors: Mapping[str, Mapping[str, Sequence[float]]], velocities: Sequence[float]) -> Claim:
    """Three bands nearer the measured sound than the global criterion, on average over velocities, in both measures.

    Parameters
    ----------
    errors : "attack" and "centroid" -> "three bands" and "global criterion" -> relative errors [velocities].
    """
    three, whole = (
        {m: np.asarray(errors[m][name], float) for m in errors} for name in ("three bands", "global criterion")
    )
    return _judged(
        "three_bands_better", "Three bands keep attack and brightness better than a global criterion.", "IV.B, VI",
        [np.abs(three[m]).mean() < np.abs(whole[m]).mean() for m in ("attack", "centroid")],
        three={m: float(np.abs(x).mean()) for m, x in three.items()},
        whole={m: float(np.abs(x).mean()) for m, x in whole.items()},
        nearer={m: int((np.abs(x) < np.abs(whole[m])).sum()) for m, x in three.items()},
        of=len(velocities), lost=float(np.mean(whole["centroid"])),
    )  # fmt: skip


def string_found(
    true: Mapping[str, float], found: Mapping[str, float], shares: Mapping[str, Mapping[int, float]]
) -> Claim:
    """c, κ and b1 within `NEAR` of the truth; b2 is a claim of its own.

    Parameters
    ----------
    shares : band -> partial -> its share in the criterion.
    """
    off = {name: abs(found[name] / true[name] - 1) for name in NEAR}
    strongest, share = max(shares["band2"].items(), key=lambda item: item[1])
    return _judged(
        "string_found", "A gradient in bands 1 and 2 finds the string.", "IV.C, Table II",
        [off[name] <= near for name, near in NEAR.items()], off=off, strongest=strongest, share=share,
    )  # fmt: skip


def changes_as_printed(initial: Mapping[str, float], printed: Mapping[str, float], found: Mapping[str, float]) -> Claim:
    """Every parameter moved from its start as in the paper: up, down, or hardly at all (`MOVED`, `STILL`)."""

    def direction(name: str, after: float) -> int:
        share = after / initial[name] - 1
        return 0 if abs(share) <= STILL.get(name, MOVED) else 1 if share > 0 else -1

    same = {name: direction(name, found[name]) == direction(name, printed[name]) for name in printed}
    return _judged(
        "changes_as_printed",
        "The felt gets stiffer and loses more, the hammer lighter and faster, p stays; the string loses more.",
        "V, Tables II and III", [*same.values()], same=same, initial=initial, printed=printed, found=found,
    )  # fmt: skip


def high_partials_differ(low_db: float, high_db: float, excess_db: float) -> Claim:
    """Partials to the seventh agree to 1 dB, those above differ more.

    Parameters
    ----------
    low_db, high_db : rms differences in level, dB, of partials to the seventh, and above.
    excess_db : mean of model over measurement above the seventh, dB.
    """
    return _judged(
        "high_partials_differ", "The first seven partials agree, those above differ.", "V, Figure 6",
        [low_db <= 1.0, high_db > low_db], low_db=low_db, high_db=high_db, excess_db=excess_db,
    )  # fmt: skip


def waveforms_nearer(before: float, after: float) -> Claim:
    """The difference from the measured waveform is less than half of what it was; both relative to its rms."""
    return _judged(
        "waveforms_nearer", "The waveform comes clearly nearer the measured one.", "V, Figure 7",
        [after < 0.5 * before], before=before, after=after,
    )  # fmt: skip


def predicts(
    velocities: Sequence[float], origin: float, predicted: Sequence[float], initial: Sequence[float],
    nearest: Sequence[float],
) -> Claim:  # fmt: skip
    """Parameters of one velocity meet another's levels better than the initial values, and than the recording itself.

    Parameters
    ----------
    origin : velocity at which they were fitted, m/s.
    predicted, initial, nearest : rms errors of the partials' levels [velocities], dB: by the fit at `origin`, by the
        initial values, and of the recording at `origin` taken for the other.
    """
    return _judged(
        "predicts", "Parameters from one velocity predict other velocities.", "V",
        [p < i and p < n for p, i, n in zip(predicted, initial, nearest, strict=True)],
        velocities=velocities, origin=origin, predicted=predicted, initial=initial, nearest=nearest,
    )  # fmt: skip


def repeats(spread: Mapping[str, float], count: int) -> Claim:
    """Every parameter's standard deviation over `count` measurements, of its logarithm, is at most `ALIKE`."""
    return _judged(
        "repeats", "Repeated measurements give very similar parameters.", "V",
        [share <= ALIKE for share in spread.values()], spread=spread, count=count,
    )  # fmt: skip


def explained(alone: Mapping[str, float], everything: float, nothing: float) -> Claim:
    """Without what the model lacks hardly anything remains (a tenth), and some effect alone leaves a tenth of it all.

    Parameters
    ----------
    alone : effect -> criterion that remains after a fit, with it alone.
    everything, nothing : with all effects, and with none.
    """
    return _judged(
        "explained", "What remains after the fit is what the model lacks.", "V, VI",
        [nothing < 0.1 * everything, max(alone.values()) >= 0.1 * everything],
        alone=sorted(alone.items(), key=lambda item: -item[1]), everything=everything, nothing=nothing,
    )  # fmt: skip


# --- in words --------------------------------------------------------------------------------------------------------


def _judged(name: str, claim: str, where: str, parts: Sequence[bool], **numbers: Any) -> Claim:
    """Whether all, some or none of the claim's `parts` came out, worded by the blocks of that `name`."""
    outcome = "yes" if all(parts) else "part" if any(parts) else "no"
    why = "" if outcome == "yes" else _worded(f"{name}_why", numbers)
    return Claim(claim, where, outcome, _worded(name, numbers), why)


def _worded(block: str, numbers: dict[str, Any]) -> str:
    """A block of `claims.j2`, if there is one of that name."""
    template = _texts()
    if block not in template.blocks:
        return ""
    return " ".join("".join(template.blocks[block](template.new_context(numbers))).split())


@cache
def _texts() -> Template:
    filters = {"listed": _listed, "joined": _joined, "percent": _percent, "factor": _factor, "symbol": SYMBOLS.get}
    return templates("pianofit.paper.reproduce", filters=filters).get_template("claims.j2")


def _joined(texts: Sequence[str]) -> str:
    return texts[0] if len(texts) == 1 else f"{', '.join(texts[:-1])} and {texts[-1]}"


def _listed(values: Sequence[float], digits: int = 3, scale: float = 1) -> str:
    return _joined([number(scale * float(v), digits) for v in values])


def _percent(share: float, digits: int = 2) -> str:
    return f"{number(100 * share, digits)} %"


def _factor(deviation: float) -> str:
    """A standard deviation of the logarithm: a percentage while it is small, else a factor."""
    return _percent(deviation) if deviation < 0.3 else f"a factor {number(float(np.exp(min(deviation, 700.0))), 2)}"
