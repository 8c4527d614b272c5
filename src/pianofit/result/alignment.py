"""Where a recording's stroke begins: a simulated attack laid on the recorded one."""

from __future__ import annotations

import numpy as np
from scipy.signal import correlate

from ..model.note import Note
from ..model.simulate import Simulation
from ..recording.onset import find_onset
from ..recording.recording import Recording

__all__ = ["fractional_lag", "align_attack", "locate_template", "estimate_contact_onset"]

# How much of an attack, s, is played to see where it begins, with how much noise before it, of which the recording
# should have at least so much.
ATTACK = 0.15
BEFORE = 0.05
HEARD = 0.02
# How much of it, s, tells when the hammer touched a string whose sound is calibrated.
LAID = 0.05


def estimate_contact_onset(note: Note, strike: Simulation, recording: Recording) -> int:
    """The index at which the hammer touched, if the strike, in the recording's noise, is first seen at its onset.

    High partials run ahead of a stiff string's main wave, and how much of that is seen is a matter of the noise: the
    recording's own before the onset, or else white noise of one seed.
    """
    rate, onset = recording.rate, recording.onset
    attack, before = recording.samples[onset:][: round(ATTACK * rate)], round(BEFORE * rate)
    sound = note.render_mono(strike, rate, len(attack))
    sound = np.pad(sound * np.abs(attack).max() / max(np.abs(sound).max(), 1e-300), (before, 0))
    noise = recording.samples[: max(onset - round(0.001 * rate), 0)]
    if len(noise) < HEARD * rate or noise.std() < 0.5 * recording.noise_rms:
        noise = np.random.default_rng(0).normal(0.0, recording.noise_rms, len(sound))
    seen = find_onset(np.resize(np.append(noise, noise[::-1]), len(sound)) + sound, rate, 0.0)
    return onset - max(seen - before, 0)


def align_attack(note: Note, recording: Recording) -> float:
    """Where in a calibrated recording the hammer touched, in samples: the note's attack is laid on the recorded one."""
    count = round(LAID * recording.rate)
    model, _ = note.render_stroke(recording.rate, count)
    begin = max(recording.onset - count, 0)
    sound = recording.samples[begin : recording.onset + 2 * count]
    if len(sound) <= count:
        return recording.onset
    at, sign = locate_template(model, sound)
    return begin + at + fractional_lag(model, sign * sound[at : at + count])


def fractional_lag(model: np.ndarray, sound: np.ndarray) -> float:
    """By how many samples, to a hundredth, `sound` has to be shifted back to lie on `model`; both [samples]."""
    size = 2 ** int(np.ceil(np.log2(2 * len(model))))
    fine = 16
    cross = np.fft.rfft(sound, size) * np.fft.rfft(model, size).conj()
    peaks = np.fft.irfft(cross, fine * size)
    at = int(np.argmax(peaks))
    before, top, after = peaks[at - 1], peaks[at], peaks[(at + 1) % len(peaks)]
    place = at + 0.5 * (before - after) / (before - 2 * top + after)
    return float((place if place < len(peaks) / 2 else place - len(peaks)) / fine)


def locate_template(model: np.ndarray, sound: np.ndarray) -> tuple[int, float]:
    """Where in the longer `sound` the `model` leaves the least behind, both [samples] in one unit, and its sign there.

    Unlike the peak of a correlation this counts the silence before an attack: a note that lies one period late leaves
    its first period behind. The sign is -1 for a pickup of the other polarity.
    """
    energy = np.concatenate([[0.0], np.cumsum(sound**2)])
    cross = correlate(sound, model, "valid", "fft")
    at = int(np.argmin(energy[len(model) :] - energy[: -len(model)] - 2 * np.abs(cross)))
    return at, float(np.sign(cross[at]))
