"""Checks of the sounds of a listening test: artefacts that would reveal the identity of a sound.

A check returns None, or a message with the measured value, its limit and what to do. The limits lie between the values
of intact piano recordings and those of recordings with an artefact.
"""

from collections.abc import Callable

import numpy as np

from ..recording.recording import MAX_FIRST_SAMPLE, Recording

# Offset over peak, 1: −40 dB. An offset is audible as a click at both ends. Intact recordings have at most 0.0008.
OFFSET = 0.01
# Jump over the rms of its surroundings, 1. In noise, not one sample in a million exceeds 5; intact recordings have at
# most 6.1. A jump of one sample by −40 dB of the peak has about 100 at the end of a decay.
JUMP = 12.0
# Jump over peak, 1: −60 dB. Smaller jumps are masked by the noise of a room.
LEAST_JUMP = 1e-3
# Surroundings on each side of a sample, s, and the width of a jump, which is excluded from them, samples.
AROUND, JUMP_WIDTH = 0.01, 4
# Time after the onset in which the hammer contact itself causes jumps, s.
CONTACT_TIME = 0.05


def clipping(recording: Recording) -> str | None:
    """Clipped samples. The other sound of the pair does not have this distortion."""
    if recording.clipped:
        return f"{recording.clipped} samples are clipped, the limit is 0; record it with less gain"
    return None


def offset(recording: Recording) -> str | None:
    """Mean of the samples."""
    share = abs(recording.dc) / float(np.abs(recording.frames).max())
    if share > OFFSET:
        return f"the offset is {share:.3g} of the peak, the limit is {OFFSET:g}; remove it with a high-pass filter"
    return None


def onset_in_file(recording: Recording) -> str | None:
    """Files that begin after the onset."""
    share = float(np.abs(recording.samples[0]) / np.abs(recording.samples).max())
    if share > MAX_FIRST_SAMPLE:
        found = f"the first sample is {share:.3g} of the peak, the limit is {MAX_FIRST_SAMPLE:g}"
        return f"{found}: the file begins inside the note; use a complete recording"
    return None


def clicks(recording: Recording) -> str | None:
    """Jumps after the attack, detected by the third difference, in which partials are weak."""
    peak, around = float(np.abs(recording.frames).max()), round(AROUND * recording.rate)
    begin = recording.onset + round(CONTACT_TIME * recording.rate)
    for frame in recording.frames:
        jump = np.abs(np.diff(frame[begin:], 3))
        if len(jump) <= 2 * around:
            continue
        over = jump / np.maximum(_surrounding_rms(jump, around), LEAST_JUMP * peak / JUMP)
        worst = int(np.argmax(over))
        if over[worst] > JUMP:
            at = (begin + worst) / recording.rate
            return f"a jump at {at:.3f} s is {over[worst]:.3g} times its surroundings, limit {JUMP:g}; repair the file"
    return None


def _surrounding_rms(values: np.ndarray, around: int) -> np.ndarray:
    """Rms of the surroundings of each of the `values` [samples], without the value itself."""
    from scipy.ndimage import uniform_filter1d

    wide, near = 2 * around + 1, 2 * JUMP_WIDTH + 1
    sums = wide * uniform_filter1d(values**2, wide) - near * uniform_filter1d(values**2, near)
    return np.sqrt(np.maximum(sums, 0) / (wide - near))


CHECKS: dict[str, Callable[[Recording], str | None]] = {
    "clipping": clipping,
    "offset": offset,
    "onset": onset_in_file,
    "clicks": clicks,
}


def failures(recording: Recording) -> list[str]:
    """Messages of all checks that the recording fails, each with the name of its check."""
    messages = {name: check(recording) for name, check in CHECKS.items()}
    return [f"check {name}: {message}" for name, message in messages.items() if message]
