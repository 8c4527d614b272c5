"""Whether the intervals of damper fits hold the truth, over synthetic notes that are let go.

    python benchmarks/damper_coverage.py [--cases 120] [--first 1000]

A case (`tests/damper_cases.py`) draws a key from E1 to C6 with the string of the literature, two components of each
partial that beat, a damper of known rate (20 to 67 1/s at partial 1) and slope (-0.1 to 0.4), a release 0.4 to 2 s
after the onset, and noise 70 dB below the peak. The table shows the percentage of 95 % intervals that hold the truth,
the rms error in standard deviations and the largest one, for the rate and the slope of the key and the rates of its
partials.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

from pianofit import AnalysisError
from pianofit.analysis.damper import fit_damper
from pianofit.conversions import HALF_WIDTH_95

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from damper_cases import RATE, released


def main() -> None:
    """Fit all cases and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=120, help="number of notes")
    parser.add_argument("--first", type=int, default=1000, help="seed of the first")
    options = parser.parse_args()
    z: dict[str, list[float]] = {"rate of the key": [], "slope of the key": [], "rates of partials": []}
    refused, began = 0, time.perf_counter()
    for seed in range(options.first, options.first + options.cases):
        case = released(seed)
        try:
            fit = fit_damper((case.samples, RATE), case.note)
        except AnalysisError as error:
            refused += 1
            print(f"seed {seed}, {case.note}: {error}")
            continue
        sd = np.sqrt(np.diag(fit.covariance))
        z["rate of the key"].append(float((fit.log_rate - np.log(case.rate)) / sd[0]))
        z["slope of the key"].append(float((fit.slope - case.slope) / sd[1]))
        truth = case.rate * (fit.frequency / fit.f1) ** case.slope
        z["rates of partials"] += ((fit.rate - truth) / fit.rate_error).tolist()
    print(f"{options.cases} cases, {refused} refused, {time.perf_counter() - began:.0f} s")
    for name, values in z.items():
        size = np.abs(values)
        held, rms = 100 * np.mean(size < HALF_WIDTH_95), np.sqrt(np.mean(np.square(size)))
        print(f"{name:20}{len(size):6} intervals, {held:5.1f} % hold, rms {rms:.2f}, largest {size.max():.1f}")


if __name__ == "__main__":
    main()
