"""How far keys that are inferred from their neighbours are from their recordings.

    python benchmarks/unrecorded.py FITS RECORDINGS [--prefix headroom] [--json FILE]

FITS holds `KEY/fit.json` of one instrument, as `pianofit fit` or `pianofit batch` left them, RECORDINGS the files that
they name. Every inner key is left out in turn: the instrument is put together from the others, the key is struck at the
velocities of its recordings, and both what it rings with by its neighbours and the string's law alone are compared with
every recording by `../shared/tools/realism.py`, dB, attack in brackets: mean over its layers. Beside them stands the
key's own fit in the instrument of all keys.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from realism import measure
from scipy import signal

RATE = 44_100
SECONDS = 3.3
BEFORE = 0.02  # s of silence before the contact


def main() -> None:
    """Print the table."""
    from pianofit.instrument import build_instrument, find_fits, load_keys
    from pianofit.model.program_cache import enable_program_cache

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("fits", type=Path)
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--prefix")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    enable_program_cache()
    tool, found = measure(), {}
    keys = load_keys(find_fits([options.fits], options.prefix))
    whole = build_instrument(keys)

    def distances(note, key) -> dict[str, float]:
        rows = []
        for layer in key.summary.layers:
            sound = note.render(layer.velocity, seconds=SECONDS, rate=RATE)
            target = tool.load(str(options.recordings / Path(layer.file).name))
            by = np.gcd(tool.RATE, RATE)
            sound = signal.resample_poly(np.pad(sound, (round(BEFORE * RATE), 0)), tool.RATE // by, RATE // by)
            there = tool.compare(target, sound)
            rows.append({"distance": there["distance_db"], **there["logmel_db"]})
        return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}

    print(f"{'':20}{'law':>16}{'by neighbours':>16}{'own fit':>16}   dB, attack in brackets", flush=True)
    for left in keys[1:-1]:
        rest = build_instrument([key for key in keys if key is not left])
        note, own = rest.keys[left.midi].note, whole.keys[left.midi].note
        rows = [distances(x, left) for x in (note._replace(ringing=None), note, own)]
        name = Path(left.summary.file).parent.name
        found[name] = dict(zip(("law", "by neighbours", "own fit"), rows, strict=True))
        cells = [f"{row['distance']:.2f} ({row['attack']:.2f})" for row in rows]
        print(f"{name:20}" + "".join(f"{cell:>16}" for cell in cells), flush=True)
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
