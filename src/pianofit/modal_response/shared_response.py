"""Patterns, knock and contact times of a key, from the forces of several strokes and their recordings."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ..dsp.damped_sums import sum_damped_modes
from ..dsp.filters import delayed
from ..model.modal_response import (
    FILTER_REACH,
    KNOCK_SECONDS,
    PRE_ONSET_S,
    ForcePulse,
    ModalResponse,
    VelocityGain,
    cancel_static_deflection,
)
from .aligned_layers import AlignedLayers
from .modes import LEAST_SINGULAR, PartialModes, common_pattern
from .random_walks import UNINFORMATIVE_ERROR, smooth_random_walk

# Share of the knock, which the shortest layer can cut, at its end, over which it fades out.
FADE = 1 / 3
# Modes whose drive lies this far below the largest one, as an amplitude ratio, lie at a zero of the force spectrum.
# Their measured amplitude does not come from the force, and division by the drive would inflate it. Values from a third
# to ten times this one give the same result.
LEAST_DRIVE = 0.003
# Floor of the force spectrum relative to its largest value, as an amplitude ratio. Below it, smoothness of the model
# sets the spectrum. Interfering sound lies equally far below the loudest partial (prior of η in the likelihood).
# Without a floor the kernel diverges; its exact value does not matter.
FLOOR = 0.002
# Largest difference between a layer's onset and its contact, s.
LARGEST_DELAY = 0.025
# Weight of the attack's correlation relative to the phases of partials.
ATTACK_WEIGHT = 1.5
# Penalty of the largest delay on the same scale: onsets are mostly right.
DELAY_PENALTY = 0.5
# The weight of a layer's partials in levels and delays grows with this power of the partial's amplitude in the layer,
# approximately as loudness does.
LOUDNESS = 0.3
# Length of the attacks that are correlated, s.
ATTACK_SECONDS = 0.08
# Exponent of the cross-spectrum in the correlation. With 1 a note correlates equally well one period later. With 0
# noise dominates.
WHITENING_EXPONENT = 0.5


class SharedResponse(NamedTuple):
    """Modal response common to the layers of a key, and the contact time of each."""

    response: ModalResponse  # without the layers' gains
    delay: np.ndarray  # of its contact after its onset, s [layers]


def estimate_shared_response(
    layers: AlignedLayers, modes: Sequence[PartialModes], forces: Sequence[ForcePulse], gain: np.ndarray
) -> SharedResponse:
    """Estimate the modal response of a key from its layers, their forces and their gains [layers]."""
    sound = [m.coordinates(m.at_onset) for m in modes]
    strongest = np.array([m.poles[_loudest(m)] for m in modes])
    drive = np.stack([g * force.drive(strongest) for g, force in zip(gain, forces, strict=True)], axis=1)
    # The largest over the channels [partials, layers], as `drive`.
    size = np.stack([np.linalg.norm(coordinates, axis=-1).max(axis=-1) for coordinates in sound])
    # The weight of a partial rises from 0 to 1 between signal-to-noise ratios of 10 and 30 dB.
    weight = np.stack([np.interp(m.snr, (10.0, 30.0), (0, 1)) for m in modes]) * size**LOUDNESS
    delay = _delays(layers, modes, sound, drive, weight)
    at_contact = [m.coordinates(m.at_onset * np.exp(np.multiply.outer(delay, m.poles))[:, None, :]) for m in modes]
    patterns = _patterns(modes, at_contact, drive, weight)
    response = ModalResponse(
        partial=np.concatenate([np.full(len(m.pole), m.number) for m in modes]),
        pole=np.concatenate([m.poles for m in modes]),
        pole_error=np.concatenate([m.pole_error for m in modes]),
        pattern=np.concatenate(patterns, axis=-1),
        knock=np.zeros((len(patterns[0]), 0)),
        rate=layers.rate,
    )
    knock = _knock(layers, modes, response, forces, delay, gain)
    per_drive = [x / row[:, None, None] for x, row in zip(at_contact, drive, strict=True)]
    part = _velocity_gain(modes, patterns, per_drive, size, np.array([force.velocity for force in forces]))
    return SharedResponse(response._replace(knock=knock, velocity_gain=part), delay)


def _loudest(modes: PartialModes) -> int:
    """The mode of a partial with the largest sound in all layers and channels."""
    amplitude = np.abs(modes.at_onset).sum(axis=(0, 1))
    return int(np.argmax(amplitude * np.linalg.norm(modes.basis, axis=0)))


def _delays(
    layers: AlignedLayers,
    modes: Sequence[PartialModes],
    sound: Sequence[np.ndarray],
    drive: np.ndarray,
    weight: np.ndarray,
) -> np.ndarray:
    """Time from each layer's onset to its contact, s [layers]."""
    factor = np.stack([common_pattern(x, m.noise)[1] for x, m in zip(sound, modes, strict=True)])
    omega = 2 * np.pi * np.array([m.frequency for m in modes])
    delay = np.array([_delay(layers, factor / drive, weight, omega, i) for i in range(len(layers.samples))])
    return delay - delay.min()  # A contact is never before its onset. With one layer the delay is 0.


def _patterns(
    modes: Sequence[PartialModes], at_contact: Sequence[np.ndarray], drive: np.ndarray, weight: np.ndarray
) -> list[np.ndarray]:
    """P of each partial [channels, modes], from the coordinates of its sound after the contact."""
    common, factors = zip(*(common_pattern(x, m.noise) for x, m in zip(at_contact, modes, strict=True)), strict=True)
    ratio = np.stack(factors) / drive
    log = np.log(np.maximum(np.abs(ratio), 1e-30))
    total = weight.sum(axis=1)
    # A partial that no layer shows is silent.
    level = np.where(total > 0, (weight * log).sum(axis=1) / np.where(total > 0, total, 1.0), -np.inf)
    phase = np.angle((weight * ratio / np.maximum(np.abs(ratio), 1e-30)).sum(axis=1))
    return [m.amplitudes(p) * np.exp(x + 1j * a) for m, p, x, a in zip(modes, common, level, phase, strict=True)]


def _velocity_gain(
    modes: Sequence[PartialModes],
    patterns: Sequence[np.ndarray],
    per_drive: Sequence[np.ndarray],
    size: np.ndarray,
    velocity: np.ndarray,
) -> VelocityGain | None:
    """Velocity gain from sounds over drives; None with one velocity, which the pattern describes completely.

    The level of a partial and the shares of its modes in its sound vary by one or two decibels beyond the force. Both
    are random walks over the logarithm of the velocity. Where the strokes do not determine a walk, it stays at its
    mean.
    """
    order = np.argsort(velocity, kind="stable")
    velocity, first = velocity[order], np.unique(velocity[order], return_index=True)[1]
    if len(first) == 1:
        return None
    # Errors: the noise of the band, and interfering sound at `FLOOR` below the layer's loudest partial.
    noise = 10 ** (-np.stack([m.snr for m in modes]) / 20)
    with np.errstate(divide="ignore", invalid="ignore"):  # a partial without amplitude gets an infinite error
        error = (np.hypot(noise, FLOOR * size.max(axis=0) / size) / np.sqrt(2)).T[order]
    error = np.where(np.isfinite(error), error, UNINFORMATIVE_ERROR)
    level, deviation, share, to_factors = [], [], [], []
    for m, sound, pattern in zip(modes, per_drive, patterns, strict=True):
        own = sound[order].reshape(len(order), -1)
        # A mode has the same factor in all channels. With these factors the sound is `columns` @ factors.
        columns = (m.basis * pattern[:, None, :]).reshape(-1, pattern.shape[-1])
        norm, common_norm = np.linalg.norm(own, axis=1), float(np.linalg.norm(columns.sum(axis=1))) or 1.0
        q, triangle = np.linalg.qr(columns / common_norm)
        share.append(triangle.sum(axis=1))
        to_factors.append(np.linalg.pinv(triangle, rcond=LEAST_SINGULAR).T)
        projected = own @ q.conj()
        turn = np.exp(-1j * np.angle(projected @ share[-1].conj()))
        level.append(np.log(np.where(norm > 0, norm, common_norm) / common_norm))
        deviation.append((turn / np.where(norm > 0, norm, 1.0))[:, None] * projected - share[-1])
    levels = smooth_random_walk(np.stack(level, axis=1), error, velocity)
    number, both = [len(x) for x in share], np.concatenate(deviation, axis=1)
    both = np.concatenate([np.real(both), np.imag(both)], axis=1)
    real, imag = np.split(smooth_random_walk(both, np.tile(np.repeat(error, number, axis=1), 2), velocity), 2, axis=1)
    parts = np.split(real + 1j * imag, np.cumsum(number)[:-1], axis=1)
    factor = 1 + np.concatenate([part @ to for part, to in zip(parts, to_factors, strict=True)], axis=1)
    return VelocityGain(velocity[first], (np.exp(np.repeat(levels, number, axis=1)) * factor)[first])


def _delay(layers: AlignedLayers, ratio: np.ndarray, weight: np.ndarray, omega: np.ndarray, layer: int) -> float:
    """Delay of a layer's contact after its onset, minus that of the last layer, s.

    Phases of partials alone are ambiguous by a period. The correlation of the attacks, half whitened (Knapp and Carter
    1976; Donohue et al. 2007), resolves the ambiguity.
    """
    step = 4e-6  # s, a tenth of a period of the highest partials
    trial = np.arange(-LARGEST_DELAY, LARGEST_DELAY, step)
    turn = ratio[:, layer] * ratio[:, -1].conj()
    turn = turn / np.maximum(np.abs(turn), 1e-30) * weight[:, layer] * np.exp(1j * omega * trial[0])
    phases = sum_damped_modes(1j * omega, turn[None], 1 / step, len(trial))[0] / max(weight[:, layer].sum(), 1e-12)
    size = round(ATTACK_SECONDS * layers.rate)
    a, b = layers.samples[layer, :, :size], layers.samples[-1, :, :size]
    cross = np.fft.rfft(a, 2 * size) * np.fft.rfft(b, 2 * size).conj()
    cross *= np.maximum(np.abs(cross), np.finfo(float).tiny) ** (WHITENING_EXPONENT - 1)
    # The spectrum of positive frequencies alone gives the envelope.
    cross[:, 1:-1] *= 2
    correlation = np.abs(np.roll(np.fft.ifft(cross.sum(axis=0), 2 * size), size))
    attacks = np.interp(trial * layers.rate + size, np.arange(2 * size), correlation / correlation.max())
    return float(trial[np.argmax(phases + ATTACK_WEIGHT * attacks - DELAY_PENALTY * np.abs(trial) / LARGEST_DELAY)])


def _knock(
    layers: AlignedLayers,
    modes: Sequence[PartialModes],
    response: ModalResponse,
    forces: Sequence[ForcePulse],
    delay: np.ndarray,
    gain: np.ndarray,
) -> np.ndarray:
    """Σ w F* R / (Σ w |F|² + floor) over layers [channels, samples].

    R is the residual of a layer after its modes, from its contact on. The modes have the layer's own amplitudes, so
    that errors of the common pattern do not enter the knock.
    """
    amplitude = np.concatenate([m.at_onset for m in modes], axis=-1)
    # Each layer has its own pitch. A mismatch of one cent would leave its partials in the knock.
    pole = np.concatenate([m.poles + 2j * np.pi * m.offset[:, None] for m in modes], axis=-1)
    rate, lead = layers.rate, round(PRE_ONSET_S * layers.rate)
    size = lead + round(min(KNOCK_SECONDS, *(layers.seconds - delay)) * rate)

    def inaudible(pattern: np.ndarray) -> np.ndarray:
        return np.pad(cancel_static_deflection(response.pole, pattern, rate, size - lead), ((0, 0), (lead, 0)))

    count = 1 << int(np.ceil(np.log2(2 * size)))
    fade, fade_size = np.ones(size), round(FADE * size)
    fade[-fade_size:] = 0.5 + 0.5 * np.cos(np.pi * np.arange(fade_size) / fade_size)
    turn = 2j * np.pi * np.fft.rfftfreq(count)
    numerator = np.zeros((layers.samples.shape[1], count // 2 + 1), complex)
    denominator = np.zeros(count // 2 + 1)
    rows = zip(layers.samples, layers.before, amplitude, pole, forces, delay, gain, strict=True)
    for x, before, own, poles, force, late, g in rows:
        around = np.concatenate([before[:, before.shape[-1] - lead :], x], axis=-1)
        # Every layer starts `PRE_ONSET_S` before its contact.
        observed = delayed(around[:, : 2 * size], -late * rate)[:, :size]
        own_modes = response._replace(pole=poles)
        residual = observed - _render_modes(own_modes, own * np.exp(poles * late), force, size, inaudible)
        spectrum = g * np.fft.rfft(force.at(rate), count) * np.exp(turn * FILTER_REACH)
        weight = 1 / np.sum(observed**2)
        numerator += weight * spectrum.conj() * np.fft.rfft(residual * fade, count)
        denominator += weight * np.abs(spectrum) ** 2
    kernel = np.fft.irfft(numerator / (denominator + FLOOR**2 * denominator.max()), count)[:, :size]
    return kernel * fade + inaudible(response.pattern)


def _render_modes(
    response: ModalResponse,
    amplitude: np.ndarray,
    force: ForcePulse,
    size: int,
    inaudible: Callable[[np.ndarray], np.ndarray],
) -> np.ndarray:
    """Modes with these amplitudes at the contact [channels, samples].

    The force drives the modes as far as its spectrum permits. The remainder of the amplitude starts at the contact.
    """
    drive = force.drive(response.pole)
    driven = amplitude * drive.conj() / (np.abs(drive) ** 2 + (LEAST_DRIVE * np.abs(drive).max()) ** 2)
    lead = round(PRE_ONSET_S * response.rate)
    remainder = sum_damped_modes(response.pole, amplitude - driven * drive, response.rate, size - lead)
    sound = response._replace(pattern=driven, knock=inaudible(driven)).sound(force, response.rate, size)
    return sound + np.pad(remainder, ((0, 0), (lead, 0)))
