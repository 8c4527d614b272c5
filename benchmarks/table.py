"""Speed, measured side by side: one command, one table.

    python benchmarks/table.py --json benchmarks/results.json --docs docs/performance.md
    python benchmarks/table.py --quick                    seconds, for trying out; its numbers mean nothing

Everything runs in turn with what it is compared with, medians of paired runs count; whole commands run in processes of
their own with a cache folder of their own. All sounds are made by the program. Needs numba (`pip install -e
".[bench]"`); a row whose tool is not installed (csound, perf) says so.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import baseline
import growth
import made
import performance_page
import works
from accelerator import measure_accelerator
from measuring import command, load, machine, paired, summed

HERE = Path(__file__).resolve().parent
EVALUATIONS = 20_000


class Effort(NamedTuple):
    """How often things are done."""

    rounds: int
    least: float  # s
    commands: int  # rounds of warm commands
    cold: int
    seconds: float  # of the notes
    recordings: int
    evaluations: int


FULL = Effort(9, 0.2, 3, 2, 6.0, 5, EVALUATIONS)
QUICK = Effort(2, 0.0, 1, 1, 1.5, 2, 1000)


def inner(effort: Effort, folder: Path) -> dict[str, Any]:
    """The rows that need no process of their own."""
    groups: dict[str, Callable[[], works.Works]] = {
        "strike": works.strikes, "criterion": works.criteria, "candidates": works.candidates, "sound": works.sounds,
        "plain scan": works.plain_scan,
    }  # fmt: skip
    found: dict[str, Any] = {}
    for name, make in groups.items():
        _say(name)
        found[name] = paired(make(), rounds=effort.rounds, least=effort.least)
    _say("search of a fit")
    files = made.make_notes(folder, made.VELOCITIES[3:4], effort.seconds)
    work, sizes = works.search(files, made.NOTE)
    found["search"] = paired(work, rounds=effort.rounds, least=effort.least)
    return found | {"search sizes": sizes, "shares of a fit": works.shares(files[0], made.NOTE)}


def commands(effort: Effort, folder: Path) -> dict[str, Any]:
    """Whole commands, warm ones in turn: seconds and the largest memory."""
    files = [str(x) for x in made.make_notes(folder, made.VELOCITIES[-effort.recordings :], effort.seconds)]
    twin, setup = made.make_measurement(folder)
    out = ["--out", str(folder / "out"), "--force"]
    note = ["--note", made.NOTE]
    paper = ["fit", str(twin), "--setup", str(setup), "--recipe", "paper", "--evaluations", str(effort.evaluations)]
    warm = {
        "--help": ["--help"],
        "fit": ["fit", files[-1], *note, *out, "--no-page"],
        "fit with page": ["fit", files[-1], *note, *out],
        "joint fit": ["fit", *files, *note, *out, "--no-page"],
        "paper's recipe": [*paper, *out, "--no-page"],
    }
    taken: dict[str, list[dict[str, float]]] = {name: [] for name in (*warm, "fit, cold")}
    cache = folder / "cache"
    for name, arguments in warm.items():
        _say(f"{name}, once to fill the caches")
        command(arguments, cache)
    for turn in range(max(effort.commands, effort.cold)):
        for name, arguments in warm.items() if turn < effort.commands else ():
            _say(f"{name}, warm")
            taken[name].append(command(arguments, cache))
        if turn < effort.cold:
            _say("fit, cold")
            with tempfile.TemporaryDirectory() as empty:
                taken["fit, cold"].append(command(warm["fit"], Path(empty)))
    return {
        name: summed([x["seconds"] for x in runs]) | {"memory_MB": max(x["memory_MB"] for x in runs)}
        for name, runs in taken.items()
    }


def counted() -> dict[str, Any]:
    """What a fit does, in numbers that no machine changes; see `counts.py`."""
    _say("counts")
    done = subprocess.run([sys.executable, str(HERE / "counts.py")], capture_output=True, check=True, text=True)
    return json.loads(done.stdout)


def instructions(steps: int = works.STEPS, batch: int = 64) -> dict[str, Any]:
    """Per step and candidate of the contact: what XLA says it computes, and what perf counts where it can.

    XLA counts the body of a loop once, so Newton's iterations count as one.
    """
    import jax

    _say("instructions")
    many = works.hammers(batch)
    analysis = jax.jit(works.contact_batch()).lower(many).compile().cost_analysis() or {}
    found: dict[str, Any] = {"operations XLA counts in the program": analysis.get("flops"), "perf": None}
    if shutil.which("perf") is None:
        return found
    script = "import sys; sys.path.insert(0, sys.argv[1]); import works, jax; run = works.contact_batch()\n"
    script += f"many = works.hammers({batch})\nfor _ in range(int(sys.argv[2])): jax.block_until_ready(run(many))"
    fewer, more = (_perf([sys.executable, "-c", script, str(HERE), str(times)]) for times in (20, 220))
    if fewer is not None and more is not None:
        found["perf"] = (more - fewer) / 200 / steps / batch
    return found


def _perf(arguments: list[str]) -> float | None:
    done = subprocess.run(
        ["perf", "stat", "-x", ",", "-e", "instructions:u", *arguments], capture_output=True, text=True, check=False,
        env=os.environ | {"JAX_PLATFORMS": "cpu"},
    )  # fmt: skip
    first = next((line.split(",")[0] for line in done.stderr.splitlines() if "instructions" in line), "")
    return float(first) if first.replace(".", "").isdigit() else None


def measured(effort: Effort) -> dict[str, Any]:
    """The whole table as one document."""
    document: dict[str, Any] = {"machine": machine(), "effort": effort._asdict()}
    document["baseline off reference.py"] = baseline.check()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        # Commands first: nothing else of this process is in their way.
        document["commands"] = commands(effort, folder)
        document["counts"] = counted()
        document["inner"] = inner(effort, folder)
        document["growth"] = growth.measured(folder, quick=effort is QUICK, say=_say)
    document["instructions"] = instructions()
    _say("accelerator")
    document["accelerator"] = measure_accelerator()
    document["machine"]["load after"] = load()
    return document


def printed(document: dict[str, Any]) -> str:
    """The table for a terminal."""
    m = document["machine"]
    lines = [f"{m['processor']}, {m['cores']} cores, load {m['load']} before and {m['load after']} after"]
    for group, works_ in document["inner"].items():
        for name, x in works_.items() if not group.endswith(("sizes", "fit")) else ():
            lines.append(f"{group:14} {name:40} {1e3 * x['median']:10.3f} ms, at best {1e3 * x['fastest']:.3f}")
    for name, x in document["commands"].items():
        lines.append(f"{'command':14} {name:40} {x['median']:10.2f} s   {x['memory_MB']:.0f} MB")
    for name, x in document["counts"].items():
        lines.append(f"{'counts':14} {name:40} {x:10g}")
    return "\n".join(lines)


def _say(what: str) -> None:
    if sys.stderr.isatty():
        print(f"\r\x1b[K{what} ...", end="", file=sys.stderr, flush=True)


def main() -> None:
    """Measure, print, and write what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write all numbers here")
    parser.add_argument("--docs", type=Path, help="fill in this page of documentation and write its picture there")
    parser.add_argument("--from", dest="source", type=Path, help="measure nothing: take the numbers of an earlier run")
    parser.add_argument("--quick", action="store_true", help="as little as possible of everything")
    arguments = parser.parse_args()
    if arguments.source:
        document = json.loads(arguments.source.read_text())
    else:
        document = measured(QUICK if arguments.quick else FULL)
    if sys.stderr.isatty():
        print("\r\x1b[K", end="", file=sys.stderr)
    print(printed(document))
    if arguments.json:
        arguments.json.write_text(json.dumps(document, indent=1) + "\n")
    if arguments.docs:
        performance_page.write(document, arguments.docs)


if __name__ == "__main__":
    main()
