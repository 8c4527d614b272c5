"""The motion that an excitation leaves on a string: by the contact of a hammer, or by the release of a displacement.

This is the one place where the model distinguishes the two. Everything after it is free motion of the modes.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool

from ..excitation import Excitation
from .contact import Pulse, strike, strike_final_state, strike_until_over
from .differentiable_sums import BLOCK
from .free_motion import FreeMotion, free_motion
from .modes import ComplexModes, Modes


class SignalState(NamedTuple):
    """State of the signal after an excitation."""

    amplitude: ComplexModes  # the signal of mode k is Re(amplitude_k exp(p_k (t - time)))
    time: Array  # s after the first contact, or after the release
    ended: Bool[Array, ""]  # hammer and string are apart


def excite(modes: Modes, hammer: Any, law: Excitation, *, steps: int, free: FreeMotion | None):
    """Return the pulse of the contact, and the free motion of the string, None if it was at rest.

    Without a contact, the pulse has one block of zeros. `free` is the motion of the string before the excitation.
    """
    if law.has_contact:
        return strike(modes, hammer, steps=steps, free=free), free
    released = release(modes, hammer, law)
    if free is not None:
        total = released.amplitude + free.amplitude
        released = free_motion(modes, total.real, (modes.free_rate * total).real)
    return no_contact(BLOCK), released


def excite_until_over(
    modes: Modes, hammer: Any, law: Excitation, *, steps: int, batch: str
) -> tuple[Pulse, Array, FreeMotion | None]:
    """Return pulse [steps], the number of computed steps, and free motion, for a string at rest.

    `batch` is as for `strike_until_over`.
    """
    if law.has_contact:
        pulse, computed = strike_until_over(modes, hammer, steps=steps, batch=batch)
        return pulse, computed, None
    return no_contact(steps), jnp.asarray(BLOCK), release(modes, hammer, law)


def signal_state(modes: Modes, hammer: Any, law: Excitation, *, steps: Any) -> SignalState:
    """Return the signal after the excitation of a string at rest."""
    if law.has_contact:
        amplitude, computed, separated = strike_final_state(modes, hammer, steps=steps)
        return SignalState(modes.pickup * amplitude, computed * modes.step, separated)
    amplitude = modes.free_pickup * release(modes, hammer, law).amplitude
    return SignalState(amplitude, jnp.zeros_like(modes.step), jnp.asarray(True))


def release(modes: Modes, hammer: Any, law: Excitation) -> FreeMotion:
    """Return the motion after the release of the displacement of an excitation without contact."""
    displacement = law.displacement(modes, hammer)
    return free_motion(modes, displacement, jnp.zeros_like(displacement))


def no_contact(steps: int) -> Pulse:
    """Return the pulse of a string that nothing touches."""
    zero = jnp.zeros(steps)
    return Pulse(zero, zero, zero, jnp.zeros((steps, 2)), jnp.asarray(0.0), jnp.asarray(True))
