"""Find the cause of envelope errors in the prediction of a left-out layer, by replacing one part at a time.

    python benchmarks/envelope_study.py                all notes of the recordings
    python benchmarks/envelope_study.py --notes C4,A0 --json envelope_study.json

As in `realism.py`, one inner layer of every note is left out. The envelope is its measure: dB, in brackets the shape
alone. The predictions use

- as it is: the modes and the knock of the key,
- one pattern: the pattern of the key at every velocity, without the participation of its strokes,
- poles: the poles of all layers, including the left-out one, with patterns and participation of the others,
- amplitudes: the poles of all layers, and the amplitudes of the left-out layer.

The last two use the left-out recording and show the best possible prediction. The last columns are distances of
`realism.py`, dB, as it is and with one pattern. Medians are given for all notes, for every second note, and for the
others.
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
    """Return envelope error, shape error and distance, dB, of the left-out layer, by column."""
    from pianofit.modal_response.aligned_layers import AlignedLayers, align_layers
    from pianofit.modal_response.model_selection import _layers, _of_layers
    from pianofit.modal_response.modes import modes_of, synthesise
    from pianofit.modal_response.shared_response import estimate_shared_response

    result, out = fit.result, fit.out
    layers, note = _layers(result), left.note()
    *_, lag, _ = tool.align(left.target, realism.sound(note, left, tool))
    begin = tool.onset(left.target)

    def compare(samples: np.ndarray, lag: float) -> tuple[float, float, float]:
        pair = tool.cut(left.target, begin), tool.cut(samples, begin + round(lag * tool.RATE))
        recorded, played = (x[: min(map(len, pair))] for x in pair)
        loud = [np.sum(tool.k_weighted(x) ** 2) for x in (recorded, played)]
        played = played * np.sqrt(loud[0] / loud[1])
        return *realism.envelopes(recorded, played, left, tool), tool.logmel(recorded, played)[0]

    def predict(ringing) -> tuple[float, float, float]:
        return compare(realism.sound(note._replace(modal_response=ringing), left, tool), lag)

    recordings = [fit.recordings[out], *(layer.recording for layer in layers.fitted)]
    analyses = [fit.analyses[out], *(layer.analysis for layer in layers.fitted)]
    aligned = align_layers(recordings, analyses)
    modes, rest = modes_of(aligned, analyses), list(range(1, len(analyses)))
    others = AlignedLayers(aligned.samples[rest], aligned.before[rest], aligned.rate, aligned.seconds[rest])
    response = estimate_shared_response(others, [_of_layers(m, rest) for m in modes], layers.forces, layers.gain)
    divisor = np.gcd(tool.RATE, aligned.rate)
    up, down = tool.RATE // divisor, aligned.rate // divisor
    own = signal.resample_poly(synthesise(modes, aligned)[0].mean(axis=0), up, down)
    own = np.pad(own, (round(recordings[0].onset / recordings[0].rate * tool.RATE), 0))
    ringing = note.modal_response
    assert ringing is not None  # noqa: S101
    rows = [ringing, ringing._replace(velocity_gain=None), response.response]
    return dict(zip(COLUMNS, [*map(predict, rows), compare(own, 0.0)], strict=True))


def line(name: str, row: dict) -> str:
    """Format a row of the table."""
    cells = [f"{row[c][0]:.2f} ({row[c][1]:.2f})" for c in COLUMNS]
    return f"{name:20}" + "".join(f"{x:>14}" for x in cells) + f"{row[COLUMNS[0]][2]:8.2f}{row[COLUMNS[1]][2]:8.2f}"


def main() -> None:
    """Print the table."""
    from pianofit.program_folder import enable_program_cache
    from pianofit.threads import numerical_settings

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--notes", default="", help="only notes whose names contain one of these, separated by commas")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    enable_program_cache()
    tool, wanted, results = realism.measure(), [x for x in options.notes.split(",") if x], {}
    header()
    with numerical_settings():
        for folder in crossval.folders():
            for name, job in crossval.notes(folder).items():
                if not wanted or any(x in name for x in wanted):
                    fit = realism.fitted(*job)
                    results[name] = study(fit, realism.left_out(fit, tool), tool)
                    print(line(name, results[name]), flush=True)
    medians(results)
    if options.json:
        options.json.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


def header() -> None:
    """Print the names of the columns."""
    print(f"{'':20}" + "".join(f"{c:>14}" for c in COLUMNS) + f"{'as is':>8}{'one':>8}", flush=True)


def medians(results: dict[str, dict]) -> None:
    """Print the medians."""
    names = list(results)
    for label, group in (("median", names), ("every second", names[::2]), ("the others", names[1::2])):
        if group:
            middle = {
                c: [statistics.median(x) for x in zip(*(results[n][c] for n in group), strict=True)] for c in COLUMNS
            }
            print(line(label, middle))


if __name__ == "__main__":
    main()
