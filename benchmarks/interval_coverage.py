"""Coverage of the 95 % intervals: synthetic recordings with known parameters, fitted and counted.

    python benchmarks/interval_coverage.py                              20 demo cases, and one without any noise
    python benchmarks/interval_coverage.py --kind model --seeds 100    random strings, hammers, paths and strokes
    python benchmarks/interval_coverage.py --kind brute-force --seeds 100 --keep runs.jsonl --page docs/coverage.md
    python benchmarks/interval_coverage.py --kind same-window --seeds 50   the same, with the program's contact window

An interrupted study continues with the same `--keep`.

`coverage_twins.py` makes the last three. For every parameter the table has the number of intervals that hold the true
value; the largest miss and the rms of the misses in standard errors (1 if the intervals are just right); the rms error
and the median of its size; and how often it was not identifiable or at a bound. Only parameters with the status
`fitted` count. `others' v_H0` are the velocities of the recordings that are not the reference.

A search can also end in another minimum, and an interval around it need not hold the true value. So every case is also
minimised from the true values, with the same F. If that minimum is lower by more than `DEEPER`, the search missed it.
The table is then repeated without these cases.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from coverage_table import STATUS, nearest, progress, report, score
from measuring import into_page

if TYPE_CHECKING:
    from coverage_twins import Values

    from pianofit.inference import FitProblem, Minima

KINDS = ("demo", "model", "brute-force", "same-window")
# Cases of one process. What it compiles stays mapped, and an operating system allows only so many mappings. Pools that
# replace their workers (`max_tasks_per_child`) hang in Python 3.11.
JOBS = 10


def judge(job: tuple[str, int, float]) -> dict:
    """Make one case, fit it and score it; a case that is refused has the reason."""
    from pianofit.errors import PianofitError
    from pianofit.program_folder import enable_program_cache

    kind, seed, noise_db = job
    enable_program_cache()
    begun = time.perf_counter()
    about = {"kind": kind, "seed": seed}
    try:
        found = _demo(seed, noise_db) if kind == "demo" else _drawn(kind, seed)
    except PianofitError as error:
        found = {"refused": str(error)}
    return about | found | {"seconds": time.perf_counter() - begun}


def _demo(seed: int, noise_db: float | None) -> dict:
    """What `pianofit demo --seed SEED` fits, through files as there."""
    import tempfile

    from pianofit.fitting import fit
    from pianofit.io.files import write_wav
    from pianofit.synthetic import demo_recording, setup_text

    twin = demo_recording(noise_db, seed)
    with tempfile.TemporaryDirectory() as folder:
        sound, setup = Path(folder) / "synthetic.wav", Path(folder) / "setup.toml"
        write_wav(sound, twin.samples, twin.rate)
        setup.write_text(setup_text(twin.setup))
        result = fit(sound, setup=setup, seed=seed, progress=False)
    cell = {"recordings": 1, "calibrated": True, "deeper": None}
    return cell | {"rows": score(result.fit, twin.true, []), "converged": result.fit.converged}


def _drawn(kind: str, seed: int) -> dict:
    """One case of `coverage_twins`, with the problem and its minima."""
    import coverage_twins

    from pianofit.analysis import analyse
    from pianofit.errors import PianofitError
    from pianofit.inference import run_inference
    from pianofit.result import build_result
    from pianofit.schema.decode import builtins_of

    twin = coverage_twins.make(kind, seed)
    about = {**twin.design._asdict(), "truth": _plain(twin)}
    try:
        analyses = [analyse(recording, f0=twin.truth.f0) for recording in twin.recordings]
        fit = run_inference(twin.recordings, analyses, twin.setup, seed=seed)
        problem, found, record = fit.problem, fit.estimate, build_result(fit).fit
    except PianofitError as error:
        return about | {"refused": str(error)}
    true = coverage_twins.values_of(kind, twin.truth, problem.reference)
    diagnostics = record.diagnostics
    return about | {
        "rows": score(record, true, list(twin.truth.velocities)), "reference": problem.reference,
        "deeper": gain_from_truth(problem, found.minima, true, twin.truth.velocities),
        "converged": record.converged, "partials": diagnostics.partials, "excess": builtins_of(diagnostics.excess_sd),
        "shares": [minimum.weight for minimum in record.minima], "claims": record.identifiability_statement,
    }  # fmt: skip


def _plain(twin) -> dict:
    truth = twin.truth
    return twin.values | {
        "f0": truth.f0, "velocities": truth.velocities, "noise_db": truth.noise_db, "rough_db": truth.rough_db,
        "glide_cents": truth.glide_cents, "beat_cents": truth.beat_cents, "beat_level": truth.beat_level,
        "M_S": truth.geometry.mass, "L": truth.geometry.length,
    }  # fmt: skip


def gain_from_truth(problem: FitProblem, minima: Minima, true: Values, velocities: Sequence[float]) -> float | None:
    """How much lower F is at the minimum that a descent from the truth finds; at most 0 if the search found it too.

    None if a contact of the true hammer does not end in the fit's steps. Gains and paths are no part of a point: F
    has integrated them out. Hyperparameters and weights begin as the best minimum has them.

    Parameters
    ----------
    velocities : m/s, of every recording; each is of a stroke of its own.
    """
    from pianofit.errors import FitError
    from pianofit.inference.objective import Objective
    from pianofit.inference.pipeline import ITERATIONS, refine

    best = minima.candidates.take(np.array([0]))
    z = point_of(problem, best.theta[0], true, velocities)
    try:
        end = refine(Objective.complete(problem), z[None], best.phi, best.w, ITERATIONS)
    except FitError:
        return None
    return float(minima.nll.min() - end.nll[0])


def point_of(problem: FitProblem, best: np.ndarray, true: Values, velocities: Sequence[float]) -> np.ndarray:
    """The truth as a point of the search [size]; what has no truth, and what is held, is as in `best`."""
    u = problem.parametrisation
    values = np.exp(u.log_values(best))
    values[u.shared :] = velocities
    named = {name: i for i, name in enumerate(u.names)}
    for name, value in true.items():
        if name in named:
            values[named[name]] = nearest(value, values[named[name]])
    return u.project(np.where(u.free, u.from_log_values(np.log(values)), best))


def fitted_before(file: Path | None, kind: str) -> dict[int, dict]:
    """Twins of a study that was cut off, by seed."""
    if file is None or not file.exists():
        return {}
    runs = [json.loads(text) for text in file.read_text(encoding="utf-8").splitlines()]
    return {run["seed"]: run for run in runs if run["kind"] == kind}


def fitted(jobs: list[tuple[str, int, float]], workers: int, file: Path | None) -> list[dict]:
    """All cases, on some processes at once; each goes into `file` when it is done, and is not fitted again."""
    runs = fitted_before(file, jobs[0][0])
    left = [job for job in jobs if job[1] not in runs]
    for first in range(0, len(left), JOBS * workers):
        with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
            for done in as_completed([pool.submit(judge, job) for job in left[first : first + JOBS * workers]]):
                run = done.result()
                runs[run["seed"]] = run
                print(progress(run), file=sys.stderr, flush=True)
                if file:
                    with file.open("a", encoding="utf-8") as lines:
                        lines.write(json.dumps(run) + "\n")
    return [runs[job[1]] for job in jobs]


def noise_free() -> tuple[list[str], dict]:
    """The demo without noise: how far every identifiable parameter is off."""
    rows = _demo(0, None)["rows"]
    lines = [f"{row['name']:8}{row['percent']:+10.4f} %   {row['status']}" for row in rows]
    worst = max(abs(row["percent"]) for row in rows if row["status"] == STATUS)
    return [*lines, f"worst of the identifiable: {worst:.4f} %"], {"parameters": rows, "worst_percent": worst}


def main() -> None:
    """Run what was asked for and print it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kind", choices=KINDS, default="demo")
    parser.add_argument("--seeds", type=int, default=20, help="number of cases")
    parser.add_argument("--first", type=int, default=0, help="seed of the first case")
    parser.add_argument("--noise", type=float, default=60.0, help="of the demo cases, dB below the first second's rms")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes; one case is one job")
    parser.add_argument("--keep", type=Path, help="a file of fitted cases, a line each; a study continues there")
    parser.add_argument("--page", type=Path, help="put what is printed into this page, under this kind of cases")
    parser.add_argument("--json", type=Path, help="write all numbers here too")
    options = parser.parse_args()
    document: dict = {"twins": options.kind, "seeds": options.seeds, "first": options.first}
    if options.kind == "demo":
        lines, document["noise_free"] = noise_free()
        print("The demo without noise:", *lines, "", sep="\n")
    jobs = [(options.kind, seed, options.noise) for seed in range(options.first, options.first + options.seeds)]
    lines, more = report(fitted(jobs, options.workers, options.keep))
    lines = [f"{options.seeds} {options.kind} cases:", *lines]
    print(*lines, sep="\n")
    if options.page:
        into_page(options.page, options.kind, ["```text", *lines, "```"])
    if options.json:
        options.json.write_text(json.dumps(document | more, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
