"""Whether one process can fit any number of notes: what each fit leaves in memory, as in a long notebook.

    python benchmarks/many_notes.py                    60 notes of different keys, about an hour on a busy machine
    python benchmarks/many_notes.py --count 5 --seed 7

Every note is made of what a piano usually has at its key, with a pitch, a velocity and a length of sound of its own, so
that no fit has the sizes of another and every fit's programs are compiled anew. After each fit a line says how many
memory mappings the process has (Linux gives it 65,530), its resident memory, and how long the fit took.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

RATE, LEAD = 44_100, 0.05
# MIDI numbers: C2 to B6. Strings below have more modes, those above faster contacts: their fits take longer.
LOWEST, HIGHEST = 36, 95
SECONDS = (0.5, 1.0)  # of sound, drawn between them


def made_notes(count: int, seed: int) -> Iterator[tuple[int, np.ndarray]]:
    """Key and samples [samples] of notes in a drawn order, the keys evenly over the range."""
    import pianofit

    draw = np.random.default_rng(seed)
    for key in draw.permutation(np.linspace(LOWEST, HIGHEST, count).round().astype(int)):
        it = pianofit.typical(key + draw.uniform(-0.1, 0.1))
        hammer = it.hammer._replace(v_H0=draw.uniform(1.0, 4.0))
        strike = pianofit.simulate(it.string, hammer, it.geometry, rate=RATE, quantity="bridge-force")
        sound = strike.waveform(RATE, round(draw.uniform(*SECONDS) * RATE))
        samples = np.pad(0.5 * sound / np.abs(sound).max(), (round(LEAD * RATE), 0))
        yield int(key), samples + draw.normal(0.0, 1e-5, len(samples))


def held() -> tuple[int, float]:
    """Memory mappings of this process, and its resident memory, MiB."""
    mappings = len(Path("/proc/self/maps").read_bytes().splitlines())
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines() if ":" in line)
    return mappings, int(status["VmRSS"].split()[0]) / 2**10


def main() -> None:
    """Fit one after another, and say what the process holds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    import pianofit
    from pianofit.analysis.note_names import midi_to_note

    print("  n  note  mappings     MiB  seconds")
    for n, (key, samples) in enumerate(made_notes(options.count, options.seed), 1):
        name = midi_to_note(key)
        began = time.perf_counter()
        pianofit.fit((samples, RATE), note=name, progress=False)
        seconds = time.perf_counter() - began
        mappings, memory = held()
        print(f"{n:3}  {name:4}  {mappings:8}  {memory:6.0f}  {seconds:7.1f}", flush=True)


if __name__ == "__main__":
    main()
