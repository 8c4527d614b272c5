"""A whole sample library: seconds, CPU seconds of a key, and memory of a worker; one command.

    python benchmarks/library.py                               88 keys, five layers
    python benchmarks/library.py --keys 6 --workers 1          six keys, evenly over the keyboard

The sounds are made by the program from what the literature has at each key. `pianofit batch` fits them with pages and
index, in a process of its own. It starts with an empty cache of programs, unless a folder of one is given. CPU seconds
hardly depend on other load of the machine. `pianofit instrument` combines the fits, with its page. The last lines say
where the CPU time of one key goes: the middle key of the library is fitted once more, by one process with one thread.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import made
from measuring import COMMAND, command, machine

LOWEST, HIGHEST = 21, 108  # MIDI numbers of a piano
PATTERN = "{note}-{layer}"
# Duration of a made sound, s: halved from octave to octave from the first on, and not below the second.
LONGEST, SHORTEST = 8.0, 1.0


def make_library(folder: Path, keys: int, layers: int) -> dict[str, list[Path]]:
    """Write the sounds, and return the files by note; the keys are the middles of equal parts of the keyboard."""
    from pianofit.analysis.note_names import midi_to_note

    library = {}
    for number in (LOWEST + int((i + 0.5) * (HIGHEST - LOWEST + 1) / keys) for i in range(keys)):
        name = midi_to_note(number)
        seconds = max(LONGEST * 2.0 ** (-(number - LOWEST) / 24), SHORTEST)
        library[name] = made.make_notes(folder, made.VELOCITIES[-layers:], seconds, name, None)
    return library


def run_batch(sounds: Path, out: Path, cache: Path, workers: int) -> dict[str, Any]:
    """Fit all keys: wall and CPU seconds of the command with its workers, and the records of all keys."""
    arguments = ["batch", str(sounds), "--out", str(out), "--pattern", PATTERN, "--processes", str(workers), "--json"]
    environment = os.environ | {"PIANOFIT_CACHE": str(cache)}
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run([sys.executable, "-c", COMMAND, *arguments], env=environment, capture_output=True, text=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode not in (0, 3):
        raise RuntimeError(done.stderr.strip())
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return json.loads(done.stdout) | {"wall_s": time.perf_counter() - start, "cpu_s": cpu}


def stages(note: str, files: list[str], out: str) -> list[tuple[str, float]]:
    """CPU seconds of every stage of one fit in this process, imports first, and of its page."""
    begun = [("imports", 0.0)]

    def begin(stage: str, _: float = 0.0) -> None:
        if stage != begun[-1][0]:
            begun.append((stage, time.process_time()))

    import pianofit.inference
    import pianofit.modal_response
    import pianofit.result
    from pianofit.program_folder import enable_program_cache

    enable_program_cache()
    result = pianofit.fit(*files, note=note, progress=begin)
    begin("files")
    result.save(out, page=False)
    begin("page")
    result.report(out)
    ends = [at for _, at in begun[1:]] + [time.process_time()]
    return [(stage, end - at) for (stage, at), end in zip(begun, ends, strict=True)]


def stages_of_one(note: str, files: list[Path], out: Path, cache: Path) -> list[tuple[str, float]]:
    """`stages` in a process like a worker, with one thread: programs compiled for other threads are others."""
    from pianofit.batch.process_pool import one_thread

    arguments = [sys.executable, __file__, "--stages", note, str(out), *map(str, files)]
    with one_thread():
        environment = os.environ | {"PIANOFIT_CACHE": str(cache)}
    done = subprocess.run(arguments, env=environment, capture_output=True, text=True, check=True)
    return [tuple(pair) for pair in json.loads(done.stdout)]  # pyright: ignore[reportReturnType]


def measured(keys: int, layers: int, workers: int, cache: Path | None) -> dict[str, Any]:
    """Make, fit and measure a library."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (sounds := folder / "sounds").mkdir()
        library = make_library(sounds, keys, layers)
        cache = cache or folder / "cache"
        result = run_batch(sounds, folder / "out", cache, workers)
        result["instrument"] = command(["instrument", str(folder / "out"), "--out", str(folder / "built")], cache)
        middle = [*library][len(library) // 2]
        result["stages"] = {middle: stages_of_one(middle, library[middle], folder / "one", cache)}
    return result | {"machine": machine(), "keys": keys, "layers": layers, "workers": workers}


def printed(result: dict[str, Any]) -> str:
    """The figures for a terminal."""
    m, keys, built = result["machine"], result["keys"], result["instrument"]
    lines = [
        f"{m['processor']}, {m['cores']} cores, load {m['load']} at the end",
        f"{keys} keys of {result['layers']} layers, {result['workers']} workers: {result['counts']}",
        f"{result['wall_s']:.1f} s, {result['cpu_s']:.1f} CPU seconds, {result['cpu_s'] / keys:.2f} a key",
        f"largest memory of a worker {result['largest_memory'] / 1e6:.0f} MB",
        f"pianofit instrument: {built['seconds']:.1f} s, {built['memory_MB']:.0f} MB",
    ]
    for note, own in result["stages"].items():
        lines.append(f"CPU seconds of {note} alone, {sum(seconds for _, seconds in own):.2f}:")
        lines += [f"  {stage:20} {seconds:6.2f}" for stage, seconds in own]
    return "\n".join(lines)


def main() -> None:
    """Measure and print."""
    if sys.argv[1:2] == ["--stages"]:
        _, _, note, out, *files = sys.argv
        print(json.dumps(stages(note, files, out)))
        return
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keys", type=int, default=HIGHEST - LOWEST + 1)
    parser.add_argument("--layers", type=int, choices=range(1, len(made.VELOCITIES) + 1), default=5)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--cache", type=Path, help="folder of compiled programs; without it, an empty one")
    parser.add_argument("--json", type=Path, help="write all numbers here")
    options = parser.parse_args()
    result = measured(options.keys, options.layers, options.workers, options.cache)
    print(printed(result))
    if options.json:
        options.json.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
