"""Tuning curves by matched partials.

Partial k of a stiff string lies at k f0 √(1 + B k²). Two keys an octave apart form a k:k/2 octave if partial k of the
lower key has the frequency of partial k/2 of the upper key, so that these partials do not beat. In cents of the first
partials, with P_k = (1200/2) log2(1 + B k²), such an octave is wider than 1200 cents by

    s(n) = P_k(B_n) - P_1(B_n) - P_k/2(B_n+12) + P_1(B_n+12)

A tuner starts from A4, tunes A3 as its octave, divides this octave into twelve equal steps, and goes on by octaves
from there to both ends (O. L. Railsback, J. Acoust. Soc. Am. 9, 274, 1938, for the resulting curve; R. W. Young, J.
Acoust. Soc. Am. 24, 267, 1952, for the inharmonicity that causes it). The stretch of an octave follows from the
inharmonicities of its two keys, so a curve is determined by the 88 values of B alone.
"""

import numpy as np

from ..conversions import A4_MIDI, CENTS, HIGHEST_KEY, LOWEST_KEY
from ..schema.tuning import OctaveType

OCTAVE = 12  # keys
# Partial of the lower key that coincides with half of its number on the upper key.
OCTAVE_TYPES: dict[OctaveType, int] = {"2:1": 2, "4:2": 4, "6:3": 6}


def partial_cents(B: np.ndarray, k: int) -> np.ndarray:
    """Return P_k, by which stiffness raises partial k above k f0, cents."""
    return 0.5 * CENTS * np.log1p(B * k**2)


def octave_stretch(B: np.ndarray, k: int) -> np.ndarray:
    """Return how far first partials of octaves without beats lie beyond 1200 cents, by lower key [..., 76].

    `B` is that of the 88 keys [..., 88]. The octaves match partial `k` of the lower key, an even number.
    """
    lower, upper = B[..., :-OCTAVE], B[..., OCTAVE:]
    raised = partial_cents(lower, k) - partial_cents(upper, k // 2)
    return raised - partial_cents(lower, 1) + partial_cents(upper, 1)


def tuning_curve(B: np.ndarray, k: int) -> np.ndarray:
    """Return the cents of first partials relative to equal temperament, 0 at A4 [..., 88]; as `octave_stretch`."""
    stretch, a4 = octave_stretch(B, k), A4_MIDI - LOWEST_KEY
    curve = np.empty(B.shape)
    step = np.arange(OCTAVE + 1) / OCTAVE - 1
    curve[..., a4 - OCTAVE : a4 + 1] = stretch[..., a4 - OCTAVE, None] * step
    for i in range(a4 + 1, HIGHEST_KEY - LOWEST_KEY + 1):
        curve[..., i] = curve[..., i - OCTAVE] + stretch[..., i - OCTAVE]
    for i in range(a4 - OCTAVE - 1, -1, -1):
        curve[..., i] = curve[..., i + OCTAVE] - stretch[..., i]
    return curve
