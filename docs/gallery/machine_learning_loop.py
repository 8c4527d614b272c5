# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     name: python3
#     display_name: Python 3
# ---

# %% [markdown]
# # A machine-learning loop
#
# The model is a function in JAX. Here a batch of hammers is trained to one sound by gradient descent, in a program
# that otherwise computes in float32: with `jit`, `vmap` and `grad` through the strike.

# %%
import jax
import jax.numpy as jnp
import numpy as np
from IPython.display import Audio, display
from matplotlib import pyplot as plt

import pianofit as pf

RATE = 44_100  # Hz, of the sounds
IT = pf.preset("bensa-final")
PARTIALS, BATCH, ITERATIONS, STEP = 20, 64, 30, 0.04


def levels(log_hammer):
    """Levels of the first partials, dB, and if the contact ended, from logs of K_H, mu, p, M_H and v_H0 [5]."""
    modes = pf.mode_table(IT.string, IT.geometry, rate=88_200.0, n_modes=48, quantity="bridge-force")
    pulse = pf.strike(modes, pf.Hammer(*jnp.exp(log_hammer)), steps=768)
    return pf.levels(modes, pulse.drive)[:PARTIALS], pulse.contact_ended


def loss(log_hammers, target):
    """Mean square difference of levels of each hammer, dB² [64], without its mean difference; and their sum."""
    level, over = jax.vmap(levels)(log_hammers)
    difference = level - target
    difference -= difference.mean(axis=1, keepdims=True)
    each = jnp.where(over[:, None], difference**2, 0.0).mean(axis=1)  # leave out pulses that are cut off
    return each.sum(), each


# %% [markdown]
# Enable float64 around the call. Hammers and gradients stay float32.

# %%
true = jnp.log(jnp.asarray(IT.hammer, jnp.float32))
hammers = first = true + 0.2 * jax.random.normal(jax.random.key(0), (BATCH, 5))
step = jax.jit(jax.value_and_grad(loss, has_aux=True))
with jax.enable_x64(True):
    target, _ = levels(true)
history = []
for _ in range(ITERATIONS):
    with jax.enable_x64(True):
        (_, each), gradient = step(hammers, target)
    history.append(np.asarray(each))
    hammers -= STEP * gradient / (jnp.linalg.norm(gradient, axis=1, keepdims=True) + 1e-9)
history = np.array(history)
print(f"{history[0].mean():.2f} dB² at first, {history[-1].mean():.2f} dB² at last; gradients {gradient.dtype}")
assert history[-1].mean() < 0.2 * history[0].mean()
assert gradient.dtype == jnp.float32

# %%
figure, axes = plt.subplots(figsize=(8, 3.5))
axes.semilogy(history, color="tab:blue", alpha=0.2)
axes.semilogy(np.median(history, axis=1), color="black", label="median of 64 hammers")
axes.set(xlabel="iteration", ylabel="mean square difference (dB²)")
axes.legend()
plt.show()

# %% [markdown]
# The levels determine only some combinations: stiffness and exponent end on a line.

# %%
figure, axes = plt.subplots(figsize=(6, 4))
for points, label in ((first, "first"), (hammers, "trained")):
    axes.plot(np.asarray(points)[:, 0], np.exp(np.asarray(points)[:, 2]), ".", label=label)
axes.plot(float(true[0]), float(jnp.exp(true[2])), "k+", ms=14, label="true")
axes.set(xlabel="log K_H", ylabel="p")
axes.legend()
plt.show()

# %% [markdown]
# The target, a hammer before training, and the same one after it:

# %%
chosen = int(history[0].argmax())
sounds = [
    pf.simulate(IT.string, pf.Hammer(*np.exp(np.asarray(log, float))), IT.geometry).waveform(RATE, RATE)
    for log in (true, first[chosen], hammers[chosen])
]
display(Audio(np.concatenate([wave / np.abs(wave).max() for wave in sounds]), rate=RATE))
