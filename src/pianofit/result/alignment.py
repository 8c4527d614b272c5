"""Alignment of a simulated attack with a recorded one, which gives the time of the first contact."""

from __future__ import annotations

import numpy as np
from scipy.signal import correlate

from ..model.note import Note
from ..model.simulate import Simulation
from ..recording.onset import find_onset
from ..recording.recording import Recording

__all__ = ["fractional_lag", "align_attack", "locate_template", "estimate_contact_onset"]

# s of the attack that is simulated to estimate the contact, and s of noise before it.
ATTACK_SECONDS = 0.15
LEAD_SECONDS = 0.05
# s of noise that a recording must have before its onset to be used; otherwise white noise is.
NOISE_SECONDS = 0.02
# s of the attack that is aligned with a calibrated recording.
ALIGNED_SECONDS = 0.05


def estimate_contact_onset(note: Note, strike: Simulation, recording: Recording) -> int:
    """Sample index of the first contact, chosen so that the simulated stroke has the onset of the recording.

    High partials of a stiff string arrive before the main wave. The noise decides how many of them the onset detector
    finds. So the stroke is simulated in the noise before the onset, or in white noise of a fixed seed.
    """
    rate, onset = recording.rate, recording.onset
    attack, before = recording.samples[onset:][: round(ATTACK_SECONDS * rate)], round(LEAD_SECONDS * rate)
    sound = note.render_mono(strike, rate, len(attack))
    sound = np.pad(sound * np.abs(attack).max() / max(np.abs(sound).max(), 1e-300), (before, 0))
    noise = recording.samples[: max(onset - round(0.001 * rate), 0)]
    if len(noise) < NOISE_SECONDS * rate or noise.std() < 0.5 * recording.noise_rms:
        noise = np.random.default_rng(0).normal(0.0, recording.noise_rms, len(sound))
    detected = find_onset(np.resize(np.append(noise, noise[::-1]), len(sound)) + sound, rate, 0.0)
    return onset - max(detected - before, 0)


def align_attack(note: Note, recording: Recording) -> float:
    """Sample index of the first contact in a calibrated recording, by alignment of the simulated attack."""
    count = round(ALIGNED_SECONDS * recording.rate)
    model, _ = note.render_stroke(recording.rate, count)
    begin = max(recording.onset - count, 0)
    sound = recording.samples[begin : recording.onset + 2 * count]
    if len(sound) <= count:
        return recording.onset
    start, sign = locate_template(model, sound)
    return begin + start + fractional_lag(model, sign * sound[start : start + count])


def fractional_lag(model: np.ndarray, sound: np.ndarray) -> float:
    """Delay of `sound` relative to `model`, in samples, accurate to a hundredth; both [samples]."""
    size = 2 ** int(np.ceil(np.log2(2 * len(model))))
    oversampling = 16
    cross = np.fft.rfft(sound, size) * np.fft.rfft(model, size).conj()
    correlation = np.fft.irfft(cross, oversampling * size)
    peak = int(np.argmax(correlation))
    before, top, after = correlation[peak - 1], correlation[peak], correlation[(peak + 1) % len(correlation)]
    lag = peak + 0.5 * (before - after) / (before - 2 * top + after)
    return float((lag if lag < len(correlation) / 2 else lag - len(correlation)) / oversampling)


def locate_template(model: np.ndarray, sound: np.ndarray) -> tuple[int, float]:
    """Position of `model` in the longer `sound` with the least residual energy, and its sign; both [samples], one unit.

    Unlike the peak of a correlation, the residual counts the silence before an attack. A position one period late
    leaves the first period unexplained. The sign is -1 for a pickup of opposite polarity.
    """
    energy = np.concatenate([[0.0], np.cumsum(sound**2)])
    cross = correlate(sound, model, "valid", "fft")
    start = int(np.argmin(energy[len(model) :] - energy[: -len(model)] - 2 * np.abs(cross)))
    return start, float(np.sign(cross[start]))
