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
# # A felt law of one's own
#
# This felt hardens more than a power law: F = K u² (1 + u/s) (1 + μ u̇). At the compression s it is twice as hard as
# its soft beginning. One object describes the law. It is used in simulations, tested for passivity, and fitted.

# %%
import numpy as np
from IPython.display import Audio, display
from matplotlib import pyplot as plt

import pianofit as pf

RATE = 44_100  # Hz

HARDENING = pf.FeltLaw(
    "hardening",
    {  # unit, meaning, bounds; median of the prior and standard deviation of its logarithm
        "K": pf.Parameter("N/m²", "stiffness of the soft beginning", 1e5, 1e11, 3e7, 1.5),
        "s": pf.Parameter("m", "compression at which it has doubled", 1e-5, 1e-2, 3e-4, 1.0),
        "mu": pf.Parameter("s/m", "loss", 1e-3, 1e1),
    },
    force=lambda u, w, felt: felt.K * u**2 * (1 + u / felt.s) * (1 + felt.mu * w),  # N
    storage=lambda u, felt: felt.K * (u**3 / 3 + u**4 / (4 * felt.s)),  # J
)
it = pf.preset("chabassier-F3")
VELOCITIES = (0.6, 1.5, 4.0)  # m/s, measured
true = HARDENING.hammer(K=8e7, s=2e-4, mu=0.2, M_H=it.hammer.M_H, v_H0=2.0)
strokes = [pf.simulate(it.string, true._replace(v_H0=v), it.geometry, quantity="bridge-force") for v in VELOCITIES]

# %%
figure, axes = plt.subplots(figsize=(7, 4))
for stroke, velocity in zip(strokes, VELOCITIES, strict=True):
    axes.plot(1e3 * np.asarray(stroke.pulse.compression), np.asarray(stroke.pulse.force), label=f"{velocity} m/s")
axes.set(xlabel="compression (mm)", ylabel="force (N)", title="Loops of the felt")
axes.legend()
plt.show()

# %% [markdown]
# The three strokes become recordings with noise. Their velocities and the sizes of the string are given. The felt is
# not.

# %%
random = np.random.default_rng(0)
waves = [np.pad(stroke.waveform(RATE, 2 * RATE), (4_410, 0)) / 100 for stroke in strokes]
recordings = [
    pf.recording_from_samples(x + random.normal(0.0, 3e-5, len(x)), RATE, name=f"{v}.wav")
    for x, v in zip(waves, VELOCITIES, strict=True)
]
setup = pf.Setup(
    length=it.geometry.length,
    mass=it.geometry.mass,
    recordings=tuple(pf.RecordingInfo(file=f"{v}.wav", v_H0=v) for v in VELOCITIES),
    felt=HARDENING,
)
result = pf.fit(*recordings, setup=setup, progress=False)
for name in HARDENING.parameters:
    estimate = result.parameters[name]
    low, high = estimate.interval
    print(
        f"{name:3} true {getattr(true, name):.4g}, fitted {estimate.value:.4g} [{low:.4g}, {high:.4g}] {estimate.unit}"
    )
    assert low < getattr(true, name) < high

# %%
figure, axes = plt.subplots(figsize=(8, 4))
result.plot.felt(axes)
plt.show()

# %% [markdown]
# `fit.json` has the name of the law only, so a stored fit is read as `pf.load_note(path, felt=HARDENING)`. The fitted
# note, soft and loud:

# %%
display(Audio(np.concatenate([result.note.render(v, seconds=1.2) for v in (0.6, 5.0)]), rate=RATE))
