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
# # A fit, read critically
#
# Three synthetic strokes of one key are fitted as ordinary recordings: the microphone, its gain and the hammer
# velocities are unknown. The true parameters are known here, so every statement of the fit can be tested.

# %%
import textwrap

import numpy as np
from IPython.display import Audio, display
from matplotlib import pyplot as plt

import pianofit as pf

RATE = 44_100  # Hz
VELOCITIES = (1.0, 2.0, 4.0)  # m/s

true = pf.preset("chabassier-F3")
random = np.random.default_rng(0)
sounds = []
for velocity in VELOCITIES:
    hammer = true.hammer._replace(v_H0=velocity)
    wave = pf.simulate(true.string, hammer, true.geometry, quantity="bridge-force").waveform(RATE, 2 * RATE) / 100
    sounds.append((np.pad(wave, (4_410, 0)) + 1e-5 * random.standard_normal(len(wave) + 4_410), RATE))

result = pf.fit(*sounds, note="F3", progress=False)

# %% [markdown]
# Read the identifiability statement first. It says which kind of measurement this is, and what it cannot determine.

# %%
print(textwrap.fill(result.identifiability_statement, 90))

# %% [markdown]
# Then the invariants. They need neither a length nor a mass. The last line is the true value of one of them.

# %%
found = result.invariants["M_H/M_S"]
print(result.invariants)
print(f"true M_H/M_S: {true.hammer.M_H / true.geometry.mass:.4g}")
assert found.interval is not None
assert found.interval[0] < true.hammer.M_H / true.geometry.mass < found.interval[1]

# %% [markdown]
# The status of each parameter says how to use its value. A scaled value is proportional to an assumed one: with
# another string mass, K_H changes in proportion.

# %%
for name, quantity in result.parameters.items():
    print(f"{name:6} {quantity.value:10.4g} {quantity.unit:7} {quantity.status}")

# %% [markdown]
# The levels of the partials show how well the model describes the recordings. Here a model made them, so the fitted
# levels meet the measured ones. On real strings, levels deviate by decibels, and the intervals are wider.

# %%
figure, axes = plt.subplots(figsize=(8, 4))
result.plot.levels(axes)
plt.show()

# %% [markdown]
# Some parameters are correlated. A single interval is then less than what the fit knows.

# %%
figure, axes = plt.subplots(figsize=(6, 5))
result.plot.correlations(axes)
plt.show()

# %% [markdown]
# The fitted note at three velocities. The last one, about 6 m/s, was not recorded.

# %%
fastest = result.note.hammer.v_H0
notes = [result.note.render(velocity, seconds=1.2) for velocity in (0.25 * fastest, fastest, 1.5 * fastest)]
display(Audio(np.concatenate(notes), rate=RATE))
