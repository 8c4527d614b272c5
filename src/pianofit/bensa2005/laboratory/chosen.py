"""What the paper does not give, chosen once, with the reason.

Mass of the string, strike, contact window, pickup, the missing initial κ: `published`, presets `bensa-final` and
`bensa-initial`. What is left is below. None of these values was measured by this project; they are plausible, and large
enough to be seen.
"""

from __future__ import annotations

from typing import NamedTuple

from ...literature import Preset, preset
from ...parameters import FIT_NAMES

__all__ = [
    "ANGLE", "CENTS", "CONTACT_RATE", "CORNER", "EPS", "FASTEST", "FINAL", "FLOOR", "INITIAL", "LEAD", "MODES", "RATE",
    "RESONATORS", "SCALE", "SECONDS", "SLOWER", "SLOWEST", "TAU", "TWIN_OVERSAMPLING", "TWIN_SCALE", "Resonator",
    "by_name",
]  # fmt: skip

FINAL, INITIAL = preset("bensa-final"), preset("bensa-initial")


def by_name(it: Preset) -> dict[str, float]:
    """The nine parameters."""
    return {name: float(value) for name, value in zip(FIT_NAMES, (*it.string, *it.hammer), strict=True)}


RATE = 44_100  # Hz, a common one; the paper names a digital tape
SECONDS = 3.0  # of a signal after the stroke
LEAD = 0.05  # s of silence before the note
# Velocity at digital full scale, m/s: one range for all velocities of the paper, up to 2.3 m/s, which peaks at 3 m/s at
# the pickup,
SCALE = 5.0
# and one that fits the demo's one velocity.
TWIN_SCALE = 2.0
TWIN_OVERSAMPLING = 32  # steps of the demo's contact in a sample: far more than a fit takes
# Hammer velocities, m/s, that the vibrometer still hears, and that do not leave its range.
SLOWEST = 0.05
FASTEST = 3.5

# The paper's N is not known. The contact window of 20 mm hardly drives modes beyond the 160th: with 256 of them the
# signal moves by 2e-6 of its peak, as much as by halving the step of the contact at CONTACT_RATE.
MODES = 160
CONTACT_RATE = 1.4e6  # steps per second, at least

# The second polarisation. The supports' principal axes are turned by ANGLE against the hammer: the pickup, which looks
# along the hammer, then has the second axis at tan² 20° = -17.6 dB beside the first, as the aftersound of piano notes
# often lies (Weinreich 1977). It loses a quarter as much, since supports give way less along the soundboard, and is
# CENTS sharp: the fifth partial beats with a period of 1.1 s, the first with one of 5.7 s.
ANGLE = 20.0  # degrees
CENTS = 2.0
SLOWER = 0.25  # b1 and b2 of the second axis, over those of the first


class Resonator(NamedTuple):
    """One damped mode of the support, felt where the string ends."""

    frequency: float  # Hz
    mass: float  # effective, at the end of the string, kg
    quality: float  # Q = ω m / R
    direction: float  # of its motion, degrees from the string's first axis


# The paper's support is concrete with a piece of bridge on it, and "not totally uncoupled" from the string. A partial
# at a resonance gains 2 f0 (M_S c/L) Q/(m ω) in decay: 0.7 to 1.1 1/s here, once or twice the string's own b1. They lie
# near partials 2, 7, 11 and 16 and between 4 and 5, as chance would have it. Masses fall with frequency: the support
# moves less and less as a whole.
RESONATORS = (
    Resonator(300.0, 8.0, 30.0, 10.0),
    Resonator(690.0, 5.0, 30.0, -25.0),
    Resonator(1085.0, 3.0, 30.0, 15.0),
    Resonator(1710.0, 2.0, 30.0, -10.0),
    Resonator(2560.0, 1.5, 30.0, 30.0),
)

# The relaxing felt (Stulov 1995). Slow compressions feel K (1 - ε) u^p, so K (1 - ε) is the paper's K_H, and lose
# energy as K_H α d(u^p)/dt with α = ετ/(1 - ε) = 20 µs: the paper's μ at a compression of pα/μ = 0.26 mm, the usual one
# at its velocities. (Stulov's own hammers are said to have some ten times that: they are not the paper's hammer.) τ is
# long enough to be felt by the ripple that reflections from the near end leave on the force: sudden compressions feel a
# third more stiffness.
EPS = 0.25
TAU = 60e-6  # s

# Noise of the vibrometer: white, and rising as 1/f below CORNER, where speckle and the building are heard; flat below
# FLOOR. The second part holds some 4 % of its power.
CORNER = 100.0  # Hz
FLOOR = 10.0  # Hz
