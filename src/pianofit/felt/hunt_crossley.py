"""The felt of Hunt and Crossley (paper eq. 8), F = K_H u^p (1 + μ u̇); with μ = 0 the power law (Ghosh)."""

from __future__ import annotations

from typing import Any

from ..parameters import PARAMETERS, Hammer, Parameter
from .law import FeltLaw

__all__ = ["COLUMNS", "HUNT_CROSSLEY", "LAWS", "POWER", "literature"]

# Felts of neighbouring instruments differ by factors (Chaigne and Askenfelt 1994; Chabassier): standard deviations of
# log(value), about the literature's hammer for the key. That of K_H is of the force at a reference compression.
SPREAD = {"K_H": 1.5, "mu": 1.5, "p": 0.2}
# A fit's unknowns beside the string's, of all laws that relax or lose by this formula, whichever of these a law has: so
# a seed draws the same numbers for all.
COLUMNS = ("K_H", "p", "mu", "M_H", "x0", "width", "epsilon", "tau")


def literature(name: str) -> Parameter:
    """One of K_H, p and μ: the paper's box, and the literature's value for the key as the prior's median."""

    def median(midi: float) -> float:
        from ..literature import typical  # its curves need SciPy, which a command's help does without

        return getattr(typical(midi).hammer, name)

    return PARAMETERS[name]._replace(median=median, spread=SPREAD[name])


def force(u: Any, w: Any, felt: Any) -> Any:
    """Newton, at compression `u`, m, and its speed `w`, m/s."""
    return felt.K_H * u**felt.p * (1 + felt.mu * w)


def storage(u: Any, felt: Any) -> Any:
    """Joule: the work of the force without its loss."""
    return felt.K_H * u ** (felt.p + 1) / (felt.p + 1)


def _law(name: str, formula: str, *own: str) -> FeltLaw:
    return FeltLaw(
        name, {n: literature(n) for n in own}, force, storage, power=("K_H", "p"), hammers=Hammer, columns=COLUMNS,
        formula=(formula,),
    )  # fmt: skip


HUNT_CROSSLEY = _law("hunt-crossley", r"F = K_H u^p (1 + μ \dot{u})", "K_H", "mu", "p")
POWER = _law("power", "F = K_H u^p", "K_H", "p")
LAWS = (HUNT_CROSSLEY, POWER)
