"""Transducers: what a recording measures, one entry each.

A transducer reads the velocity or displacement of the string at a place, or its force on the bridge. Between that
quantity and the file, an unknown smooth output path may lie. A magnetic pickup reads the velocity at its place, sin(kπ
x_p/L) for partial k. Its coil, cable and amplifier are an unknown smooth path, as soundboard, room and microphone are
for the pressure of a piano. Its aperture is a smooth factor too, which the path absorbs.
"""

from typing import NamedTuple


class Transducer(NamedTuple):
    """A kind of transducer."""

    unit: str  # of the quantity that the model computes
    on_string: bool  # it has a position; otherwise it is at the bridge
    reads_velocity: bool = False  # else displacement, which the force on the bridge follows
    unknown_path: bool = False  # an unknown output path lies between the quantity and the file
    position_is_searched: bool = False  # a fit can find its position
    # Prior of the roughness of the path, dB, median and spread of its logarithm; None for that of body and room.
    roughness: tuple[float, float] | None = None


# A coil and a cable are smooth over frequency. The plane in which a string moves turns from partial to partial, which
# changes what a pickup reads by some dB. Chosen, not published.
ELECTRICAL = (2.0, 0.5)


TRANSDUCERS: dict[str, Transducer] = {
    "velocity": Transducer("m/s", on_string=True, reads_velocity=True),
    "displacement": Transducer("m", on_string=True),
    "bridge-force": Transducer("N", on_string=False),
    "pressure": Transducer("N", on_string=False, unknown_path=True),
    "magnetic-pickup": Transducer("m/s", True, True, True, position_is_searched=True, roughness=ELECTRICAL),
}
QUANTITIES = tuple(TRANSDUCERS)
ON_STRING = tuple(name for name, transducer in TRANSDUCERS.items() if transducer.on_string)
