"""Content of an `instrument.json`: frozen records whose fields are the keys of the file.

The package `instrument` uses the same records in memory. Only notes have another form there.
"""

import math
import os
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from ..conversions import HIGHEST_KEY, LOWEST_KEY
from ..excitation import HAMMER
from ..parameters import PARAMETERS
from .bridge import BridgeAdmittance
from .dampers import Dampers
from .decode import MidiVelocity, Number, load_json, load_record
from .extras import KeyNumber, NoiseFloor, SoundEntry
from .fit import ExcitationName, PathEntry, PickupQuantity
from .modal_response import ModalResponseEntry

INSTRUMENT_FILE = "instrument.json"
# Largest instrument.json, bytes.
LARGEST_INSTRUMENT = 2**25
HINT = "give the instrument.json that pianofit instrument wrote"

V_H0 = PARAMETERS["v_H0"]
HammerVelocity = Annotated[float, Meta(ge=V_H0.lower, le=V_H0.upper)]
Gain = Annotated[float, Meta(ge=-1e12, le=1e12)]
# Smallest gain, either sign. Sounds of a smaller one are silent in every file.
SMALLEST_GAIN = 1e-12
Share = Annotated[float, Meta(ge=0.0, le=1.0)]
# Longest recording in a file, s.
ContactTime = Annotated[float, Meta(ge=-600.0, le=600.0)]
# The state of a key. The values of a changed key were set by hand on the page to play.
KeyState = Literal["recorded", "interpolated", "extrapolated", "changed"]


@dataclass(frozen=True)
class VelocityCurve:
    """Hammer velocity over MIDI velocity. Its logarithm is linear. The default is for keys without layers.

    For plucks the same numbers are forces, N.
    """

    at_64: HammerVelocity = 1.3  # m/s
    rise: Annotated[float, Meta(gt=0.0, le=10.0)] = 1.5  # of the logarithm, from 64 to 127
    # `midi-velocities` if the library gave those of some layers, `layers` if their order alone was known.
    source: Literal["midi-velocities", "layers", "default", "page"] = "default"
    layers: tuple[tuple[Number, Number], ...] = ()  # MIDI velocity and hammer velocity of each recorded layer

    def at(self, midi_velocity: float) -> float:
        """Return the hammer velocity, m/s, or the force of a pluck, N, at a MIDI velocity from 1 to 127."""
        velocity = self.at_64 * math.exp(self.rise * (midi_velocity - 64) / 63)
        return float(np.clip(velocity, V_H0.lower, V_H0.upper))


@dataclass(frozen=True, eq=False)
class KeyboardLaw:
    """One quantity over the 88 keys."""

    unit: str
    scale: Literal["linear", "log"]  # on which the law is smooth
    literature: np.ndarray | None  # [88]
    value: np.ndarray
    low: np.ndarray  # ends of the 95 % interval
    high: np.ndarray
    scatter: Number  # standard deviation of single keys on the scale of the law
    length_keys: Number  # over which the law is smooth

    def __post_init__(self) -> None:
        rows = [self.value, self.low, self.high, *([] if self.literature is None else [self.literature])]
        if {row.shape for row in rows} != {(HIGHEST_KEY - LOWEST_KEY + 1,)}:
            raise ValueError("Expected a value for each of the 88 keys")


@dataclass(frozen=True)
class OwnFit:
    """A value in the fit of its key."""

    value: Number
    interval: tuple[Number, Number]  # 95 %
    z: Number  # deviation from the prediction of all other keys, in standard deviations


@dataclass(frozen=True)
class KeyValue:
    """A quantity of one key."""

    value: Number  # as played
    interval: tuple[Number, Number]  # 95 %
    law: Number | None = None
    own_fit: OwnFit | None = None  # of a recorded key


@dataclass(frozen=True)
class Layer:
    """One recording that a key was fitted to."""

    file: str
    sha256: str  # of its bytes
    contact: ContactTime  # time at which the hammer touches the string, s
    velocity: HammerVelocity  # or the force of a pluck, N
    midi_velocity: MidiVelocity | None = None  # at which the library plays it, if known


@dataclass(frozen=True)
class PartialEntry:
    """Beating and double decay of one partial."""

    partial: int
    late_over_early: Number | None  # ratio of the T60 of the late and the early decay
    split_cents: Number | None  # of the two modes that interfere most


@dataclass(frozen=True)
class FitSummary:
    """The fit of a recorded key. An instrument that was saved from a page has no details."""

    file: str = ""
    recordings: int = 0
    levels_db: Number | None = None  # rms error of the levels of the partials
    converged: bool = True
    velocities: tuple[Number, ...] = ()  # of the recordings, ascending, m/s
    layers: tuple[Layer, ...] = ()  # soft to loud
    partials: tuple[PartialEntry, ...] = ()  # the lowest


@dataclass(frozen=True)
class StringEntry:
    """Coefficients of a string."""

    c: Number
    kappa: Number
    b1: Number
    b2: Number


@dataclass(frozen=True)
class HammerEntry:
    """A hammer without its velocity."""

    K_H: Number
    mu: Number
    p: Number
    M_H: Number
    skin: Number = 0.0


@dataclass(frozen=True)
class GeometryEntry:
    """Sizes of a string."""

    length: Number
    mass: Number
    strike_position: Number
    width: Number
    pickup: Number


@dataclass(frozen=True, kw_only=True)
class KeyEntry:
    """One key."""

    midi: KeyNumber
    note: str = ""
    state: KeyState | None = None
    string: StringEntry
    hammer: HammerEntry | None = None  # None for a pluck
    geometry: GeometryEntry
    gain: Gain
    path: PathEntry | None = None
    # `guess` if the response follows from the laws and the recorded keys.
    modal_response: ModalResponseEntry | Literal["guess"] | None = None
    values: dict[str, KeyValue] = field(default_factory=dict)  # by name of the law
    changes: dict[str, Number] | None = None  # by slider of the page: factors, and a difference of p
    fit: FitSummary | None = None  # of a recorded key

    def __post_init__(self) -> None:
        if abs(self.gain) < SMALLEST_GAIN:
            raise ValueError(f"gain must be at least {SMALLEST_GAIN:g}, or at most {-SMALLEST_GAIN:g}")


@dataclass(frozen=True)
class ReleaseEntry:
    """The noise of a key that is let go."""

    midi: KeyNumber
    sound: SoundEntry


@dataclass(frozen=True, kw_only=True)
class InstrumentFile:
    """A whole instrument."""

    schema: int = 8
    program: str = "pianofit"
    kind: Literal["instrument"] = "instrument"
    name: str = ""
    quantity: PickupQuantity
    excitation: ExcitationName = HAMMER
    velocity: VelocityCurve
    laws: dict[str, KeyboardLaw] = field(default_factory=dict)
    keys: Annotated[tuple[KeyEntry, ...], Meta(min_length=1, max_length=HIGHEST_KEY - LOWEST_KEY + 1)]
    warnings: tuple[str, ...] = ()
    even: Share = 0.0  # how far recorded keys were moved towards the laws
    bridge: BridgeAdmittance = field(default_factory=BridgeAdmittance)
    dampers: Dampers = field(default_factory=Dampers)
    releases: tuple[ReleaseEntry, ...] = ()  # of recorded keys
    noise: NoiseFloor | None = None
    versions: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        numbers = [key.midi for key in self.keys]
        if twice := {number for number in numbers if numbers.count(number) > 1}:
            raise ValueError(f"keys has two entries with midi = {min(twice)}")
        wrong = [i for i, key in enumerate(self.keys) if (key.hammer is None) == (self.excitation == HAMMER)]
        if wrong:
            raise ValueError(f"keys[{wrong[0]}].hammer must be given with excitation = {HAMMER!r}, and only then")


def read_instrument_file(path: str | os.PathLike[str]) -> InstrumentFile:
    """Read an `instrument.json`; raise a `FitError` for any other file, which names the file and the entry."""
    return load_record(path, InstrumentFile, LARGEST_INSTRUMENT, f"an {INSTRUMENT_FILE}", HINT)


def is_instrument(path: str | os.PathLike[str], hint: str) -> bool:
    """Return whether a file is an `instrument.json`, and not a `fit.json`; errors as of `load_json`."""
    content = load_json(path, LARGEST_INSTRUMENT, f"a fit.json or an {INSTRUMENT_FILE}", hint)
    return isinstance(content, dict) and content.get("kind") == "instrument"
