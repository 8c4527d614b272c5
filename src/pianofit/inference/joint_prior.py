"""The prior that other keys give, as a part of F: a Gaussian over functions of the parameters.

A fit searches logarithms of its own parameters, and a `KeyPrior` is a Gaussian over logarithms of invariants. With the
invariants g(θ), their means m and precision P, F gets

    ½ rᵀPr,  r = g(θ) - m        gradient JᵀPr        Gauss-Newton curvature JᵀPJ,  J = dg/dθ

All of g but two entries is linear in θ. The felt force at the prior's compression and its local exponent also depend on
the felt's exponent and skin. The determinant of dg/dθ is constant, so the density needs no further factor. A quantity
that the fit does not have, or that it assumes, is integrated out of the Gaussian.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from ..complex_step import slope_by_entry
from ..excitation import Excitation
from ..key_prior import INVARIANTS, KeyPrior
from .parametrisation import Parametrisation, names_of

# Half the step of log u in the local exponent, d log g/d log u: its error is below 1e-8.
SLOPE_STEP = 1e-4
FORCE, EXPONENT = "F/M_S", "local_exponent"
# Quantities of the string: its initial values, and the prior about them, come from the recordings.
STRING_QUANTITIES = ("f0", "B", "b1", "d2")
# Steps of Newton's method to the centre of the prior: skin, exponent and force follow from one another in this order.
NEWTON_STEPS = 4


class InvariantMap(NamedTuple):
    """The logarithms of invariants as functions of θ: arrays, so that JAX can pass them."""

    linear: Any  # [quantities, size]
    constant: Any  # [quantities]
    force: Any  # 1 for the felt force, otherwise 0 [quantities]
    exponent: Any  # 1 for the local exponent, otherwise 0 [quantities]
    compression: Any  # of both, m
    searched_compression: Any  # of the searched force, m; 0 if the stiffness is an entry of θ

    def __call__(self, theta: Any, law: Excitation, xp: Any = np) -> Any:
        """Values at `theta` [..., size]; `xp` is NumPy or JAX [..., quantities]."""
        out = theta @ self.linear.T + self.constant
        if law.power is None:
            return out
        log_force, log_slope = self._felt(theta, law, xp)
        return out + log_force[..., None] * self.force + log_slope[..., None] * self.exponent

    def _felt(self, theta: Any, law: Excitation, xp: Any) -> tuple[Any, Any]:
        """log F minus the searched force or stiffness, and log of d log g/d log u [...]."""
        values = {name: xp.exp(theta[..., i]) for i, name in enumerate(names_of(law)) if name in law.parameters}
        _, p = law.power or ("", "")
        u, at = self.compression, self.searched_compression
        searched, here, below, above = (
            law.log_power(x, values, xp)
            for x in (xp.where(at > 0, at, u), u, u * np.exp(-SLOPE_STEP), u * np.exp(SLOPE_STEP))
        )
        log_slope = xp.log((above - below) / (2 * SLOPE_STEP * values[p]))
        return here - xp.where(at > 0, searched, 0.0), log_slope


@dataclass(frozen=True, eq=False)
class JointPrior:
    """A Gaussian over invariants of a fit."""

    record: KeyPrior
    names: tuple[str, ...]  # of the invariants, in the order of the record
    invariants: InvariantMap
    mean: np.ndarray  # [quantities]
    precision: np.ndarray  # [quantities, quantities]
    replaced: np.ndarray  # mask of the entries of θ whose prior it replaces [size]

    def residual(self, theta: np.ndarray, law: Excitation) -> tuple[np.ndarray, np.ndarray]:
        """g(θ) - m [B, quantities] and J [B, quantities, size]."""
        jacobian = np.broadcast_to(self.invariants.linear, (len(theta), *self.invariants.linear.shape)).copy()
        for i in map(names_of(law).index, law.parameters) if law.power else ():
            jacobian[..., i] += slope_by_entry(lambda at: self._felt_part(at, law), theta, i)
        return self.invariants(theta, law) - self.mean, jacobian

    def _felt_part(self, theta: np.ndarray, law: Excitation) -> np.ndarray:
        """The part of g that is not linear [B, quantities]."""
        flat = self.invariants._replace(linear=np.zeros_like(self.invariants.linear), constant=0.0)
        return flat(theta, law)

    def evaluate(
        self, theta: np.ndarray, law: Excitation, free: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Part of F: value [B], gradient [B, size] and curvature [B, size, size]; 0 for entries that are not free."""
        r, J = self.residual(theta, law)
        J = J * free
        weighted = r @ self.precision
        gradient = np.einsum("bq,bqn->bn", weighted, J)
        return 0.5 * (weighted * r).sum(axis=1), gradient, np.einsum("bqm,qr,brn->bmn", J, self.precision, J)


def with_key_prior(u: Parametrisation, record: KeyPrior, reference: int | None) -> Parametrisation:
    """Replace the literature's prior by that of the other keys.

    Parameters
    ----------
    reference : index in θ of the velocity of the reference stroke, which has the brightest recording; None if the scale
        of the velocities is given.
    """
    table = _rows(u)
    rows = {name: table[name] for name in record.names if name in table and _has(u, name, table[name])}
    if not rows:
        return u
    u = _with_velocity(u, record, reference)
    kept = [record.names.index(name) for name in rows]
    mean, covariance = np.array(record.mean)[kept], np.array(record.covariance)[np.ix_(kept, kept)]
    entries = np.array([np.flatnonzero(row)[0] for row, _ in rows.values()])
    invariants = _invariant_map(u, record, rows)
    own = np.array([name not in STRING_QUANTITIES for name in rows]) & u.free[entries] & ~u.given[entries]
    replaced = np.isin(np.arange(u.size), entries[own])
    joint = JointPrior(record, tuple(rows), invariants, mean, np.linalg.inv(covariance), replaced)
    theta, sd = _centre(u, joint, entries, own, covariance)
    return replace(u, mean=theta, sd=sd, joint=joint)


def _with_velocity(u: Parametrisation, record: KeyPrior, reference: int | None) -> Parametrisation:
    if reference is None:
        return u
    mean, sd = u.mean.copy(), u.sd.copy()
    mean[reference], sd[reference] = np.log(record.velocity), record.velocity_sd
    return replace(u, mean=mean, sd=sd)


def _rows(u: Parametrisation) -> dict[str, tuple[np.ndarray, float]]:
    """Every invariant as exponents of the entries of θ, and a constant. Those of the hammer have one entry each."""
    length, mass = np.log(u.geometry.length), np.log(u.geometry.mass)
    stiff = 2 * (np.log(np.pi) - length)
    constant = {"f0": -np.log(2.0) - length, "B": stiff, "d2": stiff, "x0/L": -length, "width/L": -length}
    constant |= {"M_H/M_S": -mass, FORCE: -mass}
    felt = [{name: 1.0} for name in u.law.power] if u.law.power else [{}, {}]
    table = INVARIANTS | dict(zip((FORCE, EXPONENT), felt, strict=True))
    of_strokes = [0.0] * (u.size - u.shared)
    return {
        name: (np.array([powers.get(own, 0.0) for own in u.names] + of_strokes), constant.get(name, 0.0))
        for name, powers in table.items()
        if powers and {*powers} <= {*u.names}
    }


def _has(u: Parametrisation, name: str, row: tuple[np.ndarray, float]) -> bool:
    """True if the fit searches a quantity, or if its value was given."""
    if name in ("mu", "skin") and name not in u.law.parameters:
        return False
    return bool((u.free | u.given)[row[0] != 0].all())


def _invariant_map(u: Parametrisation, record: KeyPrior, rows: dict[str, tuple[np.ndarray, float]]) -> InvariantMap:
    """The map of some invariants. They are those of the given sizes, as in the model."""
    linear = np.array([row for row, _ in rows.values()])
    constant = np.array([constant for _, constant in rows.values()])
    origin = u.model_entries(np.zeros(u.size))
    constant = constant + linear @ origin
    linear = linear @ (u.model_entries(np.eye(u.size)) - origin).T
    force, exponent = (np.array([float(name == own) for name in rows]) for own in (FORCE, EXPONENT))
    return InvariantMap(linear, constant, force, exponent, record.compression, u.reference_compression or 0.0)


def _centre(
    u: Parametrisation, joint: JointPrior, entries: np.ndarray, own: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """θ at which the invariants of hammer and felt have their means, and standard deviations there [size].

    Newton's method: the felt's exponent and force are not linear in θ.
    """
    theta, sd, free = u.mean.copy(), u.sd.copy(), entries[own]
    inverse = np.zeros((len(free), len(free)))
    for _ in range(NEWTON_STEPS):
        r, J = (x[0] for x in joint.residual(theta[None], u.law))
        inverse = np.linalg.inv(J[np.ix_(own, free)])
        theta[free] -= inverse @ r[own]
    sd[free] = np.sqrt(np.diag(inverse @ covariance[np.ix_(own, own)] @ inverse.T))
    return u.project(theta), sd
