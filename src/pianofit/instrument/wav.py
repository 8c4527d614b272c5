"""A WAV file of 24 bit integers, the same bytes for the same sound."""

from __future__ import annotations

import io

import numpy as np

__all__ = ["encode_pcm24"]


def encode_pcm24(samples: np.ndarray, rate: int) -> bytes:
    """A mono WAV file, 24 bit; samples [samples] must lie within ±1."""
    import soundfile

    stream = io.BytesIO()
    soundfile.write(stream, samples, rate, format="WAV", subtype="PCM_24")
    return stream.getvalue()
