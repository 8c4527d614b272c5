"""What the ear calls attack and brightness, as two numbers measured on the sounds themselves.

The paper says that the global criterion made the attack "too smooth" and the sound less bright (IV.B), and gives no
measure for either. A struck string's attack is over within a part of the first period, so its time is taken from the
first wave that passes the pickup, not from an envelope smoothed over periods. Brightness is the spectral centroid, of
the partials' amplitudes: of the whole spectrum's it would depend on how the window leaks.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from ...errors import ParameterError

__all__ = ["attack_time", "centroid"]

# The attack runs from the first to the second of these shares of the first wave's height.
FOOT = 0.1
TOP = 0.9
SPAN = 0.35  # s under a Hann window, whose skirts hide no partial
HIGHEST = 6000.0  # Hz: above, the noise of a measurement begins to count


def attack_time(samples: np.ndarray, rate: float, f0: float) -> float:
    """Time in which the first wave rises from 10 to 90 % of its height, s.

    `samples` [samples] are from the onset on; the first half period of `f0`, Hz, is looked at. A `ParameterError`
    if there is none, or nothing in it.
    """
    head = np.abs(np.asarray(samples, float)[: int(0.5 * rate / f0) + 1])
    if head.size < 2 or head.max() == 0:
        raise ParameterError(f"samples={head.size} at {rate:g} Hz hold no attack within half a period of {f0:g} Hz")
    first, last = (_crossing(head, share * head.max()) for share in (FOOT, TOP))
    return (last - first) / rate


def centroid(samples: np.ndarray, rate: float, f0: float) -> float:
    """Σ f A / Σ A of the partials to 6 kHz over the first 0.35 s, Hz.

    A partial is the highest line of an interval as wide as `f0`, Hz, so that none counts twice. `samples` [samples]
    are from the onset on; a `ParameterError` if they are silent.
    """
    samples = np.asarray(samples, float)[: int(SPAN * rate)]
    size = 2 ** int(np.ceil(np.log2(max(len(samples), 2))) + 2)
    level = np.abs(np.fft.rfft(samples * np.hanning(len(samples)), size))
    edges = (np.arange(0.5, HIGHEST / f0) * f0 * size / rate).astype(int)
    peak = np.array([low + np.argmax(level[low:high]) for low, high in pairwise(edges)])
    amplitude = level[peak]
    if not amplitude.any():
        raise ParameterError(f"samples={len(samples)} are silent: they have no centroid")
    return float(peak @ amplitude / amplitude.sum() * rate / size)


def _crossing(rising: np.ndarray, height: float) -> float:
    """Where `rising` [samples] first comes to `height`, in samples, on the straight line between two of them."""
    after = int(np.argmax(rising >= height))
    low, high = rising[max(after - 1, 0)], rising[after]
    return after - 1 + float((height - low) / (high - low)) if after else 0.0
