"""From a fit's intervals and covariance to the felt's band, to how well each thing is known, and to correlations.

The covariance is that of logarithms, so what is a product of powers is known to the length of one vector: the felt's
static force K_H u^p at compression u has log F = log K_H + p log u, whose change with log p is p log u.
"""

from __future__ import annotations

import numpy as np

from ..inference import Result
from ..inference.coordinates import VALUES as NAMES
from ..parameters import MemoryHammer
from .curves import Felt, Known
from .known import half_interval

__all__ = ["felt_of", "has_intervals", "known_of"]

NORMAL = 1.96
POINTS = 48
FARTHEST = 300.0  # of an exponent
# A variance below this share of what it was is rounding.
HELD = 1e-10
# Parameters that an invariant stands for.
COMBINED = ("c", "kappa", "M_H", "x0")


def has_intervals(result: Result) -> bool:
    """Whether this fit says how far off it may be; the paper's recipes do not."""
    return any(entry.get("interval") for entry in result.document["parameters"].values())


def felt_of(result: Result) -> Felt:
    """The static law to the largest compression of all takes, with its band if the fit has one."""
    hammer = result.fitted.note.hammer
    reached = max(float(np.max(heard.fitted.simulation.pulse.compression)) for heard in result.takes)
    u = reached * np.linspace(0.0, 1.0, POINTS + 1)[1:]
    change = np.zeros((len(u), len(NAMES)))
    change[:, NAMES.index("K_H")], change[:, NAMES.index("p")] = 1.0, hammer.p * np.log(u)
    force, slow = hammer.K_H * u**hammer.p, None
    cov = _shared(result) if has_intervals(result) else 0 * _shared(result)
    if isinstance(hammer, MemoryHammer):
        relaxed = change.copy()
        relaxed[:, NAMES.index("epsilon")] = -hammer.epsilon / (1 - hammer.epsilon)
        slow = _band((1 - hammer.epsilon) * force, relaxed, cov)
    return Felt(1e3 * u, _band(force, change, cov), slow)


def _shared(result: Result) -> np.ndarray:
    """The covariance of what all strokes share: gauge-fixed at the reference velocity, where no velocity was measured.

    One common scale of the velocities, known by its prior alone, would else hide what the recordings say of the felt.
    """
    cov = result.covariance
    if result.document["parameters"].get("v_H0", {}).get("status") == "scaled":
        held = len(NAMES) + result.document["takes"][result.first]["strike"]
        if cov[held, held] > 0:
            cov = cov - np.outer(cov[held], cov[held]) / cov[held, held]
            # What the scale alone moved is held now, but for rounding.
            cov = np.where(np.diag(cov) > HELD * np.diag(result.covariance), cov, 0.0)
    return cov[: len(NAMES), : len(NAMES)]


def _band(value: np.ndarray, change: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """`value` [n] and the ends of its 95 % interval, from the `change` [n, names] of its logarithm: [3, n]."""
    reach = np.minimum(NORMAL * _deviation(change, cov), FARTHEST)
    return value * np.exp(np.stack([0 * reach, -reach, reach]))


def _deviation(change: np.ndarray, cov: np.ndarray) -> np.ndarray:
    return np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", change, cov, change), 0.0))


def known_of(result: Result) -> Known | None:
    """How well the parameters, and what needs no assumed scale, are known; None without intervals."""
    cov = _shared(result)
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
        tuple(NAMES[i] for i in free), correlation,
        tuple((name, reach, combined) for name, reach, combined in reaches if reach is not None),
    )  # fmt: skip
