"""The effect of a second microphone on the same strokes: on the string, and on predictions of left-out strokes.

    python benchmarks/microphones.py                      both tables
    python benchmarks/microphones.py --pairs              only the first, in about a minute
    python benchmarks/microphones.py --json microphones.json

The recordings are in ../shared/recordings, or where PIANOFIT_RECORDINGS says, with a `recordings.csv`. Rows with one
instrument, note and velocity layer are one stroke; what follows the layer in a file's name is the microphone. Every key
with such a stroke is taken.

1. Each recording of such a stroke fitted alone. The string is the same, so its parameters should agree: `apart` is the
   difference of their logarithms over the two 95 % reaches together, and beyond 1 they do not. Three
   more numbers follow: the difference of the partials that both have, the scatter of each table about the string's
   laws, and the agreement when only partials that both have are used. Then the same for two strokes at one microphone.
2. The key's microphone with most recordings alone, and with the others' recordings of the same strokes: each stroke
   left out in turn, errors of the first microphone's recordings. A stroke is scored where it lies between others.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import statistics
import sys
import time
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pianofit import LeftOutRecording, analyse, cross_validate, fit, load_recording
from pianofit.analysis import Analysis
from pianofit.analysis.inharmonicity import frequency_law
from pianofit.program_folder import enable_program_cache
from pianofit.schema.decode import builtins_of
from pianofit.schema.fit import Fit
from pianofit.setup import RecordingInfo, Setup

STRING = ("c", "kappa", "b1", "b2")


class Heard(NamedTuple):
    """One recording of a key."""

    file: Path
    stroke: str
    mic: str


def keys(folder: Path) -> dict[tuple[str, str], list[Heard]]:
    """Instrument and note of every key that has a stroke at two microphones, with all its recordings."""
    found: dict[tuple[str, str], list[Heard]] = {}
    with (folder / "recordings.csv").open(encoding="utf-8") as table:
        for row in csv.DictReader(table):
            mic = "-".join(Path(row["file"]).stem.split("-")[3:])
            heard = Heard(folder / row["file"], row["velocity_layer"], mic)
            found.setdefault((row["instrument"], row["note"]), []).append(heard)
    return {key: heard for key, heard in found.items() if pairs_of(heard)}


def pairs_of(heard: list[Heard]) -> list[tuple[Heard, Heard]]:
    """Recordings of one stroke at two microphones."""
    return [(a, b) for a, b in combinations(heard, 2) if a.stroke == b.stroke and a.mic != b.mic]


def alone(heard: Heard, note: str) -> tuple[Fit, Analysis]:
    """A recording's own fit and its partials."""
    recording = load_recording(heard.file)
    analysis = analyse(recording, note=note)
    return fit(recording, analyses=[analysis]).fit, analysis


def compared(pair: tuple[Heard, Heard], note: str) -> dict:
    """The two fits of one stroke, compared."""
    (one, first), (other, second) = (alone(heard, note) for heard in pair)
    rows = {}
    for name in STRING:
        a, b = one.parameters[name], other.parameters[name]
        ends = [p.interval or (np.nan, np.nan) for p in (a, b)]
        reach = np.hypot(*(np.log(high / low) / 2 for low, high in ends))
        rows[name] = {
            "values": [a.value, b.value],
            "intervals": [a.interval, b.interval],
            "apart": float(abs(np.log(b.value / a.value)) / reach),
        }
    return {"files": [h.file.name for h in pair], "parameters": rows} | _partials(first, second) | {
        "excess": [builtins_of(own.diagnostics.excess_sd) for own in (one, other)]
    }  # fmt: skip


def _partials(first: Analysis, second: Analysis) -> dict:
    """Differences of the partials that both recorded: robust deviations, cents, and of the logarithm of the decays."""
    a, b = first.partials, second.partials
    _, i, j = np.intersect1d(a.number, b.number, return_indices=True)
    cents = 1200 * np.log2(b.frequency[j] / a.frequency[i])
    fades = np.log(np.maximum(b.decay, b.decay_error)[j] / np.maximum(a.decay, a.decay_error)[i])
    laws = [frequency_law(p.number[at], p.frequency[at], p.frequency_error[at]) for p, at in ((a, i), (b, j))]
    reach = 1.96 * np.hypot(laws[0].B_error / laws[0].B, laws[1].B_error / laws[1].B)
    return {
        "common": len(i), "cents": _deviation(cents), "log_decay": _deviation(fades), "decays": _median(fades),
        "common_B_apart": float(abs(np.log(laws[1].B / laws[0].B)) / reach),
    }  # fmt: skip


def _median(x: np.ndarray) -> float:
    return float(np.median(x))


def _deviation(x: np.ndarray) -> float:
    return 1.4826 * _median(np.abs(x - np.median(x)))


def left_out(heard: list[Heard], note: str, mic: str) -> dict[str, LeftOutRecording]:
    """`cross_validate` of these recordings: what came of those of one microphone, by file."""
    layers = tuple(RecordingInfo(h.file.name, None, h.mic, None, h.stroke) for h in heard)
    found = cross_validate(*(h.file for h in heard), setup=Setup(recordings=layers), note=note, progress=False)
    names = {str(h.file): h for h in heard}
    return {Path(row.file).name: row for row in found.recordings if names[row.file].mic == mic}


def predictions(heard: list[Heard], note: str) -> dict:
    """One microphone alone and with the others' recordings of its strokes."""
    mics = [h.mic for h in heard]
    mic = max(sorted(set(mics)), key=mics.count)
    own = [h for h in heard if h.mic == mic]
    others = [h for h in heard if h.mic != mic and h.stroke in {o.stroke for o in own}]
    begun = time.perf_counter()
    without, beside = left_out(own, note, mic), left_out(own + others, note, mic)
    rows = [
        {"file": name, "inner": row.has_neighbours, "alone_db": row.predicted_db, "both_db": beside[name].predicted_db,
         "nearest_db": row.nearest_db}
        for name, row in without.items()
    ]  # fmt: skip
    return {"recordings": rows, "others": [h.file.name for h in others], "seconds": time.perf_counter() - begun}


def print_pair(found: dict) -> None:
    """A stroke's table."""
    print(
        f"\n{' and '.join(found['files'])}: {found['common']} partials in common, apart by {found['cents']:.2f} cents"
    )
    print(f"  and a factor of {np.exp(found['log_decay']):.2f} in decay (median ratio {np.exp(found['decays']):.2f}); "
          f"B through these alone: apart {found['common_B_apart']:.2f}")  # fmt: skip
    for mic, s in zip(found["files"], found["excess"], strict=True):
        print(f"  {mic}: about the string's laws {s['frequency_cents']:.2f} cents, decays {s['decay_relative']:.2f}")
    for name, p in found["parameters"].items():
        shown = [f"{v:.5g} [{low:.5g}, {high:.5g}]" for v, (low, high) in zip(p["values"], p["intervals"], strict=True)]
        said = "agree" if p["apart"] <= 1 else "DISAGREE"
        print(f"  {name:6} {shown[0]:34} {shown[1]:34} apart {p['apart']:.2f}  {said}")


def print_blows(heard: list[Heard], note: str) -> None:
    """For comparison, different strokes at one microphone, of those that several microphones recorded."""
    shared = sorted({h for pair in pairs_of(heard) for h in pair})
    for a, b in combinations(shared, 2):
        if a.mic == b.mic:
            found = _partials(*(analyse(load_recording(h.file), note=note) for h in (a, b)))
            print(
                f"  two strokes at one place, {a.file.name} and {b.file.name}: {found['common']} partials in common, "
                f"{found['cents']:.2f} cents and a factor of {np.exp(found['log_decay']):.2f} in decay apart"
            )


def print_predictions(key: tuple[str, str], found: dict) -> None:
    """A key's table."""
    print(f"\n{key[1]}, {key[0]}: each stroke left out, dB a partial; with {', '.join(found['others'])} "
          f"({found['seconds']:.0f} s)")  # fmt: skip
    print(f"  {'':28}{'alone':>8}{'with':>8}{'nearest':>9}")
    for row in found["recordings"]:
        print(f"  {row['file']:28}{row['alone_db']:8.2f}{row['both_db']:8.2f}{row['nearest_db']:9.2f}"
              f"{'' if row['inner'] else '  (beyond the others)'}")  # fmt: skip
    inner = [row for row in found["recordings"] if row["inner"]]
    one, both = (statistics.median(row[name] for row in inner) for name in ("alone_db", "both_db"))
    print(f"  median of the {len(inner)} between others: {one:.2f} dB alone, {both:.2f} dB with both")


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", action="store_true", help="only compare the fits of single recordings")
    parser.add_argument("--notes", default="", help="only these notes, separated by commas")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    folder = Path(os.environ.get("PIANOFIT_RECORDINGS", "../shared/recordings"))
    if not (folder / "recordings.csv").is_file():
        sys.exit(f"{folder}: no recordings.csv here; say where the recordings are with PIANOFIT_RECORDINGS")
    enable_program_cache()
    wanted = [n for n in options.notes.split(",") if n]
    chosen = {key: heard for key, heard in keys(folder).items() if not wanted or key[1] in wanted}
    pairs, left = [], {}
    for (_, note), heard in chosen.items():
        for pair in pairs_of(heard):
            pairs.append(compared(pair, note))
            print_pair(pairs[-1])
        print_blows(heard, note)
    apart = [p["apart"] for pair in pairs for p in pair["parameters"].values()]
    print(f"\n{sum(a <= 1 for a in apart)} of {len(apart)} string parameters agree within their intervals", flush=True)
    for key, heard in {} if options.pairs else chosen.items():
        left[" ".join(key)] = predictions(heard, key[1])
        print_predictions(key, left[" ".join(key)])
        sys.stdout.flush()
    if options.json:
        options.json.write_text(json.dumps({"pairs": pairs, "left_out": left}, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
