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
# # An instrument from five keys
#
# Five keys of the upper half are measured and fitted. All other keys follow from smooth laws over the keyboard. The
# laws interpolate between the recorded keys and extrapolate below them.

# %%
from pathlib import Path

import numpy as np
from IPython.display import Audio, display
from matplotlib import pyplot as plt

import pianofit as pf

RATE = 44_100  # Hz
RECORDED = ("C4", "F#4", "C5", "F#5", "C6")
for number, name in enumerate(RECORDED):
    it = pf.typical(name)
    made = pf.synthetic_recording(
        it.string, it.hammer, it.geometry, quantity="bridge-force", noise_db=60.0, seed=number, scale=20.0, seconds=2.0
    )
    pf.fit(made.recording, setup=made.setup, note=name, progress=False).save(f"fits/{name}", page=False)

piano = pf.build_instrument(pf.load_keys(pf.find_fits([Path("fits")])), "five keys")
print(piano)
assert len(piano.keys) == 88

# %%
midi = np.array(sorted(piano.keys))
recorded = np.array([key for key in midi if piano.keys[key].state == "recorded"])
figure, axes = plt.subplots(1, 2, figsize=(10, 4))


def inharmonicity(note):
    """Inharmonicity B of a string."""
    return (note.string.kappa * np.pi / (note.string.c * note.geometry.length)) ** 2


for panel, (title, value) in zip(
    axes,
    {
        "inharmonicity B": inharmonicity,
        "hammer mass over string mass": lambda n: n.hammer.M_H / n.geometry.mass,
    }.items(),
    strict=True,
):
    panel.semilogy(midi, [value(piano.keys[key].note) for key in midi], label="instrument")
    panel.semilogy(midi, [value(pf.typical(int(key))) for key in midi], "--", label="true")
    panel.semilogy(recorded, [value(piano.keys[key].note) for key in recorded], "o", label="recorded")
    panel.set(title=title, xlabel="MIDI key")
axes[0].legend()
plt.show()

# %% [markdown]
# The true piano is that of the literature, which is also the prior of the laws. Keys that were not recorded are
# therefore right here. For real pianos see [the accuracy of instruments](../instrument-accuracy.md).
#
# A chord of keys that were never recorded, with the pedal:

# %%
CHORD = (62, 65, 69, 74, 77)
song = pf.Song(
    {key: [(0.15 * i, 70), (2.5, 0)] for i, key in enumerate(CHORD)}, [(0.0, 127), (2.5, 0)], 2.5, len(CHORD)
)
played = pf.render_song(piano, song, rate=RATE).samples.mean(axis=0)
display(Audio(played[: 3 * RATE], rate=RATE))

# %%
figure, axes = plt.subplots(figsize=(8, 3.5))
axes.specgram(played[: 3 * RATE], NFFT=2048, Fs=RATE, noverlap=1536, vmin=-160)
axes.set(ylim=(0, 4000), xlabel="time (s)", ylabel="frequency (Hz)", title="The chord")
plt.show()
