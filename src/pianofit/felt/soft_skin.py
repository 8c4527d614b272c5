"""A felt with a soft skin, F = K_H g^p (1 + μ u̇), g = u²/(u + d): softer than a power law below the thickness d.

Needled and worn felts are loose at their surface. Under a small compression, u ≪ d, the force rises as u^(2p); under a
large one it follows the power law of the felt below, displaced by d. The exponent of the force at a compression u is
p (1 + d/(u + d)). Without a skin it is the felt of Hunt and Crossley. The stored energy is the integral of the static
force, by Gauss-Legendre quadrature.
"""

from typing import Any, NamedTuple

import numpy as np

from ..io.number_format import summary
from ..parameters import Number, Parameter
from .law import FeltLaw
from .published import COLUMNS, published_parameter

# Nodes and weights on 0 to 1 of the stored energy. Its integrand is smooth: 24 nodes give 9 digits.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(24)
NODES, WEIGHTS = 0.5 * (_NODES + 1), 0.5 * _WEIGHTS
# Prior of the thickness: median over the key's reference compression, and spread of the logarithm. Fits of 20 keys of
# five pianos have 0.02 to 5 times that compression, 0.2 times in the median (docs/fitting.md).
SKIN, SKIN_SPREAD = 0.3, 1.5


class SoftHammer(NamedTuple):
    """A hammer whose felt has a soft skin: F = K_H [u²/(u + d)]^p (1 + μ u̇).

    It is made from a hammer of the same felt below the skin by `SoftHammer(*hammer, skin)`.
    """

    K_H: Number  # felt stiffness below the skin, N/m^p
    mu: Number  # felt loss coefficient, s/m
    p: Number  # felt exponent, 1
    M_H: Number  # hammer mass, kg
    v_H0: Number  # initial hammer velocity, m/s
    skin: Number  # thickness d of the skin, m

    def __repr__(self) -> str:
        return summary(self, exact=True)


def base(u: Any, felt: Any) -> Any:
    """g, m, at compression `u`, m."""
    return u * u / (u + felt.skin)


def static_force(u: Any, felt: Any) -> Any:
    """Static felt force, N, at compression `u`, m."""
    return felt.K_H * base(u, felt) ** felt.p


def force(u: Any, w: Any, felt: Any) -> Any:
    """Felt force, N, at compression `u`, m, and its speed `w`, m/s."""
    return static_force(u, felt) * (1 + felt.mu * w)


def storage(u: Any, felt: Any) -> Any:
    """Stored energy, J: the work of the static force."""
    return u * sum(weight * static_force(node * u, felt) for node, weight in zip(NODES, WEIGHTS, strict=True))


def _median(midi: float) -> float:
    from ..literature import reference_compression  # its curves need SciPy, which help texts must not import

    return SKIN * reference_compression(midi)


SOFT_SKIN = FeltLaw(
    "soft-skin",
    {
        **{name: published_parameter(name) for name in ("K_H", "mu", "p")},
        "skin": Parameter("m", "thickness of the felt's soft skin", 1e-9, 1e-2, _median, SKIN_SPREAD),
    },
    force,
    storage,
    power=("K_H", "p"),
    base=base,
    hammers=SoftHammer,
    columns=COLUMNS,
    formula=(r"F = K_H (\frac{u^2}{u + d})^p (1 + μ \dot{u})",),
)
LAWS = (SOFT_SKIN,)
