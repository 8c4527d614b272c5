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
# # Which parameters the data hold
#
# A fit rests on derivatives: how many decibels each partial changes if a parameter changes by one percent. JAX gives
# this table for a stroke. Its singular values tell which combinations of parameters a measurement determines.

# %%
import jax
import jax.numpy as jnp
import numpy as np
from IPython.display import Audio, display
from matplotlib import pyplot as plt

import pianofit as pf

RATE, CONTACT_RATE = 44_100, 88_200.0  # Hz
PARTIALS = 24
it = pf.preset("bensa-final")
NAMES = (*it.string._fields, *it.hammer._fields)


def levels(log_values):
    """Levels of the first partials, dB [partials], from the logarithms of the nine parameters [9]."""
    values = jnp.exp(log_values)
    string, hammer = pf.String(*values[:4]), pf.Hammer(*values[4:])
    modes = pf.mode_table(string, it.geometry, rate=CONTACT_RATE, n_modes=64, quantity="bridge-force")
    return pf.levels(modes, pf.strike(modes, hammer, steps=1024).drive)[:PARTIALS]


with jax.enable_x64(True):  # the model computes in float64
    at = jnp.log(jnp.asarray([*it.string, *it.hammer]))
    slopes = 0.01 * np.asarray(jax.jit(jax.jacfwd(levels))(at))  # dB for one percent [partials, 9]

# %%
figure, axes = plt.subplots(figsize=(8, 3.5))
image = axes.imshow(slopes.T, aspect="auto", cmap="RdBu", vmin=-0.2, vmax=0.2, extent=(0.5, PARTIALS + 0.5, 8.5, -0.5))
axes.set(yticks=range(9), yticklabels=NAMES, xlabel="partial number", title="Change of level for 1 %")
figure.colorbar(image, label="dB")
plt.show()

# %% [markdown]
# If the gain is unknown, (K_H, μ, v_H0) → (K_H s^(1−p), μ/s, s v_H0) changes all levels alike. One direction is then
# lost.

# %%
gained = slopes - slopes.mean(axis=0)
scaling = np.zeros(9)
scaling[[NAMES.index("K_H"), NAMES.index("mu"), NAMES.index("v_H0")]] = 1 - it.hammer.p, -1, 1
assert np.abs(gained @ scaling).max() < 1e-6 * np.abs(slopes @ scaling).max()

figure, axes = plt.subplots(figsize=(8, 3.5))
for table, label in ((slopes, "known gain"), (gained, "unknown gain")):
    axes.semilogy(range(1, 10), np.maximum(np.linalg.svd(table)[1], 1e-9), "o-", label=label)
axes.set(xlabel="direction", ylabel="dB for 1 %", title="Singular values: how well each direction is determined")
axes.legend()
plt.show()

# %% [markdown]
# Two hammers that differ by a factor of two in velocity, along this direction. After a change of gain they sound the
# same.

# %%
hammers = [
    it.hammer,
    it.hammer._replace(K_H=it.hammer.K_H * 2 ** (1 - it.hammer.p), mu=it.hammer.mu / 2, v_H0=2 * it.hammer.v_H0),
]
waves = [pf.simulate(it.string, hammer, it.geometry).waveform(RATE, RATE) for hammer in hammers]
assert np.allclose(waves[1], 2 * waves[0], rtol=0, atol=1e-6 * np.abs(waves[1]).max())
display(Audio(np.concatenate([wave / np.abs(wave).max() for wave in waves]), rate=RATE))
