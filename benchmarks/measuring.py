"""How everything is timed: works in turn, whole commands in processes of their own, and what the machine is.

And how tables come into a page of the docs.
"""

from __future__ import annotations

import importlib.metadata
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pianofit.model.modal_response import ModalResponse
    from pianofit.result import Result

COMMAND = "from pianofit.cli import run; run()"
# Seconds and the largest memory of a process, in the system's unit.
LAUNCHER = """
import os, subprocess, sys, time
start = time.perf_counter()
child = subprocess.Popen(sys.argv[1:], stdout=subprocess.DEVNULL)
_, status, used = os.wait4(child.pid, 0)
print(time.perf_counter() - start, used.ru_maxrss)
os._exit(0 if sys.stdout.flush() is None and os.waitstatus_to_exitcode(status) == 0 else 1)
"""
NAMES = ("pianofit", "jax", "jaxlib", "numpy", "scipy", "numba")


def paired(works: Mapping[str, Callable[[], Any]], *, rounds: int = 7, least: float = 0.3) -> dict[str, dict]:
    """Seconds of every work, by name; all are done in turn, `rounds` times, after once that does not count.

    In a round a work is repeated for at least `least` seconds, or done once if that takes longer.
    """
    import jax

    taken: dict[str, list[float]] = {name: [] for name in works}
    often = {}
    for name, work in works.items():
        jax.block_until_ready(work())
        start = time.perf_counter()
        jax.block_until_ready(work())
        often[name] = max(1, int(least / max(time.perf_counter() - start, 1e-7)))
    for _ in range(rounds):
        for name, work in works.items():
            start = time.perf_counter()
            for _ in range(often[name]):
                jax.block_until_ready(work())
            taken[name].append((time.perf_counter() - start) / often[name])
    return {name: summed(seconds) for name, seconds in taken.items()}


def summed(seconds: list[float]) -> dict[str, Any]:
    """Median, fastest and the number of repeats."""
    return {"median": statistics.median(seconds), "fastest": min(seconds), "repeats": len(seconds), "all": seconds}


def ratio(slow: dict, fast: dict) -> float:
    """How many times as long `slow` takes: the median over the rounds in which both were done."""
    return statistics.median(a / b for a, b in zip(slow["all"], fast["all"], strict=False))


def command(arguments: list[str], cache: Path) -> dict[str, float]:
    """One `pianofit` command in a process of its own: seconds, and its largest memory, MB.

    A small process starts it: what the system reports as a child's largest memory begins with its parent's.

    Raises
    ------
    RuntimeError
        If it fails, with what it said.
    """
    environment = os.environ | {"PIANOFIT_CACHE": str(cache)}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    done = subprocess.run(
        [sys.executable, "-I", "-S", "-c", LAUNCHER, sys.executable, "-c", COMMAND, *arguments],
        env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode:
        raise RuntimeError(f"pianofit {' '.join(arguments)}: {done.stderr.strip()}")
    seconds, memory = map(float, done.stdout.split())
    return {"seconds": seconds, "memory_MB": memory / (1e6 if sys.platform == "darwin" else 1e3)}


def machine() -> dict[str, Any]:
    """What the numbers were measured on."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    name = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.processor())
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {
        "processor": name, "cores": cores, "load": load(), "system": platform.platform(),
        "python": platform.python_version(), "versions": {name: _version(name) for name in NAMES}, "commit": commit(),
    }  # fmt: skip


def commit() -> str:
    """Return the commit of this clone, with "-dirty" if files differ from it."""
    git = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--exclude=*"]
    return subprocess.run(git, capture_output=True, text=True, check=False).stdout.strip()


def load() -> list[float]:
    """Of the machine in the last 1, 5 and 15 minutes."""
    return [round(x, 2) for x in os.getloadavg()] if hasattr(os, "getloadavg") else []


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def into_page(page: Path, mark: str, lines: list[str]) -> None:
    """Put `lines` between `<!-- MARK -->` and `<!-- end of MARK -->` of a page."""
    text = page.read_text(encoding="utf-8")
    before, _, rest = text.partition(f"<!-- {mark} -->\n")
    _, end, after = rest.partition(f"<!-- end of {mark} -->")
    if not end:
        sys.exit(f"{page}: no <!-- {mark} --> and <!-- end of {mark} --> in it; write both where the table belongs")
    block = "\n".join(line.rstrip() for line in lines)
    page.write_text(f"{before}<!-- {mark} -->\n{block}\n{end}{after}", encoding="utf-8")


def modal_response_of(result: Result) -> ModalResponse | None:
    """Return modes and knock of a fitted key, as in the result's note, whether or not they improve the prediction.

    None if no partial exceeds the noise long enough for its modes.
    """
    from pianofit.modal_response.model_selection import _layers
    from pianofit.modal_response.shared_response import estimate_shared_response
    from pianofit.threads import numerical_settings

    with numerical_settings():
        layers = _layers(result)
        modes = layers.modes()
        if not modes:
            return None
        return estimate_shared_response(layers.aligned, modes, layers.forces, layers.gain).response
