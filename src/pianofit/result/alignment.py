"""Alignment of a simulated attack with a recorded one."""

import numpy as np

from ..dsp.filters import fractional_lag, locate_template
from ..model.note import Note
from ..model.simulate import Simulation
from ..recording.onset import find_onset
from ..recording.recording import Recording

# s of the attack that is simulated to estimate the contact, and s of noise before it.
ATTACK_SECONDS, LEAD_SECONDS = 0.15, 0.05
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
