"""A law of the felt from outside of this package, as one object: parameters, force, stored energy.

The step's equation is the same for every law, R(u) = u + C F(u, w(u)) - upper = 0, with w = (u - u_old)/a - w_old. Of F
only its value is known here, and its slope by differentiation; all that is asked is that it does not fall as the felt
is pressed, so that R rises. The root then lies in [0, upper] and is found by Newton's steps, halving the bracket
wherever one leaves it or gains less than half.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ...errors import ParameterError
from ...parameters import PARAMETERS, Parameter, check
from ..precision import float64

__all__ = ["FeltLaw", "compression", "felt_force", "force", "own_law"]

# What every hammer has beside its felt.
HAMMER = ("M_H", "v_H0")
# Halving alone would take some 60 to rounding.
MOST_ITERATIONS = 200
# The relative change of u after which the next of Newton's would only change its rounding.
NEAR = 1e-9
# Where a law is tried for giving more than it has stored: compressions, m, and their speeds, m/s.
TRIED_U = np.geomspace(1e-6, 2e-3, 25)
TRIED_W = np.array([-5.0, -1.0, -0.2, 0.2, 1.0, 5.0])
# Rounding that is forgiven there, relative.
ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class FeltLaw:
    """A felt without memory, F(u, u̇), for `strike`, `simulate` and a `Note`; fits know the package's own laws only.

    Parameters
    ----------
    name : a Python name.
    parameters : unit, meaning and bounds of each.
    force : `force(u, w, hammer)`, N, of compression u > 0, m, and its speed w, m/s, written in `jax.numpy`, with the
        parameters as fields of `hammer`. It must not fall as u rises. Below 0 it counts as 0: a felt does not pull.
    storage : `storage(u, hammer)`, J: the energy that the felt gives back. Where it is given, hammers whose felt would
        give more than that are refused.

    Raises
    ------
    ParameterError
        For a name that is none, or that every hammer has.
    """

    name: str
    parameters: Mapping[str, Parameter]
    force: Callable[[Any, Any, Any], Any]
    storage: Callable[[Any, Any], Any] | None = None

    def __post_init__(self) -> None:
        for name in (self.name, *self.parameters):
            if not name.isidentifier() or name.startswith("_") or name in HAMMER:
                raise ParameterError(f"felt law {self.name!r}: {name!r} must be a name other than {', '.join(HAMMER)}")

    @cached_property
    def kind(self) -> Any:
        """The type of its hammers: a named tuple, and so a JAX pytree, that knows its law."""
        fields = namedtuple(self.name, (*self.parameters, *HAMMER))  # fields are known at run time
        return type(self.name, (fields,), {"__slots__": (), "law": self})

    @property
    def boxes(self) -> dict[str, Parameter]:
        """Unit, meaning and bounds of all of a hammer's fields."""
        return {**self.parameters, **{name: PARAMETERS[name] for name in HAMMER}}

    def hammer(self, **values: float) -> Any:
        """A hammer with this felt: the law's parameters, M_H, kg, and v_H0, m/s.

        Raises
        ------
        ParameterError
            For a value that is missing, unknown or out of its bounds, and for a felt that gives more than it stores.
        """
        if missing := [name for name in self.boxes if name not in values]:
            raise ParameterError(f"felt law {self.name}: a hammer needs {', '.join(missing)} too")
        hammer = self.kind(**check(values, f"felt law {self.name}", self.boxes))
        self._check_stored(hammer)
        return hammer

    @float64
    def _check_stored(self, hammer: Any) -> None:
        storage = self.storage
        if storage is None:
            return
        u, w = (jnp.asarray(x.ravel()) for x in np.meshgrid(TRIED_U, TRIED_W))
        stored = jax.vmap(jax.grad(lambda x: jnp.asarray(storage(x, hammer), float)))(u)
        push = felt_force(u, w, hammer)
        given = np.asarray((stored - push) * w)
        worst = int(np.argmax(given))
        if given[worst] > ROUNDING * float(abs(push[worst] * w[worst])):
            raise ParameterError(
                f"felt law {self.name}: at u={float(u[worst]):.2g} m and u̇={float(w[worst]):g} m/s the felt would "
                "give more than its storage holds; the force while it is pressed must be at least the storage's slope, "
                "and while it springs back at most"
            )


def own_law(hammer: Any) -> FeltLaw | None:
    """The law of a hammer that was made by one; None for the package's own hammers."""
    return getattr(type(hammer), "law", None)


def felt_force(u: Array, w: Array, hammer: Any) -> Array:
    """Felt force, N; 0 when apart."""
    law = own_law(hammer)
    assert law is not None  # noqa: S101  # by `step`
    pressed = u > 0
    return jnp.where(pressed, jnp.maximum(law.force(jnp.where(pressed, u, 1.0), w, hammer), 0.0), 0.0)


def compression(e, u_old, w_old, f_old, c, a, hammer: Any):
    """The root u of u + C (F(u) + F_old) = e."""
    upper = e - c * f_old
    root = _root(jnp.maximum(upper, 0.0), u_old, w_old, c, a, hammer)
    return jnp.where(upper > 0, root, upper)


def force(u, w, upper, c, a, hammer: Any):
    """F_n: by the law, or by what it does to string and hammer, whichever magnifies the rounding of u less."""
    law = felt_force(u, w, hammer)
    slope = _sloped(u, upper, u - a * w, jnp.zeros_like(u), c, a, hammer)[1]
    return jnp.where((law > 0) & (slope > 2), (upper - u) / c, law)


def _residual(u, upper, u_old, w_old, c, a, hammer):
    return u + c * felt_force(u, (u - u_old) / a - w_old, hammer) - upper


def _sloped(u, *rest):
    """R and its derivative by u."""
    return jax.jvp(lambda x: _residual(x, *rest), (u,), (jnp.ones_like(u),))


@jax.custom_jvp
def _root(upper, u_old, w_old, c, a, hammer):
    """The compression in [0, upper] at which `_residual` vanishes."""
    rest = (upper, u_old, w_old, c, a, hammer)
    floor = 4 * jnp.finfo(float).eps * upper

    def going(state):
        return state[-2] & (state[-1] < MOST_ITERATIONS)

    def iterate(state):
        u, low, high, before, _, iteration = state
        residual, slope = _sloped(u, *rest)
        low, high = jnp.where(residual < 0, u, low), jnp.where(residual < 0, high, u)
        newton = u - residual / slope
        fine = (newton > low) & (newton < high) & (jnp.abs(residual) <= 0.5 * before)
        onward = jnp.where(fine, newton, 0.5 * (low + high))
        moving = (jnp.abs(onward - u) > NEAR * u) & (jnp.abs(residual) > floor)
        return jnp.where(jnp.abs(residual) > floor, onward, u), low, high, jnp.abs(residual), moving, iteration + 1

    going_on = u_old + 2 * a * w_old
    guess = jnp.where((going_on > 0) & (going_on < upper), going_on, 0.5 * upper)
    begin = (guess, jnp.zeros_like(upper), upper, jnp.full_like(upper, jnp.inf), upper > 0, 0)
    return jax.lax.while_loop(going, iterate, begin)[0]


@_root.defjvp
def _root_jvp(rest, tangents):
    # The implicit function theorem, never the iterations: du = -(∂R/∂rest · d rest)/(∂R/∂u).
    u = _root(*rest)
    slope = _sloped(u, *rest)[1]
    _, change = jax.jvp(lambda *r: _residual(u, *r), rest, tangents)
    return u, -change / slope
