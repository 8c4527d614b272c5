"""Offset, noise floor, clipping and channels of a recording."""

import math
from numbers import Integral

import numpy as np

from ..dsp.damped_sums import z_transform_at_poles
from ..dsp.filters import forward_mean, without_drift
from ..errors import ParameterError, RecordingError
from ..io.files import short_repr
from ..io.number_format import counted

CHANNELS = ("average", "left", "right", *"12345678")
CANCELLATION = 4.0  # 6 dB; inverting channels of spaced microphones gains less than 5 dB, of a reversed channel more
MIN_AVERAGE = 0.01  # of the channels' energy; a weaker average holds only the differences between the channels
MIN_OVERSHOOT = 4.0  # spreads by which the slope extrapolates beyond a clipped top; unclipped notes reach 2.3


def offset(x: np.ndarray) -> float:
    """Mean under a Hann window.

    A partial ω contributes 4π²/(ωT)³ of its amplitude. To a plain mean it contributes 1/(ωT), 750 times more at
    27.5 Hz.
    """
    angle = 2 * np.pi / (len(x) + 1)
    cosine = np.real(np.exp(1j * angle) * z_transform_at_poles(np.array([1j * angle]), x)[0])
    return float((np.sum(x) - cosine) / (len(x) + 1))


def noise_rms(x: np.ndarray, onset: int, rate: int) -> float:
    """Return the rms of the noise: of the lead-in above 20 Hz, or of the quietest second without a lead-in."""
    floor = _quiet_floor(x, rate)
    loudest = math.sqrt(forward_mean(x * x, round(0.02 * rate)).max())
    # 6 dB: the level of noise alone varies by less than 1 dB. In a short file partials of a low note fill the spectrum.
    if loudest < 2 * floor and len(x) > 0.5 * rate:
        raise RecordingError(f"holds no sound above its noise (rms {loudest:.2g}, noise {floor:.2g}); record it again")
    lead = x[: onset - round(0.001 * rate)] if onset > 0.05 * rate else x[:1]
    if np.ptp(lead) == 0:  # a lead-in below 50 ms, or digital silence, which is not the noise of the room
        return floor
    power = forward_mean(without_drift(lead, rate) ** 2, round(0.01 * rate))
    return math.sqrt(np.median(power))  # the median ignores a knock


def _quiet_floor(x: np.ndarray, rate: int) -> float:
    """Return the rms of the noise in the quietest second, in which partials may still ring.

    Partials are narrow, so a running median over 100 Hz of the spectrum ignores them. The median of the exponential
    distribution of a noise spectrum is ln 2 of its mean.
    """
    from scipy.ndimage import median_filter

    length = min(len(x), rate)
    starts = {*range(0, len(x) - length, length // 2), len(x) - length}
    frames = [f for s in sorted(starts) if np.ptp(f := x[s : s + length]) > 0]
    quietest = min(frames, key=lambda f: float(np.var(f)))
    window = np.hanning(length)
    power = np.abs(np.fft.rfft(quietest * window)) ** 2 / (window @ window)
    smooth = median_filter(power, max(round(100 * length / rate), 11))
    return math.sqrt(float(smooth.mean()) / math.log(2))


def count_clipped(used: np.ndarray, onset: int, rate: int, step: float) -> tuple[int, tuple[str, ...]]:
    """Count the clipped samples of `used` [samples, channels], and warn; raise if the attack is clipped."""
    columns = [column - offset(column) for column in used.T]
    runs = np.concatenate([_flat_runs(sign * column, step) for column in columns for sign in (1, -1)])
    if len(runs) == 0:
        return 0, ()
    lengths, first = runs[:, 1] - runs[:, 0], runs[:, 0].min() / rate
    early = lengths[(runs[:, 0] >= onset) & (runs[:, 0] < onset + 0.5 * rate)].sum()
    if early > 0.1 * used.shape[1] * min(0.5 * rate, len(used) - onset):
        raise RecordingError(f"is clipped beyond use: {early} samples in the first 0.5 s; record it with less gain")
    return int(lengths.sum()), (
        f"clipped: {lengths.sum()} samples, the first at {first:.3f} s; record it with less gain",
    )


def _flat_runs(y: np.ndarray, step: float) -> np.ndarray:
    """Start and stop of the runs in which `y` was clipped at its highest value [runs, 2].

    A later gain moves the highest value to any level, and dither spreads it over two steps. Half a step covers
    rounding. A slow, unclipped wave also stays on its highest quantised value for some samples, but its slope vanishes
    there. A clipped wave arrives with a slope that extrapolates to many steps beyond the top.
    """
    top, spread = y.max(), 2.5 * step
    if top < 0.25 * np.abs(y).max():  # the edge of a one-sided wave
        return np.zeros((0, 2), int)
    runs = np.flatnonzero(np.diff(np.concatenate([[0], (y >= top - spread).astype(np.int8), [0]]))).reshape(-1, 2)
    runs = runs[runs[:, 1] - runs[:, 0] >= 3]
    if len(runs) == 0:
        return runs
    values = np.unique(y[y > 0.5 * top])
    overshoot = MIN_OVERSHOOT * (spread + max(step, float(np.diff(values).min(initial=top))))
    padded = np.pad(y, 2, constant_values=top)  # a run that touches an end is judged by the slope on its other side
    start, stop = runs[:, 0] + 2, runs[:, 1] + 2
    entering = 2 * padded[start - 1] - padded[start - 2] - top
    leaving = 2 * padded[stop] - padded[stop + 1] - top
    return runs if np.any(np.maximum(entering, leaving) > overshoot) else runs[:0]  # one clipping level for all runs


def checked_channel(channel: str | int) -> str:
    """Return the name or number of a channel as a text. Raises a `ParameterError` for another value."""
    name = str(channel) if isinstance(channel, str | Integral) else ""  # a bool has no such name
    if name not in CHANNELS:
        raise ParameterError(f"channel={short_repr(channel)} must be average, left, right, or a number from 1 to 8")
    return name


def select_channels(frames: np.ndarray, channel: str) -> tuple[np.ndarray, str]:
    """Return the frames of the channels to average [samples, selected], and the name of the selection."""
    count = frames.shape[1]
    if channel == "average":
        return frames, "mono" if count == 1 else "average"
    number = {"left": 1, "right": 2}.get(channel) or int(channel)
    if number > count:
        raise RecordingError(f"has {counted(count, 'channel')}, so channel={channel!r} must be 1 to {count}")
    return frames[:, number - 1 : number], "mono" if count == 1 else channel


def opposite_channels(used: np.ndarray, rate: int) -> tuple[str, ...]:
    """Warn about channels of `used` [samples, channels] that are opposite in phase to the others, so that they cancel.

    With the signs of the strongest principal component the channels add up. Channels cancel if their plain average has
    far less energy than the average with these signs. An average of less than a hundredth of the energy of the channels
    does not hold the note, and raises.
    """
    if used.shape[1] == 1:
        return ()
    covariance = np.cov([without_drift(column, rate) for column in used.T])
    channels, average = len(covariance), float(covariance.mean())
    _, directions = np.linalg.eigh(covariance)
    sign = np.where(directions[:, -1] < 0, -1, 1)
    if sign.sum() < 0 or (sign.sum() == 0 and sign[0] < 0):  # fewer channels, or the second of two, are opposite
        sign = -sign
    added = float(sign @ covariance @ sign) / channels**2
    if average * CANCELLATION >= added:
        return ()
    energy = float(np.trace(covariance)) / channels
    loss = 10 * math.log10(energy / max(average, 1e-30 * energy))
    numbers = ", ".join(str(i + 1) for i in np.flatnonzero(sign < 0))
    message = (
        f"channel {numbers} is opposite in phase to the others: their average is {loss:.1f} dB weaker than "
        f"they are; choose one with --channel, or invert channel {numbers}"
    )
    if average < MIN_AVERAGE * energy:
        raise RecordingError(f"its channels cancel when averaged: {message}")
    return (message,)
