"""A plucked string: pulled aside by a finger or plectrum, and released at t = 0.

A force F, spread over a contact window ĝ about x0, holds the string in static equilibrium. Mode k is displaced by its
static compliance,

    q_k = 2 F Φ_k / (M_S ω_k²),     Φ_k = ∫ ĝ sin(β_k x) dx ≈ sin(k π x0/L) (1 - ½ β_k² σ²)

with the ω_k of the stiff string and σ the standard deviation of the window. Without stiffness and width this is the
triangle of an ideal pluck, and q_k falls as 1/k². After the release the string moves freely. The factor F is a factor
of the sound, which no recording of unknown gain determines, so it is not a parameter. The levels of one pluck determine
x0/L by the partials that they lack.

The width stands for all that rounds the corner: width of finger or plectrum, and their own roundness. To second order
both multiply the levels by one smooth function of k, so no recording distinguishes them. A pluck at x0 and one at
L - x0 give the same levels. The position is therefore that from the nearer end.

The force is constant up to t = 0, so a mode with the pole p has the excitation

    ∫ F exp(-p t) dt = F ∫_{-∞}^0 exp(-p t) dt = -F/p,

which is that of an impulse of the size F through the response to the release of 1 N, -P/p, in place of the response P
to an impulse of 1 N s. All that plays forces plays a pluck as such an impulse, with the size of the pluck in N.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import numpy as np

from ..io.number_format import summary
from ..parameters import Geometry, Number, Parameter
from .protocol import Excitation, StrokeParameter, Words

# Length of the string, m, if none is given: the scale of a classical guitar (Fletcher and Rossing, The Physics of
# Musical Instruments, chapter 9). Banjos and steel-string guitars are within 10 % of it.
LENGTH = 0.65
# Plucking position over string length: median and standard deviation of its logarithm. The 95 % interval is 0.05 to
# 0.49, from next to the bridge to the middle of the string (Traube and Smith, DAFx 2000, pluck at 0.03 to 0.5).
POSITION, POSITION_SD = 0.15, 0.6
POSITIONS = (0.02, 0.5)
# Effective width, m, median and standard deviation of its logarithm: from the tip of a plectrum, 1 mm, to the ball of a
# thumb, 2 cm. Chosen, not published.
WIDTH, WIDTH_SD = 5e-3, 0.8
WIDTHS = (3e-4, 0.2)  # bounds, over the string length
# Pickup position over string length: neck pickups lie at about 0.25, bridge pickups at 0.05 to 0.1 (Paiva, Pakarinen
# and Välimäki, J. Audio Eng. Soc. 60, 768, 2012, model pickups in this range).
PICKUP, PICKUP_SD = 0.15, 0.6
PICKUPS = (0.02, 0.5)
# Scanned positions. Partial k has a lobe of its level in each L/k, which a minimisation bridges in part: the steps are
# a sixth of the lobe of partial 32, and a twentieth of that of partial 100.
COARSE, FINE = 96, 1024
# Positions at which the descent over strokes begins, all strokes alike.
STARTS = 24
# A player's strokes differ in size by up to 30 dB, in any order. They share nothing about their gain.
GAIN_DEVIATION = 20.0
# Roughness of the path, dB: levels in a field of many overlapping modes scatter by 5.57 dB (Schroeder 1954). A small
# body and a room are two such fields, 5.57 √2. The spread is that of pianos.
ROUGHNESS = (7.9, 0.4)


class Pluck(NamedTuple):
    """A pluck by a static force, released at t = 0. Position and width are those of the geometry.

    Parameters
    ----------
    force : static force before the release, N.
    """

    force: Number

    def __repr__(self) -> str:
        return summary(self, exact=True)


def _bounds(geometry: Geometry) -> tuple[float, float]:
    return POSITIONS[0] * geometry.length, POSITIONS[1] * geometry.length


def _starts(geometry: Geometry, rank: np.ndarray) -> list[np.ndarray]:
    return [np.full(len(rank), position) for position in np.linspace(*_bounds(geometry), STARTS)]


STROKE = StrokeParameter(
    "x0",
    "m",
    "plucking position, from the nearer end",
    lambda geometry: (POSITION * geometry.length, POSITION_SD),
    _bounds,
    lambda geometry: np.linspace(*_bounds(geometry), COARSE),
    lambda geometry: np.linspace(*_bounds(geometry), FINE),
    _starts,
    lambda _, setup: setup.strike_position,
    scale_is_open=False,
)


class PluckLaw(Excitation):
    """The pluck as an excitation of a fit."""

    name = "pluck"
    kind: ClassVar[str] = "pluck"
    parameters: Mapping[str, Parameter] = MappingProxyType({})
    columns = ("width", "pickup")
    stroke: ClassVar[StrokeParameter] = STROKE
    words = Words("pluck", "plucking position", "plucking positions", "plucking position", "plucked")
    formula = (r"q_k(0) = \frac{2 F}{M_S ω_k^2} ∫ w(x) \op{sin}(β_k x) \op{d}x", r"\dot{q}_k(0) = 0")
    hammers = Pluck
    has_contact: ClassVar[bool] = False
    size: ClassVar[str] = "force"
    size_is_gain: ClassVar[bool] = True
    key_quantities: ClassVar[tuple[str, ...]] = ()
    gain_deviations: ClassVar[tuple[float, ...]] = (GAIN_DEVIATION,)
    roughness: ClassVar[tuple[float, float]] = ROUGHNESS
    figures: ClassVar[tuple[str, ...]] = ("release",)
    spreads: ClassVar[Mapping[str, float]] = MappingProxyType({"width": WIDTH_SD, "pickup": PICKUP_SD})
    ranges: ClassVar[Mapping[str, tuple[float, float]]] = MappingProxyType({"width": WIDTHS, "pickup": PICKUPS})

    def __repr__(self) -> str:
        return "PluckLaw()"

    def __reduce__(self) -> str:
        return "PLUCK"  # pickle finds it by this name, so it remains one object

    @property
    def hammer_parameters(self) -> dict[str, Parameter]:
        """The static force, which a fit does not search."""
        return {"force": Parameter("N", "static force before the release", 1e-6, 1e6)}

    def make_hammer(self, values: Mapping[str, Any], absent: Any = 1.0) -> Pluck:
        """Return a pluck; without a value its force is 1 N, because the gain of a recording contains the size."""
        return Pluck(values.get("force", 0.0 * absent + 1.0))

    def mode_excitation(self, omega: Any) -> Any:
        """Return 1/ω, the size of -1/p for a weakly damped mode, s [modes]."""
        return 1.0 / omega

    def displacement(self, modes: Any, hammer: Pluck) -> Any:
        """Return the static displacement of the modes, m [modes]."""
        return hammer.force * modes.modal_gain / modes.omega2

    def typical(self, preset: Geometry, length: float | None) -> Geometry:
        """Return the sizes of a guitar string with the mass per metre of the preset, which has no effect."""
        length = length or LENGTH
        mass = preset.mass * length / preset.length
        return Geometry(length, mass, POSITION * length, min(WIDTH, 0.1 * length), PICKUP * length)


PLUCK = PluckLaw()
