"""A playable instrument: the note of every key, and what its fits and keyboard laws report."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from ..analysis.note_names import midi_to_note
from ..conversions import A4, DB, LOWEST_KEY
from ..errors import ParameterError
from ..excitation import Excitation
from ..felt import law_of
from ..io.number_format import counted
from ..model.note import Note
from ..schema.bridge import BridgeAdmittance
from ..schema.dampers import LAST_DAMPER, Dampers
from ..schema.extras import NoiseFloor
from ..schema.instrument import FitSummary, KeyboardLaw, KeyState, KeyValue, VelocityCurve
from .release_noise import ReleaseNoise

# States of a key, and what they mean.
KEY_STATES: dict[KeyState, str] = {
    "recorded": "has its own fit",
    "interpolated": "never recorded, between recorded keys",
    "extrapolated": "never recorded, beyond the recorded keys",
    "changed": "changed by hand on the page to play",
}


@dataclass(frozen=True, eq=False)
class Key:
    """One key of an instrument.

    Parameters
    ----------
    note : the note, with any hammer velocity.
    state : one of `KEY_STATES`.
    values : values with 95 % intervals by name of the law.
    fit : the fit of a recorded key.
    changes : changes by slider of the page to play.
    is_guessed : whether the note follows from the laws and the other keys.
    """

    note: Note
    state: KeyState | None = None
    values: Mapping[str, KeyValue] = field(default_factory=dict)
    fit: FitSummary | None = None
    changes: Mapping[str, float] | None = None
    is_guessed: bool = False


@dataclass(frozen=True, eq=False, repr=False)
class Instrument:
    """A playable instrument.

    Parameters
    ----------
    name : name of the instrument.
    keys : keys by MIDI number.
    velocity : hammer velocity over MIDI velocity.
    laws : keyboard laws by name.
    warnings : limitations.
    even : how far recorded keys were moved towards the laws, from 0 (as fitted) to 1.
    dampers : decay rates that dampers add.
    release : noise of keys that are let go, if it was recorded.
    noise : noise floor of the recordings, if they have one.
    bridge : admittance of the bridge, which couples the strings.

    Examples
    --------
    Three keys with typical parameters of a grand piano:

    >>> import pianofit
    >>> presets = {midi: pianofit.typical(midi) for midi in (60, 64, 67)}
    >>> keys = {
    ...     midi: pianofit.Key(pianofit.Note(it.string, it.hammer, it.geometry, "bridge-force", gain=0.1))
    ...     for midi, it in presets.items()
    ... }
    >>> pianofit.Instrument("grand", keys).note(60, velocity=64).hammer.v_H0
    1.3
    """

    name: str
    keys: Mapping[int, Key]
    velocity: VelocityCurve = field(default_factory=VelocityCurve)
    laws: Mapping[str, KeyboardLaw] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    even: float = 0.0
    dampers: Dampers = field(default_factory=Dampers)
    release: ReleaseNoise | None = None
    noise: NoiseFloor | None = None
    bridge: BridgeAdmittance = field(default_factory=BridgeAdmittance)

    def __repr__(self) -> str:
        return f"Instrument({self.name!r}, {counted(len(self.keys), 'key')}, {len(self.recorded)} recorded)"

    @property
    def quantity(self) -> str:
        """Recorded quantity."""
        return next(iter(self.keys.values())).note.quantity

    @property
    def law(self) -> Excitation:
        """Excitation of the strings."""
        return law_of(next(iter(self.keys.values())).note.hammer)

    @property
    def resonates(self) -> bool:
        """True if strings excite one another over the bridge.

        Not for plucks: a key of a guitar is not a string of its own, so the free strings are not known.
        """
        return self.law.has_contact

    @property
    def channels(self) -> int:
        """Number of channels: the largest of all keys."""
        return max(
            1 if key.note.modal_response is None else key.note.modal_response.channels for key in self.keys.values()
        )

    @property
    def pre_onset_s(self) -> float:
        """Longest time from the begin of a sound to its contact, s."""
        return max(key.note.pre_onset_s for key in self.keys.values())

    @property
    def recorded(self) -> list[int]:
        """Keys with a fit. The others follow from the laws."""
        return sorted(midi for midi, key in self.keys.items() if key.fit is not None)

    @property
    def changed(self) -> list[int]:
        """Keys that were changed by hand on the page to play."""
        return sorted(midi for midi, key in self.keys.items() if key.state == "changed")

    def unrecorded(self, keys: Iterable[int]) -> list[int]:
        """Return those of these MIDI keys that were never recorded."""
        return sorted(set(keys) - set(self.recorded))

    @property
    def unrecorded_counts(self) -> tuple[int, int]:
        """Numbers of keys that were never recorded: between recorded keys, and beyond them."""
        recorded, unrecorded = self.recorded, self.unrecorded(self.keys)
        between = sum(recorded[0] < midi < recorded[-1] for midi in unrecorded) if recorded else 0
        return between, len(unrecorded) - between

    @property
    def guesses(self) -> str:
        """Text on the keys that were never recorded. Their values are guesses."""
        between, beyond = self.unrecorded_counts
        parts = [f"{n} {where}" for n, where in ((between, "between recorded keys"), (beyond, "beyond them")) if n]
        if not parts:
            return "none is a guess"
        return f"{between + beyond} {'is a guess' if between + beyond == 1 else 'are guesses'}: {', '.join(parts)}"

    @property
    def evenness(self) -> str:
        """Text on how recorded keys are played."""
        if not self.even:
            return "recorded keys are played as fitted"
        return f"recorded keys are moved by {100 * self.even:.3g} % to the laws in level, decay and brightness"

    def note(self, midi: int, velocity: float) -> Note:
        """Return the note of a key, struck or plucked at a MIDI velocity.

        Parameters
        ----------
        midi : MIDI number of the key.
        velocity : MIDI velocity, 1 to 127.

        Raises
        ------
        ParameterError
            If the instrument does not have this key.
        """
        if midi not in self.keys:
            span = f"{midi_to_note(min(self.keys))} to {midi_to_note(max(self.keys))}"
            raise ParameterError(
                f"key {midi} is not among the {len(self.keys)} keys of {self.name or 'this instrument'}, {span}"
            )
        return self.keys[midi].note.with_size(self.velocity.at(velocity))

    @property
    def state_counts(self) -> dict[KeyState, int]:
        """Numbers of keys by state, without states that no key has."""
        states = [key.state for key in self.keys.values()]
        return {state: count for state in KEY_STATES if (count := states.count(state))}

    @property
    def beyond_strings(self) -> str:
        """Text on dampers, release noise and noise floor."""
        measured = f"{self.dampers.source}, {counted(len(self.dampers.keys), 'key')}" * bool(self.dampers.keys)
        low, high = (self.dampers.rate(midi) * DB for midi in (LOWEST_KEY, LAST_DAMPER))
        dampers = f"dampers: {low:.0f} to {high:.0f} dB/s at the fundamental, from: {measured or self.dampers.source}"
        release = counted(len(self.release.sounds), "key") if self.release else "none"
        noise = f"{self.noise.level_db:.0f} dB re full scale" if self.noise else "none"
        bridge = f"; {self._bridge}" * self.resonates
        return f"{dampers}; release noise: {release} recorded; noise floor: {noise}{bridge}"

    @property
    def _bridge(self) -> str:
        """Text on the impedance of the bridge, 1/Re Y, at the frequency of A4."""
        low, high = (float(1 / ends[0]) for ends in reversed(self.bridge.interval(np.array([A4]))))
        source = f"{self.bridge.source}, {counted(self.bridge.partials, 'partial')}" * bool(self.bridge.partials)
        return (
            f"bridge: {1 / self.bridge.at(np.array([A4]))[0]:.0f} kg/s at {A4:.0f} Hz, 95 % {low:.0f} to {high:.0f}, "
            f"from: {source or self.bridge.source}"
        )

    def summary(self) -> str:
        """Return a summary in a few lines: states and evenness of keys, keyboard laws, MIDI velocity, warnings."""
        lines = [
            f"{self.name or 'instrument'}: {counted(len(self.recorded), 'key')} recorded: "
            + ", ".join(f"{count} {state}" for state, count in self.state_counts.items()),
            self.evenness,
            "",
            f"{'':26}{'key scatter':>14}{'smooth over':>12}",
        ]
        for name, law in self.laws.items():
            label = f"{'tuning' if name == 'cents' else name}{f', {law.unit}' if law.unit not in ('', '1') else ''}"
            scatter = f"{law.scatter:.2g} {law.unit}" if law.scale == "linear" else f"{100 * law.scatter:.2g} %"
            lines.append(f"{label:26}{scatter:>14}{law.length_keys:>7.0f} keys")
        size = f"{self.velocity.at_64:.3g} {self.law.hammer_parameters[self.law.size].unit}"
        lines += ["", f"MIDI velocity 64 is {size}, from: {self.velocity.source}"]
        lines.append(self.beyond_strings)
        return "\n".join([*lines, *self.warnings])
