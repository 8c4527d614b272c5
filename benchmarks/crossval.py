"""How well velocities that were not fitted are predicted, on real notes and by each law of the felt.

    python benchmarks/crossval.py                                      all notes of the recordings, by the default law
    python benchmarks/crossval.py --laws soft-skin,hunt-crossley,power,stulov --json cross_validation.json
    python benchmarks/crossval.py --seeds 0,1,2                        how far the median moves with the seed

The recordings are in ../shared/recordings and ../shared/disklavier, or where PIANOFIT_RECORDINGS says (folders
separated by a colon), each with a `recordings.csv`. For every note each layer is left out in turn and predicted from
the others, as `pianofit cross-validate` does: rms over partials, dB, one gain removed. A layer is scored if it is
between others, at least `FEWEST` partials are compared, and three or more layers are left to fit; the rest is
printed in brackets. Where a machine played the key (a column `blow` with MIDI velocities), its layers share one gain.
"""

from __future__ import annotations

import argparse
import csv
import json
import multiprocessing
import os
import statistics
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pianofit import Setup

FEWEST = 8
# How far above the nearest recorded layer a prediction may lie, dB, and what median, mean and worst should reach.
MORE, MEDIAN, MEAN, WORST = 0.3, 1.3, 1.45, 2.5
FOLDERS = "../shared/recordings:../shared/disklavier"


def folders() -> list[Path]:
    """Where the recordings are; ends the program if they are nowhere."""
    named = [Path(name) for name in os.environ.get("PIANOFIT_RECORDINGS", FOLDERS).split(":")]
    found = [folder for folder in named if (folder / "recordings.csv").is_file()]
    if not found:
        sys.exit(f"{named[0]}: no recordings.csv here; say where the recordings are with PIANOFIT_RECORDINGS")
    return found


def notes(folder: Path) -> dict[str, tuple[str, list[Path], Setup]]:
    """Every key with three layers or more at one microphone: its note, its files and what is known of them."""
    from pianofit import RecordingInfo, Setup

    with (folder / "recordings.csv").open(encoding="utf-8") as table:
        rows = [row for row in csv.DictReader(table) if row.get("kind", "recording") == "recording"]
    found: dict[str, tuple[str, list[Path], list[RecordingInfo]]] = {}
    for row in rows:
        stem = row["file"].rsplit(".", 1)[0]
        group = [] if row.get("blow") else stem.split("-")[3:]
        instrument, note = row["file"].split("-")[:2]
        _, files, layers = found.setdefault("-".join([instrument, note, *group]), (note.replace("s", "#"), [], []))
        files.append(folder / row["file"])
        layers.append(RecordingInfo(file=row["file"], gain_group="machine" if row.get("blow") else None))
    return {
        key: (note, sorted(files), Setup(recordings=tuple(layers)))
        for key, (note, files, layers) in sorted(found.items())
        if len(files) >= 3
    }


def validate(job: tuple[str, str, list[Path], Setup, str, int]) -> dict:
    """One note by one law from one seed."""
    from pianofit import cross_validate
    from pianofit.program_folder import enable_program_cache

    key, note, files, setup, law, seed = job
    enable_program_cache()
    begun = time.perf_counter()
    found = cross_validate(*files, setup=replace(setup, felt=law), note=note, seed=seed, progress=False)
    velocities = {Path(row.file).stem: row.stroke_value for row in found.result.fit.recordings}
    seconds = time.perf_counter() - begun
    return {"note": key, "law": law, "seed": seed, "seconds": seconds, "velocities": velocities} | found.to_dict()


def scored(result: dict) -> list[dict]:
    """The layers that count."""
    rows = result["recordings"]
    return [row for row in rows if row["has_neighbours"] and row["partials"] >= FEWEST and len(rows) > 3]


def line(result: dict) -> str:
    """A note's row."""
    counts = scored(result)
    cells = []
    for row in result["recordings"]:
        text = f"{row['predicted_db']:.2f}/{row['nearest_db']:.2f}"
        cells.append(text if row in counts else f"({text})")
    return f"{result['note']:20} {result['law']:14} {' '.join(f'{c:>13}' for c in cells)}   {result['seconds']:.0f} s"


def summary(results: list[dict], law: str, seed: int) -> str:
    """What one law reaches over all notes."""
    rows = [row for r in results if (r["law"], r["seed"]) == (law, seed) for row in scored(r)]
    if not rows:
        return f"{law}: nothing scored"
    errors = [row["predicted_db"] for row in rows]
    over = sum(row["predicted_db"] > row["nearest_db"] + MORE for row in rows)
    return (
        f"{law}, seed {seed}: {len(rows)} layers, median {statistics.median(errors):.2f} dB (wanted {MEDIAN}), mean "
        f"{statistics.mean(errors):.2f} (wanted {MEAN}), worst {max(errors):.2f} (wanted {WORST}), {over} more than "
        f"{MORE} dB above the nearest layer"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--laws", default="soft-skin", help="separated by commas")
    parser.add_argument("--seeds", default="0", help="separated by commas")
    parser.add_argument("--notes", default="", help="only notes whose names contain one of these, separated by commas")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    wanted, laws = [n for n in options.notes.split(",") if n], options.laws.split(",")
    seeds = [int(seed) for seed in options.seeds.split(",")]
    jobs = [
        (key, *note, law, seed)
        for law in laws
        for seed in seeds
        for folder in folders()
        for key, note in notes(folder).items()
        if not wanted or any(w in key for w in wanted)
    ]
    print("predicted/nearest layer, dB a partial, soft to loud; in brackets: not scored")
    results = []
    with ProcessPoolExecutor(options.workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        for result in pool.map(validate, jobs):
            results.append(result)
            print(line(result), flush=True)
    for law in laws:
        for seed in seeds:
            print(summary(results, law, seed))
    if options.json:
        options.json.write_text(json.dumps(results, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
