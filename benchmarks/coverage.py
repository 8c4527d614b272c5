"""Do the 95 % intervals hold the truth? Twins with known parameters, fitted, and counted.

    python benchmarks/coverage.py                              20 demo twins, and one without any noise
    python benchmarks/coverage.py --twins model --seeds 100    strings, hammers, paths and 1 to 5 takes drawn at random
    python benchmarks/coverage.py --twins brute-force --seeds 100 --json coverage.json

How the last two are made is in `coverage_twins.py`. For every parameter: how many intervals hold the truth; the largest
miss and the rms of the misses in standard errors (1 if the intervals are just right); the rms error; and how often it
was told to be not identifiable or at a bound. Only parameters whose status is `free` count. `takes' v_H0` are the
velocities of the takes beside the first.

A search can also end in another basin, and then no interval about its end holds the truth. So every twin is fitted once
more from the truth, on the same residuals: if the cost there is lower by more than `DEEPER`, the basin was missed, and
the table is printed without such twins too.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

import numpy as np

REACH = 1.96  # standard errors to either side of a 95 % interval
DEEPER = 1.0  # half a sum of squares of residuals
KINDS = ("demo", "model", "brute-force")
TAKES = "takes' v_H0"
FOUR = 4.0
HEADING = f"{'':14}{'held':>9}{'':9}{'largest miss':>14}{'rms miss':>10}{'rms error':>12}{'vague':>7}{'at bound':>10}"


def judge(job: tuple[str, int, float]) -> dict:
    """Make one twin, fit it and score it; a twin that is refused says why."""
    from pianofit.errors import PianofitError
    from pianofit.model.cache import keep_programs

    kind, seed, noise_db = job
    keep_programs()
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

    from pianofit.analysis import analyse
    from pianofit.fit import fit_recording
    from pianofit.recording import load_recording
    from pianofit.render import encode_wav
    from pianofit.setup_file import load_setup
    from pianofit.twin import make_twin, setup_text

    twin = make_twin(noise_db, seed)
    with tempfile.TemporaryDirectory() as folder:
        sound, setup = Path(folder) / "twin.wav", Path(folder) / "setup.toml"
        sound.write_bytes(encode_wav(twin.samples, twin.rate))
        setup.write_text(setup_text())
        recording = load_recording(sound)
        result = fit_recording(recording, analyse(recording), load_setup(setup), seed=seed)
    cell = {"takes": 1, "calibrated": True, "deeper": None}
    return cell | {"rows": score(result.document, twin.true, []), "converged": result.document["converged"]}


def _drawn(kind: str, seed: int) -> dict:
    """One twin of `coverage_twins`, by the same steps as `fit_takes`, which keep the search's own state."""
    import coverage_twins

    from pianofit.analysis import analyse
    from pianofit.fit.recipe import fit_partials
    from pianofit.fit.result import conclude
    from pianofit.fit.takes import arranged

    twin = coverage_twins.make(kind, seed)
    about = {**twin.design._asdict(), "truth": _plain(twin)}
    try:
        analyses = [analyse(recording, f0=twin.truth.f0) for recording in twin.recordings]
        takes, start, layout, order = arranged(twin.recordings, analyses, twin.setup, None)
        fit = fit_partials(takes, start, layout, seed=seed)
        document = conclude(takes, start, fit, seed, order).document
    except Exception as error:
        from pianofit.errors import PianofitError

        if not isinstance(error, PianofitError):
            raise
        return about | {"refused": str(error)}
    gained = gain_from_truth(fit, twin.values, [twin.truth.velocities[i] for i in order])
    return about | {
        "rows": score(document, twin.values, list(twin.truth.velocities)),
        "deeper": gained, "converged": document["converged"], "agreeing": document["diagnostics"]["agreeing_starts"],
        "partials": document["diagnostics"]["partials"], "scatter": document["diagnostics"]["scatter"],
        "verdict": document["verdict"],
    }  # fmt: skip


def _plain(twin) -> dict:
    truth = twin.truth
    return twin.values | {
        "f0": truth.f0, "velocities": truth.velocities, "noise_db": truth.noise_db, "rough_db": truth.rough_db,
        "glide_cents": truth.glide_cents, "beat_cents": truth.beat_cents, "beat_level": truth.beat_level,
        "M_S": truth.geometry.mass, "L": truth.geometry.length,
    }  # fmt: skip


def gain_from_truth(fit, true: dict, velocities: list[float]) -> float:
    """How much lower the cost is where a descent from the truth ends, on the fit's own residuals; ≤ 0 if nowhere.

    `velocities` are of the takes as the fit has them. Path and gains go down first: they are not part of the truth.
    """
    import jax.numpy as jnp

    from pianofit.fit.levenberg import descend
    from pianofit.fit.residuals import joint_batch
    from pianofit.fit.space import LOG, NAMES

    space, layout = fit.space, fit.data.layout
    values = fit.values.copy()
    for i, name in enumerate(NAMES):
        values[i] = nearest(true.get(name, values[i]), values[i]) if space.free[i] else values[i]
    first = velocities[0] if space.free[NAMES.index("v_H0")] else float(values[NAMES.index("v_H0")])
    values[NAMES.index("v_H0")] = first
    values[layout.ratio] = np.log(np.array(velocities) / velocities[0])
    index = np.arange(layout.size)
    path = (index >= LOG) & ~np.isin(index, layout.ratio)

    def evaluate(z):
        return joint_batch(jnp.asarray(z), fit.target, fit.cfg)

    z = space.z(values[None])
    if (space.free & path).any():
        z = descend(evaluate, z, space, iterations=20, free=path, tolerance=1e-6).z
    return fit.cost - float(descend(evaluate, z, space, iterations=60, tolerance=1e-8).cost[0])


def score(document: dict, true: dict, velocities: list[float]) -> list[dict]:
    """A row by parameter and take: status, relative error in percent, and the miss in standard errors."""
    table = document["parameters"]
    rows = [
        _row(name, table[name]["value"], table[name]["interval"], table[name]["status"], true[name])
        for name in true
        if name in table
    ]
    for take, v in zip(document["takes"], velocities, strict=False):
        if not take["first"]:
            rows.append(_row(TAKES, take["v_H0"], take["v_H0_interval"], take["v_H0_status"], v))
    return rows


def nearest(true: float | tuple[float, float], value: float) -> float:
    """The truth, or of a range of truths the one next to `value`."""
    return min(max(value, true[0]), true[1]) if isinstance(true, tuple) else true


def _row(name: str, value: float, interval, status: str, true: float | tuple[float, float]) -> dict:
    true = nearest(true, value)
    error = math.log(value / true)
    row = {"name": name, "status": status, "percent": 100 * math.expm1(error), "miss": None, "held": None}
    if interval:
        low, high = interval
        # Intervals are symmetric in log(value).
        row |= {"miss": error * 2 * REACH / math.log(high / low), "held": bool(low <= true <= high)}
        row["width_percent"] = 100 * (math.sqrt(high / low) - 1)
    return row


def table(runs: list[dict]) -> tuple[list[str], dict]:
    """Lines to print, and the same as data: every parameter, and all together by cell."""
    rows = [row for run in runs for row in run["rows"]]
    lines, data = [HEADING], {}
    for name in dict.fromkeys(row["name"] for row in rows):
        data[name] = entry(row for row in rows if row["name"] == name)
        lines.append(line(name, data[name]))
    data["all"] = entry(rows)
    lines.append(line("all", data["all"]))
    cells = dict.fromkeys((run["takes"], run["calibrated"]) for run in runs)
    if len(cells) > 1:
        for takes, calibrated in sorted(cells):
            name = f"{takes} take{'s' * (takes > 1)}, {'cal' if calibrated else 'path'}"
            mine = [run for run in runs if (run["takes"], run["calibrated"]) == (takes, calibrated)]
            data[name] = entry(row for run in mine for row in run["rows"])
            lines.append(line(name, data[name]))
    for name in ("glide", "beats"):
        mine = [run for run in runs if run.get(name)]
        if mine:
            data[name] = entry(row for run in mine for row in run["rows"])
            lines.append(line(name, data[name]))
    plain = [run for run in runs if not (run.get("glide") or run.get("beats"))]
    if 0 < len(plain) < len(runs):
        data["neither"] = entry(row for run in plain for row in run["rows"])
        lines.append(line("neither", data["neither"]))
    return lines, data


def entry(rows) -> dict:
    """Counts and sizes of some rows."""
    rows = list(rows)
    free = [row for row in rows if row["status"] == "free" and row["held"] is not None]
    misses = [abs(row["miss"]) for row in free]
    status = [row["status"] for row in rows]
    return {
        "free": len(free),
        "held": sum(row["held"] for row in free),
        "coverage": sum(row["held"] for row in free) / len(free) if free else math.nan,
        "largest_miss": max(misses, default=math.nan),
        "beyond_four": sum(miss > FOUR for miss in misses),
        "rms_miss": float(np.sqrt(np.mean(np.square(misses)))) if free else math.nan,
        "rms_percent": float(np.sqrt(np.mean([row["percent"] ** 2 for row in free]))) if free else math.nan,
        "not_identifiable": status.count("not-identifiable"),
        "at_bound": status.count("at-bound"),
    }


def line(name: str, e: dict) -> str:
    """One entry as a line."""
    return (
        f"{name:14}{e['held']:4}/{e['free']:<4}{100 * e['coverage']:7.1f} %{e['largest_miss']:12.2f} σ"
        f"{e['rms_miss']:8.2f} σ{e['rms_percent']:10.2g} %{e['not_identifiable']:7}{e['at_bound']:10}"
    )


def fitted_before(file: Path | None, kind: str) -> dict[int, dict]:
    """Twins of a study that was cut off, by seed."""
    if file is None or not file.exists():
        return {}
    runs = [json.loads(text) for text in file.read_text(encoding="utf-8").splitlines()]
    return {run["seed"]: run for run in runs if run["kind"] == kind}


def fitted(jobs: list[tuple[str, int, float]], workers: int, file: Path | None) -> list[dict]:
    """All twins, on some processes at once; each goes into `file` when it is done, and is not fitted again."""
    runs = fitted_before(file, jobs[0][0])
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        for done in as_completed([pool.submit(judge, job) for job in jobs if job[1] not in runs]):
            run = done.result()
            runs[run["seed"]] = run
            print(progress(run), file=sys.stderr, flush=True)
            if file:
                with file.open("a", encoding="utf-8") as lines:
                    lines.write(json.dumps(run) + "\n")
    return [runs[job[1]] for job in jobs]


def report(runs: list[dict]) -> tuple[list[str], dict]:
    """Tables of the twins that were fitted, and what became of the others."""
    found = [run for run in runs if "rows" in run]
    lines, data = table(found)
    document = {"table": data}
    missed = [run for run in found if (run["deeper"] or 0.0) > DEEPER]
    if missed:
        lines.append(f"\nwithout {len(missed)} twins whose cost is lower at the truth:")
        more, document["right_basin"] = table([run for run in found if run not in missed])
        lines += more
    unsettled = sum(not run["converged"] for run in found)
    lines += ["", f"fitted {len(found)} of {len(runs)}; not converged: {unsettled}; another basin: {len(missed)}"]
    lines += [f"refused, seed {run['seed']}: {run['refused']}" for run in runs if "refused" in run]
    return lines, document | {"runs": runs}


def progress(run: dict) -> str:
    """What is told while the twins are fitted."""
    head = f"  {run['kind']} {run['seed']:3}: {run['seconds']:5.1f} s, "
    if "rows" not in run:
        return head + "refused: " + run["refused"]
    scored = [row for row in run["rows"] if row["status"] == "free" and row["held"] is not None]
    if not scored:
        return head + "nothing free"
    worst = max(scored, key=lambda row: abs(row["miss"]))
    basin = ", another basin" if (run["deeper"] or 0.0) > DEEPER else ""
    cell = f"{run['takes']} take{'s' * (run['takes'] > 1)}, {'calibrated' if run['calibrated'] else 'path'}"
    return f"{head}{cell}, largest miss {worst['miss']:+.2f} σ ({worst['name']}){basin}"


def noise_free() -> tuple[list[str], dict]:
    """The demo without noise: how far every identifiable parameter is off."""
    rows = _demo(0, None)["rows"]
    lines = [f"{row['name']:8}{row['percent']:+10.4f} %   {row['status']}" for row in rows]
    worst = max(abs(row["percent"]) for row in rows if row["status"] == "free")
    return [*lines, f"worst of the identifiable: {worst:.4f} %"], {"parameters": rows, "worst_percent": worst}


def main() -> None:
    """Run what was asked for and print it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--twins", choices=KINDS, default="demo")
    parser.add_argument("--seeds", type=int, default=20, help="how many twins")
    parser.add_argument("--first", type=int, default=0, help="seed of the first twin")
    parser.add_argument("--noise", type=float, default=60.0, help="of the demo twins, dB below the first second's rms")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes; one twin is one job")
    parser.add_argument("--keep", type=Path, help="a file of twins already fitted, a line each; a study goes on there")
    parser.add_argument("--json", type=Path, help="write all numbers here too")
    options = parser.parse_args()
    document: dict = {"twins": options.twins, "seeds": options.seeds, "first": options.first}
    if options.twins == "demo":
        lines, document["noise_free"] = noise_free()
        print("The demo without noise:", *lines, "", sep="\n")
    jobs = [(options.twins, seed, options.noise) for seed in range(options.first, options.first + options.seeds)]
    lines, more = report(fitted(jobs, options.workers, options.keep))
    print(f"{options.seeds} {options.twins} twins:", *lines, sep="\n")
    if options.json:
        options.json.write_text(json.dumps(document | more, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
