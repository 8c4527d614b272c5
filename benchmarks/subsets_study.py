"""Whether fits of some layers of a key agree with the fit of all: intervals of every parameter, minima and seeds.

    python benchmarks/subsets_study.py                         every key with four layers or more, two left out
    python benchmarks/subsets_study.py --laws hunt-crossley,soft-skin --notes C4,Ds1 --seeds 0,1,2

Subsets are fitted with the first seed, and all layers with every seed.

The recordings are those of `crossval.py`. Every subset without two of a key's layers is fitted. A parameter of a subset
agrees if its 95 % interval overlaps that of all layers. The data of a subset are part of all data. Given the subset,
the posterior mean m of a parameter therefore is a martingale, and by the law of total variance

    E[(m_all - m_subset)² | subset] = v_subset - E[v_all | subset],        v the posterior variance.

Both sides are divided by v_subset, which the subset knows, and summed over subsets. The root of their ratio is z. It is
1 for posteriors that are right, and it needs no difference of two variances of one subset.

Parameters are p, μ, M_H, x0, those of the string, and the ratios of velocities. An unknown scale of the velocities
moves μ, so μ v is compared, with the velocity v of the first layer in both. K_H, whose unit changes with p, is not
compared. Two seeds agree if every interval of all layers overlaps.
"""

from __future__ import annotations

import argparse
import itertools
import json
import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from crossval import folders, notes

if TYPE_CHECKING:
    from pianofit import Setup
    from pianofit.inference import InferenceResult

FEWEST_LAYERS = 4
LEFT_OUT = 2
# Standard deviations of a logarithm above which a parameter says nothing to compare.
UNKNOWN = 0.7
STRING = ("c", "kappa", "b1", "b2")
HAMMER = ("p", "mu", "M_H", "x0", "skin")


class Value(NamedTuple):
    """Logarithm of a parameter: posterior mean and standard deviation, and the 95 % interval."""

    mean: float
    sd: float
    low: float
    high: float


class Job(NamedTuple):
    """Fits of one key by one law from one seed."""

    key: str
    note: str
    files: list[Path]
    setup: Setup
    law: str
    seed: int
    subsets: bool  # fit them too


def values(fit: InferenceResult, names: list[str], of: list[str]) -> dict[str, Value]:
    """Parameters and ratios of velocities that subset `names` of the recordings `of` share; free ones alone."""
    u, unit = fit.problem.parametrisation, np.eye(fit.problem.parametrisation.size)
    stroke = {name: u.shared + fit.problem.structure.stroke[i] for i, name in enumerate(of)}
    first = unit[stroke[names[0]]]
    found = {name: unit[u.index_of(name)] for name in (*STRING, *HAMMER) if name in u.reported}
    found["mu"] = found["mu"] + first
    if "skin" in found:
        found["skin"] = found["skin"] - first
    found = {name: change for name, change in found.items() if u.free[u.index_of(name)]}
    found |= {f"v {name}": unit[stroke[name]] - first for name in names[1:]}
    posterior, table = fit.posterior, {}
    for name, change in found.items():
        interval = posterior.interval(change)
        if interval is not None:
            centre = posterior.mean @ change
            spread = np.einsum("i,bij,j->b", change, posterior.covariance, change)
            mean = float(posterior.weight @ centre)
            sd = float(np.sqrt(posterior.weight @ (spread + (centre - mean) ** 2)))
            table[name] = Value(mean, sd, *interval)
    return table


def study(job: Job) -> dict[str, Any]:
    """Differences of all subsets of one key from all of its layers."""
    from pianofit.analysis import analyse
    from pianofit.inference import run_inference
    from pianofit.program_folder import enable_program_cache
    from pianofit.recording.recording import load_recording

    enable_program_cache()
    recordings = [load_recording(file) for file in job.files]
    analyses = [analyse(recording, note=job.note) for recording in recordings]
    setup = replace(job.setup, felt=job.law)

    def fitted(which: tuple[int, ...]) -> tuple[InferenceResult, list[str]]:
        chosen = [recordings[i] for i in which]
        return run_inference(chosen, [analyses[i] for i in which], setup, seed=job.seed), [
            Path(recording.path).stem for recording in chosen
        ]

    everything, of = fitted(tuple(range(len(recordings))))
    rows = []
    subsets = itertools.combinations(range(len(recordings)), len(recordings) - LEFT_OUT)
    for which in subsets if job.subsets else ():
        some, names = fitted(which)
        for name, one in values(some, names, names).items():
            whole = values(everything, names, of).get(name)
            if whole is None or min(one.sd, whole.sd) > UNKNOWN:
                continue
            overlap = one.low <= whole.high and whole.low <= one.high
            rows.append(
                {
                    "parameter": name.split()[0],
                    "layers": names,
                    "change": (whole.mean - one.mean) / one.sd,
                    "variance_left": (whole.sd / one.sd) ** 2,
                    "overlap": bool(overlap),
                }
            )
    whole = {name: list(value) for name, value in values(everything, of, of).items()}
    return {"key": job.key, "law": job.law, "seed": job.seed, "all": whole, "rows": rows}


def table(results: list[dict[str, Any]], law: str) -> str:
    """Shares of overlapping intervals, z and the largest change by parameter."""
    rows = [row for result in results if result["law"] == law for row in result["rows"]]
    lines = [f"{law}: parameter   compared   overlap       z   largest change, sd of the subset"]
    for name in [*dict.fromkeys(row["parameter"] for row in rows), "all"]:
        own = [row for row in rows if name in (row["parameter"], "all")]
        change = np.array([row["change"] for row in own])
        expected = np.sum([1 - row["variance_left"] for row in own])
        share = np.mean([row["overlap"] for row in own])
        z = np.sqrt(np.sum(change**2) / expected) if expected > 0 else np.nan
        lines.append(f"{name:>22} {len(own):10d} {100 * share:8.1f} % {z:7.2f} {np.abs(change).max():9.1f}")
    return "\n".join(lines)


def agreement_of_seeds(results: list[dict[str, Any]], law: str) -> str:
    """How many parameters of all layers have overlapping intervals from every pair of seeds."""
    by_key: dict[str, list[dict]] = {}
    for result in results:
        if result["law"] == law:
            by_key.setdefault(result["key"], []).append(result["all"])
    pairs = [
        (one[name], other[name])
        for fits in by_key.values()
        for one, other in itertools.combinations(fits, 2)
        for name in one
        if name in other
    ]
    agree = sum(a[2] <= b[3] and b[2] <= a[3] for a, b in pairs)
    return f"{law}: {agree} of {len(pairs)} parameters of two seeds have overlapping intervals"


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--laws", default="soft-skin", help="separated by commas")
    parser.add_argument("--seeds", default="0", help="separated by commas")
    parser.add_argument("--notes", default="", help="only notes whose names contain one of these, separated by commas")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    wanted, laws = [n for n in options.notes.split(",") if n], options.laws.split(",")
    seeds = options.seeds.split(",")
    jobs = [
        Job(key, *note, law, int(seed), seed == seeds[0])
        for law in laws
        for folder in folders()
        for key, note in notes(folder).items()
        for seed in seeds
        if len(note[1]) >= FEWEST_LAYERS and (not wanted or any(w in key for w in wanted))
    ]
    results = []
    with ProcessPoolExecutor(options.workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        for result in pool.map(study, jobs):
            results.append(result)
            rows = result["rows"]
            if not rows:
                continue
            apart = sorted({row["parameter"] for row in rows if not row["overlap"]})
            share = 100 * np.mean([row["overlap"] for row in rows])
            print(f"{result['key']:18} {result['law']:14} seed {result['seed']}: {share:.0f} %", *apart, flush=True)
    for law in laws:
        print(table(results, law))
        if len(seeds) > 1:
            print(agreement_of_seeds(results, law))
    if options.json:
        options.json.write_text(json.dumps(results, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
