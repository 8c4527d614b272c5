"""Whether the intervals of fits of plucked strings hold the truth, over synthetic plucks by the brute-force witness.

    python benchmarks/pluck_coverage.py [--cases 10] [--first 0]

Each seed gives three cases (`tests/pluck_cases.py`): a microphone behind a rough body and room, a magnetic pickup whose
position is given, and one whose position is searched. The table has the number of 95 % intervals and the percentage of
them that hold the truth, the rms error in standard deviations of the logarithm by the half interval, and the largest
one. A plucking position in an interval of several minima has no single standard deviation, so its errors are relative
to half of the whole interval.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

from pianofit import fit
from pianofit.conversions import HALF_WIDTH_95
from pianofit.program_folder import enable_program_cache

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from pluck_cases import Case, draw

KINDS = {
    "microphone": ("pressure", True),
    "pickup, given": ("magnetic-pickup", True),
    "pickup, searched": ("magnetic-pickup", False),
}


def rows(case: Case) -> list[tuple[str, bool, float]]:
    """Name, whether the interval holds the truth, and the error in standard deviations, of all fitted values."""
    result = fit(*case.recordings, setup=case.setup, progress=False)
    found = []
    for name, true in case.true.items():
        quantity = result.parameters.get(name)
        if quantity is not None and quantity.interval is not None:
            found.append((name, quantity.interval, true))
    length = case.setup.length
    for recording, position in zip(result.fit.recordings, case.positions, strict=True):
        if recording.stroke_interval is not None and length is not None:
            found.append(("x0", recording.stroke_interval, position * length))
    return [(name, low <= true <= high, _error(low, high, true)) for name, (low, high), true in found]


def _error(low: float, high: float, true: float) -> float:
    middle, half = np.log(low * high) / 2, np.log(high / low) / 2
    return float((np.log(true) - middle) / half * HALF_WIDTH_95)


def main() -> None:
    """Fit all cases and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=10, help="seeds of each kind")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    options = parser.parse_args()
    enable_program_cache()
    began = time.perf_counter()
    for kind, (quantity, known) in KINDS.items():
        z: dict[str, list[tuple[bool, float]]] = {}
        for seed in range(options.first, options.first + options.cases):
            for name, holds, error in rows(draw(seed, quantity, pickup_known=known)):
                z.setdefault(name, []).append((holds, error))
                if not holds:
                    print(f"  seed {seed}: {name} {error:+.1f}", file=sys.stderr)
        print(f"{kind:18}{'intervals':>10}{'hold':>8}{'rms z':>7}{'worst':>7}")
        for name, values in [*z.items(), ("all", [value for own in z.values() for value in own])]:
            held, errors = (np.array(x, float) for x in zip(*values, strict=True))
            rms, worst = np.sqrt(np.mean(errors**2)), np.abs(errors).max()
            print(f"  {name:16}{len(held):10d}{100 * held.mean():7.1f}%{rms:7.2f}{worst:7.1f}", flush=True)
    print(f"{time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
