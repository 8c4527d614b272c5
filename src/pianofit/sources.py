"""Recordings in any form that a caller has them in: files, arrays with their rates, or as they were read before."""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np

from .errors import ParameterError
from .io import shown
from .recording import Recording, load_recording, recording_from_samples

__all__ = ["Source", "as_recording", "read"]

Source = str | os.PathLike[str] | tuple[np.ndarray, int] | Recording


def read(recordings: Sequence[Source], channel: str = "average") -> list[Recording]:
    """Recordings from files, from arrays with their rates, and as they are.

    Raises `RecordingError` for a sound that cannot be used; `ParameterError` for what is no recording, or another
    channel.
    """
    return [as_recording(source, channel, f"recording {at}") for at, source in enumerate(recordings, 1)]


def as_recording(source: Source, channel: str = "average", name: str = "recording") -> Recording:
    """One of them; `name` is what messages call an array."""
    if isinstance(source, Recording):
        return source
    if isinstance(source, str | os.PathLike):
        return load_recording(source, channel=channel)
    if isinstance(source, tuple) and len(source) == 2:
        return recording_from_samples(*source, name=name)
    raise ParameterError(
        f"{name} = {shown(source)} must be a path, a Recording, or (samples, rate); give each as an argument of its own"
    )
