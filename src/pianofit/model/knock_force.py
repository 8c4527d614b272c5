"""The model's knock: the force on the bridge below the lowest partial, where the string passes the hammer's force on.

At a frequency f below f0 a string without losses passes the share sin(π f/f0 · x0/L) / sin(π f/f0) of the force at x0
on to the bridge. The spectrum of the force is read from modes that the hammer does not touch: their strike weight is
zero, so they have no effect on the contact, and the force leaves its spectrum in their amplitudes.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np

from ..dsp.knock_band import BAND, nodes
from .modes import Modes


def add_probes(modes: Modes, f0: Any) -> Modes:
    """Append modes whose amplitudes times pickup weights become the spectrum of the force, N s, at the band's nodes."""
    a, omega = modes.step / 2, 2 * jnp.pi * f0 * nodes()
    scheme = jnp.tan(omega * a) / a
    zero = jnp.zeros_like(omega)
    probes = Modes(
        omega2=scheme**2,
        alpha=zero,
        strike=zero,
        modal_gain=zero + 1.0,
        pickup=scheme * (1 + (a * scheme) ** 2) + 0j,
        pole=1j * omega,
        free_rate=1j * omega,
        free_pickup=zero + 0j,
        step=modes.step,
    )
    joined = [jnp.concatenate(pair) for pair in zip(modes[:-1], probes[:-1], strict=True)]
    return Modes(**dict(zip(Modes._fields, [*joined, modes.step], strict=True)))


def knock_level(force: Any, f0: Any, strike: Any) -> Any:
    """Level of the knock, dB re N² · s [...], for a strike at x0/L = `strike`.

    `force` is the magnitude of the force's spectrum at the nodes of the band, N s [..., nodes].
    """
    phase = np.pi * nodes()
    share = jnp.sin(phase * strike) / np.sin(phase)
    density = 2 * ((share * force) ** 2).mean(axis=-1)
    return 10 * jnp.log10(jnp.maximum(density * (BAND[1] - BAND[0]) * f0, np.finfo(float).tiny))
