"""Soft, middle and loud recordings of a key, fitted together: the cells of a notebook, which run as a program too.

python examples/06_notebook.py                                  three layers that the program makes
python examples/06_notebook.py F#2 soft.flac mezzo.flac ff.flac recordings of yours
"""

# %% Load: here a published string and hammer, struck at three velocities, behind the same unknown gain.
import sys

import numpy as np

import pianofit as pf

note, files = (sys.argv[1], sys.argv[2:]) if len(sys.argv) > 2 else ("F3", [])
if not files:
    p, random = pf.preset("chabassier-F3"), np.random.default_rng(0)
    hammers = [p.hammer._replace(v_H0=velocity) for velocity in (1.0, 2.0, 4.0)]
    strikes = [pf.simulate(p.string, hammer, p.geometry, quantity="bridge-force") for hammer in hammers]
    sounds = [np.pad(strike.waveform(44_100, 88_200), (4_410, 0)) / 100 for strike in strikes]  # full scale is 100 N
    files = [(sound + 1e-5 * random.standard_normal(len(sound)), 44_100) for sound in sounds]

# %% Fit, and look: in a notebook `result` alone, as the last line of a cell, is the statement and its tables.
result = pf.fit(*files, note=note)
print(result)
print(result.parameters)

# %% One number, with what is known of it.
hammer = result.invariants["M_H/M_S"]
low, high = hammer.interval or (np.nan, np.nan)  # None where nothing was fitted
print(f"{hammer.meaning}: {hammer.value:.4g}, 95 % interval {low:.4g} to {high:.4g}")
print(f"K_H is {result.parameters.K_H.status}; {result.claims.splitlines()[0]}")

# %% Which estimates go together, and how well the levels of the partials are met.
result.plot.correlations().figure.savefig("correlations.png")
result.plot.levels().figure.savefig("levels.png")

# %% To take elsewhere: a table, and a folder with sounds and a page.
result.parameters.to_csv("parameters.csv")
result.save("fit", force=True)
