"""What the envelopes of a left-out layer's partials miss: one thing replaced at a time.

    python benchmarks/envelope_study.py                all notes of the recordings
    python benchmarks/envelope_study.py --notes C4,A0 --json envelope_study.json

As in `realism.py` one inner layer of every note is left out, and the envelope is its measure: dB, in brackets the
shape alone. Beside the key's modes and knock stand

- one pattern: at every velocity that of the key, without what its strokes show of their participation,
- poles: of all layers, the left-out one too; patterns and participation of the others,
- amplitudes: of all layers' poles, and the amplitudes that the layer itself shows.

The last two know the recording and say what could be reached. The last columns are distances of `realism.py`, dB, as
it is and with one pattern. Medians are of all notes, of every second one, and of the others.
"""

from __future__ import annotations

import argparse
import json
import statistics
from pathlib import Path
from types import ModuleType

import crossval
import numpy as np
import realism
from scipy import signal

COLUMNS = ("as it is", "one pattern", "poles", "amplitudes")


def study(fit: realism.Fitted, left: realism.LeftOut, tool: ModuleType) -> dict[str, tuple[float, float, float]]:
    """Envelope, its shape and distance, dB, of the left-out layer, by what is replaced."""
    from pianofit.modal_response import AlignedLayers, align_layers, estimate_shared_response, modes_of
    from pianofit.modal_response.model_selection import _layers, _of_layers
    from pianofit.modal_response.modes import synthesise

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
    heard = align_layers(recordings, analyses)
    together, rest = modes_of(heard, analyses), list(range(1, len(analyses)))
    others = AlignedLayers(heard.samples[rest], heard.before[rest], heard.rate, heard.seconds[rest])
    known = estimate_shared_response(others, [_of_layers(m, rest) for m in together], layers.forces, layers.gain)
    by = np.gcd(tool.RATE, heard.rate)
    own = signal.resample_poly(synthesise(together, heard)[0].mean(axis=0), tool.RATE // by, heard.rate // by)
    own = np.pad(own, (round(recordings[0].onset / recordings[0].rate * tool.RATE), 0))
    ringing = note.ringing
    assert ringing is not None  # noqa: S101
    rows = [ringing, ringing._replace(participation=None), known.ringing]
    return dict(zip(COLUMNS, [*map(rung_by, rows), of(own, 0.0)], strict=True))


def line(name: str, row: dict) -> str:
    """A row of the table."""
    cells = [f"{row[c][0]:.2f} ({row[c][1]:.2f})" for c in COLUMNS]
    return f"{name:20}" + "".join(f"{x:>14}" for x in cells) + f"{row[COLUMNS[0]][2]:8.2f}{row[COLUMNS[1]][2]:8.2f}"


def main() -> None:
    """Print the table."""
    from pianofit.model.program_cache import enable_program_cache
    from pianofit.threads import one_blas_thread

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--notes", default="", help="only notes whose names contain one of these, separated by commas")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    enable_program_cache()
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
    print(f"{'':20}" + "".join(f"{c:>14}" for c in COLUMNS) + f"{'as is':>8}{'one':>8}", flush=True)


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
