"""Arrays and sounds of the page. `build.py` computes them; the page only draws and plays them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from ..model.modal_response import PartialDecay

__all__ = [
    "ContactCurves",
    "Envelope",
    "Felt",
    "FigureData",
    "IdentifiabilityData",
    "LevelCurves",
    "RecordingCurves",
    "ModalResponseCurves",
    "Strokes",
]


@dataclass(frozen=True)
class RecordingCurves:
    """One recording and its fitted sound. Sounds have full scale 1 and the sample rate of the recording, Hz."""

    place: int  # position in the list of recordings, from 1
    velocity: float  # m/s
    error_db: float  # rms over the scored partials, one gain removed
    number: np.ndarray  # [partials], k
    level: np.ndarray  # [partials], dB
    level_error: np.ndarray
    level_fitted: np.ndarray
    compression: np.ndarray  # [steps], mm, during contact; NaN in between
    force: np.ndarray  # [steps], N
    sound_rate: int
    onset: float  # s
    sound_original: np.ndarray
    sound_fitted: np.ndarray


@dataclass(frozen=True)
class ContactCurves:
    """Contact of the reference recording, initial and fitted."""

    force_ms: np.ndarray  # [steps], from the first contact
    force: dict[str, np.ndarray]  # N [steps]
    compression: dict[str, np.ndarray]  # mm [steps]


@dataclass(frozen=True)
class LevelCurves:
    """Levels of the partials of the reference recording: measured, initial and fitted."""

    number: np.ndarray  # [partials], k
    levels: dict[str, np.ndarray]  # dB [partials]
    level_error: np.ndarray  # [partials], one standard deviation of the measured levels


@dataclass(frozen=True)
class Felt:
    """Static law over the compressions of the strokes, with its 95 % band; without a band, its ends equal the law.

    A relaxing felt has two laws, one for sudden and one for slow compression.
    """

    compression: np.ndarray  # [n], mm
    force: np.ndarray  # [3, n], N: law, lower and upper end
    slow: np.ndarray | None = None  # [3, n], N
    formula: tuple[str, ...] = ()  # of the law, in the notation of `formula.py`; empty if the law has none


@dataclass(frozen=True)
class IdentifiabilityData:
    """Uncertainty of each quantity, and correlations of the estimates."""

    names: tuple[str, ...]  # of the parameters
    correlation: np.ndarray  # [parameters, parameters]
    # Name, half of the 95 % interval of the logarithm, and True for an invariant.
    half_widths: tuple[tuple[str, float, bool], ...]


@dataclass(frozen=True)
class Strokes:
    """The fitted note at several velocities, all with one gain."""

    velocity: np.ndarray  # [strokes], m/s, rising
    sounds: tuple[np.ndarray, ...]  # each [samples], full scale = 1
    rate: int  # Hz
    first: int  # initial position of the slider
    inside: bool  # True if all lie within the velocities of the recordings


@dataclass(frozen=True)
class Envelope:
    """Level of one partial over time, dB, full scale = 0."""

    number: int  # k
    frequency: float  # Hz
    time: np.ndarray  # s from the onset [n]
    measured: np.ndarray  # [n]
    law: np.ndarray  # [n], string model
    fitted: np.ndarray | None = None  # [n], with the modes of the key; None if it has none


@dataclass(frozen=True)
class ModalResponseCurves:
    """Reference recording and fitted note, over time and frequency."""

    envelopes: tuple[Envelope, ...]
    time: np.ndarray  # s from the onset [frames]
    frequency: np.ndarray  # centre of the mel bands, Hz [bands]
    measured: np.ndarray  # dB [bands, frames], with a lower limit
    played: np.ndarray
    decays: tuple[PartialDecay, ...] = ()  # of every partial that has modes


@dataclass(frozen=True)
class FigureData:
    """Curves and sounds of one fit. Frequencies in Hz, decay rates in 1/s; NaN where a value is missing.

    `frequency_cents` is the deviation from k f0, and `frequency_cents_law` that of k f0 √(1 + B k²). `decay_law` is
    b1 + d2 k². `_error` is one standard deviation. `path` is the fitted output path at the partials, or None. Arrays
    of one recording are those of the reference recording. The keys are measured, initial and fitted, or two of them.
    """

    frequency: np.ndarray  # [bins], of the spectra on the damped circle
    spectra: dict[str, np.ndarray]  # dB [bins]
    borders: tuple[float, ...]  # Hz; low, 1|2, 2|3, high, of the bands that exist
    attack_ms: np.ndarray  # [n], from the onset
    attack: dict[str, np.ndarray]  # [n], full scale = 1
    number: np.ndarray  # [partials], k
    frequency_cents: np.ndarray  # [partials]
    frequency_cents_error: np.ndarray
    frequency_cents_law: np.ndarray
    decay: np.ndarray  # [partials]
    decay_error: np.ndarray
    decay_law: np.ndarray
    levels: dict[str, np.ndarray]  # dB [partials]
    level_error: np.ndarray
    path: np.ndarray | None  # [partials], dB
    force_ms: np.ndarray  # [m], from the first contact
    force: dict[str, np.ndarray]  # N [m], initial and fitted
    compression: dict[str, np.ndarray]  # mm [m], initial and fitted
    sound_rate: int  # Hz
    sounds: dict[str, np.ndarray]  # each [samples] or [channels, samples], full scale = 1
    recordings: tuple[RecordingCurves, ...] = ()  # in the order given
    reference_index: int = 0  # in `recordings`
    paths: tuple[tuple[np.ndarray, np.ndarray], ...] = ()  # of each path group: Hz and dB, [partials]
    felt: Felt | None = None
    identifiability: IdentifiabilityData | None = None
    strokes: Strokes | None = None
    ringing: ModalResponseCurves | None = None
