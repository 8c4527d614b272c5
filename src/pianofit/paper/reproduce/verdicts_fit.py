"""Verdicts on the criterion, the searches and the results (paper IV to VI)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ...report.words import number
from .verdict import Verdict, joined, listed, outcome_of, percent

__all__ = [
    "annealing_escapes", "changes_as_printed", "explained", "high_partials_differ", "local_minima", "predicts",
    "repeats", "string_found", "three_bands_better", "waveforms_nearer",
]  # fmt: skip

SYMBOLS = {"kappa": "κ", "b1": "b₁", "b2": "b₂", "mu": "μ", "v_H0": "v₀"}
# Moved by less than this, relative, a parameter has hardly moved; the paper says so of p alone.
STILL = {"p": 0.05}
# Off by less than this, relative, a centroid has lost little.
LITTLE = 0.05
# What is near the truth, relative.
NEAR = {"c": 1e-3, "kappa": 0.05, "b1": 0.2}


def local_minima(in_plane: Sequence[float], in_all: Sequence[float]) -> Verdict:
    """More than one minimum in the plane shown, and more than one over all five parameters.

    Parameters
    ----------
    in_plane, in_all : the criterion at each minimum.
    """
    parts = [len(in_plane) > 1, len(in_all) > 1]
    sentence = f"The plane shown has {_places(in_plane)}; over all five parameters descents rest in {_places(in_all)}."
    return Verdict("Band 3 has local minima.", "IV.C", outcome_of(parts), sentence)


def _places(costs: Sequence[float]) -> str:
    if len(costs) < 2:
        return f"{len(costs)} minimum" if costs else "no minimum"
    return f"{len(costs)} different minima, of criteria from {number(min(costs), 2)} to {number(max(costs), 2)}"


def annealing_escapes(starts: int, reached: Mapping[str, int], within: float) -> Verdict:
    """The gradient fails from some starts, and the annealing from none.

    Parameters
    ----------
    reached : `gradient`, `squares`, `annealed` and `polished` -> from how many starts it reached the deepest minimum.
    within : of the lowest criterion found by any, a factor.
    """
    parts = [reached["gradient"] < starts, reached["annealed"] == starts]
    sentence = (
        f"Of {starts} starts, gradient descent came within a factor {number(within)} of the lowest criterion found "
        f"from {reached['gradient']}, least squares from {reached['squares']}, annealing from {reached['annealed']}, "
        f"and annealing with least squares after it from {reached['polished']}."
    )
    why = ""
    if not parts[0]:
        why = "The gradient found the deepest minimum from everywhere."
    elif not parts[1]:
        why = "The annealing, too, stops short of the deepest minimum where the evaluations it is given run out."
    return Verdict(
        "A gradient alone fails from some starts where annealing does not.", "IV.C", outcome_of(parts), sentence, why
    )


def three_bands_better(errors: Mapping[str, Mapping[str, Sequence[float]]], velocities: Sequence[float]) -> Verdict:
    """Three bands nearer the measured sound than the global criterion, on average over velocities, in both measures.

    Parameters
    ----------
    errors : "attack" and "centroid" -> "three bands" and "global criterion" -> relative errors [velocities].
    """
    three, whole = "three bands", "global criterion"
    said, parts = [], []
    for key, what in (("attack", "attack time"), ("centroid", "spectral centroid")):
        by = {name: np.abs(np.asarray(errors[key][name], float)) for name in (three, whole)}
        parts.append(bool(by[three].mean() < by[whole].mean()))
        said.append(
            f"the {what} is off by {percent(by[three].mean())} with three bands and by {percent(by[whole].mean())} "
            f"with the global criterion (three bands nearer at {int((by[three] < by[whole]).sum())} of "
            f"{len(velocities)} velocities)"
        )
    lost = float(np.mean(errors["centroid"][whole]))
    if abs(lost) < LITTLE:
        why = (
            f"The global criterion itself loses little brightness ({percent(abs(lost))} on average): the strong "
            "partials, which rule it, depend on the hammer too."
        )
    else:
        why = (
            f"The global criterion makes the sound too {'dull' if lost < 0 else 'bright'}, its centroid is off by "
            f"{percent(abs(lost))}; but the three-band fit is off as well."
        )
    return Verdict(
        "Three bands keep attack and brightness better than a global criterion.", "IV.B, VI", outcome_of(parts),
        f"On average over velocities {said[0]}; {said[1]}.", "" if all(parts) else why,
    )  # fmt: skip


def string_found(
    true: Mapping[str, float], found: Mapping[str, float], shares: Mapping[str, Mapping[int, float]]
) -> Verdict:
    """c, κ and b1 within `NEAR` of the truth; b2 has a verdict of its own.

    Parameters
    ----------
    shares : band -> partial -> its share in the criterion.
    """
    off = {name: found[name] / true[name] - 1 for name in NEAR}
    said = [f"{SYMBOLS.get(name, name)} is off by {percent(abs(share))}" for name, share in off.items()]
    strongest = max(shares["band2"], key=lambda k: shares["band2"][k])
    why = (
        f"Squared energies let the strongest partial rule: partial {strongest} alone makes up "
        f"{percent(shares['band2'][strongest])} of what band 2 is compared by, and one partial's place and height "
        "cannot tell κ from c, nor from a hammer that is still the initial one."
    )
    parts = [abs(off[name]) <= near for name, near in NEAR.items()]
    return Verdict(
        "A gradient in bands 1 and 2 finds the string.", "IV.C, Table II", outcome_of(parts), f"{joined(said)}.",
        "" if all(parts) else why,
    )  # fmt: skip


def changes_as_printed(
    initial: Mapping[str, float], printed: Mapping[str, float], found: Mapping[str, float]
) -> Verdict:
    """Every parameter moved from its start as in the paper: up, down, or hardly at all (`STILL`)."""

    def way(name: str, after: float) -> int:
        share = after / initial[name] - 1
        return 0 if abs(share) <= STILL.get(name, 0.005) else 1 if share > 0 else -1

    same = {name: way(name, found[name]) == way(name, printed[name]) for name in printed}
    other = [
        f"{SYMBOLS.get(name, name)} went from {number(initial[name], 3)} to {number(found[name], 3)}, the paper's to "
        f"{number(printed[name], 3)}"
        for name, agrees in same.items()
        if not agrees
    ]
    sentence = f"{sum(same.values())} of {len(same)} parameters moved from their start as the paper's did"
    return Verdict(
        "The felt gets stiffer and loses more, the hammer lighter and faster, p stays; the string loses more.",
        "V, Tables II and III", outcome_of([*same.values()]), "; ".join([sentence, *other]) + ".",
    )  # fmt: skip


def high_partials_differ(low_db: float, high_db: float, excess_db: float) -> Verdict:
    """Partials to the seventh agree to 1 dB, those above differ more.

    Parameters
    ----------
    low_db, high_db : rms differences in level, dB, of partials to the seventh, and above.
    excess_db : mean of model over measurement above the seventh, dB.
    """
    parts = [low_db <= 1.0, high_db > low_db]
    sentence = (
        f"The first seven partials differ by {number(low_db, 2)} dB (rms), those above by {number(high_db, 2)} dB; on "
        f"average the model has {number(abs(excess_db), 2)} dB {'more' if excess_db > 0 else 'less'} there than "
        "measured."
    )
    return Verdict("The first seven partials agree, those above differ.", "V, Figure 6", outcome_of(parts), sentence)


def waveforms_nearer(before: float, after: float) -> Verdict:
    """The difference from the measured waveform is less than half of what it was; both relative to its rms."""
    sentence = (
        f"The difference from the measured waveform is {percent(before)} of its rms before, {percent(after)} after."
    )
    return Verdict(
        "The waveform comes clearly nearer the measured one.",
        "V, Figure 7",
        outcome_of([after < 0.5 * before]),
        sentence,
    )


def predicts(
    velocities: Sequence[float], origin: float, predicted: Sequence[float], initial: Sequence[float],
    nearest: Sequence[float],
) -> Verdict:  # fmt: skip
    """Parameters of one velocity meet another's levels better than the initial values, and than the recording itself.

    Parameters
    ----------
    origin : velocity at which they were fitted, m/s.
    predicted, initial, nearest : rms errors of the partials' levels [velocities], dB: by the fit at `origin`, by the
        initial values, and of the recording at `origin` taken for the other.
    """
    parts = [bool(p < i and p < n) for p, i, n in zip(predicted, initial, nearest, strict=True)]
    sentence = (
        f"Fitted at {number(origin)} m/s, the model misses the partials' levels by {listed(predicted, 2)} dB at "
        f"{listed(velocities, 4)} m/s, the initial values by {listed(initial, 2)} dB, and the recording itself, taken "
        f"for the others, by {listed(nearest, 2)} dB."
    )
    return Verdict("Parameters from one velocity predict other velocities.", "V", outcome_of(parts), sentence)


def repeats(spread: Mapping[str, float], count: int, alike: float = 0.05) -> Verdict:
    """Every parameter's standard deviation over repeated measurements, of its logarithm, is at most `alike`."""
    close = [name for name, share in spread.items() if share <= alike]
    loose = [name for name, share in spread.items() if share > alike]
    said = []
    if close:
        names = joined([SYMBOLS.get(name, name) for name in close])
        said.append(f"{names} scatter by {percent(max(spread[name] for name in close))} at most")
    if loose:
        said.append(joined([f"{SYMBOLS.get(name, name)} by {_scatter(spread[name])}" for name in loose]))
    why = (
        "The measurements differ by noise, and the fits by where the sensor makes them start. What scatters is what "
        "the criterion hardly sees, or hardly tells apart (K_H and p along equal force), and the annealing ends at "
        "another point of the same valley."
    )
    return Verdict(
        "Repeated measurements give very similar parameters.", "V", outcome_of([name in close for name in spread]),
        f"Over {count} measurements of the same blow {'; '.join(said)} (standard deviation).", "" if not loose else why,
    )  # fmt: skip


def _scatter(deviation: float) -> str:
    """A standard deviation of the logarithm: a percentage while it is small, else a factor."""
    return percent(deviation) if deviation < 0.3 else f"a factor {number(float(np.exp(min(deviation, 700.0))), 2)}"


def explained(alone: Mapping[str, float], everything: float, nothing: float) -> Verdict:
    """Without what the model lacks hardly anything remains (a tenth), and some effect alone leaves a tenth of it all.

    Parameters
    ----------
    alone : effect -> criterion that remains after a fit, with it alone.
    everything, nothing : with all effects, and with none.
    """
    order = sorted(alone, key=lambda name: -alone[name])
    parts = [nothing < 0.1 * everything, alone[order[0]] >= 0.1 * everything]
    sentence = (
        f"With all effects {number(everything, 2)} of band 3 remains after the fit, with none {number(nothing, 2)}. "
        f"Alone, {joined([f'{name} leaves {number(alone[name], 2)}' for name in order])}."
    )
    why = "" if parts[0] else "What remains with no effect at all is the search's own shortfall, and it is as large."
    return Verdict("What remains after the fit is what the model lacks.", "V, VI", outcome_of(parts), sentence, why)
