"""An instrument as modes for other engines: the content of a modal JSON file, documented in docs/modal-json.md."""

import base64
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from .instrument import KeyState, KeyValue


@dataclass(frozen=True, eq=False)
class ModeColumns:
    """Modes of a key as columns [modes]."""

    partial: np.ndarray
    frequency: np.ndarray  # Hz
    decay: np.ndarray  # of the amplitude, 1/s
    damper: np.ndarray  # decay rate that the damper adds, 1/s


@dataclass(frozen=True, eq=False)
class ForceEntry:
    """A stroke: the impulses of the hammer force, and what each mode makes of them."""

    midi_velocity: int
    velocity: float  # of the hammer, m/s
    contact_ms: float  # time in which the hammer touches the string
    impulses: np.ndarray  # N s in each sample [samples]
    gain: np.ndarray  # [2, modes]: real and imaginary part of the velocity gain
    level_db: np.ndarray  # amplitude of each mode at the touch, of all channels, dB re full scale [modes]
    knock_change: np.ndarray  # share of each of the key's `knock_changes` in the knock of this stroke [strokes]


@dataclass(frozen=True, eq=False)
class ModesKey:
    """One key."""

    midi: int
    note: str
    state: KeyState | None
    modes: ModeColumns
    pattern: np.ndarray  # [channels, 2, modes]: real and imaginary part, file units per N s
    knock: str  # base64 of 16 bit integers, little endian, channels after each other
    knock_scale: float  # file units per N s and integer
    knock_changes: str  # as `knock` from the touch on, strokes after each other: what is added to it
    knock_changes_scale: float
    forces: tuple[ForceEntry, ...]  # by ascending MIDI velocity
    string: dict[str, float]  # SI units
    hammer: dict[str, float]
    values: dict[str, KeyValue] = field(default_factory=dict)  # with 95 % intervals, by name of the law


@dataclass(frozen=True, kw_only=True)
class ModesFile:
    """A whole instrument."""

    schema: int = 1
    program: str = "pianofit"
    kind: Literal["modes"] = "modes"
    name: str
    licence: str | None
    rate: int  # Hz, of impulses and knocks
    lead: int  # samples of the impulses before the touch
    knock_lead: int  # samples of the knock before the touch
    channels: int
    keys: tuple[ModesKey, ...]


def integers(sound: np.ndarray) -> tuple[str, float]:
    """Return a sound [..., samples] as base64 of 16 bit integers, and their scale."""
    scale = float(np.abs(sound).max(initial=0.0)) / (2**15 - 1) or 1.0
    return base64.b64encode(np.round(sound / scale).astype("<i2").tobytes()).decode(), scale
