"""The parameters of a fit as logarithms: string, felt, hammer and contact, then the velocity of every stroke.

If the felt law has a power, its stiffness is searched as the static force at a reference compression, F = K_H g^p. The
base g of the power is u_ref, unless the law has another. Strokes determine the force where they compress the felt. K_H
alone, whose unit changes with p, trades off against p. All other parameters of a law are logarithms of their values. No
stroke is special: without a measured velocity, the scaling (K_H, μ, d, v) → (K_H s^(1-p), μ/s, s d, s v) is one wide
direction of the prior.

Sizes that were given with a standard deviation follow the velocities. The model always computes with the given length
and mass. The two scalings of a string (docs/model.md) make this exact: a string of another length sounds the same if
all its lengths, c, κ and b2 scale with it. So each entry of θ is of one of two kinds:

    a given value       θ is its logarithm, and the model gets θ - Σ g δ
    any other value     the model gets θ, and the logarithm of the value is θ + Σ g δ

δ is the deviation of the logarithm of a size from its given value, and g the exponent with which the value scales. The
prior stays diagonal, and every method works on the same θ.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from ..complex_step import slope_by_entry
from ..excitation import GEOMETRY_FIELDS, Excitation
from ..felt import ALL_PARAMETERS
from ..parameters import STRING_NAMES, Geometry, String

if TYPE_CHECKING:
    from .joint_prior import JointPrior

STRING_SIZE = len(STRING_NAMES)
# Logarithm of a loss that the felt law does not have: its square is still a number.
LOG_ABSENT_LOSS = -300.0


def names_of(law: Excitation) -> tuple[str, ...]:
    """Names of the shared parameters, in order: the string, then felt, hammer mass and contact."""
    return STRING_NAMES + law.columns


@dataclass(frozen=True)
class Parametrisation:
    """Gaussian priors of the logarithms of all parameters, with bounds; [size] each.

    With a joint prior, `mean` and `sd` are its centre and its standard deviations.
    """

    mean: np.ndarray
    sd: np.ndarray  # 0: fixed at the mean
    lower: np.ndarray  # bounds of the values' logarithms, so of K_H in place of the force
    upper: np.ndarray
    reference_compression: Any  # of the searched force, m; None if the stiffness is searched, or given
    geometry: Geometry  # strike position and contact width are parameters
    law: Excitation
    sizes: tuple[str, ...]  # L, M_S, pickup or scale, if given with a standard deviation
    exponents: np.ndarray  # g with which the value of every entry scales with every size [sizes, size]
    given: np.ndarray  # mask of the values that the user gave [size]
    joint: JointPrior | None = None  # of the other keys; it replaces the own prior of some entries

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the shared parameters."""
        return names_of(self.law)

    @property
    def shared(self) -> int:
        """Number of shared parameters; the velocities follow, then the sizes."""
        return len(self.names)

    def index_of(self, name: str) -> int:
        """Index of a shared parameter, or of a size that was given with a standard deviation."""
        if name in self.sizes:
            return self.velocities.stop + self.sizes.index(name)
        return self.names.index(name)

    @cached_property
    def force_and_exponent_index(self) -> tuple[int, int] | None:
        """Index of the force at the reference compression, in place of the stiffness, and of the exponent."""
        if self.law.power is None or self.reference_compression is None:
            return None
        return self.index_of(self.law.power[0]), self.index_of(self.law.power[1])

    @cached_property
    def reported(self) -> tuple[str, ...]:
        """Names of parameters of this law's hammers; the others are fixed."""
        own = {*STRING_NAMES, *self.law.hammer_type._fields, *GEOMETRY_FIELDS}
        absent = {name for name, mean in zip(self.names, self.mean, strict=False) if mean <= LOG_ABSENT_LOSS}
        return tuple(name for name in self.names if name in own - (absent & {*GEOMETRY_FIELDS}))

    @property
    def size(self) -> int:
        """Number of parameters, velocities and sizes included."""
        return len(self.mean)

    @property
    def strokes(self) -> int:
        """Number of velocities."""
        return self.size - self.shared - len(self.sizes)

    @property
    def velocities(self) -> slice:
        """Place of the velocities."""
        return slice(self.shared, self.shared + self.strokes)

    @property
    def free(self) -> np.ndarray:
        """Mask of the searched parameters [size]."""
        return self.sd > 0

    @property
    def precision(self) -> np.ndarray:
        """Precision of each parameter's own prior; 0 if it is fixed, or has a joint prior instead [size]."""
        own = self.free if self.joint is None else self.free & ~self.joint.replaced
        return np.where(own, 1 / np.where(own, self.sd, 1.0) ** 2, 0.0)

    # --- coordinates: θ has the force, log values have K_H; θ may also be an array of JAX -----------------------------

    def size_changes(self, theta: Any) -> Any:
        """δ, the logarithms of the sizes over their given values [..., sizes]."""
        return theta[..., self.velocities.stop :] - self.mean[self.velocities.stop :]

    def model_entries(self, theta: Any) -> Any:
        """`theta` as the model gets it, at the given sizes [..., size]."""
        if not self.sizes:  # an empty product would change the rounding of compiled gradients
            return theta
        return theta - self.size_changes(theta) @ (self.exponents * self.given)

    @property
    def moving(self) -> np.ndarray:
        """Mask of the model's entries that change with θ: the free ones, and given ones that scale [size]."""
        return self.free | (self.given & self.exponents.any(axis=0))

    def by_theta(self, jacobian: np.ndarray) -> np.ndarray:
        """Derivatives by θ from those by the model's entries [..., size]; 0 for fixed parameters."""
        jacobian = jacobian.copy()
        jacobian[..., self.velocities.stop :] -= jacobian @ (self.exponents * self.given).T
        return jacobian * self.free

    def _shift(self, theta: Any) -> Any:
        """θ minus the log values [..., size]: p log g(u_ref) for the force, -Σ g δ for values that were not given.

        θ and log values have the same p and sizes.
        """
        xp = theta.__array_namespace__()
        shift = xp.zeros(theta.shape)
        if self.sizes:
            shift -= self.size_changes(theta) @ (self.exponents * ~self.given)
        if self.force_and_exponent_index:
            force, _ = self.force_and_exponent_index
            shift += xp.where(np.arange(self.size) == force, self._log_power(theta)[..., None], 0.0)
        return shift

    def _log_power(self, theta: Any) -> Any:
        """p log g(u_ref) [...]."""
        xp = theta.__array_namespace__()
        values = {name: xp.exp(theta[..., self.index_of(name)]) for name in self.law.parameters}
        return self.law.log_power(self.reference_compression, values, xp)

    def log_values(self, theta: np.ndarray) -> np.ndarray:
        """`theta` with log K_H in place of the force [..., size]."""
        return theta - self._shift(theta)

    def from_log_values(self, logs: Any) -> Any:
        """θ from the `log_values` of it [..., size]."""
        return logs + self._shift(logs)

    def tangent(self, theta: np.ndarray) -> np.ndarray:
        """d(log values)/dθ [size, size] at `theta` [size]."""
        return np.eye(self.size) - self._shift_slopes(theta)

    def _shift_slopes(self, theta: np.ndarray) -> np.ndarray:
        """Derivatives of the shift by θ [..., size, size]."""
        out = np.zeros((*theta.shape, self.size))
        if self.force_and_exponent_index:
            for i in map(self.index_of, self.law.parameters):
                out[..., self.force_and_exponent_index[0], i] = slope_by_entry(self._log_power, theta, i)
        out[..., self.velocities.stop :] = -(self.exponents * ~self.given).T
        return out

    def force_direction(self, theta: np.ndarray) -> np.ndarray:
        """Change of the log values by which log F(u_ref) = log K_H + p log g(u_ref) changes [size]."""
        direction = np.zeros(self.size)
        if self.force_and_exponent_index:
            felt = [self.index_of(name) for name in self.law.parameters]
            direction[felt] = self._shift_slopes(theta)[self.force_and_exponent_index[0], felt]
            direction[self.force_and_exponent_index[0]] = 1.0
        return direction

    @property
    def felt_force_name(self) -> str:
        """The name of the force that replaces K_H in the search, with its compression."""
        return f"static felt force at {1e3 * self.reference_compression:.3g} mm"

    def value(self, name: str, log: float) -> float:
        """A value from its logarithm, limited to its range: the exponential of a bound's logarithm can exceed it."""
        value, ranges = float(np.exp(log)), ALL_PARAMETERS | self.law.hammer_parameters
        return min(max(value, ranges[name].lower), ranges[name].upper) if name in ranges else value

    def string(self, theta: np.ndarray) -> String:
        """The string at `theta` [size]."""
        return String(*map(self.value, STRING_NAMES, self.log_values(theta)[:STRING_SIZE]))

    def hammer(self, theta: np.ndarray, stroke: int) -> Any:
        """The hammer at `theta` [size] with the velocity of one stroke."""
        logs = dict(zip(self.names, self.log_values(theta), strict=False))
        logs[self.law.stroke.name] = theta[self.shared + stroke]
        return self.law.make_hammer({n: self.value(n, logs[n]) for n in self.law.hammer_parameters if n in logs})

    def geometry_at(self, theta: np.ndarray, stroke: int = 0) -> Geometry:
        """The geometry with contact, pickup and uncertain sizes at `theta` [size], for one stroke."""
        logs = self.log_values(theta)
        values = {name: logs[self.index_of(name)] for name in (*self.reported, *self.sizes)}
        values[self.law.stroke.name] = logs[self.shared + stroke]
        fields = {field: values[name] for name, field in GEOMETRY_FIELDS.items() if name in values}
        return self.geometry._replace(**{field: float(np.exp(log)) for field, log in fields.items()})

    # --- bounds -------------------------------------------------------------------------------------------------------

    def range(self, i: int) -> tuple[float, float]:
        """Bounds of the logarithm of one value."""
        return float(self.lower[i]), float(self.upper[i])

    def bounds_at(self, theta: Any) -> tuple[Any, Any]:
        """Lower and upper bounds of θ at `theta` [..., size]: those of the force depend on p, others on sizes."""
        shift = self._shift(theta)
        return self.lower + shift, self.upper + shift

    def project(self, theta: np.ndarray) -> np.ndarray:
        """The nearest point inside the bounds [..., size]."""
        lower, upper = self.bounds_at(np.where(self.free, np.clip(theta, self.lower, self.upper), self.mean))
        return np.where(self.free, np.clip(theta, lower, upper), self.mean)

    def at_bound(self, theta: np.ndarray) -> np.ndarray:
        """Mask of the free parameters at a bound [..., size]."""
        lower, upper = self.bounds_at(theta)
        return self.free & ((theta <= lower + 1e-9) | (theta >= upper - 1e-9))

    def bound_jacobian(self, theta: np.ndarray, active: np.ndarray) -> np.ndarray:
        """d θ/d(free θ) [B, size, size] at `theta`: with a value at a bound θ follows its shift, as in `project`."""
        follows = active[:, :, None] & self.free
        return np.eye(self.size) + np.where(follows, self._shift_slopes(theta), 0.0)

    def fix_parameter(self, i: int, log: float) -> Parametrisation:
        """Fix the logarithm of one value by equal bounds."""
        lower, upper = self.lower.copy(), self.upper.copy()
        lower[i] = upper[i] = log
        return replace(self, lower=lower, upper=upper)
