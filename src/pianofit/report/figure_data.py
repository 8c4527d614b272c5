"""What the page draws and plays: arrays, ready computed. The page itself computes no physics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from ..model.decay import PartialDecay

__all__ = [
    "ContactCurves",
    "FigureData",
    "Envelope",
    "Felt",
    "IdentifiabilityData",
    "LevelCurves",
    "RecordingCurves",
    "RingingCurves",
    "Strokes",
]


@dataclass(frozen=True)
class RecordingCurves:
    """One recording beside what the model makes of it. Sounds have full scale 1 and the recording's own rate, Hz."""

    place: int  # in the order given, from 1
    velocity: float  # m/s
    error_db: float  # rms over the scored partials, one gain removed
    number: np.ndarray  # [partials], k
    level: np.ndarray  # [partials], dB
    level_error: np.ndarray
    level_fitted: np.ndarray
    compression: np.ndarray  # [steps], mm, while the hammer touches; NaN in between
    force: np.ndarray  # [steps], N
    sound_rate: int
    onset: float  # s
    sound_original: np.ndarray
    sound_fitted: np.ndarray


@dataclass(frozen=True)
class ContactCurves:
    """The reference's stroke, initial and fitted."""

    force_ms: np.ndarray  # [steps], from the first touch
    force: dict[str, np.ndarray]  # N [steps]
    compression: dict[str, np.ndarray]  # mm [steps]


@dataclass(frozen=True)
class LevelCurves:
    """Levels of the reference's partials: measured, initial and fitted."""

    number: np.ndarray  # [partials], k
    levels: dict[str, np.ndarray]  # dB [partials]
    level_error: np.ndarray  # of the measured ones, one standard deviation [partials]


@dataclass(frozen=True)
class Felt:
    """The static law over the compressions reached, with its 95 % band; without one, the ends are the law itself.

    A relaxing felt has two laws: to a sudden stroke, and to a slow one.
    """

    compression: np.ndarray  # [n], mm
    force: np.ndarray  # [3, n], N: law, lower and upper end
    slow: np.ndarray | None = None  # [3, n], N
    formula: tuple[str, ...] = ()  # of the law, in the notation of `formula.py`; empty if the law brings none


@dataclass(frozen=True)
class IdentifiabilityData:
    """How well each thing is known, and what cannot be told apart."""

    names: tuple[str, ...]  # of the parameters, as the page's words have them
    correlation: np.ndarray  # [parameters, parameters]
    # Of what: its name, half of the 95 % interval of its logarithm, and whether it rests on no assumed scale.
    half_widths: tuple[tuple[str, float, bool], ...]


@dataclass(frozen=True)
class Strokes:
    """The note as the model plays it at several velocities, all through one gain."""

    velocity: np.ndarray  # [strokes], m/s, rising
    sounds: tuple[np.ndarray, ...]  # each [samples], full scale = 1
    rate: int  # Hz
    first: int  # where the slider starts
    inside: bool  # all lie within the recordings' velocities


@dataclass(frozen=True)
class Envelope:
    """How one partial falls; levels in dB, full scale = 0."""

    number: int  # k
    frequency: float  # Hz
    time: np.ndarray  # s from the onset [n]
    measured: np.ndarray  # [n]
    law: np.ndarray  # [n], by the string's law
    fitted: np.ndarray | None = None  # [n], as the key rings; None where that is by its law


@dataclass(frozen=True)
class RingingCurves:
    """The reference recording beside the note as it plays, over time and frequency."""

    envelopes: tuple[Envelope, ...]
    time: np.ndarray  # s from the onset [frames]
    frequency: np.ndarray  # middle of the mel bands, Hz [bands]
    measured: np.ndarray  # dB [bands, frames], down to a floor
    played: np.ndarray
    decays: tuple[PartialDecay, ...] = ()  # of every partial that has modes


@dataclass(frozen=True)
class FigureData:
    """One fit's curves and sounds. Frequencies in Hz, decays in 1/s; NaN where there is no value.

    `frequency_cents` is the deviation from k f0, `frequency_cents_law` that of k f0 √(1 + B k²); `decay_law` is
    b1 + d2 k². `_error` is one standard deviation. `path` is the fitted output path at the partials, or None. What has
    one recording only is that of the first. All three: measured, initial and fitted.
    """

    frequency: np.ndarray  # [bins], of the spectra on the damped circle
    spectra: dict[str, np.ndarray]  # dB [bins], of all three
    borders: tuple[float, ...]  # Hz; low, 1|2, 2|3, high, as far as there are such bands
    attack_ms: np.ndarray  # [n], from the onset
    attack: dict[str, np.ndarray]  # [n], full scale = 1, of all three
    number: np.ndarray  # [partials], k
    frequency_cents: np.ndarray  # [partials]
    frequency_cents_error: np.ndarray
    frequency_cents_law: np.ndarray
    decay: np.ndarray  # [partials]
    decay_error: np.ndarray
    decay_law: np.ndarray
    levels: dict[str, np.ndarray]  # dB [partials], of all three
    level_error: np.ndarray
    path: np.ndarray | None  # [partials], dB
    force_ms: np.ndarray  # [m], from the first touch
    force: dict[str, np.ndarray]  # N [m], initial and fitted
    compression: dict[str, np.ndarray]  # mm [m], initial and fitted
    sound_rate: int  # Hz
    sounds: dict[str, np.ndarray]  # what is heard, each [samples] or [channels, samples], full scale = 1
    recordings: tuple[RecordingCurves, ...] = ()  # in the order given
    first: int = 0  # the recording that the curves above are of
    paths: tuple[tuple[np.ndarray, np.ndarray], ...] = ()  # of each group: Hz and dB, [partials]
    felt: Felt | None = None
    known: IdentifiabilityData | None = None
    strokes: Strokes | None = None
    ringing: RingingCurves | None = None
