"""The tuning of a piano: frozen records whose fields are the keys of the JSON that `pianofit tuning` writes."""

from dataclasses import dataclass
from typing import Literal

from .decode import Number
from .extras import KeyNumber

# Octave types by the partials of the lower and of the upper key that coincide. A tuner names them so.
OctaveType = Literal["2:1", "4:2", "6:3"]


@dataclass(frozen=True)
class IntervalValue:
    """A number with its 95 % interval.

    Parameters
    ----------
    value : best estimate.
    interval : its two ends.
    """

    value: Number
    interval: tuple[Number, Number]


@dataclass(frozen=True)
class PartialBeat:
    """Beats of one partial of a recorded key: the frequency difference of the two modes that interfere most.

    Parameters
    ----------
    partial : number of the partial.
    frequency : its frequency, Hz.
    rate : beats per second.
    cents : the same difference as an interval.
    depth_db : from the lowest to the highest effect of the interference, dB.
    """

    partial: int
    frequency: Number
    rate: IntervalValue
    cents: IntervalValue
    depth_db: Number


@dataclass(frozen=True, kw_only=True)
class TunedKey:
    """One key. Cents are those of partial 1 relative to equal temperament at the A4 of the tuning.

    Parameters
    ----------
    midi, note : the key.
    recorded : whether a fit measured it. The other keys are inferred.
    f0 : frequency of the string without stiffness, Hz.
    B : inharmonicity.
    first_partial : frequency of partial 1 of the piano as it was recorded, Hz.
    as_found : its cents.
    law : cents of the smooth law through the recorded keys.
    curves : cents of the tuning curve of every octave type.
    target : frequency of partial 1 by the chosen tuning curve, Hz.
    change : target minus as found, cents.
    deviation : as found minus the law, cents, of a recorded key.
    beats : of the partials of a recorded key.
    unison_cents : split of the unison, cents: median over the partials in which it, but at least 2 cents, would be a
        measurable beat. A partial that does not beat counts as 0. None without a modal response.
    """

    midi: KeyNumber
    note: str
    recorded: bool
    f0: IntervalValue
    B: IntervalValue
    first_partial: IntervalValue
    as_found: IntervalValue
    law: IntervalValue
    curves: dict[OctaveType, IntervalValue]
    target: IntervalValue
    change: IntervalValue
    deviation: IntervalValue | None = None
    beats: tuple[PartialBeat, ...] = ()
    unison_cents: IntervalValue | None = None


@dataclass(frozen=True, kw_only=True)
class Tuning:
    """The tuning of all 88 keys of a piano, as it was recorded and as it could be.

    Parameters
    ----------
    name : of the instrument.
    a4 : frequency of partial 1 of A4, Hz.
    octave : type of the octaves of the chosen tuning curve.
    keys : A0 to C8.
    off : notes of recorded keys that deviate from the law by more than the interval, largest deviation first.
    wide_unisons : notes of recorded keys whose unison is split by more than listeners prefer, widest first.
    warnings : reservations about the result.
    """

    schema: int = 1
    program: str = "pianofit"
    kind: Literal["tuning"] = "tuning"
    name: str
    a4: Number
    octave: OctaveType
    keys: tuple[TunedKey, ...]
    off: tuple[str, ...] = ()
    wide_unisons: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
