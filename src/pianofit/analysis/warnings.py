"""Warnings of an analysis: the pitch, B, beats, a second stroke."""

import numpy as np

from ..conversions import BEATING_DB
from .analysis_result import Partials
from .inharmonicity import B_RANGE, DecayLaw, FrequencyLaw
from .note_names import cents_above, hz_to_note, midi_to_note, note_to_hz, note_to_midi

# 1/s; slower envelopes do not decay: their T60 is above two hours.
LEAST_DECAY = 1e-3
# Cents; a smaller glide is removed without a warning, which has one decimal.
_LEAST_WARNED_GLIDE = 0.1


def analysis_warnings(
    note: str | int | None,
    law: FrequencyLaw,
    losses: DecayLaw,
    table: Partials,
    glide_cents: float,
    second_stroke_s: float | None,
) -> tuple[str, ...]:
    """All warnings of an analysis. `glide_cents` is the fall of the pitch, 0 if it is not significant."""
    warnings = [_wrong_note(note, law.f0), _bound(law)]
    if second_stroke_s is not None:
        warnings.append(
            f"most partials rise again about {second_stroke_s:.2f} s after the onset: a second stroke changes the "
            "results; give a file of one stroke"
        )
    if len(table) == 1:
        warnings.append("only one partial detected: B is assumed, f0 depends on it, the losses are poorly determined")
    elif len(table) == 2:
        warnings.append("only 2 partials detected: B and the losses are poorly determined")
    if np.mean(table.decay <= LEAST_DECAY) > 0.5:
        warnings.append(
            "most partials do not decay: a looped, reversed or compressed sound does not determine the losses"
        )
    if abs(glide_cents) > _LEAST_WARNED_GLIDE:
        warnings.append(
            f"the pitch {'falls' if glide_cents > 0 else 'rises'} by {abs(glide_cents):.1f} cents as the note decays"
        )
    warnings.append(beating_warning(table))
    if losses.d2 < 2 * losses.d2_error and len(table) > 1:
        warnings.append("the decay rates do not determine how losses rise with frequency")
    return tuple(filter(None, warnings))


def _wrong_note(note: str | int | None, f0: float) -> str:
    """The warning of a recording whose pitch lies nearer to another key than to the given note."""
    cents = 0.0 if note is None else cents_above(f0, note_to_hz(note))
    if note is None or abs(cents) <= 50:
        return ""
    name, side = midi_to_note(note_to_midi(note)), "above" if cents > 0 else "below"
    return (
        f"the pitch lies {abs(cents):.0f} cents {side} {name}, nearer to {hz_to_note(f0)}: check the note's name, or "
        "how the instrument is tuned"
    )


def _bound(law: FrequencyLaw) -> str:
    """The warning of a B at either end of the searched range."""
    if not np.isfinite(law.B_error) or law.B not in B_RANGE:
        return ""
    if B_RANGE[1] == law.B:
        remark = f"upper bound, {law.B:g}: check the note (--note), and that the partials belong to one string"
    else:
        remark = (
            f"lower bound, {law.B:g}: the partials are harmonic, and those of a stiff string are not; "
            "check that the recording holds one string without effects"
        )
    return f"B is at its {remark}"


def count_beating(table: Partials) -> int:
    """Number of partials whose log envelope deviates from one exponential by more than `BEATING_DB`."""
    return int(np.sum(table.beating > BEATING_DB))


def beating_warning(table: Partials) -> str:
    """The warning of a recording whose partials beat; empty if none do."""
    deep = count_beating(table)
    if not deep:
        return ""
    return (
        f"{deep} of {len(table)} partials deviate from an exponential decay by more than {BEATING_DB:g} dB, because "
        "several strings or polarisations beat, or because the note was damped or cut"
    )
