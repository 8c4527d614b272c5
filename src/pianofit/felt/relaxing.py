"""The felt of Stulov, which relaxes: F = K_H (u^p - ε c), τ ċ = u^p - c.

It is as stiff as K_H to a sudden blow and as K_H (1 - ε) to a slow one. What it stores is
K_H [∫ u^p du - ε (c u - Φ(c))] with Φ' = c^(1/p): the power that it takes exceeds the rise of this by
ε K_H ċ (u - c^(1/p)), which is never negative.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from ..io.number_format import summary
from ..parameters import Number, Parameter
from .hunt_crossley import COLUMNS, literature
from .law import FeltLaw

__all__ = ["LAWS", "STULOV", "RelaxingHammer"]


class RelaxingHammer(NamedTuple):
    """A hammer whose felt remembers: F = K_H [u^p (1 + μ u̇) - ε c], τ ċ = u^p - c; with μ = 0 Stulov's felt.

    From a hammer of the same stiffness: `RelaxingHammer(*hammer._replace(mu=0.0), epsilon, tau)`.
    """

    K_H: Number  # felt stiffness to a sudden compression, N/m^p; a slow one feels K_H (1 - ε)
    mu: Number  # felt loss coefficient, s/m
    p: Number  # stiffness exponent, 1
    M_H: Number  # hammer mass, kg
    v_H0: Number  # initial hammer velocity, m/s
    epsilon: Number  # share of the stiffness that relaxes, 1
    tau: Number  # relaxation time, s

    def __repr__(self) -> str:
        return summary(self, exact=True)


def force(u: Any, w: Any, felt: Any, c: Any = 0.0) -> Any:
    """Newton, at compression `u`, m, its speed `w`, m/s, and the memory `c`, m^p; suddenly pressed if that is 0."""
    return felt.K_H * (u**felt.p * (1 + felt.mu * w) - felt.epsilon * c)


def storage(u: Any, felt: Any, c: Any = 0.0) -> Any:
    """Joule."""
    turned = felt.p / (felt.p + 1) * c ** ((felt.p + 1) / felt.p)
    return felt.K_H * (u ** (felt.p + 1) / (felt.p + 1) - felt.epsilon * (c * u - turned))


def slow(u: Any, felt: Any) -> Any:
    """Newton, of a felt that has had the time to relax."""
    return force(u, 0.0, felt, u**felt.p)


# Relaxing felts are hardly published: a factor of two about a half, and of about five about a tenth of a millisecond.
STULOV = FeltLaw(
    "stulov",
    {
        "K_H": literature("K_H"),
        "p": literature("p"),
        "epsilon": Parameter("1", "share of the felt's stiffness that relaxes", 1e-3, 0.99, 0.5, 0.7),
        "tau": Parameter("s", "relaxation time of the felt", 1e-6, 1e-2, 1e-4, 1.5),
    },
    force,
    storage,
    slow,
    power=("K_H", "p"),
    hammers=RelaxingHammer,
    columns=COLUMNS,
    formula=("F = K_H (u^p - ε q)", r"τ \dot{q} = u^p - q"),
)
LAWS = (STULOV,)
