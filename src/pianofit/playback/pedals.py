"""Contact of each damper with its strings over time, as keys and pedals move it.

A damper is up while its key is down, or while the middle pedal holds it. Otherwise it follows the right pedal. Its
contact is 1 when it rests fully on the strings and 0 when it does not touch them. In between, the part of the pedal's
travel given by `PedalRange`, the contact is the square of the way that the damper still has to fall: the felt is soft,
so that the force on the strings rises faster than its compression. The exponent 2 is a design choice without data.
"""

from __future__ import annotations

from typing import NamedTuple

from ..errors import ParameterError
from .midi import SWITCH, Song

# Exponent of the contact over the way of the damper. A design choice, see above.
FELT_EXPONENT = 2


class PedalRange(NamedTuple):
    """Values of controller 64 between which the right pedal lifts the dampers.

    With the default a pedal that is a switch works as MIDI defines it: 64 and above is down. Half pedal lies below,
    where pedals and files without half pedal have only 0.

    Parameters
    ----------
    low : up to this value dampers rest fully on the strings.
    high : from this value on they do not touch them.

    Examples
    --------
    >>> import pianofit
    >>> pianofit.PedalRange().contact(44)
    0.25
    """

    low: float = 24.0
    high: float = 64.0

    def check(self) -> PedalRange:
        """Return this range, or raise a `ParameterError` unless 0 <= low < high <= 127."""
        if not 0 <= self.low < self.high <= 127:
            raise ParameterError(
                f"pedal_range=({self.low:g}, {self.high:g}) must be two controller values from 0 to 127, lower first"
            )
        return self

    def contact(self, value: float) -> float:
        """Contact of the dampers, 0 to 1, at a value of the controller, 0 to 127."""
        way = (self.high - value) / (self.high - self.low)
        return min(max(way, 0.0), 1.0) ** FELT_EXPONENT


class KeyMotion(NamedTuple):
    """One event of a key: a stroke, or another contact of its damper."""

    seconds: float
    velocity: int  # of a stroke; 0 for the damper alone
    contact: float  # of the damper after the event, 0 to 1
    soft: float = 0.0  # position of the left pedal, 0 to 1


def key_motions(song: Song, key: int, pedal_range: PedalRange, end: float) -> list[KeyMotion]:
    """Return strokes of a key and movements of its damper, in time order. At `end`, s, all pedals and keys go up."""
    # Pedals move before keys of the same time, the middle pedal after the right one.
    moves = [(t, 0, value) for t, value in [*song.pedal, (end, 0)]]
    moves += [(t, 1, value) for t, value in [*song.sostenuto, (end, 0)]]
    moves += [(t, 2, value) for t, value in song.una_corda]
    moves += [(t, 3, velocity) for t, velocity in [*song.keys.get(key, ()), (end, 0)]]
    moves.sort(key=lambda move: move[:2])
    pedal, soft, before = 1.0, 0.0, 1.0
    is_down = is_caught = is_holding = False
    motions: list[KeyMotion] = []
    for t, kind, value in moves:
        if kind == 0:
            pedal = pedal_range.contact(value)
        elif kind == 1:
            was_holding, is_holding = is_holding, value >= SWITCH
            is_caught = is_holding and (is_caught if was_holding else before == 0.0)
        elif kind == 2:
            soft = value / 127
        else:
            is_down = value > 0
        contact = 0.0 if is_down or is_caught else pedal
        velocity = value if kind == 3 else 0
        if velocity or contact != before:
            motions.append(KeyMotion(t, velocity, contact, soft))
        before = contact
    return motions


def releases(song: Song, key: int) -> list[tuple[float, float]]:
    """Return times of releases of a key, s, and how long it was down, s."""
    found: list[tuple[float, float]] = []
    struck: float | None = None
    for t, velocity in song.keys.get(key, ()):
        if velocity and struck is None:
            struck = t
        elif not velocity and struck is not None:
            found.append((t, t - struck))
            struck = None
    return found
