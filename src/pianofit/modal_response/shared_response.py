"""What lies between the forces of several strokes and their recordings: patterns, knock and contact times."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import signal

from ..model.modal_response import (
    EDGE,
    PRE_ONSET_S,
    ForcePulse,
    ModalResponse,
    VelocityGain,
    cancel_static_deflection,
    sum_damped_modes,
)
from .aligned_layers import AlignedLayers
from .modes import PartialModes, common_pattern
from .velocity_gain import velocity_gain

__all__ = ["SharedResponse", "estimate_shared_response"]

# The knock lasts so long after the contact, s: beyond this it gains little (the knee of the distance over its length);
# and no longer than any layer is heard.
KNOCK = 0.4
# Part of it, at its end, in which it fades.
FADE = 1 / 3
# A mode that the force drives so much less than another, amplitude, lies where its spectrum is nought: what it shows
# there is not the force's, and would be lifted to any size. Any value from a third to ten times this does the same.
DRIVEN = 0.003
# A force whose spectrum lies so far below its largest, amplitude, is the model's smoothness and drives no knock: other
# sounds than the model's lie as far below the loudest partial (the likelihood's prior of η). Without any floor the
# kernel explodes; where it lies makes no difference.
FLOOR = 0.002
# Onsets of layers may differ so much from the contact's, s.
LATEST = 0.025
# Between delays tried, s: a tenth of a period of the highest partials.
FINEST = 4e-6
# What a delay's attack says over what its phases say.
ATTACK = 1.5
# What the largest delay costs on that scale: onsets are mostly right.
FAR = 0.5
# Of a layer's partials that tell levels and delays: nothing at the first of these over the noise, dB, all at the
# second; and by their amplitude in that layer to this power, as loudness goes.
TELLING = 10.0, 30.0
LOUDNESS = 0.3
# Length, s, of the attacks that are correlated, and the power of their spectrum by which that is done: with all of it
# (1) a note is as much like itself a period later, with none (0) it is what noise is like.
ALIGNED = 0.08
WHITENED = 0.5


class SharedResponse(NamedTuple):
    """What the layers of a key have in common, and when each was touched."""

    ringing: ModalResponse  # gains of layers taken out
    delay: np.ndarray  # of its contact after its onset, s [layers]


def estimate_shared_response(
    heard: AlignedLayers, modes: Sequence[PartialModes], forces: Sequence[ForcePulse], gain: np.ndarray
) -> SharedResponse:
    """The key that these layers, by these forces and through these gains [layers], show."""
    strongest = np.array([m.poles[np.argmax(np.abs(m.amplitude).sum((0, 1)))] for m in modes])
    drive = np.stack([g * force.drive(strongest) for g, force in zip(gain, forces, strict=True)], axis=1)
    loud = np.stack([np.abs(m.amplitude).sum(-1).max(axis=-1) for m in modes])  # [partials, layers], as `drive`
    weight = np.stack([np.interp(m.snr, TELLING, (0, 1)) for m in modes]) * loud**LOUDNESS
    delay = _delays(heard, modes, drive, weight)
    observed_amplitudes = [
        m.at_onset * np.exp(np.multiply.outer(delay, m.poles))[:, None, :] for m in modes
    ]  # at the contact
    patterns = _patterns(modes, observed_amplitudes, drive, weight)
    pattern, pole = np.concatenate(patterns, axis=-1), np.concatenate([m.poles for m in modes])
    found = ModalResponse(
        np.concatenate([np.full(len(m.pole), m.number) for m in modes]), pole,
        np.concatenate([m.pole_error for m in modes]), pattern, np.zeros((len(pattern), 0)), heard.rate,
    )  # fmt: skip
    knock = _knock(heard, modes, found, forces, delay, gain)
    over = [one / row[:, None, None] for one, row in zip(observed_amplitudes, drive, strict=True)]
    part = _participation(modes, patterns, over, loud, np.array([force.velocity for force in forces]))
    return SharedResponse(found._replace(knock=knock, participation=part), delay)


def _delays(heard: AlignedLayers, modes: Sequence[PartialModes], drive: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """When each layer's contact was after its onset, s [layers]."""
    factor = np.stack([common_pattern(m.at_onset, m.noise)[1] for m in modes])
    omega = 2 * np.pi * np.array([m.frequency for m in modes])
    delay = np.array([_delay(heard, factor / drive, weight, omega, i) for i in range(len(heard.samples))])
    return delay - delay.min()  # no contact is before its onset, and of one layer it is there


def _patterns(
    modes: Sequence[PartialModes], observed_amplitudes: Sequence[np.ndarray], drive: np.ndarray, weight: np.ndarray
) -> list[np.ndarray]:
    """P of each partial [channels, modes], of the amplitudes that are `shown` at the contact."""
    each, factors = zip(
        *(common_pattern(one, m.noise) for one, m in zip(observed_amplitudes, modes, strict=True)), strict=True
    )
    ratio = np.stack(factors) / drive
    log = np.log(np.maximum(np.abs(ratio), 1e-30))
    level = (weight * log).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-9)
    phase = np.angle((weight * ratio / np.maximum(np.abs(ratio), 1e-30)).sum(axis=1))
    return [p * np.exp(x + 1j * a) for p, x, a in zip(each, level, phase, strict=True)]


def _participation(
    modes: Sequence[PartialModes],
    patterns: Sequence[np.ndarray],
    observed_amplitudes: Sequence[np.ndarray],
    loud: np.ndarray,
    velocity: np.ndarray,
) -> VelocityGain | None:
    """How modes take part in the strokes of these layers; of one velocity the pattern says all.

    A partial's amplitude errs by the noise of its band and, as its level does in the likelihood, by other sounds that
    lie so far below the layer's loudest partial.
    """
    if len(np.unique(velocity)) == 1:
        return None
    order = np.argsort(velocity, kind="stable")
    noise = 10 ** (-np.stack([m.snr for m in modes]) / 20)
    with np.errstate(divide="ignore", invalid="ignore"):  # what a layer does not show says nothing
        error = np.hypot(noise, FLOOR * loud.max(axis=0) / loud) / np.sqrt(2)
    known, first = np.unique(velocity[order], return_index=True)
    rising = velocity_gain([one[order] for one in observed_amplitudes], patterns, error.T[order], velocity[order])
    return VelocityGain(known, rising[first])


def _delay(heard: AlignedLayers, ratio: np.ndarray, weight: np.ndarray, omega: np.ndarray, layer: int) -> float:
    """How much later a layer's contact lies after its onset than the last one's, s.

    Phases alone are ambiguous by a period: the attacks' correlation, half whitened (Knapp and Carter 1976; Donohue et
    al. 2007), has a say as well.
    """
    tried = np.arange(-LATEST, LATEST, FINEST)
    turn = ratio[:, layer] * ratio[:, -1].conj()
    turn = turn / np.maximum(np.abs(turn), 1e-30) * weight[:, layer]
    phases = (np.exp(1j * np.outer(tried, omega)) @ turn).real / max(weight[:, layer].sum(), 1e-12)
    size = round(ALIGNED * heard.rate)
    a, b = heard.samples[layer, :, :size], heard.samples[-1, :, :size]
    cross = np.fft.rfft(a, 2 * size) * np.fft.rfft(b, 2 * size).conj()
    cross *= np.maximum(np.abs(cross), np.finfo(float).tiny) ** (WHITENED - 1)
    alike = np.abs(signal.hilbert(np.roll(np.fft.irfft(cross).sum(axis=0), size)))
    attacks = np.interp(tried * heard.rate + size, np.arange(2 * size), alike / alike.max())
    return float(tried[np.argmax(phases + ATTACK * attacks - FAR * np.abs(tried) / LATEST)])


def _knock(
    heard: AlignedLayers,
    modes: Sequence[PartialModes],
    key: ModalResponse,
    forces: Sequence[ForcePulse],
    delay: np.ndarray,
    gain: np.ndarray,
) -> np.ndarray:
    """Σ w F* R / (Σ w |F|² + floor) over layers [channels, samples].

    R is what a layer's modes leave by the amplitudes that the layer itself shows, from its contact on: what the common
    pattern misses of a partial is no knock.
    """
    amplitude = np.concatenate([m.at_onset for m in modes], axis=-1)
    # Each layer at its own pitch: a cent beside it, its partials would be left for the knock.
    pole = np.concatenate([m.poles + 2j * np.pi * m.offset[:, None] for m in modes], axis=-1)
    rate, lead = heard.rate, round(PRE_ONSET_S * heard.rate)
    size = lead + round(min(KNOCK, *(heard.seconds - delay)) * rate)

    def inaudible(pattern: np.ndarray) -> np.ndarray:
        return np.pad(cancel_static_deflection(key.pole, pattern, rate, size - lead), ((0, 0), (lead, 0)))

    count = 1 << int(np.ceil(np.log2(2 * size)))
    fade, last = np.ones(size), round(FADE * size)
    fade[-last:] = 0.5 + 0.5 * np.cos(np.pi * np.arange(last) / last)
    turn = 2j * np.pi * np.fft.rfftfreq(count)
    above = np.zeros((heard.samples.shape[1], count // 2 + 1), complex)
    below = np.zeros(count // 2 + 1)
    rows = zip(heard.samples, heard.before, amplitude, pole, forces, delay, gain, strict=True)
    for x, before, own, poles, force, late, g in rows:
        # Every layer from `LEAD` before its contact.
        around = np.concatenate([before[:, before.shape[-1] - lead :], x], axis=-1)
        seen = _shifted(around[:, : 2 * size], -late * rate)[:, :size]
        rest = seen - _alone(key._replace(pole=poles), own * np.exp(poles * late), force, size, inaudible)
        spectrum = g * np.fft.rfft(force.at(rate), count) * np.exp(turn * EDGE)
        weight = 1 / np.sum(seen**2)
        above += weight * spectrum.conj() * np.fft.rfft(rest * fade, count)
        below += weight * np.abs(spectrum) ** 2
    return np.fft.irfft(above / (below + FLOOR**2 * below.max()), count)[:, :size] * fade + inaudible(key.pattern)


def _alone(
    key: ModalResponse, amplitude: np.ndarray, force: ForcePulse, size: int, unheard: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """Modes of these amplitudes at the contact, driven by the force where it drives them and begun there otherwise."""
    drive = force.drive(key.pole)
    driven = amplitude * drive.conj() / (np.abs(drive) ** 2 + (DRIVEN * np.abs(drive).max()) ** 2)
    lead = round(PRE_ONSET_S * key.rate)
    begun = sum_damped_modes(key.pole, amplitude - driven * drive, key.rate, size - lead)
    sound = key._replace(pattern=driven, knock=unheard(driven)).sound(force, key.rate, size)
    return sound + np.pad(begun, ((0, 0), (lead, 0)))


def _shifted(x: np.ndarray, samples: float) -> np.ndarray:
    """x later by so many samples, a fraction of one too."""
    size = x.shape[-1] + 2048
    turn = np.exp(-2j * np.pi * np.fft.rfftfreq(size) * samples)
    return np.fft.irfft(np.fft.rfft(x, size) * turn, size)[..., : x.shape[-1]]
