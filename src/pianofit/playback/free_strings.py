"""Strings of all keys as modes on one bridge (`coupled_modes`), from the notes of an instrument.

The amplitude a of a mode is normalised to energy: for a displacement q it is √(n M_S/2) ω q, with the n strings of the
key. An impulse of the hammer's force on one string, 1 N s, excites a = √(2n/M_S) Φ_k/j, with the strike weight Φ_k. A
partial with a measured modal response has several modes, which a stroke excites alike. Their amplitudes in the sound
are their shares in the partial, and the bridge excites them in the same shares.

Strings without a damper were free when the keys were recorded. So their response to a stroke is in the measured modes
and in the knock of the struck key. In an instrument with measured keys nothing is added to them: it would sound twice.
They do excite other strings.
"""

import math
from typing import NamedTuple

import numpy as np

from ..instrument import Instrument
from ..instrument.bridge import unison_bridge_rate
from ..literature import typical_strings
from ..model.modal_response import PRE_ONSET_S, ForcePulse, ModalResponse
from ..model.modes import raised_cosine_weights
from ..model.note import Note
from .cached_strike import string_tables
from .coupled_modes import CoupledModes, bridge_drive

# Highest frequency of a free mode, Hz: higher ones decay fast and take little from the bridge. See docs/pedals.md.
HIGHEST = 4500.0
# Smallest strike weight Φ of a partial. Near a node of the stroke the measured level of a partial is error.
LEAST_STRIKE = 0.1
# Strike weight whose sign is certain: at a node rounding errors would decide.
CERTAIN_SIGN = 1e-9
# Spacing of the frequencies at which transforms of forces are computed, Hz: pulses of some milliseconds are smooth
# there.
FORCE_SPACING = 10.0
# Zero padding of the transform of a knock, so that it can be interpolated linearly. Its size is a power of two, as in
# the page to play, and so independent of its sample rate.
KNOCK_PADDING = 4


class FreeString(NamedTuple):
    """Modes of one key. Arrays [modes] unless stated otherwise."""

    chosen: np.ndarray  # indices among the modes of the voice
    pole: np.ndarray  # 1/s, complex
    drive: np.ndarray  # v with its sign, √(1/s)
    per_state: np.ndarray  # amplitude per state of the voice's mode, complex
    per_impulse: np.ndarray  # amplitude per N s on one string, complex
    sound: np.ndarray  # file units per amplitude, complex [channels, modes]
    damping: np.ndarray  # rate that the damper adds when it rests on the string, 1/s


class FreeStrings:
    """Modes of all keys of an instrument at one sample rate, Hz; `common` as for `CoupledModes`."""

    def __init__(self, instrument: Instrument, rate: int, common: float = 1.0) -> None:
        self.instrument, self.rate = instrument, rate
        self.keys = sorted(instrument.keys)
        strings = [_free_string(instrument, midi, rate) for midi in self.keys]
        columns = ("pole", "drive", "per_state", "per_impulse", "damping")
        joined = [np.concatenate([getattr(string, name) for string in strings]) for name in columns]
        channels = max(len(string.sound) for string in strings)
        sound = np.concatenate([np.broadcast_to(s.sound, (channels, len(s.pole))) for s in strings], axis=1)
        key = np.repeat(np.arange(len(strings)), [len(string.pole) for string in strings])
        order = np.argsort(np.imag(joined[0]), kind="stable")
        self.pole, self.drive, self.per_state, self.per_impulse, self.damping = (x[order] for x in joined)
        self.sound, self.key_index = sound[:, order], key[order]
        # Modes of each key here, and among those of its voice.
        own = np.concatenate([string.chosen for string in strings])[order]
        self.modes = {midi: np.flatnonzero(self.key_index == i) for i, midi in enumerate(self.keys)}
        self.chosen = {midi: own[modes] for midi, modes in self.modes.items()}
        has_damper = np.bincount(self.key_index, self.damping, len(strings))[self.key_index] > 0
        is_measured = any(key.note.modal_response is not None for key in instrument.keys.values())
        receives = (has_damper | (not is_measured)).astype(float)
        self.coupled = CoupledModes(self.pole, self.drive, self.key_index, common, receives)
        self._responses: dict[int, np.ndarray] = {}

    def amplitudes(self, midi: int, state: np.ndarray) -> np.ndarray:
        """Amplitudes of the modes of a key from the state of its voice, complex [modes of the key]."""
        return self.per_state[self.modes[midi]] * state[self.chosen[midi]]

    def excited_by(self, midi: int, force: ForcePulse) -> np.ndarray:
        """Amplitudes that a stroke on a key leaves on modes far from its own, at the first touch, complex [modes]."""
        if midi not in self._responses:
            self._responses[midi] = self._response(midi)
        return self._responses[midi] * self._velocity_gain(midi, force.velocity) * _transform(force, self.pole)

    def _response(self, midi: int) -> np.ndarray:
        """The same for a force of 1 N s: by the strings of the key, and by its knock, complex [modes]."""
        own = self.modes[midi]
        response = self.coupled.far_response(own, self.per_impulse[own])
        note = self.instrument.keys[midi].note
        if note.modal_response is not None and note.modal_response.knock.shape[-1]:
            response += self._knock_response(note.modal_response.scale_gain(note.gain))
        response[own] = 0.0
        return response

    def _knock_response(self, response: ModalResponse) -> np.ndarray:
        """Amplitudes that a knock leaves, for a force of 1 N s, complex [modes].

        The bridge moves by b = Σ v a and radiates in proportion. So a string that a sound of the bridge excites
        radiates -2α times the transform of this sound at its pole. The amplitude is the one that comes nearest to this
        in all channels.
        """
        transform = _knock_transform(response, self.pole)
        radiated = -2 * self.coupled.received * self.drive**2 * (np.conj(self.sound) * transform).sum(axis=0)
        power = (np.abs(self.sound) ** 2).sum(axis=0)
        return radiated / np.maximum(power, 1e-300)

    def _velocity_gain(self, midi: int, velocity: float) -> np.ndarray | float:
        """Velocity gain of the struck key near the frequency of each mode [modes]."""
        response = self.instrument.keys[midi].note.modal_response
        if response is None or response.velocity_gain is None:
            return 1.0
        omega, order = np.imag(response.pole), np.argsort(np.imag(response.pole))
        size = np.abs(response.velocity_gain.at(velocity))
        return np.interp(np.imag(self.pole), omega[order], size[order])


def _free_string(instrument: Instrument, midi: int, rate: int) -> FreeString:
    note = instrument.keys[midi].note
    response = note.modal_response
    pole, number, share, pattern, per_state = (
        _modelled(note, midi, rate) if response is None else _measured(response.scale_gain(note.gain), rate)
    )
    weight = raised_cosine_weights(note.geometry, int(number.max(initial=1)), np)[number - 1]
    unison = np.sqrt(2 * typical_strings(midi) / note.geometry.mass)
    per_impulse = -1j * np.sqrt(share) * unison * weight
    if per_state is None:
        sign = np.where(weight < -CERTAIN_SIGN, -1.0, 1.0)
        per_state = -1j * np.sqrt(share) * unison * sign * np.maximum(np.abs(weight), LEAST_STRIKE)
    hz = np.imag(pole) / (2 * np.pi)
    chosen = np.flatnonzero((hz < min(HIGHEST, rate / 2)) & (share > 0) & (np.abs(pattern).max(axis=0) > 0))
    pole, number, share, hz = pole[chosen], number[chosen], share[chosen], hz[chosen]
    rates = unison_bridge_rate(note, midi, hz, instrument.bridge)
    drive = np.where(number % 2, 1.0, -1.0) * bridge_drive(rates, -np.real(pole), share, number)
    return FreeString(
        chosen,
        pole,
        drive,
        per_state[chosen],
        per_impulse[chosen],
        pattern[:, chosen] / per_state[chosen],
        instrument.dampers.rates(midi, hz),
    )


def _measured(response: ModalResponse, rate: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, None]:
    """Pole, partial, share and pattern of the modes of a measured response. Their states are impulses, N s."""
    response = response.without_knock().at(rate)
    size = np.linalg.norm(response.pattern, axis=0)
    _, index = np.unique(response.partial, return_inverse=True)
    total = np.bincount(index, size)[index]
    return response.pole, response.partial, size / np.maximum(total, 1e-300), response.pattern, None


def _modelled(note: Note, midi: int, rate: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The same of a key without a measured response, and the amplitude per state, a displacement in m [modes]."""
    table = string_tables(note, rate)
    pole = np.asarray(table.modes.pole)
    db = 0.0 if note.path is None else note.path.at(np.imag(pole) / (2 * np.pi))
    pattern = (table.pickup * 10 ** (np.asarray(db) / 20))[None]
    per_state = np.sqrt(typical_strings(midi) * note.geometry.mass / 2) * np.abs(pole) + 0j
    return pole, np.arange(1, len(pole) + 1), np.ones(len(pole)), pattern, per_state


def _transform(force: ForcePulse, pole: np.ndarray) -> np.ndarray:
    """∫ F e^{-pole t} dt, N s, complex [modes], interpolated over frequency about the centre of the pulse."""
    time = force.step * np.arange(len(force.force))
    centre = float(time @ np.abs(force.force) / np.abs(force.force).sum())
    size = max(round(1 / (FORCE_SPACING * force.step)), len(force.force))
    return _interpolated(np.fft.rfft(force.force, size)[None] * force.step, 1 / (size * force.step), centre, pole)[0]


def _knock_transform(response: ModalResponse, pole: np.ndarray) -> np.ndarray:
    """Transform of a knock at poles, relative to the contact, file units s per N s, complex [channels, modes].

    The decay of a mode during the knock is neglected. A mode that decays evenly from the contact on with this amplitude
    has the energy that the knock gives it, if the spectrum of the knock is smooth over the width of the mode.
    """
    pole = 1j * np.imag(pole)
    knock, rate = response.continuous_knock(), response.rate
    energy = (knock**2).sum(axis=0)
    centre = float(np.arange(knock.shape[-1]) @ energy / max(energy.sum(), 1e-300)) / rate
    size = 1 << math.ceil(math.log2(KNOCK_PADDING * knock.shape[-1]))
    spectrum = np.fft.rfft(knock, size) / rate
    return _interpolated(spectrum, rate / size, centre, pole) * np.exp(pole * PRE_ONSET_S)


def _interpolated(spectrum: np.ndarray, spacing: float, centre: float, pole: np.ndarray) -> np.ndarray:
    """Interpolate a spectrum [rows, bins] at poles, about the time `centre` of its signal, s, complex [rows, modes]."""
    place = np.imag(pole) / (2 * np.pi * spacing)
    below = place.astype(int)
    bins = np.arange(below.max(initial=0) + 2)
    turned = spectrum[:, : len(bins)] * np.exp(2j * np.pi * spacing * centre * bins)
    at = turned[:, below] + (place - below) * (turned[:, below + 1] - turned[:, below])
    return at * np.exp(-pole * centre)
