"""The onset of a note: the first arrival of its sound, before it is loud.

It is detected in the recording above 20 Hz, in three steps:

1. The level is divided into sounds at its deep minima. The note is the first sound that stays above the noise for long.
   A click, a key noise or a cough is shorter than a ringing string.
2. The first loud sample of that sound is detected.
3. The samples around it are divided where "noise before, note after" is most likely. Each side is an autoregression
   with its own variance (the AR-AIC picker of seismology; Sleeman and van Eck 1999). Predictable hum has no effect.
"""

import numpy as np

from ..dsp.filters import forward_mean, without_drift

LOUD = 0.05  # of the peak, above which a sample belongs to a sound
WIDTH = 0.02  # s, over which a level is averaged; a click is much shorter
PERIOD = 0.037  # s, of the lowest key; the level that divides sounds is averaged over it, because bass notes are pulses
DEPTH = 6.0  # dB; a minimum this far below the maxima on both its sides divides two sounds
LOUDNESS = 0.3  # power of the level that is summed over a sound; a long soft note outweighs a short loud noise
RINGS = 0.3  # of the largest sum; the first beat of a real treble note reaches 0.4, a key noise or thump less than 0.2
SILENT = 1e-6  # of the highest level; a level below it is digital silence


def find_onset(x: np.ndarray, rate: int, step: float) -> int:
    """Return the index of the first sample of the attack in `x` [samples], of steps `step`."""
    return find_sounds(x, rate, step)[-1]


def find_sounds(x: np.ndarray, rate: int, step: float) -> list[int]:
    """Detect the note and the sounds before it.

    Parameters
    ----------
    x : recording [samples], full scale = 1.
    rate : Hz.
    step : step of the quantiser, full scale = 1; 0 for floats.

    Returns
    -------
    The index of the first sample of each sound. The last one is the onset of the note.

    Examples
    --------
    >>> import numpy as np
    >>> t = np.arange(44_100) / 44_100
    >>> note = np.append(np.zeros(22_050), np.sin(2 * np.pi * 220 * t) * np.exp(-3 * t))
    >>> note[9_000:9_100] = 0.5
    >>> find_sounds(note, 44_100, 0.0)
    [9000, 22051]
    """
    above = without_drift(x, rate)
    width = round(WIDTH * rate)
    level = forward_mean(np.abs(above), width)
    quiet, hop = _quiet_level(level, width), max(width // 4, 1)
    slow = forward_mean(np.abs(above), round(PERIOD * rate))
    frames = np.maximum(slow[::hop], max(quiet, SILENT * level.max(), 1e-300))
    starts = _sound_starts(20 * np.log10(frames))
    loudness = [float(np.sum(part**LOUDNESS - frames.min() ** LOUDNESS)) for part in np.split(frames, starts[1:])]
    note = int(np.argmax(np.array(loudness) >= RINGS * max(loudness)))
    bounds = [hop * start for start in starts] + [len(level)]
    parts = [slice(*bounds[i : i + 2]) for i in range(note + 1)]
    threshold = max(4 * quiet, 0.1 * level[parts[note]].max())
    reported = [part for part in parts[:-1] if level[part].max() >= threshold]
    return [_first_sample(x, above, level, part, quiet, rate, step) for part in (*reported, parts[note])]


def _quiet_level(level: np.ndarray, width: int) -> float:
    """Return the level between sounds: the lower of the levels of the whole file and before the note.

    A bass note may ring until the end of its file. Other files begin with the note.
    """
    half, hop = int(np.argmax(level >= 0.5 * level.max())), max(width // 4, 1)
    return min(float(np.quantile(part[::hop], 0.1)) for part in (level, level[: half + 1]))


def _sound_starts(decibels: np.ndarray) -> list[int]:
    """Frames at which sounds begin in the levels `decibels` [frames]: 0 and each minimum that is deep on both sides."""
    starts = [0]
    top, low, at = decibels[0], decibels[0], 0
    for i, value in enumerate(decibels):
        if value < low:
            low, at = value, i
        if top - low >= DEPTH and value - low >= DEPTH:
            starts.append(at)
            top, low, at = value, value, i
        elif value > top and top - low < DEPTH:
            top, low, at = value, value, i
    return starts


def _first_sample(
    x: np.ndarray, above: np.ndarray, level: np.ndarray, part: slice, quiet: float, rate: int, step: float
) -> int:
    """Index of the first sample of the sound in `part`: the most likely change before its first loud sample.

    A sample is loud at 5 % of the local peak and above the noise. The change lies in the 10 ms before that sample. The
    recording `above` 20 Hz replaces `x` where a drift or rumble reaches that level.
    """
    width, segment = round(WIDTH * rate), level[part]
    half = segment[int(np.argmax(segment >= 0.5 * segment.max()))]
    start = part.start + int(np.argmax(segment >= min(max(4 * quiet, 0.1 * segment.max()), half)))
    near = slice(start, start + 3 * width)
    if np.abs(x[max(start - width, 0) : start]).max(initial=0.0) > LOUD * np.abs(x[near]).max():
        x = above
    local = np.abs(x[near])
    noise = 1.4826 * np.median(np.abs(x[:start])) if start > width // 2 else 0.0
    if part.start:  # another sound may still decay
        noise = max(noise, 1.25 * segment[0])
    loud = start + int(np.argmax(local >= min(max(LOUD * local.max(), 5 * noise), 0.5 * local.max())))
    first, last = max(0, loud - round(0.01 * rate)), loud + max(round(0.002 * rate), 8)
    return first + min(_change_point(x[first:last], max(step / 4, 1e-7 * local.max())), loud - first)


def _change_point(x: np.ndarray, floor: float, margin: int = 4) -> int:
    """Return the index at which a second-order autoregression of another variance most likely begins; 0 if too short.

    C [3, 3] is the covariance of the samples of one side and their two predecessors, C' that of the predecessors. The
    prediction error has variance det C / det C'. `floor` is the smallest standard deviation assumed.
    """
    if len(x) < 3:
        return 0
    rows = np.lib.stride_tricks.sliding_window_view(x, 3)
    splits = np.arange(margin, len(rows) - margin)
    if len(splits) == 0:
        return 0
    sums = np.cumsum(rows[:, :, None] * rows[:, None, :], axis=0)
    before = sums[splits - 1]
    cost = _deviance(before, splits, floor) + _deviance(sums[-1] - before, len(rows) - splits, floor)
    return int(splits[np.argmin(cost)]) + 2  # index of the newest sample of a row


def _deviance(sums: np.ndarray, counts: np.ndarray, floor: float) -> np.ndarray:
    """Minus twice the log-likelihood of each side, up to a constant [splits]."""
    covariance = sums / counts[:, None, None] + floor**2 * np.eye(3)
    return counts * (np.linalg.slogdet(covariance)[1] - np.linalg.slogdet(covariance[:, :2, :2])[1])
