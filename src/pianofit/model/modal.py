"""How a note rings: what lies between the hammer's force and the file, measured once a key.

    sound(t) = g F(t) ∗ (Re Σ_m P_m e^{p_m t} + knock(t))

Poles p, patterns P (one complex number a mode and channel) and the knock are the key's and the same at every velocity.
The knock is a short kernel that holds what no mode does: the soundboard's and the key's own thump, and what lies below
the lowest partial. F is the force of a stroke, from string, hammer and felt.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.signal import oaconvolve, resample_poly

from .simulate import Simulation

__all__ = ["EDGE", "LEAD", "Force", "Ringing", "force_of", "ring"]

# The knock may begin so long before the contact, s: an onset is found a little late.
LEAD = 0.012
# Samples before a force's touch that a band-limited force needs.
EDGE = 8
# Steps a sample of a force whose own step is no whole part of one.
FINE = 8


class Force(NamedTuple):
    """A stroke's force, from the first touch on."""

    newton: np.ndarray  # [steps]
    step: float  # s

    def drive(self, pole: np.ndarray) -> np.ndarray:
        """∫ F e^{-pole t} dt, N s, complex [modes]: how far a stroke sets modes ringing."""
        return np.exp(-np.outer(pole, self.step * np.arange(len(self.newton)))) @ self.newton * self.step

    def at(self, rate: int) -> np.ndarray:
        """The impulse of every sample at `rate`, N s [samples], band-limited; `EDGE` samples before the touch."""
        by = round(1 / (self.step * rate))
        if by < 1 or abs(by * self.step * rate - 1) > 1e-6:
            step = 1 / (FINE * rate)
            fine = np.arange(0, len(self.newton) * self.step, step)
            return Force(np.interp(fine, self.step * np.arange(len(self.newton)), self.newton), step).at(rate)
        edge = EDGE * by
        return resample_poly(np.pad(self.newton, (edge, edge)), 1, by) / rate


def force_of(stroke: Simulation) -> Force:
    """The force of a stroke on the string."""
    return Force(np.asarray(stroke.pulse.force), float(stroke.modes.step))


class Ringing(NamedTuple):
    """What lies between the force on a key's strings and the file."""

    number: np.ndarray  # int, partial of each mode [modes]
    pole: np.ndarray  # 1/s, complex [modes]
    pole_error: np.ndarray  # standard error of its real and imaginary part, 1/s [modes]
    pattern: np.ndarray  # P, file units over N s, complex [channels, modes]
    knock: np.ndarray  # file units over N s [channels, samples] at `rate`, from `LEAD` before the contact; can be empty
    rate: int  # of the knock, Hz

    @property
    def channels(self) -> int:
        """How many."""
        return len(self.pattern)

    def louder(self, gain: float) -> Ringing:
        """The same key through another gain."""
        return self._replace(pattern=gain * self.pattern, knock=gain * self.knock)

    def sharper(self, ratio: float) -> Ringing:
        """The same key with all frequencies times `ratio`."""
        return self._replace(pole=np.real(self.pole) + 1j * ratio * np.imag(self.pole))

    def without_knock(self) -> Ringing:
        """The modes alone."""
        return self._replace(knock=self.knock[:, :0])

    def knock_at(self, rate: int) -> np.ndarray:
        """The knock at another rate [channels, samples], of the same impulse."""
        if rate == self.rate or not self.knock.shape[-1]:
            return self.knock
        by = np.gcd(rate, self.rate)
        return resample_poly(self.knock, rate // by, self.rate // by, axis=-1) * (self.rate / rate)

    def sound(self, force: Force, rate: int, count: int) -> np.ndarray:
        """A stroke in file units [channels, count], from `LEAD` before its first touch.

        While the force lasts, modes are convolved with it; afterwards they ring in closed form.
        """
        pulse, lead = force.at(rate), round(LEAD * rate)
        below = np.imag(self.pole) < np.pi * rate
        pole, pattern = self.pole[below], self.pattern[:, below]
        out = np.zeros((self.channels, max(count, lead - EDGE) + len(pulse)))
        begin, head = lead - EDGE, len(pulse)
        left = np.exp(-np.outer(pole, np.arange(head) / rate)) @ pulse
        rung = ring(pole, pattern * left, rate, out.shape[-1] - begin)
        rung[:, :head] = oaconvolve(ring(pole, pattern, rate, head), pulse[None], axes=-1)[:, :head]
        out[:, begin:] = rung
        if self.knock.shape[-1]:
            knock = oaconvolve(self.knock_at(rate), pulse[None], axes=-1)[:, EDGE:]
            size = min(knock.shape[-1], out.shape[-1])
            out[:, :size] += knock[:, :size]
        return out[:, :count]


def ring(pole: np.ndarray, amplitude: np.ndarray, rate: float, count: int) -> np.ndarray:
    """Re Σ amplitude exp(pole t), [channels, count], of amplitudes [channels, modes].

    Time is cut into blocks: a block's begin times the way through a block is one matrix product.
    """
    block = 1 << int(np.ceil(np.log2(np.sqrt(max(count, 1)))))
    begins = np.exp(np.outer(np.arange(-(-count // block)) * (block / rate), pole))
    inside = np.exp(np.outer(pole, np.arange(block) / rate))
    start = amplitude[:, None, :] * begins
    rows = np.real(start) @ np.real(inside) - np.imag(start) @ np.imag(inside)
    return rows.reshape(len(amplitude), -1)[:, :count]
