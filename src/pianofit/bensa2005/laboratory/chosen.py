"""Values that the paper does not give, each with the reason for the choice.

String mass, strike position, contact window, pickup and the missing initial κ are in the presets `bensa-final` and
`bensa-initial` of `pianofit.literature`. The others are below. They are not measured: they are plausible, and large
enough to have a visible effect.
"""

from __future__ import annotations

from typing import NamedTuple

from ...literature import Preset, preset
from ...parameters import FIT_NAMES

__all__ = [
    "ANGLE", "CENTS", "CONTACT_RATE", "CORNER", "EPS", "FASTEST", "FINAL", "FLOOR", "INITIAL", "LEAD", "MODES", "RATE",
    "RESONATORS", "SCALE", "SECONDS", "SLOWER", "SLOWEST", "TAU", "DEMO_OVERSAMPLING", "DEMO_SCALE", "Resonator",
    "by_name",
]  # fmt: skip

FINAL, INITIAL = preset("bensa-final"), preset("bensa-initial")


def by_name(values: Preset) -> dict[str, float]:
    """Return the nine parameters by name."""
    return {name: float(value) for name, value in zip(FIT_NAMES, (*values.string, *values.hammer), strict=True)}


RATE = 44_100  # Hz, a common one; the paper names a digital tape
SECONDS = 3.0  # length of a signal after the stroke, s
LEAD = 0.05  # s of silence before the note
# Velocity at digital full scale, m/s. The paper's velocities reach 2.3 m/s, with a peak of 3 m/s at the pickup.
SCALE = 5.0
# The same for the one velocity of the demo.
DEMO_SCALE = 2.0
DEMO_OVERSAMPLING = 32  # contact steps per sample of the demo, far more than in a fit
# Range of hammer velocities, m/s, within the noise and the range of the vibrometer.
SLOWEST = 0.05
FASTEST = 3.5

# The paper does not give N. The contact window of 20 mm hardly drives modes beyond number 160. 256 modes change the
# signal by 2e-6 of its peak, as much as half the contact step at CONTACT_RATE does.
MODES = 160
CONTACT_RATE = 1.4e6  # steps per second, at least

# The second polarisation. The principal axes of the supports are turned by ANGLE against the hammer. The pickup
# measures along the hammer, so the second axis lies at tan² 20° = -17.6 dB relative to the first, a common level of the
# aftersound of piano notes (Weinreich 1977). Its losses are a quarter, because supports are stiffer along the
# soundboard. It is CENTS sharp: the fifth partial beats with a period of 1.1 s, the first with one of 5.7 s.
ANGLE = 20.0  # degrees
CENTS = 2.0
SLOWER = 0.25  # b1 and b2 of the second axis, over those of the first


class Resonator(NamedTuple):
    """One damped mode of the support at the end of the string."""

    frequency: float  # Hz
    mass: float  # effective, at the end of the string, kg
    quality: float  # Q = ω m / R
    direction: float  # of its motion, degrees from the string's first axis


# The paper's support is concrete with a piece of bridge on it, and "not totally uncoupled" from the string. A resonance
# adds 2 f0 (M_S c/L) Q/(m ω) to the decay rate of a partial: 0.7 to 1.1 1/s here, one to two times b1 of the string.
# The resonances are arbitrary: near partials 2, 7, 11 and 16, and between 4 and 5. Masses fall with frequency, because
# ever smaller parts of the support move.
RESONATORS = (
    Resonator(300.0, 8.0, 30.0, 10.0),
    Resonator(690.0, 5.0, 30.0, -25.0),
    Resonator(1085.0, 3.0, 30.0, 15.0),
    Resonator(1710.0, 2.0, 30.0, -10.0),
    Resonator(2560.0, 1.5, 30.0, 30.0),
)

# The relaxing felt (Stulov 1995). A slow compression has the force K (1 - ε) u^p, so K (1 - ε) is the paper's K_H. The
# loss is K_H α d(u^p)/dt with α = ετ/(1 - ε) = 20 µs. It equals the paper's μ at a compression of pα/μ = 0.26 mm, which
# is typical at the paper's velocities. (Stulov's own hammers have some ten times that, but they are not the paper's
# hammer.) τ is long enough to affect the ripple that reflections from the near end cause in the force: the stiffness is
# a third larger for sudden compressions.
EPS = 0.25
TAU = 60e-6  # s

# Noise of the vibrometer: white, rising as 1/f below CORNER because of speckle and vibration of the building, and flat
# below FLOOR. The 1/f part has some 4 % of the power.
CORNER = 100.0  # Hz
FLOOR = 10.0  # Hz
