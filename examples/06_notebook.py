"""Soft, medium and loud recordings of a key, fitted together: cells of a notebook that also run as a program.

python examples/06_notebook.py                                  fits three synthetic layers
python examples/06_notebook.py F#2 soft.flac mezzo.flac ff.flac fits your recordings
"""

# %% Load: a published string and hammer, struck at three velocities, with the same unknown gain.
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

# %% Fit and inspect: in a notebook `result`, as the last line of a cell, shows the statement and its tables.
result = pf.fit(*files, note=note)
print(result)
print(result.parameters)

# %% One quantity with its interval.
hammer = result.invariants["M_H/M_S"]
low, high = hammer.interval or (np.nan, np.nan)  # None if the value was not fitted
print(f"{hammer.meaning}: {hammer.value:.4g}, 95 % interval {low:.4g} to {high:.4g}")
print(f"K_H is {result.parameters.K_H.status}; {result.identifiability_statement.splitlines()[0]}")

# %% Correlations of the parameters, and measured and fitted levels of the partials.
result.plot.correlations().figure.savefig("correlations.png")
result.plot.levels().figure.savefig("levels.png")

# %% Export a table, and a folder with sounds and a page.
result.parameters.to_csv("parameters.csv")
result.save("fit", force=True)
