"""What the envelopes of a left-out layer's partials miss: one thing replaced at a time.

    python benchmarks/envelope_study.py                all notes of the recordings
    python benchmarks/envelope_study.py --notes C4,A0 --json envelope_study.json

As in `realism.py` one inner layer of every note is left out, and the envelope is its measure: dB, in brackets the
shape alone. Beside the key's modes and knock stand

- poles: of all layers, the left-out one too; patterns of the others,
- amplitudes: of all layers' poles, and the amplitudes that the layer itself shows,
- levels: partials as much louder or softer than the key's pattern as the two layers of neighbouring velocity are,
  interpolated in the logarithm of the velocity,
- shapes: the ratios of a partial's modes, and their phases, interpolated likewise,
- both.

The first two know the recording and say what could be reached; the others do not. The last columns are the distances of
`realism.py`, dB, with the key's pattern and with both interpolated. Medians are of all notes, of every second one,
and of the others.
"""

from __future__ import annotations

import argparse
import json
import statistics
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import crossval
import numpy as np
import realism
from scipy import signal

# A layer's partial tells its level and shape from here on, dB over the noise; a level differs by so much at the most.
TELLING = 20.0
MOST = 20.0
# A shape whose projection on the key's is a smaller part of it is taken for the key's.
ALIKE = 0.5
COLUMNS = ("as it is", "poles", "amplitudes", "levels", "shapes", "both")


class Changed(NamedTuple):
    """Patterns [channels, modes] for one velocity."""

    levels: np.ndarray
    shapes: np.ndarray
    both: np.ndarray


def follow(layers, modes, key, velocity: float) -> Changed:
    """The key's patterns, moved to where those of the layers of neighbouring velocity lie."""
    known = np.array([layer.fitted.note.hammer.v_H0 for layer in layers.fitted])
    low = int(np.clip(np.searchsorted(known, velocity) - 1, 0, len(known) - 2))
    share = float(np.clip(np.log(velocity / known[low]) / np.log(known[low + 1] / known[low]), 0, 1))
    parts: list[Changed] = []
    ends = np.cumsum([len(m.pole) for m in modes])
    for m, common in zip(modes, np.split(key.ringing.pattern, ends[:-1], axis=-1), strict=True):
        strongest = m.poles[[np.argmax(np.abs(m.amplitude).sum((0, 1)))]]
        drive = np.array([force.drive(strongest)[0] for force in layers.forces])
        own = m.at_onset * np.exp(np.multiply.outer(key.delay, m.poles))[:, None, :]
        own = own / (drive * layers.gain)[:, None, None]
        along = (own * common.conj()).sum((1, 2)) / np.sum(np.abs(common) ** 2)
        told = (m.snr > TELLING) & (np.abs(along) > 0)
        limit = MOST / 20 * np.log(10)
        level = np.where(told, np.log(np.abs(along) + 1e-30), 0.0).clip(-limit, limit)
        alike = np.abs(along) * np.linalg.norm(common) > ALIKE * np.linalg.norm(own, axis=(1, 2))
        shape = np.where((told & alike)[:, None, None], own / np.where(told, along, 1)[:, None, None], common)
        louder = np.exp((1 - share) * level[low] + share * level[low + 1])
        moved = (1 - share) * shape[low] + share * shape[low + 1]
        parts.append(Changed(louder * common, moved, louder * moved))
    return Changed(*(np.concatenate(each, axis=-1) for each in zip(*parts, strict=True)))


def study(fit: realism.Fitted, left: realism.LeftOut, tool: ModuleType) -> dict[str, tuple[float, float, float]]:
    """Envelope, its shape and distance, dB, of the left-out layer, by what is replaced."""
    from pianofit.ringing import Heard, hear, key_of, modes_of
    from pianofit.ringing.fitted import _layers, _of_layers
    from pianofit.ringing.modes import sounded

    result, out = fit.result, fit.out
    layers, note = _layers(result), left.note()
    *_, lag, _ = tool.align(left.target, realism.sound(note, left, tool))
    begin = tool.onset(left.target)

    def of(samples: np.ndarray, lag: float) -> tuple[float, float, float]:
        pair = tool.cut(left.target, begin), tool.cut(samples, begin + round(lag * tool.RATE))
        recorded, played = (x[: min(map(len, pair))] for x in pair)
        loud = [np.sum(tool.k_weighted(x) ** 2) for x in (recorded, played)]
        played = played * np.sqrt(loud[0] / loud[1])
        return *realism.envelopes(recorded, played, left, tool), tool.logmel(recorded, played)[0]

    def rung_by(ringing) -> tuple[float, float, float]:
        return of(realism.sound(note._replace(ringing=ringing), left, tool), lag)

    recordings = [fit.recordings[out], *(layer.recording for layer in layers.fitted)]
    analyses = [fit.analyses[out], *(layer.analysis for layer in layers.fitted)]
    heard = hear(recordings, analyses)
    together, rest = modes_of(heard, analyses), list(range(1, len(analyses)))
    others = Heard(heard.samples[rest], heard.before[rest], heard.rate, heard.seconds[rest])
    known = key_of(others, [_of_layers(m, rest) for m in together], layers.forces, layers.gain)
    by = np.gcd(tool.RATE, heard.rate)
    own = signal.resample_poly(sounded(together, heard)[0].mean(axis=0), tool.RATE // by, heard.rate // by)
    own = np.pad(own, (round(recordings[0].onset / recordings[0].rate * tool.RATE), 0))
    modes = layers.modes()
    key = key_of(layers.heard, modes, layers.forces, layers.gain)
    changed = follow(layers, modes, key, note.hammer.v_H0)
    rows = [note.ringing, known.ringing]
    found: dict[str, tuple[float, float, float]] = {}
    found.update(zip(COLUMNS, [*map(rung_by, rows), of(own, 0.0)], strict=False))
    for name, pattern in zip(Changed._fields, changed, strict=True):
        found[name] = rung_by(key.ringing._replace(pattern=pattern))
    return found


def line(name: str, row: dict) -> str:
    """A row of the table."""
    cells = [f"{row[c][0]:.2f} ({row[c][1]:.2f})" for c in COLUMNS]
    return f"{name:20}" + "".join(f"{x:>14}" for x in cells) + f"{row[COLUMNS[0]][2]:8.2f}{row[COLUMNS[-1]][2]:8.2f}"


def main() -> None:
    """Print the table."""
    from pianofit.model.cache import keep_programs
    from pianofit.threads import one_blas_thread

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--notes", default="", help="only notes whose names contain one of these, separated by commas")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    keep_programs()
    tool, wanted, found = realism.measure(), [x for x in options.notes.split(",") if x], {}
    header()
    with one_blas_thread():
        for folder in crossval.folders():
            for name, job in crossval.notes(folder).items():
                if not wanted or any(x in name for x in wanted):
                    fit = realism.fitted(*job)
                    found[name] = study(fit, realism.left_out(fit, tool), tool)
                    print(line(name, found[name]), flush=True)
    medians(found)
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


def header() -> None:
    """Print the names of the columns."""
    print(f"{'':20}" + "".join(f"{c:>14}" for c in COLUMNS) + f"{'as is':>8}{'both':>8}", flush=True)


def medians(found: dict[str, dict]) -> None:
    """Print what is usual."""
    names = list(found)
    for what, some in (("median", names), ("every second", names[::2]), ("the others", names[1::2])):
        if some:
            middle = {
                c: [statistics.median(x) for x in zip(*(found[n][c] for n in some), strict=True)] for c in COLUMNS
            }
            print(line(what, middle))


if __name__ == "__main__":
    main()
