"""What may be heard in a test: sounds that betray by a fault which of the two they are, are refused.

A gate takes a recording and returns what it measured where that is too much, with what to do, or nothing. The limits
lie between what whole recordings of pianos have and what a fault of each kind has.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..recording.recording import INSIDE, Recording

__all__ = ["GATES", "clicks", "clipping", "failures", "onset_in_file", "offset"]

# Offset over the peak, 1: −40 dB. Where a sound begins and ends it is a step, a tick; whole recordings have 0.0008.
OFFSET = 0.01
# A jump over the rms of what surrounds it, 1: of noise no sample in a million exceeds 5 and whole recordings have at
# most 6.1; a jump of one sample by −40 dB of the peak has some hundred on a note that has faded.
JUMP = 12.0
# A jump over the peak, 1: −60 dB; below, it is in the noise of a room.
LEAST_JUMP = 1e-3
# What surrounds a sample, s, and the part of it next to the sample that is left out, samples: a jump's own width.
AROUND, OWN = 0.01, 4
# After the onset, s, in which the hammer itself makes jumps.
HAMMER = 0.05


def clipping(recording: Recording) -> str | None:
    """Samples cut off at an extreme: a single flat run is a distortion that the other sound does not have."""
    if recording.clipped:
        return f"{recording.clipped} samples are cut off, none may be; record it with less gain"
    return None


def offset(recording: Recording) -> str | None:
    """A mean that is not zero."""
    share = abs(recording.dc) / float(np.abs(recording.frames).max())
    if share > OFFSET:
        return f"the offset is {share:.3g} of the peak, at most {OFFSET:g} may be; filter it out"
    return None


def onset_in_file(recording: Recording) -> str | None:
    """An onset that is not in the file."""
    share = float(np.abs(recording.samples[0]) / np.abs(recording.samples).max())
    if share > INSIDE:
        return f"the first sample is {share:.3g} of the peak, at most {INSIDE:g} may be: it begins inside the note"
    return None


def clicks(recording: Recording) -> str | None:
    """Jumps after the attack, by the third difference, which partials hardly have."""
    peak, around = float(np.abs(recording.frames).max()), round(AROUND * recording.rate)
    begin = recording.onset + round(HAMMER * recording.rate)
    for frame in recording.frames:
        jump = np.abs(np.diff(frame[begin:], 3))
        if len(jump) <= 2 * around:
            continue
        over = jump / np.maximum(_surroundings(jump, around), LEAST_JUMP * peak / JUMP)
        worst = int(np.argmax(over))
        if over[worst] > JUMP:
            at = (begin + worst) / recording.rate
            return (
                f"a jump at {at:.3f} s is {over[worst]:.3g} times what surrounds it, at most {JUMP:g} may be; mend it"
            )
    return None


def _surroundings(values: np.ndarray, around: int) -> np.ndarray:
    """The rms of `values` [samples] around each, without itself [samples]."""
    from scipy.ndimage import uniform_filter1d

    wide, near = 2 * around + 1, 2 * OWN + 1
    sums = wide * uniform_filter1d(values**2, wide) - near * uniform_filter1d(values**2, near)
    return np.sqrt(np.maximum(sums, 0) / (wide - near))


GATES: dict[str, Callable[[Recording], str | None]] = {
    "clipping": clipping, "offset": offset, "onset": onset_in_file, "clicks": clicks,
}  # fmt: skip


def failures(recording: Recording) -> list[str]:
    """What each gate that the recording fails says, with its name."""
    found = {name: gate(recording) for name, gate in GATES.items()}
    return [f"gate {name}: {words}" for name, words in found.items() if words]
