"""How long everything takes on this machine: whole commands in processes of their own, and the inner loops.

    python benchmarks/speed.py                         on a 6 s note that the program makes
    python benchmarks/speed.py note.flac:F#2 --json speed.json

Commands are run in turn, round after round, so that a change in the machine's load falls on all of them; the median
counts, and the fastest is printed beside it. `warm` has the compiled programs of earlier fits, `cold` an empty cache.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

RATE, SECONDS, LEAD = 44_100, 6.0, 0.05
PRESET, NOTE = "chabassier-C2", "C2"
# The contact alone: this rate, at least 200 steps (whole blocks of 32), hammers spread by this factor.
STEPS, BATCH, MODES, SPREAD = 224, 64, 192, 0.3
# Targets, s, on two idle cores.
TARGETS = {"help": 0.5, "fit, warm": 4.0, "fit with page, warm": 6.0, "fit, cold": 15.0}


def make_note(path: Path) -> None:
    """Write a note as a microphone might give it: the force on the bridge behind a path that wanders, and noise."""
    import pianofit
    from pianofit.criterion import OutputPath

    it = pianofit.preset(PRESET)
    frequency = np.geomspace(40.0, 16_000.0, 60)
    octaves = np.log2(frequency / 40.0)
    shape = OutputPath(frequency, 4 * np.cos(1.1 * octaves) + 3 * np.sin(2.3 * octaves) - 0.8 * octaves)
    voice = pianofit.Voice(it.string, it.hammer._replace(v_H0=2.5), it.geometry, "pressure", 1.0, shape)
    samples, _ = voice.play(RATE, round(SECONDS * RATE), touch=round(LEAD * RATE))
    samples *= 0.5 / np.abs(samples).max()
    samples += np.random.default_rng(0).normal(0.0, 1e-5, len(samples))
    path.write_bytes(pianofit.encode_wav(samples, RATE))


def seconds_of(arguments: list[str], cache: Path | None = None) -> float:
    """Wall clock of one `pianofit` command in a process of its own, s."""
    environment = os.environ | ({"PIANOFIT_CACHE": str(cache)} if cache else {})
    code = "from pianofit.cli import main; main()"
    start = time.perf_counter()
    subprocess.run([sys.executable, "-c", code, *arguments], env=environment, check=True, capture_output=True)
    return time.perf_counter() - start


def commands(notes: list[tuple[Path, str]], rounds: int, cold: int, folder: Path) -> dict[str, list[float]]:
    """Seconds of every command [rounds], by name; several notes count one after the other."""
    warm_cache = folder / "cache"

    def fit(cache: Path, *more: str) -> list[float]:
        return [
            seconds_of(["fit", str(file), "--note", note, "--out", str(folder / "out"), "--force", *more], cache)
            for file, note in notes
        ]

    fit(warm_cache)
    taken: dict[str, list[float]] = {name: [] for name in TARGETS}
    for turn in range(max(rounds, cold)):
        if turn < rounds:
            taken["help"].append(seconds_of(["--help"]))
            taken["fit, warm"] += fit(warm_cache, "--no-page")
            taken["fit with page, warm"] += fit(warm_cache)
        if turn < cold:
            with tempfile.TemporaryDirectory() as empty:
                taken["fit, cold"] += fit(Path(empty), "--no-page")
    return taken


def repeat(work: Callable[[], Any], least: float = 2.0) -> float:
    """Median time of `work`, s, over at least 5 calls and `least` seconds, after one that compiles."""
    import jax

    jax.block_until_ready(work())
    taken: list[float] = []
    while len(taken) < 5 or sum(taken) < least:
        start = time.perf_counter()
        jax.block_until_ready(work())
        taken.append(time.perf_counter() - start)
    return statistics.median(taken)


def contacts() -> dict[str, float]:
    """Hammer candidates a second on one string: contact only, no derivatives."""
    import jax
    import jax.numpy as jnp

    import pianofit
    from pianofit.model import mode_table, strike

    it = pianofit.preset("bensa-final")
    modes = mode_table(it.string, it.geometry, rate=float(RATE), n_modes=MODES)
    spread = np.exp(SPREAD * np.random.default_rng(0).standard_normal((BATCH, 5)))
    many = pianofit.Hammer(*(jnp.asarray(x) for x in np.asarray(it.hammer)[:, None] * spread.T))
    one = pianofit.Hammer(*(x[0] for x in many))
    alone = jax.jit(lambda hammer: strike(modes, hammer, steps=STEPS).force)
    together = jax.jit(jax.vmap(lambda hammer: strike(modes, hammer, steps=STEPS).force))
    return {"alone": 1 / repeat(lambda: alone(one)), f"{BATCH} together": BATCH / repeat(lambda: together(many))}


def criterion(file: Path, note: str) -> dict[str, float]:
    """Milliseconds of what a fit's last stage evaluates: residuals and all their derivatives, one start."""
    import jax.numpy as jnp

    import pianofit
    from pianofit.fit.recipe import fit_partials
    from pianofit.fit.residuals import joint_batch
    from pianofit.initial import starting_values

    recording = pianofit.load_recording(file)
    analysis = pianofit.analyse(recording, note=note)
    fit = fit_partials(recording, analysis, starting_values(analysis, pianofit.Setup()))
    z = jnp.asarray(fit.space.z(fit.values[None]))
    milliseconds = 1e3 * repeat(lambda: joint_batch(z, fit.target, fit.cfg))
    sizes = {"partials": len(fit.data.partials), "modes": fit.cfg.n_modes, "steps": fit.cfg.steps}
    return {"milliseconds": milliseconds} | sizes


def machine() -> dict[str, Any]:
    """What the numbers were measured on."""
    from pianofit.fit.result import versions

    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    model = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.processor())
    load = os.getloadavg() if hasattr(os, "getloadavg") else ()
    return {"processor": model, "cores": os.cpu_count(), "load": load, "system": platform.platform()} | versions()


def main() -> None:
    """Measure, print, and write JSON if asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("notes", nargs="*", metavar="FILE:NOTE", help="recordings to fit instead of the made one")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--cold", type=int, default=2, help="rounds with an empty cache")
    parser.add_argument("--json", type=Path, help="write all numbers here too")
    arguments = parser.parse_args()
    document: dict[str, Any] = {"machine": machine()}
    print("{processor}, {cores} cores, load {load}".format(**document["machine"]))
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "note.wav"
        make_note(made)
        notes = [(Path(file), note) for file, _, note in (text.rpartition(":") for text in arguments.notes)]
        notes = notes or [(made, NOTE)]
        taken = commands(notes, arguments.rounds, arguments.cold, Path(folder))
        print(f"{'':24}{'median':>9}{'fastest':>10}{'target':>9}   s, of the whole command")
        for name, seconds in taken.items():
            if seconds:
                print(f"{name:24}{statistics.median(seconds):9.2f}{min(seconds):10.2f}{TARGETS[name]:9.1f}")
        document["commands"] = taken
        document["criterion"] = criterion(*notes[0])
    c = document["criterion"]
    print(f"residuals and derivatives: {c['milliseconds']:.1f} ms ({c['partials']} partials, {c['modes']} modes, "
          f"{c['steps']} steps of contact)")  # fmt: skip
    document["candidates"] = contacts()
    for name, rate in document["candidates"].items():
        print(f"hammers, {name:14}{rate:10,.0f} a second ({STEPS} steps at {RATE} Hz, {MODES} modes)")
    document["machine"]["load_after"] = os.getloadavg() if hasattr(os, "getloadavg") else ()
    if arguments.json:
        arguments.json.write_text(json.dumps(document, indent=1) + "\n")


if __name__ == "__main__":
    main()
