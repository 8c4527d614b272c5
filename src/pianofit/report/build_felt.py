"""From a fit's intervals and covariance to the felt's band, to how well each thing is known, and to correlations.

The covariance is that of logarithms, so what is a product of powers is known to the length of one vector: the felt's
static force K_H u^p at compression u has log F = log K_H + p log u, whose change with log p is p log u. Of other laws
the curve is as well known as its own changes by its parameters say.
"""

from __future__ import annotations

import numpy as np

from ..felt import law_of
from ..inference import Result
from ..model import static_force
from ..units import NORMAL
from .curves import Felt, Known
from .known import half_interval

__all__ = ["felt_of", "has_intervals", "known_of"]

POINTS = 48
FARTHEST = 300.0  # of an exponent
# A variance below this share of what it was is rounding.
HELD = 1e-10
# Parameters that an invariant stands for.
COMBINED = ("c", "kappa", "M_H", "x0")


def has_intervals(result: Result) -> bool:
    """Whether this fit says how far off it may be; the paper's recipes do not."""
    return any(quantity.interval for quantity in result.parameters.values())


def felt_of(result: Result) -> Felt:
    """The static law to the largest compression of all recordings, with its band if the fit has one."""
    hammer = result.note.hammer
    reached = max(float(np.max(heard.fitted.simulation.pulse.compression)) for heard in result.recordings)
    u = reached * np.linspace(0.0, 1.0, POINTS + 1)[1:]
    names, cov = _shared(result)
    cov = cov if has_intervals(result) else 0 * cov

    def curve(slow: bool) -> np.ndarray:
        force, slopes = static_force(u, hammer, slow)
        zero = np.zeros(len(u))
        return _band(force, np.stack([slopes.get(name, zero) for name in names], axis=1), cov)

    return Felt(1e3 * u, curve(False), curve(True) if law_of(hammer).slow else None)


def _shared(result: Result) -> tuple[tuple[str, ...], np.ndarray]:
    """Names and covariance of what all strokes share.

    Gauge-fixed at the reference velocity, where no velocity was measured: one common scale of the velocities, known by
    its prior alone, would else hide what the recordings say of the felt.
    """
    given = result.covariance.matrix
    names = tuple(name for name in result.covariance.names if not name.startswith("v_H0"))
    cov = given
    velocity = result.parameters.get("v_H0")
    if velocity is not None and velocity.status == "scaled":
        held = len(names) + result.document["recordings"][result.first]["stroke"]
        if cov[held, held] > 0:
            cov = cov - np.outer(cov[held], cov[held]) / cov[held, held]
            # What the scale alone moved is held now, but for rounding.
            cov = np.where(np.diag(cov) > HELD * np.diag(given), cov, 0.0)
    return names, cov[: len(names), : len(names)]


def _band(value: np.ndarray, change: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """`value` [n] and the ends of its 95 % interval, from the `change` [n, names] of its logarithm: [3, n]."""
    reach = np.minimum(NORMAL * _deviation(change, cov), FARTHEST)
    return value * np.exp(np.stack([0 * reach, -reach, reach]))


def _deviation(change: np.ndarray, cov: np.ndarray) -> np.ndarray:
    return np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", change, cov, change), 0.0))


def known_of(result: Result) -> Known | None:
    """How well the parameters, and what needs no assumed scale, are known; None without intervals."""
    names, cov = _shared(result)
    free = np.flatnonzero(np.diag(cov) > 0)
    if not (has_intervals(result) and len(free)):
        return None
    sd = np.sqrt(np.diag(cov)[free])
    correlation = np.clip(cov[np.ix_(free, free)] / np.outer(sd, sd), -1.0, 1.0)
    document = result.document
    entries = [(name, entry, True) for name, entry in document["invariants"].items()]
    entries += [(name, entry, False) for name, entry in document["parameters"].items() if name not in COMBINED]
    reaches = [(name, half_interval(entry), combined) for name, entry, combined in entries]
    return Known(
        tuple(names[i] for i in free), correlation,
        tuple((name, reach, combined) for name, reach, combined in reaches if reach is not None),
    )  # fmt: skip
