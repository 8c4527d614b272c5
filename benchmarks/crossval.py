"""How well velocities that were not fitted are predicted, on real notes and by each law of the felt.

    python benchmarks/crossval.py                                      all notes of the recordings, by the default law
    python benchmarks/crossval.py --laws hunt-crossley,power,stulov --json crossval.json

The recordings are in ../shared/recordings, or where PIANOFIT_RECORDINGS says, with a `recordings.csv`. For every note
each layer is left out in turn and predicted from the others, as `pianofit crossval` does: rms over partials, dB, one
gain removed. A layer is scored if it lies between others, at least `FEWEST` partials are compared, and three or more
layers are left to fit; the rest is printed, in brackets.
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
from pathlib import Path

FEWEST = 8
# How far above the nearest recorded layer a prediction may lie, dB, and what the median and the worst should reach.
MORE, MEDIAN, WORST = 0.3, 1.5, 2.5


def notes(folder: Path) -> dict[str, tuple[str, list[Path]]]:
    """Every key with three layers or more at one microphone: its note and its files."""
    with (folder / "recordings.csv").open(encoding="utf-8") as table:
        rows = list(csv.DictReader(table))
    found: dict[str, tuple[str, list[Path]]] = {}
    for row in rows:
        group = row.get("mic") or row.get("group") or row["file"].rsplit(".", 1)[0].split("-")[3:]
        instrument, note = row["file"].split("-")[:2]
        key = "-".join([instrument, note, *([group] if isinstance(group, str) else group)])
        found.setdefault(key, (note.replace("s", "#"), []))[1].append(folder / row["file"])
    return {key: pair for key, pair in found.items() if len(pair[1]) >= 3}


def validate(job: tuple[str, str, list[Path], str]) -> dict:
    """One note by one law."""
    from pianofit import analyse, cross_validate, load_recording
    from pianofit.model.cache import keep_programs
    from pianofit.setup_file import Setup

    key, note, files, law = job
    keep_programs()
    recordings = [load_recording(file) for file in sorted(files)]
    begun = time.perf_counter()
    found, whole = cross_validate(recordings, [analyse(r, note=note) for r in recordings], Setup(felt=law))
    velocities = {Path(take["file"]).stem: take["v_H0"] for take in whole.document["takes"]}
    return {"note": key, "law": law, "seconds": time.perf_counter() - begun, "velocities": velocities} | found


def scored(result: dict) -> list[dict]:
    """The layers that count."""
    return [t for t in result["takes"] if t["inner"] and t["partials"] >= FEWEST and len(result["takes"]) > 3]


def line(result: dict) -> str:
    """A note's row."""
    counts = scored(result)
    cells = []
    for take in result["takes"]:
        text = f"{take['predicted_db']:.2f}/{take['nearest_db']:.2f}"
        cells.append(text if take in counts else f"({text})")
    return f"{result['note']:20} {result['law']:14} {' '.join(f'{c:>13}' for c in cells)}   {result['seconds']:.0f} s"


def summary(results: list[dict], law: str) -> str:
    """What one law reaches over all notes."""
    takes = [take for result in results if result["law"] == law for take in scored(result)]
    if not takes:
        return f"{law}: nothing scored"
    errors = [take["predicted_db"] for take in takes]
    over = sum(take["predicted_db"] > take["nearest_db"] + MORE for take in takes)
    return (
        f"{law}: {len(takes)} layers, median {statistics.median(errors):.2f} dB (wanted {MEDIAN}), worst "
        f"{max(errors):.2f} dB (wanted {WORST}), {sum(e <= WORST for e in errors)} within {WORST}, {over} more than "
        f"{MORE} dB above the nearest layer"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--laws", default="hunt-crossley", help="separated by commas")
    parser.add_argument("--notes", default="", help="only notes whose names contain one of these, separated by commas")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    folder = Path(os.environ.get("PIANOFIT_RECORDINGS", "../shared/recordings"))
    if not (folder / "recordings.csv").is_file():
        sys.exit(f"{folder}: no recordings.csv here; say where the recordings are with PIANOFIT_RECORDINGS")
    wanted, laws = [n for n in options.notes.split(",") if n], options.laws.split(",")
    jobs = [
        (key, note, files, law)
        for law in laws
        for key, (note, files) in notes(folder).items()
        if not wanted or any(w in key for w in wanted)
    ]
    print("predicted/nearest layer, dB a partial, soft to loud; in brackets: not scored")
    results = []
    with ProcessPoolExecutor(options.workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        for result in pool.map(validate, jobs):
            results.append(result)
            print(line(result), flush=True)
    for law in laws:
        print(summary(results, law))
    if options.json:
        options.json.write_text(json.dumps(results, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
