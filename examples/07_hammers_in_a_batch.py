"""A training loop in float32: 64 hammers in a batch, your own loss, and `jit`, `vmap` and `grad` through a strike."""

from __future__ import annotations

import jax
import jax.numpy as jnp

import pianofit

IT = pianofit.preset("bensa-final")
PARTIALS, BATCH, ITERATIONS, RATE = 20, 64, 20, 0.04


def levels(log_hammer):
    """Levels of the first partials, dB, and if the contact ended, from logs of K_H, mu, p, M_H and v_H0 [5]."""
    modes = pianofit.mode_table(IT.string, IT.geometry, rate=88_200.0, n_modes=48, quantity="bridge-force")
    pulse = pianofit.strike(modes, pianofit.Hammer(*jnp.exp(log_hammer)), steps=768)
    return pianofit.levels(modes, pulse.drive)[:PARTIALS], pulse.contact_ended


def loss(log_hammers, target):
    """Mean square difference of levels, dB², without the mean difference of each hammer, over the batch [64, 5]."""
    level, over = jax.vmap(levels)(log_hammers)
    difference = level - target
    difference -= difference.mean(axis=1, keepdims=True)
    return jnp.where(over[:, None], difference**2, 0.0).mean()  # leave out pulses that are cut off


def main() -> None:
    """Fit 64 hammers to one sound by gradient descent, and print the loss."""
    true = jnp.log(jnp.asarray(IT.hammer, jnp.float32))
    hammers = true + 0.2 * jax.random.normal(jax.random.key(0), (BATCH, 5))  # float32, as in a neural network
    value_and_grad = jax.jit(jax.value_and_grad(loss))
    with jax.enable_x64(True):  # around the call; hammers and gradients stay float32
        target, _ = levels(true)
    for step in range(ITERATIONS + 1):
        with jax.enable_x64(True):
            value, gradient = value_and_grad(hammers, target)
        if step % 10 == 0:
            print(f"step {step:3}: {float(value):8.3f} dB², gradients {gradient.dtype}")
        hammers -= RATE * gradient / (jnp.linalg.norm(gradient, axis=1, keepdims=True) + 1e-9)


if __name__ == "__main__":
    main()
