"""How the smooth deviation of a string from its model grows with the partial, decided by F of real keys.

    python benchmarks/string_deviations.py                       ../shared/recordings and ../shared/pianos
    python benchmarks/string_deviations.py --growth 0,1,2 --keys headroom-C4-close,cp80-Fs2

Every key with four layers or more is fitted for every exponent of `inference.priors.DEVIATION_GROWTH`: with all layers,
with every second one and with the others. A row has F of all layers, f0 and B with the half width of their intervals in
percent, and the differences of f0 and B between the two halves in standard deviations. The last rows have the sums of F
and the rms differences.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pianofit.conversions import HALF_WIDTH_95

if TYPE_CHECKING:
    from crossval import Setup

FOLDERS = "../shared/recordings:../shared/pianos"
FEWEST_LAYERS = 4
NAMES = ("f0", "B")


def spread(quantity) -> float:
    """Standard deviation of the logarithm."""
    low, high = quantity.interval
    return math.log(high / low) / (2 * HALF_WIDTH_95)


def measure(job: tuple[str, str, list[Path], Setup, float]) -> dict:
    """Fit one key for one exponent."""
    from dataclasses import replace

    import pianofit
    from pianofit.inference import priors
    from pianofit.program_folder import enable_program_cache

    key, note, files, setup, growth = job
    enable_program_cache()
    priors.DEVIATION_GROWTH = growth
    parts = [slice(None), slice(0, None, 2), slice(1, None, 2)]
    fits = [
        pianofit.fit(*files[part], note=note, setup=replace(setup, recordings=setup.recordings[part])) for part in parts
    ]
    whole, *halves = ({**fit.parameters, **fit.invariants} for fit in fits)
    apart = {
        name: math.log(halves[0][name].value / halves[1][name].value) / math.hypot(*(spread(x[name]) for x in halves))
        for name in NAMES
    }
    objective = min(float(minimum.negative_log_posterior) for minimum in fits[0].fit.minima)
    values = {name: (whole[name].value, 100 * HALF_WIDTH_95 * spread(whole[name])) for name in NAMES}
    return {"key": key, "growth": growth, "F": objective, "values": values, "apart": apart}


def main() -> None:
    """Print the table."""
    os.environ.setdefault("PIANOFIT_RECORDINGS", FOLDERS)
    from crossval import folders, notes

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--growth", default="0,1,2,3", help="exponents, separated by commas")
    parser.add_argument("--keys", help="only these keys, separated by commas")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    options = parser.parse_args()
    exponents = [float(x) for x in options.growth.split(",")]
    wanted = options.keys and options.keys.split(",")
    jobs = [
        (key, *found, growth)
        for folder in folders()
        for key, found in notes(folder).items()
        if len(found[1]) >= FEWEST_LAYERS and (not wanted or key in wanted)
        for growth in exponents
    ]
    rows = []
    with ProcessPoolExecutor(options.workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        for row in pool.map(measure, jobs):
            rows.append(row)
            cells = [f"{name} {v:.5g} ± {p:.2f} %, {row['apart'][name]:+.1f}" for name, (v, p) in row["values"].items()]
            print(f"{row['key']:22} growth {row['growth']:g}  F {row['F']:7.1f}  {'  '.join(cells)}", flush=True)
    for growth in exponents:
        own = [row for row in rows if row["growth"] == growth]
        apart = [f"{name} {np.sqrt(np.mean([row['apart'][name] ** 2 for row in own])):.2f}" for name in NAMES]
        print(f"{'all':22} growth {growth:g}  F {sum(row['F'] for row in own):7.1f}  rms of z: {', '.join(apart)}")


if __name__ == "__main__":
    main()
