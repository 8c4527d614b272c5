"""Do the 95 % intervals hold the truth? Twins with known parameters, fitted one after the other.

    python benchmarks/coverage.py                  20 demo twins with the default noise, and one without any
    python benchmarks/coverage.py --brute-force    20 twins that the fit's own model did not make
    python benchmarks/coverage.py --seeds 50 --json coverage.json

For every parameter: how many intervals hold the truth; the largest miss in standard errors; the rms error; the rms of
the misses in standard errors (1 if the intervals are just right); and how often it was told to be not identifiable.
Only parameters whose status is `free` count. Every brute-force twin has a string, a hammer and a noise of its own; it
comes from a fine grid with another contact window, which shares nothing with the program (`tests/brute_force.py`).
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

import numpy as np

from pianofit.analysis import analyse
from pianofit.fit import Result, fit_recording
from pianofit.model.cache import keep_programs
from pianofit.parameters import FIT_NAMES
from pianofit.recording import load_recording
from pianofit.render import encode_wav
from pianofit.setup_file import load_setup
from pianofit.twin import make_twin, setup_text

# A 95 % interval reaches this many standard errors to either side.
REACH = 1.96


def fit_demo(seed: int, noise_db: float | None) -> tuple[Result, dict[str, float]]:
    """What `pianofit demo --seed SEED` fits, through files as there, and its true values."""
    twin = make_twin(noise_db, seed)
    with tempfile.TemporaryDirectory() as folder:
        sound, setup = Path(folder) / "twin.wav", Path(folder) / "setup.toml"
        sound.write_bytes(encode_wav(twin.samples, twin.rate))
        setup.write_text(setup_text())
        recording = load_recording(sound)
        result = fit_recording(recording, analyse(recording), load_setup(setup), seed=seed)
    return result, twin.true


def fit_brute_force(seed: int) -> tuple[Result, dict[str, float]]:
    """A random string and hammer, stepped on a fine grid, with noise 60 dB below its first second."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    from twin_cases import random_truth, record, setup_of

    truth = random_truth(seed)
    recording = record(truth, seed=seed)
    found = fit_recording(recording, analyse(recording, f0=truth.f0), setup_of(truth), seed=seed)
    return found, truth.values


def score(document: dict, true: dict[str, float]) -> dict[str, dict]:
    """By parameter: status, relative error in percent, and the miss in standard errors where there is an interval."""
    rows = {}
    for name in FIT_NAMES:
        p = document["parameters"][name]
        error = math.log(p["value"] / true[name])
        row = {"status": p["status"], "percent": 100 * math.expm1(error), "miss": None, "held": None}
        if p["interval"]:
            low, high = p["interval"]
            # Intervals are symmetric in log(value).
            row |= {"miss": error * 2 * REACH / math.log(high / low), "held": low <= true[name] <= high}
        rows[name] = row
    return rows


def table(runs: list[dict[str, dict]]) -> tuple[list[str], dict]:
    """Lines to print, and the same as data."""
    lines = [f"{'':8}{'held':>9}{'largest miss':>14}{'rms miss':>10}{'rms error':>12}{'vague':>7}{'at bound':>10}"]
    data, every = {}, defaultdict(list)
    for name in FIT_NAMES:
        rows = [run[name] for run in runs]
        free = [row for row in rows if row["status"] == "free"]
        status = [row["status"] for row in rows]
        entry = {
            "free": len(free),
            "held": sum(row["held"] for row in free),
            "largest_miss": max((abs(row["miss"]) for row in free), default=math.nan),
            "rms_miss": float(np.sqrt(np.mean([row["miss"] ** 2 for row in free]))) if free else math.nan,
            "rms_percent": float(np.sqrt(np.mean([row["percent"] ** 2 for row in rows]))),
            "not_identifiable": status.count("not-identifiable"),
            "at_bound": status.count("at-bound"),
        }
        data[name] = entry
        for key in ("free", "held", "largest_miss"):
            every[key].append(entry[key])
        lines.append(
            f"{name:8}{entry['held']:4}/{entry['free']:<4}{entry['largest_miss']:12.2f} σ{entry['rms_miss']:8.2f} σ"
            f"{entry['rms_percent']:10.2g} %{entry['not_identifiable']:7}{entry['at_bound']:10}"
        )
    free, held = sum(every["free"]), sum(every["held"])
    largest = float(np.nanmax(every["largest_miss"]))
    data["all"] = {"free": free, "held": held, "coverage": held / max(free, 1), "largest_miss": largest}
    lines.append(f"{'all':8}{held:4}/{free:<4}{largest:12.2f} σ   {100 * held / max(free, 1):.1f} % held the truth")
    return lines, data


def noise_free() -> tuple[list[str], dict]:
    """The demo without noise: how far every identifiable parameter is off."""
    result, true = fit_demo(0, None)
    rows = score(result.document, true)
    lines = [f"{name:8}{row['percent']:+10.4f} %   {row['status']}" for name, row in rows.items()]
    worst = max(abs(row["percent"]) for row in rows.values() if row["status"] == "free")
    return [*lines, f"worst of the identifiable: {worst:.4f} %"], {"parameters": rows, "worst_percent": worst}


def study(seeds: int, brute_force: bool, noise_db: float) -> tuple[list[str], dict]:
    """Fit the twins and put them into a table."""
    runs, seconds, unsettled = [], [], 0
    for seed in range(seeds):
        start = time.perf_counter()
        result, true = fit_brute_force(seed) if brute_force else fit_demo(seed, noise_db)
        seconds.append(time.perf_counter() - start)
        unsettled += not result.document["converged"]
        runs.append(score(result.document, true))
        worst = max(runs[-1], key=lambda name: abs(runs[-1][name]["miss"] or 0.0))
        miss = runs[-1][worst]["miss"] or 0.0
        print(
            f"  seed {seed:3}: {seconds[-1]:5.1f} s, largest miss {miss:+.2f} σ ({worst})", file=sys.stderr, flush=True
        )
    lines, data = table(runs)
    lines.append(f"not converged: {unsettled} of {seeds}; a twin and its fit took {statistics.median(seconds):.1f} s")
    return lines, {"table": data, "runs": runs, "not_converged": unsettled, "seconds": seconds}


def main() -> None:
    """Run what was asked for and print it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20, help="how many twins")
    parser.add_argument("--noise", type=float, default=60.0, help="of the demo twins, dB below the first second's rms")
    parser.add_argument("--brute-force", action="store_true", help="twins from the fine grid instead of the demo's")
    parser.add_argument("--json", type=Path, help="write all numbers here too")
    arguments = parser.parse_args()
    keep_programs()
    document: dict = {"seeds": arguments.seeds, "brute_force": arguments.brute_force, "noise_db": arguments.noise}
    if not arguments.brute_force:
        lines, document["noise_free"] = noise_free()
        print("The demo without noise:", *lines, "", sep="\n")
    lines, document["noisy"] = study(arguments.seeds, arguments.brute_force, arguments.noise)
    kind = "brute-force" if arguments.brute_force else "demo"
    print(f"{arguments.seeds} {kind} twins with noise:", *lines, sep="\n")
    if arguments.json:
        arguments.json.write_text(json.dumps(document, indent=1) + "\n")


if __name__ == "__main__":
    main()
