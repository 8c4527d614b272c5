"""Labelled synthetic notes: wall and CPU time of `pianofit dataset`, and where the time of one process goes.

    python benchmarks/dataset.py                     10,000 notes of 1 s over the keyboard, on all cores
    python benchmarks/dataset.py --count 1000 --profile

The first run has an empty program cache, as on a new machine. The second run has the programs of the first.
"""

from __future__ import annotations

import argparse
import cProfile
import os
import pstats
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path


def run(folder: Path, cache: Path, arguments: list[str]) -> tuple[float, float]:
    """Wall time and CPU time of the command and all its processes, s."""
    shutil.rmtree(folder, ignore_errors=True)
    began, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-m", "pianofit", "dataset", "--out", str(folder), *arguments]
    subprocess.run(command, check=True, env=os.environ | {"PIANOFIT_CACHE": str(cache)})
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return time.perf_counter() - began, cpu


def profile(count: int, seed: int) -> None:
    """Print the functions in which one process spends most time, with all programs loaded."""
    import pianofit

    list(pianofit.notes(count, seed=seed))
    profiler = cProfile.Profile()
    profiler.runcall(lambda: list(pianofit.notes(count, seed=seed)))
    pstats.Stats(profiler).sort_stats("tottime").print_stats(15)


def main() -> None:
    """Make the data set twice, and say how long it took."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--profile", action="store_true")
    options, more = parser.parse_known_args()
    arguments = ["--count", str(options.count), "--seed", str(options.seed), *more]
    print(f"load average {os.getloadavg()[0]:.1f} before the first run")
    with tempfile.TemporaryDirectory() as folder:
        for kind in ("empty program cache", "filled program cache"):
            wall, cpu = run(Path(folder) / "notes", Path(folder) / "cache", arguments)
            each = 1e3 * cpu / options.count
            print(f"{kind}: {wall:.1f} s wall, {cpu:.1f} s CPU, {each:.2f} ms CPU a note", flush=True)
    if options.profile:
        profile(min(options.count, 1000), options.seed)


if __name__ == "__main__":
    main()
