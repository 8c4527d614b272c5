"""Selection of the channels of a sound file, and detection of channels that cancel in their average."""

from __future__ import annotations

import math

import numpy as np

from ..errors import ParameterError, RecordingError
from ..io.files import printable
from ..io.number_format import counted
from .onset import without_drift

__all__ = ["check_channel", "opposite_channels", "select_channels"]

CHANNELS = ("average", "left", "right", *"12345678")
CANCELLATION = 4.0  # 6 dB; inverting channels of spaced microphones gains less than 5 dB, of a reversed channel more
MIN_AVERAGE = 0.01  # of the channels' energy; a weaker average holds only the differences between the channels


def check_channel(channel: str) -> None:
    """Raise a `ParameterError` unless `channel` is the name or number of a channel."""
    if not (isinstance(channel, str) and channel in CHANNELS):
        raise ParameterError(f"channel={printable(channel)!r} must be average, left, right, or a number from 1 to 8")


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
