"""The relaxing felt of Stulov, F = K_H (u^p - ε c), τ ċ = u^p - c.

Its stiffness is K_H in a sudden compression and K_H (1 - ε) in a slow one. The stored energy is
K_H [∫ u^p du - ε (c u - Φ(c))] with Φ' = c^(1/p). The power that the felt absorbs exceeds the growth of this energy by
ε K_H ċ (u - c^(1/p)), which is never negative.
"""

from typing import Any, NamedTuple

from ..io.number_format import summary
from ..parameters import Number, Parameter
from .law import FeltLaw
from .published import COLUMNS, published_parameter


class RelaxingHammer(NamedTuple):
    """A hammer with relaxing felt: F = K_H [u^p (1 + μ u̇) - ε c], τ ċ = u^p - c; with μ = 0 the law of Stulov.

    It is made from a hammer of the same stiffness by `RelaxingHammer(*hammer._replace(mu=0.0), epsilon, tau)`.
    """

    K_H: Number  # felt stiffness in sudden compression, N/m^p; K_H (1 - ε) in slow compression
    mu: Number  # felt loss coefficient, s/m
    p: Number  # felt exponent, 1
    M_H: Number  # hammer mass, kg
    v_H0: Number  # initial hammer velocity, m/s
    epsilon: Number  # share of the stiffness that relaxes, 1
    tau: Number  # relaxation time, s

    def __repr__(self) -> str:
        return summary(self, exact=True)


def force(u: Any, w: Any, felt: Any, c: Any = 0.0) -> Any:
    """Felt force, N, at compression `u`, m, its speed `w`, m/s, and relaxation state `c`, m^p; sudden if c = 0."""
    return felt.K_H * (u**felt.p * (1 + felt.mu * w) - felt.epsilon * c)


def storage(u: Any, felt: Any, c: Any = 0.0) -> Any:
    """Stored energy, J."""
    conjugate = felt.p / (felt.p + 1) * c ** ((felt.p + 1) / felt.p)
    return felt.K_H * (u ** (felt.p + 1) / (felt.p + 1) - felt.epsilon * (c * u - conjugate))


def slow(u: Any, felt: Any) -> Any:
    """Force of the relaxed felt, N."""
    return force(u, 0.0, felt, u**felt.p)


# Few values are published. Prior: ε = 0.5 within a factor of two, τ = 0.1 ms within a factor of about five.
STULOV = FeltLaw(
    "stulov",
    {
        "K_H": published_parameter("K_H"),
        "p": published_parameter("p"),
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
