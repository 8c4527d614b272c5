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
# # Two hammers compared
#
# A technician voices a hammer: the felt becomes softer, all else stays. Two calibrated measurements, before and
# after, are fitted one by one. The comparison says which differences are larger than their uncertainty.

# %%
import numpy as np
from IPython.display import Audio, display
from matplotlib import pyplot as plt

import pianofit as pf

RATE = 44_100  # Hz
it = pf.typical("C4")
VOICED = 0.6  # stiffness of the felt after voicing, over that before it

made = {
    label: pf.synthetic_recording(
        it.string, it.hammer._replace(K_H=share * it.hammer.K_H), it.geometry, noise_db=60.0, seed=seed, scale=5.0
    )
    for seed, (label, share) in enumerate({"hard": 1.0, "voiced": VOICED}.items())
}
fits = {label: pf.fit(one.recording, setup=one.setup, note="C4", progress=False) for label, one in made.items()}
compared = pf.compare(fits["hard"], fits["voiced"], labels=("hard", "voiced"))
print(compared)

# %% [markdown]
# K_H and p are correlated. The force at one compression is better determined than either, and a felt is compared by
# it.

# %%
figure, axes = plt.subplots(figsize=(8, 4))
compared.plot(axes)
plt.show()

# %%
figure, axes = plt.subplots(figsize=(8, 3.5))
for label, one in made.items():
    axes.plot(
        1e3 * np.arange(len(one.simulation.pulse.force)) * float(one.simulation.modes.step),
        np.asarray(one.simulation.pulse.force),
        label=label,
    )
axes.set(xlim=(0, 4), xlabel="time (ms)", ylabel="force (N)", title="True force on the string")
axes.legend()
plt.show()

# %% [markdown]
# The strings are the same, so their differences must be within their uncertainty.

# %%
z = {quantity.name: quantity.z for quantity in compared if quantity.z is not None}
assert abs(z["c"]) < 4

# %% [markdown]
# First the hard felt, then the voiced one, at 3 m/s:

# %%
display(Audio(np.concatenate([fit.note.render(3.0, seconds=1.2) for fit in fits.values()]), rate=RATE))
