"""The objective F of given recordings as a function of the parameters, for programs of users.

A fit minimises F by θ, by the hyperparameters φ and by the weights w of the partials. As a function of the parameters
alone it needs values of φ and w. Those that minimise F at one point are used everywhere, until `at` moves the point.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..errors import ParameterError, check_type
from ..felt import ALL_PARAMETERS
from ..io.number_format import is_number
from ..x64 import AnyArray, float64, x64_scope
from .density import DensityContext, density_context_at, negative_log_density
from .objective import Objective
from .parametrisation import STRING_SIZE
from .pipeline import fit_string, initial_point
from .problem import FitProblem

# Rounds of φ and w at a fixed θ, and the decrease of F below which they end.
ROUNDS, SETTLED = 60, 1e-6
# Units of the sizes that a setup can give with a standard deviation.
SIZE_UNITS = {"L": "m", "M_S": "kg", "pickup": "m", "scale": "pickup units at full scale", "x0": "m", "width": "m"}


@dataclass(frozen=True, eq=False, repr=False)
class RecordingObjective:
    """F of given recordings: minus the log marginal posterior density of the parameters. From `pianofit.objective`.

    It is called with the natural logarithms of the values in SI units, in the order of `names` [parameters], and
    returns F, a number without a unit. It works under `jit`, `grad`, `vmap` and `jacfwd` inside
    `jax.enable_x64(True)`. F is infinite where a contact does not end.

    Parameters
    ----------
    names : the free parameters of string, hammer and contact, the velocities of all strokes, and sizes that were given
        with a standard deviation.
    units : their units.
    start : logarithms of their initial values [parameters].
    lower, upper : bounds of the logarithms [parameters]. A fit searches between them; F also exists beyond.

    Examples
    --------
    >>> import jax, pianofit
    >>> it = pianofit.typical("C5")
    >>> made = pianofit.synthetic_recording(it.string, it.hammer, it.geometry, seconds=1.5, noise_db=60)
    >>> F = pianofit.objective(made.recording, setup=made.setup)
    >>> with jax.enable_x64(True):
    ...     value, slope = jax.jit(jax.value_and_grad(F))(F.start)
    >>> F.names[:4], F.units[0], slope.shape == F.start.shape
    (('c', 'kappa', 'b1', 'b2'), 'm/s', True)
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    start: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    _problem: FitProblem
    _context: DensityContext

    def __post_init__(self) -> None:
        for values in (self.start, self.lower, self.upper):
            values.setflags(write=False)

    def __repr__(self) -> str:
        return f"RecordingObjective of {len(self._problem.recordings)} recordings: {', '.join(self.names)}"

    def __getstate__(self) -> dict[str, Any]:
        return {own.name: getattr(self, own.name) for own in fields(self)}  # without programs, which cannot be pickled

    @float64
    def __call__(self, log_values: Float[AnyArray, " parameters"]) -> Array:
        """F at the logarithms of values [parameters]; see the class."""
        self._check(log_values)
        at = jax.tree.map(jnp.asarray, self._context)
        theta = self._theta(jnp.asarray(log_values))
        return negative_log_density(at, theta, at.phi, at.w, self._problem.cfg)

    def value_and_gradient(self, log_values: np.ndarray) -> tuple[float, np.ndarray]:
        """F and its gradient by the logarithms [parameters], from a compiled program.

        Parameters
        ----------
        log_values : natural logarithms of the values in SI units [parameters].
        """
        self._check(log_values)
        with x64_scope():
            value, slope = self._compiled(jnp.asarray(log_values, float))
            return float(value), np.asarray(slope)

    def values(self, log_values: np.ndarray) -> dict[str, float]:
        """Return the values in SI units by name."""
        self._check(log_values)
        return dict(zip(self.names, np.exp(log_values).tolist(), strict=True))

    def log_values(self, values: Mapping[str, float]) -> np.ndarray:
        """Return the logarithms of values in SI units [parameters], from `start` where a name is missing.

        Raises
        ------
        ParameterError
            For a name that is not among `names`, and a value that is not positive.
        """
        check_type("values=", values, Mapping, "values in SI units by name")
        for name, value in values.items():
            if name not in self.names:
                raise ParameterError(f"values=: no free parameter is called {name!r}; use {', '.join(self.names)}")
            if not (is_number(value) and value > 0):
                raise ParameterError(f"values=: {name}={value!r} must be a positive number")
        return np.log([values.get(name, own) for name, own in zip(self.names, np.exp(self.start), strict=True)])

    def at(self, log_values: np.ndarray) -> RecordingObjective:
        """Return the same objective with the φ and w that minimise F at another point.

        Its `start` is this point. The error of the time step of the contact is also that of the point.

        Parameters
        ----------
        log_values : natural logarithms of the values in SI units [parameters].

        Raises
        ------
        ParameterError
            If the contact does not end there.
        """
        self._check(log_values)
        with x64_scope():
            theta = np.asarray(self._theta(jnp.asarray(log_values, float)))
        return objective_at(self._problem, theta)

    def _check(self, log_values: np.ndarray | Array) -> None:
        if np.shape(log_values) != self.start.shape:
            raise ParameterError(
                f"log_values= has the shape {np.shape(log_values)} and must have one logarithm for each of {self.names}"
            )

    def _theta(self, log_values: Array) -> Array:
        """θ [size] from the logarithms of the free values."""
        u = self._problem.parametrisation
        return u.from_log_values(jnp.asarray(u.log_values(u.mean)).at[np.flatnonzero(u.free)].set(log_values))

    @cached_property
    def _compiled(self) -> Any:
        return jax.jit(jax.value_and_grad(self.__call__))


def objective_of(problem: FitProblem) -> RecordingObjective:
    """Return F of a problem, with φ and w at the initial values and the string that the partials determine."""
    return objective_at(problem, initial_point(problem, fit_string(problem).theta[0, :STRING_SIZE]))


def objective_at(problem: FitProblem, theta: np.ndarray) -> RecordingObjective:
    """Return F of a problem, with the φ and w that minimise it at θ [size].

    Raises `ParameterError` if the contact does not end there.
    """
    u, whole = problem.parametrisation, Objective.complete(problem)
    offset = whole.level_model.discretisation_error_db(theta[None])
    now = whole.start(theta[None], [np.asarray(term.table.prior[0]) for term in whole.terms], None, offset)
    if not len(now):
        raise ParameterError("log_values=: the contact of hammer and string does not end; give other values")
    now, before = whole.enter(now, 0.0), np.inf
    for _ in range(ROUNDS):
        if before - (before := float(whole.total(now)[0])) < SETTLED:
            break
        now = whole.step_nuisances(now, 0.0)
    free = np.flatnonzero(u.free)
    identity = np.eye(u.size)[:, free]
    context = density_context_at(
        problem, theta, identity, [phi[0] for phi in now.phi], [w[0] for w in now.w], now.offset[0]
    )
    named = {index: name for name, index in problem.parameter_indices.items()}
    names = tuple(named[int(i)] for i in free)
    boxes = ALL_PARAMETERS | u.law.hammer_parameters
    units = tuple(SIZE_UNITS.get(n) or boxes[n.partition(" ")[0]].unit for n in names)
    logs = u.log_values(theta)
    return RecordingObjective(names, units, logs[free], u.lower[free], u.upper[free], problem, context)
