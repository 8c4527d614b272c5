"""Noise of keys that are let go.

Physics: the key, its action and the damper make a noise when they return, which was recorded with a silent string.
Chosen: how its level depends on the release velocity and on the time that the note sounded. Nobody published either.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..dsp.filters import resample
from ..schema.extras import KeyExtras, SoundEntry
from ..schema.instrument import ReleaseEntry, VelocityCurve

# Release velocity of the recordings. MIDI 1.0 gives it to keyboards that do not measure a velocity.
RECORDED_VELOCITY = 64
# Time in which a note reaches 63 % of the noise of a long note, s. Chosen: a key that is let go earlier has not come to
# rest at its bottom, so it returns over a shorter way and more slowly.
SOUNDING_TIME = 0.1


@dataclass(frozen=True, eq=False)
class ReleaseNoise:
    """Recorded noises of keys that are let go while their strings are silent.

    Parameters
    ----------
    sounds : noises by MIDI number, file units [channels, samples]. There is at least one.
    rate : their sample rate, Hz.
    """

    sounds: Mapping[int, np.ndarray]
    rate: int

    def source(self, midi: int) -> int:
        """Return the recorded key whose noise a key plays: the nearest, or the lower of two."""
        return min(self.sounds, key=lambda key: (abs(key - midi), key))

    def log_gain(self, midi: int) -> float:
        """Return the logarithm of the amplitude of a key's noise over that of its source."""
        keys = sorted(self.sounds)
        log_rms = {key: 0.5 * math.log(max(float(np.sum(self.sounds[key] ** 2)), 1e-30)) for key in keys}
        return float(np.interp(midi, keys, [log_rms[key] for key in keys])) - log_rms[self.source(midi)]

    def sound(self, midi: int, velocity: int, seconds: float, rate: int) -> np.ndarray:
        """Return the noise of a key, file units [channels, samples].

        The amplitude is proportional to the speed of the key, which follows the MIDI velocity as the speed of a hammer
        does. It grows with the time t since the stroke as 1 − exp(−t/0.1 s).

        Parameters
        ----------
        midi : MIDI number of the key. A key without a recording has the noise of the nearest recorded key, with an
            energy that is interpolated between the recorded keys, in dB.
        velocity : MIDI release velocity, 0 to 127. 64 is that of the recording.
        seconds : time since the stroke, s.
        rate : sample rate, Hz.
        """
        speed = VelocityCurve().at(max(velocity, 1)) / VelocityCurve().at(RECORDED_VELOCITY)
        gain = math.exp(self.log_gain(midi)) * speed * -math.expm1(-max(seconds, 0.0) / SOUNDING_TIME)
        return gain * resample(self.sounds[self.source(midi)], self.rate, rate)


def release_noise(extras: Sequence[KeyExtras], channels: int) -> ReleaseNoise | None:
    """Return the noise of the keys whose release was recorded: the recording of median energy, all at one rate.

    Parameters
    ----------
    channels : number of channels of the instrument. All noises become mono if one has another number.
    """
    sounds: dict[int, list[tuple[np.ndarray, int]]] = {}
    for key in extras:
        for i, entry in enumerate(key.releases):
            sounds.setdefault(key.midi, []).append(entry.samples(f"key {key.midi}: releases[{i}]"))
    if not sounds:
        return None
    chosen = {midi: sorted(takes, key=_energy)[len(takes) // 2] for midi, takes in sorted(sounds.items())}
    rate = max(old for _, old in chosen.values())
    same = all(len(samples) == channels for samples, _ in chosen.values())
    mixed = {midi: (x if same else x.mean(axis=0, keepdims=True), old) for midi, (x, old) in chosen.items()}
    return ReleaseNoise({midi: resample(x, old, rate) for midi, (x, old) in mixed.items()}, rate)


def _energy(take: tuple[np.ndarray, int]) -> float:
    samples, rate = take
    return float(np.sum(samples**2)) / rate / len(samples)


def release_entries(release: ReleaseNoise | None) -> tuple[ReleaseEntry, ...]:
    """Return the entries of an `instrument.json`."""
    if release is None:
        return ()
    return tuple(ReleaseEntry(midi, SoundEntry.of(x, release.rate)) for midi, x in release.sounds.items())
