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
# # The paper's figure 5 again
#
# Figure 5 of Bensa, Gipouloux and Kronland-Martinet (2005) is their experiment. A hammer strikes a string of 1 m at
# measured velocities from 0.8 to 2.3 m/s, and a laser measures the velocity of the string. This notebook runs the
# experiment with the paper's final parameters. The paper does not give the strike position, the laser's position and
# the string mass. They are chosen here, see [the model](../model.md#misprints-and-gaps-in-the-paper).

# %%
import numpy as np
from IPython.display import Audio, display
from matplotlib import pyplot as plt
from matplotlib.patches import Rectangle

import pianofit as pf

RATE = 44_100  # Hz
VELOCITIES = (0.8, 1.3, 1.8, 2.3)  # m/s
it = pf.preset("bensa-final")
strokes = [pf.simulate(it.string, it.hammer._replace(v_H0=velocity), it.geometry) for velocity in VELOCITIES]
g = it.geometry
print(f"string {g.length} m, {1e3 * g.mass:.2f} g; strike at {g.strike_position} m, laser at {g.pickup} m")

# %%
figure, axes = plt.subplots(figsize=(9, 3))
axes.add_patch(Rectangle((-0.1, -0.5), 1.2, 0.3, color="0.8"))
axes.text(0.5, -0.35, "concrete support", ha="center", va="center")
for x, name in ((0.0, "agraffe"), (g.length, "bridge")):
    axes.add_patch(Rectangle((x - 0.015, -0.2), 0.03, 0.2, color="0.5"))
    axes.text(x, 0.1, name, ha="center")
axes.plot([0, g.length], [0, 0], "k")
axes.annotate(
    "hammer", (g.strike_position, 0), (g.strike_position, -0.15), ha="center", arrowprops={"arrowstyle": "->"}
)
axes.annotate(
    "laser vibrometer", (g.pickup, 0), (g.pickup, 0.4), ha="center", arrowprops={"arrowstyle": "->", "color": "red"}
)
axes.set(xlim=(-0.15, 1.15), ylim=(-0.55, 0.55), title="The setup")
axes.axis("off")
plt.show()

# %% [markdown]
# Force over time, as in the paper's figure 2, and string velocity at the laser. A faster hammer meets a harder felt:
# the contact is shorter, and the force rises faster than the velocity.

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.5))
for velocity, stroke in zip(VELOCITIES, strokes, strict=True):
    force = np.asarray(stroke.pulse.force)
    left.plot(1e3 * float(stroke.modes.step) * np.arange(len(force)), force, label=f"{velocity} m/s")
    right.plot(1e3 * np.arange(1323) / RATE, stroke.waveform(RATE, 1323))
left.set(xlim=(0, 5), xlabel="time (ms)", ylabel="force (N)", title="Force of the hammer")
right.set(xlabel="time (ms)", ylabel="velocity (m/s)", title="Velocity of the string")
left.legend()
plt.show()

# %%
times = [stroke.contact_time for stroke in strokes]
peaks = [float(stroke.pulse.force.max()) for stroke in strokes]
for velocity, time, peak in zip(VELOCITIES, times, peaks, strict=True):
    print(f"{velocity} m/s: contact {1e3 * time:.2f} ms, largest force {peak:.2f} N")
assert times == sorted(times, reverse=True)
assert peaks[-1] / peaks[0] > VELOCITIES[-1] / VELOCITIES[0]

# %% [markdown]
# The laser's signal, from the slowest to the fastest stroke:

# %%
display(Audio(np.concatenate([stroke.waveform(RATE, RATE) for stroke in strokes]), rate=RATE))
