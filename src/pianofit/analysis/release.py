"""The noise of a key that is let go while its string is silent, cut from its recording."""

import numpy as np

from ..recording.recording import Recording

# The sound before the onset that is kept, s: the gate finds the first loud sample.
BEFORE = 0.002
# Longest noise, s. Real ones last a third of a second.
LONGEST = 1.0
# Energy that is cut at the end, relative to the whole, and the length of the final fade, s.
CUT_ENERGY, FADE = 1e-5, 0.02


def release_sound(recording: Recording) -> np.ndarray:
    """Return the noise from its onset on, full scale = 1 [channels, samples]. It ends in a fade."""
    rate = recording.rate
    first = max(recording.onset - round(BEFORE * rate), 0)
    sound = recording.frames[:, first : first + round(LONGEST * rate)]
    noise = recording.noise_rms**2 * len(sound)
    energy = np.cumsum(np.maximum(np.sum(sound**2, axis=0) - noise, 0.0)[::-1])[::-1]
    sound = sound[:, : max(int(np.sum(energy > CUT_ENERGY * energy[0])), 1)]
    fade = min(round(FADE * rate), sound.shape[-1])
    sound = sound.copy()
    sound[:, sound.shape[-1] - fade :] *= 0.5 * (1 + np.cos(np.pi * (np.arange(fade) + 1) / fade))
    return sound
