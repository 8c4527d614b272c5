"""How far keys that were never recorded are from their recordings.

    python benchmarks/unrecorded.py FITS RECORDINGS [--prefix headroom] [--keys C2-D#4] [--every 2 | --outermost]
        [--json FILE]

FITS holds `KEY/fit.json` of one instrument, as `pianofit fit` or `pianofit batch` left them. RECORDINGS has the files
that they name, also in subfolders. Every inner key is left out in turn, or every second, third... key at once, or the
lowest and then the highest key. The instrument is built from the other keys, and the key is struck at the velocities of
its recordings, on the scale that the instrument of all keys gives it. The distance from every recording is that of
`../shared/tools/realism.py`, dB, mean over the layers of the key, with the attack in brackets. The columns are

    law          the string model of the key by the keyboard laws, without a modal response
    guess        the guess of the instrument
    other speed  the recording of the nearest recorded key, at the layer of the same rank, played at another speed
    own fit      the key's own fit

`loudness` is the error of the K-weighted level of the guess, dB, with one gain taken out for all left-out keys.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from realism import measure
from scipy import signal

RATE = 44_100
SECONDS = 3.3
BEFORE = 0.02  # s of silence before the contact
COLUMNS = ("law", "guess", "other speed", "own fit")


def left_out(keys: Sequence[Any], every: int = 0, *, outermost: bool = False) -> Iterator[list[Any]]:
    """Keys that are left out together."""
    if outermost:
        yield from ([keys[0]], [keys[-1]])
    elif every:
        for start in range(1, every):
            yield list(keys[start:-1:every])
    else:
        yield from ([key] for key in keys[1:-1])


def other_speed(tool: Any, path: Path, semitones: float) -> np.ndarray:
    """A recording transposed by playing it at another speed, at the tool's rate."""
    sound = tool.load(str(path))
    ratio = 2 ** (semitones / 12)
    return np.interp(np.arange(0, len(sound) - 1, ratio), np.arange(len(sound)), sound)


def k_level(tool: Any, sound: np.ndarray) -> float:
    """K-weighted level of the first second after the onset, dB."""
    start = tool.onset(sound)
    return float(10 * np.log10(np.mean(tool.k_weighted(sound)[start : start + tool.RATE] ** 2)))


def rendered(tool: Any, note: Any, velocity: float) -> np.ndarray:
    """A stroke at the tool's rate."""
    sound = note.render(velocity, seconds=SECONDS, rate=RATE)
    by = np.gcd(tool.RATE, RATE)
    return signal.resample_poly(np.pad(sound, (round(BEFORE * RATE), 0)), tool.RATE // by, RATE // by)


def main() -> None:
    """Print the table."""
    from pianofit.analysis.note_names import note_to_midi
    from pianofit.instrument import build_instrument, find_fits, load_keys
    from pianofit.program_folder import enable_program_cache

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("fits", type=Path)
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--prefix")
    parser.add_argument("--keys", help="only keys from LOW-HIGH are left out or used, such as C2-D#4")
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--every", type=int, default=0, help="keep every second, third... key; default: all but one")
    which.add_argument("--outermost", action="store_true", help="leave out the lowest and the highest key")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    enable_program_cache()
    tool, found = measure(), {}
    files = {file.name: file for file in options.recordings.rglob("*") if file.is_file()}
    keys = load_keys(find_fits([options.fits], options.prefix))
    if options.keys:
        low, high = map(note_to_midi, options.keys.split("-"))
        keys = [key for key in keys if low <= key.midi <= high]
    whole = build_instrument(keys)

    print(f"{'':16}" + "".join(f"{column:>15}" for column in COLUMNS) + "  loudness   dB", flush=True)
    for out in left_out(keys, options.every, outermost=options.outermost):
        rest = [key for key in keys if key not in out]
        piano = build_instrument(rest)
        for key in out:
            near = min(rest, key=lambda other, key=key: abs(other.midi - key.midi))
            guess = piano.keys[key.midi].note
            rows: list[dict[str, Any]] = []
            own = whole.keys[key.midi]
            layers = own.fit.layers if own.fit else ()
            for rank, layer in enumerate(layers):
                target = tool.load(str(files[Path(layer.file).name]))
                at = round(rank * (len(near.summary.layers) - 1) / max(len(layers) - 1, 1))
                neighbour = files[Path(near.summary.layers[at].file).name]
                sounds = {
                    "law": rendered(tool, guess._replace(modal_response=None), layer.velocity),
                    "guess": rendered(tool, guess, layer.velocity),
                    "other speed": other_speed(tool, neighbour, key.midi - near.midi),
                    "own fit": rendered(tool, own.note, layer.velocity),
                }
                compared = {name: tool.compare(target, sound) for name, sound in sounds.items()}
                rows.append(
                    {name: {"distance": x["distance_db"], **x["logmel_db"]} for name, x in compared.items()}
                    | {"loudness": k_level(tool, sounds["guess"]) - k_level(tool, target)}
                )
            name = Path(key.summary.file).parent.name
            found[name] = {
                column: {part: float(np.mean([row[column][part] for row in rows])) for part in rows[0][column]}
                for column in COLUMNS
            } | {"loudness": float(np.mean([row["loudness"] for row in rows])), "nearest": abs(near.midi - key.midi)}
            cells = [f"{found[name][c]['distance']:.2f} ({found[name][c]['attack']:.2f})" for c in COLUMNS]
            print(f"{name:16}" + "".join(f"{c:>15}" for c in cells) + f"{found[name]['loudness']:+10.1f}", flush=True)
    means = {c: {p: np.mean([row[c][p] for row in found.values()]) for p in ("distance", "attack")} for c in COLUMNS}
    loudness = np.std([row["loudness"] for row in found.values()])
    cells = [f"{means[c]['distance']:.2f} ({means[c]['attack']:.2f})" for c in COLUMNS]
    print(f"{'mean':16}" + "".join(f"{cell:>15}" for cell in cells) + f"{loudness:10.1f} rms")
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
