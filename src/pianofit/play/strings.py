"""A string while it is played: modes that ring, a hammer that sets them ringing, a damper that falls on them.

All that is left of the past is one complex amplitude a mode, `q = Re(a exp(p t))`. Between events the sound is the sum
of damped exponentials in closed form; a damper adds to their decay and changes nothing else, so nothing clicks. A
hammer meets the string as it moves: the contact is solved with that motion under the hammer, its pulse is convolved
with the string's response while it lasts, and then joins the amplitudes.
"""

from __future__ import annotations

import math

import numpy as np

from ..model.note import Note
from ..model.path import filtered
from .contact import Table, stroke, table_of

__all__ = ["BLOCK", "FAINT", "LAST_DAMPER", "PlayedString", "damper_rate"]

BLOCK = 256  # samples whose powers are kept
CHUNK = 64  # blocks at once, between looks at what still sounds
FAINT = 1e-8  # of full scale: modes below are left out, -160 dB
LAST_DAMPER = 90  # F#6; the strings above have none
# What a damper adds to every mode's decay, 1/s, at the lowest key and at the last that has one: about 0.3 s to 0.12 s
# for 60 dB. Chosen once; no fit sees a damper.
DAMPER = (25.0, 60.0)
_FINE = 32


def damper_rate(midi: int) -> float:
    """Extra decay under the damper, 1/s; 0 for the keys that have none."""
    if midi > LAST_DAMPER:
        return 0.0
    x = min(max((midi - 21) / (LAST_DAMPER - 21), 0.0), 1.0)
    return DAMPER[0] * (DAMPER[1] / DAMPER[0]) ** x


class PlayedString:
    """One key's string at one rate, silent at first; what it gives is still to go through its path."""

    def __init__(self, note: Note, midi: int, rate: int) -> None:
        self.note, self.midi, self.rate = note, midi, rate
        self.table: Table = table_of(note, rate)
        self.ratio = round(self.table.rate / rate)
        self.pole = self.table.pole
        self.state = np.zeros(len(self.pole), complex)
        self.damped = False
        self._decay = damper_rate(midi)
        self._powers: dict[bool, np.ndarray] = {}
        self._response = np.zeros(0)

    def strike(self, velocity: float) -> np.ndarray:
        """The sound [samples] of the contact with a hammer of `velocity`, m/s; then the string rings, undamped."""
        hammer = self.note.hammer._replace(v_H0=velocity)
        drive = stroke(self.table, hammer, self.state, f"key {self.midi}")
        samples = max(-(-len(drive) // self.ratio), 1)
        drive = np.pad(drive, (0, samples * self.ratio - len(drive)))
        self.damped = False
        free = self.ring(samples)  # moves the state on to the contact's end
        head = filtered(self._kernel(len(drive)), drive)[: len(drive) : self.ratio]
        self.state = self.state + self.table.unit * _left(drive, self.pole / self.table.rate)
        return free + head

    def ring(self, samples: int) -> np.ndarray:
        """The string by itself [samples]; ends early, with what is left out taken for zero, once it is inaudible."""
        out = np.zeros(samples)
        done = 0
        pole = self.pole - (self._decay if self.damped else 0.0)
        while done < samples:
            loud = np.flatnonzero(self.table.loudness * np.abs(self.state) > FAINT)
            if not loud.size:
                self.state = np.zeros_like(self.state)
                break
            rows = slice(0, int(loud[-1]) + 1)
            count = min(samples - done, CHUNK * BLOCK)
            blocks = -(-count // BLOCK)
            starts = np.exp(np.outer(np.arange(blocks) * BLOCK, pole[rows] / self.rate))
            starts *= (self.table.pickup * self.state)[rows]
            re, im = self._fine(rows)
            sound = (np.real(starts) @ re - np.imag(starts) @ im).ravel()
            out[done : done + count] = sound[:count]
            self.state = self.state * np.exp(pole * (count / self.rate))
            done += count
        return out

    def heard(self, sound: np.ndarray) -> np.ndarray:
        """A sound of this string [samples] through its path, and what that rings on."""
        return filtered(sound, self.table.path)

    @property
    def sounding(self) -> bool:
        """Whether anything is left to hear."""
        return bool((self.table.loudness * np.abs(self.state) > FAINT).any())

    def _fine(self, rows: slice) -> tuple[np.ndarray, np.ndarray]:
        """Real and imaginary part of z^j, j < BLOCK [rows, BLOCK]."""
        if self.damped not in self._powers:
            pole = self.pole - (self._decay if self.damped else 0.0)
            powers = np.exp(np.outer(pole / self.rate, np.arange(BLOCK)))
            self._powers[self.damped] = np.stack([np.real(powers), np.imag(powers)])
        re, im = self._powers[self.damped]
        return re[rows], im[rows]

    def _kernel(self, steps: int) -> np.ndarray:
        """What a unit T makes heard, at the contact's rate [steps]."""
        if len(self._response) < steps:
            size = max(2 * len(self._response), 1 << math.ceil(math.log2(steps)))
            log_z = self.pole / self.table.rate
            coarse = self.table.drive * np.exp(np.outer(np.arange(-(-size // _FINE)) * _FINE, log_z))
            fine = np.exp(np.outer(log_z, np.arange(_FINE)))
            self._response = (np.real(coarse) @ np.real(fine) - np.imag(coarse) @ np.imag(fine)).ravel()
        return self._response[:steps]


def _left(drive: np.ndarray, log_z: np.ndarray) -> np.ndarray:
    """Σ_n T_n z^(N - n), N = len(T): what the pulse has left at its end, for a unit response [modes]."""
    blocks = -(-len(drive) // _FINE)
    late = np.pad(drive, (blocks * _FINE - len(drive), 0)).reshape(blocks, _FINE)
    fine = np.exp(np.outer(log_z, np.arange(_FINE, 0, -1)))
    coarse = np.exp(np.outer(log_z, np.arange(blocks - 1, -1, -1) * _FINE))
    return ((fine @ late.T) * coarse).sum(axis=1)
