"""Estimate the prior of the residual standard deviation τ of output paths, from notes recorded at several velocities.

    python benchmarks/path_prior.py

The recordings are in ../shared/recordings and ../shared/disklavier, or in the folders of PIANOFIT_RECORDINGS (separated
by a colon), each with a `recordings.csv`. Every note with three layers or more is fitted. The part common to its
layers, beyond the fitted hammer, is attributed to its output path. F is then minimised over τ, and over the amplitude
and length of the smooth part, with all other parameters at the minimum. The median and the standard deviation of the
logarithms of τ are the prior (`inference/priors.py`, PATH).
"""

from __future__ import annotations

import sys

import numpy as np
from crossval import folders, notes
from scipy.optimize import minimize

from pianofit import analyse, load_recording
from pianofit.inference import FitProblem, build_problem, map_estimate
from pianofit.inference.likelihood import table_objective
from pianofit.program_folder import enable_program_cache
from pianofit.x64 import x64_scope

# Least number of partials of an output path to estimate τ.
FEWEST = 12


def residual_of(problem: FitProblem) -> float:
    """τ of one fit, dB."""
    import jax.numpy as jnp

    candidates, table = map_estimate(problem).minima.candidates, problem.observed.level
    level = candidates.level
    phi, w, residual, theta = (jnp.asarray(x[0]) for x in (level.phi, level.w, level.residual, candidates.theta))

    def F(x: np.ndarray) -> float:
        log_tau, log_smooth, log_octaves = x
        at = table._replace(log_tau=np.full_like(np.asarray(table.log_tau), log_tau))
        return float(table_objective(at, residual, phi.at[1].set(log_smooth).at[2].set(log_octaves), w, theta))

    start = np.log([4.0, 8.0, 0.7])
    end = minimize(F, start, method="Nelder-Mead", options={"xatol": 0.02, "fatol": 0.02, "maxiter": 120})
    return float(np.exp(end.x[0]))


def main() -> None:
    """Print τ of every note, and the prior."""
    enable_program_cache()
    taus = []
    for folder in folders():
        for key, (note, files, setup) in notes(folder).items():
            recordings = [load_recording(file) for file in files]
            problem = build_problem(recordings, [analyse(r, note=note) for r in recordings], setup)
            partials = int((np.asarray(problem.observed.level.detected).sum(axis=0) > 1).sum())
            layout = problem.structure
            # Only a path with two velocities can be distinguished from the hammer.
            if partials < FEWEST or len({*zip(layout.group, layout.stroke, strict=True)}) == layout.groups:
                continue
            tau = residual_of(problem)
            taus.append(tau)
            print(f"{key:24} {partials:3d} partials  τ {tau:5.2f} dB", flush=True)
    if not taus:
        sys.exit("no note with three layers or more was found; set PIANOFIT_RECORDINGS to their folders")
    log = np.log(taus)
    median, spread = np.exp(np.median(log)), log.std(ddof=1)
    print(f"{len(taus)} notes: median {median:.2f} dB, standard deviation of the logarithm {spread:.2f}")


if __name__ == "__main__":
    with x64_scope():
        main()
