"""A felt of your own: a law in one object, struck with, checked for giving no energy, and found again from levels.

This felt hardens beyond a power: F = K u^2 (1 + u/s) (1 + μ u̇), with the compression s at which it is twice as hard as
its soft beginning. A twin made with it is fitted by SciPy down the derivatives that JAX takes of `strike`. (The command
line's fit knows the package's own laws only.)
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares

import pianofit
from pianofit import Parameter

PARTIALS, NOISE_DB = 24, 0.1


def force(u, w, felt):
    """Newton, at compression `u`, m, and its speed `w`, m/s."""
    return felt.K * u**2 * (1 + u / felt.s) * jnp.maximum(1 + felt.mu * w, 0.0)


def storage(u, felt):
    """Joule: what the felt gives back, ∫ F du at rest."""
    return felt.K * (u**3 / 3 + u**4 / (4 * felt.s))


HARDENING = pianofit.FeltLaw(
    "Hardening",
    {
        "K": Parameter("N/m²", "stiffness of the soft beginning", 1e5, 1e11),
        "s": Parameter("m", "compression at which it has doubled", 1e-5, 1e-2),
        "mu": Parameter("s/m", "loss", 1e-3, 1e1),
    },
    force,
    storage,
)


def main() -> None:
    """Strike, disturb, find, and print the truth beside what was found."""
    it = pianofit.preset("bensa-final")
    true = HARDENING.hammer(K=8e7, s=2e-4, mu=0.2, M_H=it.hammer.M_H, v_H0=2.0)
    modes = pianofit.mode_table(it.string, it.geometry, rate=88_200.0, n_modes=64, quantity="bridge-force")
    free = ("K", "s", "mu")

    def levels(log_values, velocity):
        """Of the partials, dB, struck at a velocity, m/s."""
        felt = true._replace(v_H0=velocity, **dict(zip(free, jnp.exp(log_values), strict=True)))
        return pianofit.levels(modes, pianofit.strike(modes, felt, steps=1024).drive)[:PARTIALS]

    truth, speeds = np.log([getattr(true, name) for name in free]), np.array([0.5, 1.0, 2.0, 4.0])
    every = jax.jit(lambda z: jax.vmap(lambda v: levels(z, v))(speeds).ravel())
    slope = jax.jit(jax.jacfwd(every))
    measured = every(truth) + np.random.default_rng(0).normal(0.0, NOISE_DB, len(speeds) * PARTIALS)
    found = least_squares(lambda z: np.asarray(every(z) - measured), truth + np.array([0.5, -0.7, 0.4]), slope)
    error = np.sqrt(np.diag(np.linalg.inv(found.jac.T @ found.jac))) * NOISE_DB
    for name, at, e in zip(free, found.x, error, strict=True):
        print(f"{name:3} true {getattr(true, name):.4g}   found {np.exp(at):.4g} ± {100 * e:.1f} %")

    pulse = pianofit.simulate(it.string, true, it.geometry).pulse
    print(f"contact: {pulse.force.max():.1f} N at most, {1e3 * pulse.compression.max():.2f} mm")
    note = pianofit.Note(it.string, true, it.geometry, "bridge-force", gain=0.02)
    print(f"rendered: {len(note.render(seconds=1.0))} samples")


if __name__ == "__main__":
    with jax.enable_x64(True):  # the model computes in float64, and so do the derivatives that JAX takes of it
        main()
