"""The felt of Hunt and Crossley (paper eq. 8), F = K_H u^p (1 + μ u̇); with μ = 0 the power law (Ghosh)."""

from __future__ import annotations

from typing import Any

from ..parameters import PARAMETERS, Hammer, Parameter
from .law import FeltLaw

# Prior standard deviations of log(value) around the published hammer for the key. Felts of similar instruments differ
# by factors (Chaigne and Askenfelt 1994; Chabassier). K_H stands for the force at a reference compression.
FELT_SPREAD = {"K_H": 1.5, "mu": 1.5, "p": 0.2}
# The same for hammer mass, strike position and contact window: hammer masses of neighbouring instruments differ by tens
# of percent (Chaigne and Askenfelt 1994; Chabassier).
HAMMER_SD = {"M_H": 0.4, "x0": 0.2, "width": 0.3}
# The parameters of a fit next to those of the string, for all laws of this package, including parameters that a law
# does not have. So a seed draws the same numbers for all laws.
COLUMNS = ("K_H", "p", "mu", "M_H", "x0", "width", "epsilon", "tau", "skin")


def published_parameter(name: str) -> Parameter:
    """Return K_H, p or μ with the bounds of the paper, and the published value for the key as prior median."""

    def median(midi: float) -> float:
        from ..literature import typical  # its curves need SciPy, which help texts must not import

        return getattr(typical(midi).hammer, name)

    return PARAMETERS[name]._replace(median=median, spread=FELT_SPREAD[name])


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
