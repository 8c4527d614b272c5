"""Errors of b1 and b2 of brute-force strings, from the frequencies and decays of their recordings alone.

    python benchmarks/string_study.py                without beats
    python benchmarks/string_study.py --beats        with a second polarisation
    python benchmarks/string_study.py --range 40     with an early line over another range of the envelope, dB

The recordings are those of the brute-force cases of `coverage_twins.py` with at most `MOST` of them. The string is
fitted as a fit does before any hammer is known. Its standard deviations integrate over hyperparameters and weights.
"""

from __future__ import annotations

import argparse

import coverage_twins
import numpy as np

from pianofit.analysis import analyse, envelope_slopes
from pianofit.inference.laplace import Minima, laplace
from pianofit.inference.objective import Objective
from pianofit.inference.pipeline import fit_string
from pianofit.inference.problem import build_problem

MOST = 2  # recordings
LOSSES = ("b1", "b2")


def errors(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Errors of log b1 and log b2 of a case, and their standard deviations."""
    twin = coverage_twins.make("brute-force", seed)
    analyses = [analyse(recording, f0=twin.truth.f0) for recording in twin.recordings]
    problem = build_problem(twin.recordings, analyses, twin.setup)
    found, objective = fit_string(problem), Objective.of_string(problem)
    _, posterior = laplace(objective, Minima(found, objective.total(found), np.ones(len(found), bool)))
    at = [problem.parametrisation.index_of(name) for name in LOSSES]
    true = np.log([getattr(twin.truth.string, name) for name in LOSSES])
    return found.theta[0][at] - true, np.sqrt(np.diag(posterior.covariance[0]))[at]


def main() -> None:
    """Print a line for each case, and the summary of both parameters."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--beats", action="store_true")
    parser.add_argument("--seeds", type=int, default=100, help="cases 0 to this")
    parser.add_argument("--range", type=float, default=envelope_slopes.EARLY_RANGE, help="dB")
    options = parser.parse_args()
    envelope_slopes.EARLY_RANGE = options.range
    rows = []
    for seed in range(options.seeds):
        design = coverage_twins.design_of("brute-force", seed)
        if design.beats == options.beats and design.recordings <= MOST:
            rows.append(np.array(errors(seed)))
            cells = (f"{n} {100 * e:+.1f} ± {100 * sd:.1f} %" for n, e, sd in zip(LOSSES, *rows[-1], strict=True))
            print(f"{seed:3d} key {design.key}:", *cells, flush=True)
    for name, (error, sd) in zip(LOSSES, np.moveaxis(np.array(rows), 0, 2).swapaxes(0, 1), strict=True):
        held = int(np.sum(np.abs(error) < 1.96 * sd))
        print(
            f"{name}: rms {100 * np.sqrt(np.mean(error**2)):.1f} %, median {100 * np.median(np.abs(error)):.2f} %, "
            f"rms z {np.sqrt(np.mean((error / sd) ** 2)):.2f}, {held} of {len(sd)} intervals hold"
        )


if __name__ == "__main__":
    main()
