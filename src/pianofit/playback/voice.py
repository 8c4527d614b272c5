"""One string during playback: free vibration, damping, and strokes on the moving string.

Between strokes every mode decays in closed form. Its state is one complex amplitude, which continues from event to
event. A damper only adds to the decay rates, so that nothing clicks. The contact with the hammer is solved with the
current motion of the string.

If the modal response of the key was measured (`model.modal_response`), it gives the sound. The string is then
simulated only for the contact with the next hammer. In both cases the sound during a stroke is a convolution with the
stroke, and the modes ring freely afterwards. A finger that plucks a string stops it first. A knock may begin before the
stroke, so all output is `lead` samples late.
"""

import math

import numpy as np

from ..dsp.damped_sums import AMPLITUDE_FLOOR, sum_damped_modes, z_transform_at_poles
from ..felt import law_of
from ..instrument.dampers import Dampers
from ..model.modal_response import ForcePulse
from ..model.note import Note
from ..model.output_path import apply_filter
from .cached_strike import StringTables, strike_string, string_tables
from .una_corda import UnaCorda, una_corda

# Largest number of channels of exports and pages: stereo.
CHANNELS = 2
# Reduced rates of knocks in exports and pages, Hz: divisors of 48,000 Hz, the best first.
KNOCK_RATES = (24_000, 16_000, 12_000, 8_000, 6_000, 4_000)
# Decay rate of a string that a finger stops before it plucks it again, 1/s, and the time after which its motion is
# gone: -60 dB after 3.5 ms, -174 dB at the end. Chosen: no measurement was found. It is slow enough not to click.
STOP_RATE, STOP_SECONDS = 2000.0, 0.01


class ModeBank:
    """Modes in free vibration, initially at rest: the sound is Re(pattern · state), and the state evolves by `pole`."""

    def __init__(self, pole: np.ndarray, pattern: np.ndarray, faint: np.ndarray, rate: int) -> None:
        self.pole = pole  # 1/s, complex [modes]
        self.pattern = pattern  # file units per unit of state, complex [channels, modes]
        self.faint = faint  # largest inaudible amplitude, file units [modes]
        self.rate = rate  # Hz
        self.reset()

    def reset(self) -> None:
        """Set all modes to rest."""
        self.state = np.zeros(len(self.pole), complex)

    @property
    def is_audible(self) -> bool:
        """True while any mode exceeds its inaudible amplitude."""
        return bool((np.abs(self.pattern * self.state) > self.faint).any())

    def ring(self, samples: int, damper: np.ndarray | float) -> np.ndarray:
        """The sound [channels, samples] with decay rates, 1/s [modes], added. Inaudible modes are cut off."""
        sound = sum_damped_modes(self.pole - damper, self.pattern * self.state, self.rate, samples, self.faint)
        self.advance(samples, damper)
        return sound

    def advance(self, samples: int, damper: np.ndarray | float) -> None:
        """Advance the state by `samples` without computing the sound."""
        self.state = self.state * np.exp((self.pole - damper) * (samples / self.rate))
        if not self.is_audible:
            self.reset()


class StringVoice:
    """The string of one key at one sample rate, initially at rest. Its output must still pass `through_path`."""

    def __init__(self, note: Note, midi: int, rate: int, dampers: Dampers | None = None) -> None:
        self.note, self.midi, self.rate = note, midi, rate
        # With a measured modal response the string itself is inaudible, so the output path is not needed.
        self.table: StringTables = string_tables(
            note if note.modal_response is None else note._replace(path=None), rate
        )
        self.ratio = round(self.table.rate / rate)
        self.string = ModeBank(np.asarray(self.table.modes.pole), self.table.pickup[None], self.table.faint, rate)
        self.modal_response, self.modes = None, self.string
        if note.modal_response is not None:
            self.modal_response = note.modal_response.scale_gain(note.gain).at(rate)
            faint = np.full(len(self.modal_response.pole), AMPLITUDE_FLOOR)
            self.modes = ModeBank(self.modal_response.pole, self.modal_response.pattern, faint, rate)
        self.lead = round(note.pre_onset_s * rate)
        self.contact = 0.0  # of the damper: 0 when it is up, 1 when it rests on the strings
        dampers = Dampers() if dampers is None else dampers
        self._rates = [dampers.rates(midi, np.imag(bank.pole) / (2 * np.pi)) for bank in (self.string, self.modes)]
        self.force = ForcePulse(np.zeros(1), 1 / self.table.rate, 0.0)  # of the last stroke
        self._response = np.zeros(0)
        self.reset()

    def reset(self) -> None:
        """Set the string to rest and discard pending output."""
        self.string.reset()
        self.modes.reset()
        # Pending output from the current sample on; later samples are zero.
        self._pending = np.zeros((len(self.modes.pattern), self.lead))

    def strike(self, size: float, soft: float = 0.0) -> np.ndarray:
        """Strike with a hammer of this velocity, m/s, or pluck with this force, N; return the sound during the contact.

        The sound is [channels, samples]. Afterwards the string is undamped. `soft` is the position of the left pedal, 0
        to 1, which has no effect on a pluck.
        """
        struck = self.note.with_size(size).hammer
        is_pluck = not law_of(struck).has_contact
        shift = UnaCorda() if is_pluck else una_corda(self.midi, soft)
        hammer = shift.hammer(struck)
        drive, force = strike_string(self.table, hammer, f"key {self.midi}", self.string.state)
        samples = max(-(-len(drive) // self.ratio), 1)
        drive = np.pad(drive, (0, samples * self.ratio - len(drive)))
        self.contact, self.force = 0.0, force._replace(force=shift.share * force.force)
        # Advances all states to the end of the contact. The finger ends the earlier motion.
        sound = self._stop() if is_pluck else self._free(samples)
        self.string.state = self.string.state + shift.share * self.table.unit * self._residual_drive(drive)
        onset = self._onset(drive, force, samples, shift)
        self._add(sound, self.lead)
        self._add(onset, 0)
        return self._next(samples)

    def ring(self, samples: int) -> np.ndarray:
        """The sound of free vibration [channels, samples]."""
        self._add(self._free(samples), self.lead)
        return self._next(samples)

    def through_path(self, sound: np.ndarray) -> np.ndarray:
        """Filter a sound of this string [channels, samples] by its output path, if any, with the filter's tail."""
        return sound if self.modal_response is not None else apply_filter(sound[0], self.table.path)[None]

    @property
    def is_audible(self) -> bool:
        """True while the modes or the pending output are audible."""
        return self.modes.is_audible or bool((np.abs(self._pending) > AMPLITUDE_FLOOR).any())

    @property
    def in_motion(self) -> bool:
        """True while the string moves audibly under the next hammer."""
        return self.string.is_audible

    def _free(self, samples: int) -> np.ndarray:
        """Sound of the modes in free vibration [channels, samples]."""
        string, modes = (self.contact * rates for rates in self._rates)
        if self.modal_response is not None:
            self.string.advance(samples, string)
        return self.modes.ring(samples, modes)

    def _stop(self) -> np.ndarray:
        """Sound of the modes while a finger stops the string [channels, samples]. Afterwards the string is at rest."""
        sound = self.modes.ring(max(round(STOP_SECONDS * self.rate), 1), STOP_RATE)
        self.string.reset()
        self.modes.reset()
        return sound

    def _residual_drive(self, drive: np.ndarray) -> np.ndarray:
        """Σ_n T_n z^(N - n), N = len(T): amplitude at the end of the pulse, for a unit response [modes]."""
        log_z = self.string.pole / self.table.rate
        return np.exp(log_z) * z_transform_at_poles(log_z, drive[::-1])

    def _onset(self, drive: np.ndarray, force: ForcePulse, samples: int, shift: UnaCorda) -> np.ndarray:
        """Sound of a stroke in addition to the free modes after it, from `lead` samples before the contact on."""
        if self.modal_response is None:
            return shift.share * apply_filter(self._kernel(len(drive)), drive)[None, : len(drive) : self.ratio]
        weight = shift.weights(self.modal_response)
        state, onset = shift.response(self.modal_response, weight).strike_response(force, samples)
        self.modes.state = self.modes.state + weight * state
        return onset

    def _add(self, sound: np.ndarray, at: int) -> None:
        """Add a sound [channels, samples] to the pending output, `at` samples after the current one."""
        end, size = at + sound.shape[-1], self._pending.shape[-1]
        if end > size:
            longer = np.zeros((len(self._pending), end))
            longer[:, :size] = self._pending
            self._pending = longer
        self._pending[:, at:end] += sound

    def _next(self, samples: int) -> np.ndarray:
        """Take the next samples [channels, samples] from the pending output."""
        sound, self._pending = self._pending[:, :samples], self._pending[:, samples:]
        if not self.is_audible:
            self._pending = np.zeros((len(sound), self.lead))
        return sound

    def _kernel(self, steps: int) -> np.ndarray:
        """Response of the sound to a unit T, at the rate of the contact [steps]."""
        if len(self._response) < steps:
            size = max(2 * len(self._response), 1 << math.ceil(math.log2(steps)))
            pole, drive = self.string.pole, self.table.drive[None]
            self._response = sum_damped_modes(
                pole, drive, self.table.rate, size, audibility_threshold=np.zeros(len(pole))
            )[0]
        return self._response[:steps]
