"""Where the hammer struck, if neither that nor the path is known: the place has zeros in the spectrum.

What takes through one path have not in common tells of the place, by the echo from the near end that meets the hammer;
but that has many valleys. In what they have in common a wrong place leaves its zeros where there are none, and they
pass for a rough path. So the path is asked at which place it would be smooth.
"""

from __future__ import annotations

import numpy as np

from ..criterion import PATH_SPREAD
from ..model.modes import raised_cosine_weights
from ..parameters import Geometry
from .residuals import Target
from .space import NAMES, struck
from .state import State, predicted

__all__ = ["smoother_place", "smoothest"]

STRIKE = NAMES.index("x0")

# The place is looked for so many of the literature's spreads to either side, and searched again within this factor.
REACH, ABOUT = 2.0, 1.01
# A path must become this much smoother, its roughness times this, for a place to be another one.
SMOOTHER = 0.6
# A path's usual roughness, dB.
USUAL = 3.0
# How deep a zero may be, of the amplitude of a partial that has none.
DEEPEST = 0.03
# Of the highest partial's period along the string: how finely places are tried, and how far apart two valleys are.
STEP, APART = 0.02, 0.1


def smoother_place(state: State, at: Target, z: np.ndarray) -> tuple[float, tuple[float, float]] | None:
    """Where else the hammer at `z` [size] would leave a much smoother path, m, and how far about it to look.

    None where the place or the path is known, and where no place is much better. Of several microphones the one that
    heard most takes is asked.
    """
    data, space, values = state.data, state.space, state.space.natural(z)
    if not (space.free[STRIKE] and state.start.quantity == "pressure"):
        return None
    group = np.array(data.layout.groups) == np.bincount(data.layout.groups).argmax()
    mine = data.found & group[:, None]
    columns = data.layout.path[int(group.argmax())]
    terms = np.asarray(at.basis)[mine.argmax(axis=0), np.arange(data.rows)][:, columns]
    miss = np.where(mine, data.level - predicted(at, state.cfg, z)[:, 2], 0.0).sum(axis=0)
    heard = mine.any(axis=0)
    common = miss[heard] / mine.sum(axis=0)[heard] + (terms @ values[columns])[heard]
    reach = REACH * space.spread[STRIKE]
    box = (
        max(space.lower[STRIKE], space.start[STRIKE] * np.exp(-reach)),
        min(space.upper[STRIKE], space.start[STRIKE] * np.exp(reach)),
    )
    place = smoothest(common, terms[heard], data.number[heard], struck(state.start.geometry, values), box)
    return None if place is None else (place, (max(place / ABOUT, box[0]), min(place * ABOUT, box[1])))


def smoothest(
    common: np.ndarray, terms: np.ndarray, number: np.ndarray, geometry: Geometry, box: tuple[float, float]
) -> float | None:
    """The place in `box`, m, at which the path is smoothest, if it is much smoother than with that of `geometry`.

    Parameters
    ----------
    common : dB, [partials], what all takes are louder by than the model
    terms : [partials, terms], of a smooth path
    number : k [partials]
    """
    period = 2 * geometry.length / number.max()
    places = np.append(geometry.strike, np.arange(*box, STEP * period))
    weights = np.stack([_weights(geometry._replace(strike=float(x)), number) for x in places])
    rough = _rough(common - weights + weights[0], terms)
    best = int(np.argmin(rough))
    apart = abs(places[best] - geometry.strike) > APART * period
    return float(places[best]) if apart and rough[best] < SMOOTHER * rough[0] else None


def _weights(geometry: Geometry, number: np.ndarray) -> np.ndarray:
    """How strongly a hammer excites each partial, dB."""
    return 20 * np.log10(np.hypot(raised_cosine_weights(geometry, number.max(), np), DEEPEST))[number - 1]


def _rough(miss: np.ndarray, terms: np.ndarray) -> np.ndarray:
    """Mean deviation of each row of `miss` [places, partials], dB, from what gain and terms can follow."""
    shape = np.column_stack([np.ones(len(terms)), terms])
    believed = np.diag(np.append(0.0, (USUAL / PATH_SPREAD) ** 2))
    followed = shape @ np.linalg.solve(shape.T @ shape + believed, shape.T)
    return np.abs(miss - miss @ followed.T).mean(axis=1)
