"""One string as it is played: it rings, is damped, is struck again while it moves.

Between strokes every mode decays by itself, in closed form. Its state is one complex amplitude, which goes on from
event to event: a damper adds to its decay and changes nothing else, so nothing clicks. A hammer meets the string as it
moves: the contact is solved with that motion under the hammer.

Where the key's ringing is known (`model.modal`), that is heard instead of the string: the string is only followed for
the next hammer's sake. Either way what a stroke makes heard while it lasts is convolved with the stroke, and afterwards
the modes ring on. A knock may begin before the stroke, so all of a string is heard `lead` samples late.
"""

from __future__ import annotations

import math

import numpy as np

from ..model.modal_response import FAINT, ForcePulse, sum_damped_modes, z_transform_at_poles
from ..model.note import Note
from ..model.output_path import filtered
from .repeated_strike import StringTables, stroke, table_of

__all__ = ["CHANNELS", "KNOCK_RATES", "LAST_DAMPER", "StringVoice", "damper_rate"]

# Channels of what is handed to other programs and pages: a listener has two ears.
CHANNELS = 2
# Rates at which they hold knocks, Hz, where there is no room for more: whole parts of 48,000 Hz, the best first.
KNOCK_RATES = (24_000, 16_000, 12_000, 8_000, 6_000, 4_000)
LAST_DAMPER = 90  # F#6; the strings above have none
# What a damper adds to every mode's decay, 1/s, at the lowest key and at the last that has one: about 0.3 s to 0.12 s
# for 60 dB. Chosen once; no fit sees a damper.
DAMPER = (25.0, 60.0)


def damper_rate(midi: int) -> float:
    """Extra decay under the damper, 1/s; 0 for the keys that have none."""
    if midi > LAST_DAMPER:
        return 0.0
    x = min(max((midi - 21) / (LAST_DAMPER - 21), 0.0), 1.0)
    return DAMPER[0] * (DAMPER[1] / DAMPER[0]) ** x


class ModeBank:
    """Modes that ring by themselves, at rest at first: Re(pattern · state), which decays and turns by `pole`."""

    def __init__(self, pole: np.ndarray, pattern: np.ndarray, faint: np.ndarray, rate: int) -> None:
        self.pole = pole  # 1/s, complex [modes]
        self.pattern = pattern  # file units per unit of state, complex [channels, modes]
        self.faint = faint  # what is not heard, file units [modes]
        self.rate = rate  # Hz
        self.reset()

    def reset(self) -> None:
        """Stop them."""
        self.state = np.zeros(len(self.pole), complex)

    @property
    def is_audible(self) -> bool:
        """Whether anything is left to hear."""
        return bool((np.abs(self.pattern * self.state) > self.faint).any())

    def ring(self, samples: int, extra: float) -> np.ndarray:
        """What is heard [channels, samples] with so much extra decay, 1/s; modes end where they are inaudible."""
        sound = sum_damped_modes(self.pole - extra, self.pattern * self.state, self.rate, samples, self.faint)
        self.advance(samples, extra)
        return sound

    def advance(self, samples: int, extra: float) -> None:
        """Move on, unheard."""
        self.state = self.state * np.exp((self.pole - extra) * (samples / self.rate))
        if not self.is_audible:
            self.reset()


class StringVoice:
    """One key's string at one rate, silent at first; what it gives is still to go through `heard`."""

    def __init__(self, note: Note, midi: int, rate: int) -> None:
        self.note, self.midi, self.rate = note, midi, rate
        # Where the key's ringing is known nothing goes through the path: the string, unheard, rings by its law.
        self.table: StringTables = table_of(note if note.ringing is None else note._replace(path=None), rate)
        self.ratio = round(self.table.rate / rate)
        self.string = ModeBank(self.table.pole, self.table.pickup[None], self.table.faint, rate)
        self.ringing, self.modes = None, self.string
        if note.ringing is not None:
            self.ringing = note.ringing.scale_gain(note.gain).at(rate)
            faint = np.full(len(self.ringing.pole), FAINT)
            self.modes = ModeBank(self.ringing.pole, self.ringing.pattern, faint, rate)
        self.lead = round(note.pre_onset_s * rate)
        self.damped = False
        self._decay = damper_rate(midi)
        self._response = np.zeros(0)
        self.reset()

    def reset(self) -> None:
        """Stop it."""
        self.string.reset()
        self.modes.reset()
        # What is sure to be heard, from now on; later samples are nought.
        self._late = np.zeros((len(self.modes.pattern), self.lead))

    def strike(self, velocity: float) -> np.ndarray:
        """The sound [channels, samples] in the time of the contact with a hammer of `velocity`, m/s.

        Then the string rings, undamped.
        """
        hammer = self.note.hammer._replace(v_H0=velocity)
        drive, force = stroke(self.table, hammer, self.string.state, f"key {self.midi}")
        samples = max(-(-len(drive) // self.ratio), 1)
        drive = np.pad(drive, (0, samples * self.ratio - len(drive)))
        self.damped = False
        sound = self._free(samples)  # moves all states on to the contact's end
        self.string.state = self.string.state + self.table.unit * self._left(drive)
        onset = self._onset(drive, force, samples)
        self._add(sound, self.lead)
        self._add(onset, 0)
        return self._next(samples)

    def ring(self, samples: int) -> np.ndarray:
        """The string by itself [channels, samples]."""
        self._add(self._free(samples), self.lead)
        return self._next(samples)

    def heard(self, sound: np.ndarray) -> np.ndarray:
        """A sound of this string [channels, samples] through its path, if any, and what that rings on."""
        return sound if self.ringing is not None else filtered(sound[0], self.table.path)[None]

    @property
    def is_audible(self) -> bool:
        """Whether anything is left to hear."""
        return self.modes.is_audible or bool((np.abs(self._late) > FAINT).any())

    @property
    def in_motion(self) -> bool:
        """Whether a hammer meets it moving, by so much that it would be heard."""
        return self.string.is_audible

    def _free(self, samples: int) -> np.ndarray:
        """What the modes give by themselves [channels, samples]."""
        extra = self._decay if self.damped else 0.0
        if self.ringing is not None:
            self.string.advance(samples, extra)
        return self.modes.ring(samples, extra)

    def _left(self, drive: np.ndarray) -> np.ndarray:
        """Σ_n T_n z^(N - n), N = len(T): what the pulse has left at its end, for a unit response [modes]."""
        log_z = self.string.pole / self.table.rate
        return np.exp(log_z) * z_transform_at_poles(log_z, drive[::-1])

    def _onset(self, drive: np.ndarray, force: ForcePulse, samples: int) -> np.ndarray:
        """What a stroke makes heard beside the modes that ring by themselves after it, from `lead` before it on."""
        if self.ringing is None:
            return filtered(self._kernel(len(drive)), drive)[None, : len(drive) : self.ratio]
        state, onset = self.ringing.strike_response(force, samples)
        self.modes.state = self.modes.state + state
        return onset

    def _add(self, sound: np.ndarray, at: int) -> None:
        """Make a sound [channels, samples] sure to be heard, from `at` samples from now on."""
        end = at + sound.shape[-1]
        self._late = np.pad(self._late, ((0, 0), (0, max(end - self._late.shape[-1], 0))))
        self._late[:, at:end] += sound

    def _next(self, samples: int) -> np.ndarray:
        """Take the next samples [channels, samples] of what is sure."""
        sound, self._late = self._late[:, :samples], self._late[:, samples:]
        if not self.is_audible:
            self._late = np.zeros((len(sound), self.lead))
        return sound

    def _kernel(self, steps: int) -> np.ndarray:
        """What a unit T makes heard, at the contact's rate [steps]."""
        if len(self._response) < steps:
            size = max(2 * len(self._response), 1 << math.ceil(math.log2(steps)))
            pole, drive = self.string.pole, self.table.drive[None]
            self._response = sum_damped_modes(
                pole, drive, self.table.rate, size, audibility_threshold=np.zeros(len(pole))
            )[0]
        return self._response[:steps]
