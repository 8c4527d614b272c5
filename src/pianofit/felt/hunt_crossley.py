"""The felt of Hunt and Crossley (paper eq. 8), F = K_H u^p (1 + μ u̇); with μ = 0 the power law (Ghosh)."""

from typing import Any

from ..parameters import Hammer
from .law import FeltLaw
from .published import COLUMNS, published_parameter


def force(u: Any, w: Any, felt: Any) -> Any:
    """Felt force, N, at compression `u`, m, and its speed `w`, m/s."""
    return felt.K_H * u**felt.p * (1 + felt.mu * w)


def storage(u: Any, felt: Any) -> Any:
    """Stored energy, J: the work of the force without its loss."""
    return felt.K_H * u ** (felt.p + 1) / (felt.p + 1)


def _law(name: str, formula: str, *own: str) -> FeltLaw:
    return FeltLaw(
        name,
        {n: published_parameter(n) for n in own},
        force,
        storage,
        power=("K_H", "p"),
        hammers=Hammer,
        columns=COLUMNS,
        formula=(formula,),
    )


HUNT_CROSSLEY = _law("hunt-crossley", r"F = K_H u^p (1 + μ \dot{u})", "K_H", "mu", "p")
POWER = _law("power", "F = K_H u^p", "K_H", "p")
LAWS = (HUNT_CROSSLEY, POWER)
