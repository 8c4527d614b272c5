"""How far a synthesised layer that took no part in anything is from its recording.

    python benchmarks/realism.py                       all notes of the recordings
    python benchmarks/realism.py --notes C4,A0 --json realism.json

Of every note with three layers or more one inner layer is left out entirely: string, hammer, modes and knock come from
the others, and its velocity is the one at which the fit's partials suit it best. The distance is that of
`../shared/tools/realism.py` (or of the file that PIANOFIT_REALISM names), dB: the mean of three log-mel distances,
attack, early and late, blind to gain and shift. Beside it stands the nearer of the two neighbouring recordings.
Recordings are found as `crossval.py` finds them.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import statistics
from pathlib import Path
from types import ModuleType

import crossval
import numpy as np
from scipy import signal

TOOL = Path(__file__).parents[2] / "shared" / "tools" / "realism.py"
SECONDS = 3.3
RUNGS = ("law", "modes", "modes and knock", "nearest layer")


def measure() -> ModuleType:
    """The program that measures."""
    spec = importlib.util.spec_from_file_location("realism_tool", os.environ.get("PIANOFIT_REALISM", TOOL))
    if spec is None or spec.loader is None:
        raise SystemExit(f"{TOOL}: no such file; say where it is in PIANOFIT_REALISM")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def brightness(analysis) -> float:
    """Mean frequency of the partials, weighed by amplitude, Hz: it rises with the stroke, whatever a file's gain."""
    amplitude = 10 ** (analysis.partials.level / 20)
    return float((amplitude * analysis.partials.frequency).sum() / amplitude.sum())


def rungs(note: str, files: list[Path], setup, tool: ModuleType) -> dict:
    """Distances of the layer in the middle, by what it is made of."""
    from pianofit import analyse, fit, load_recording, predict_take
    from pianofit.model.modal import force_of
    from pianofit.ringing import ringing_of

    pairs = [(recording, analyse(recording, note=note)) for recording in map(load_recording, files)]
    order = sorted(range(len(files)), key=lambda i: brightness(pairs[i][1]))
    files, pairs = [files[i] for i in order], [pairs[i] for i in order]
    recordings, analyses = zip(*pairs, strict=True)
    out = (len(files) - 1) // 2
    rest = [i for i in range(len(files)) if i != out]
    result = fit(*(recordings[i] for i in rest), analyses=[analyses[i] for i in rest], setup=setup)
    played = predict_take(result.mixture, analyses[out]).note
    rate = recordings[out].rate
    stroke, key = played.strike(rate), ringing_of(result)
    force, count = force_of(stroke), round(SECONDS * rate)
    target = tool.load(str(files[out]))

    def distance(samples: np.ndarray) -> dict[str, float]:
        by = np.gcd(tool.RATE, rate)
        there = tool.compare(target, signal.resample_poly(samples, tool.RATE // by, rate // by))
        return {"distance": there["distance_db"], **there["logmel_db"], "loudness": there["loudness_rms_db"]}

    near = [tool.compare(target, tool.load(str(files[i]))) for i in (out - 1, out + 1)]
    best = min(near, key=lambda x: x["distance_db"])
    return {
        "law": distance(played._replace(ringing=None).heard(stroke, rate, count, round(0.01 * rate))),
        "modes": distance(key.without_knock().sound(force, rate, count).mean(axis=0)),
        "modes and knock": distance(key.sound(force, rate, count).mean(axis=0)),
        "nearest layer": {"distance": best["distance_db"], **best["logmel_db"], "loudness": best["loudness_rms_db"]},
        "modes_count": len(key.pole),
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--notes", default="", help="only notes whose names contain one of these, separated by commas")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    from pianofit.model.cache import keep_programs

    keep_programs()
    tool, found = measure(), {}
    wanted = [x for x in options.notes.split(",") if x]
    print(f"{'':20}" + "".join(f"{rung:>18}" for rung in RUNGS) + "   dB, attack in brackets", flush=True)
    for folder in crossval.folders():
        for name, (note, files, setup) in crossval.notes(folder).items():
            if wanted and not any(x in name for x in wanted):
                continue
            found[name] = rungs(note, files, setup, tool)
            cells = [f"{found[name][r]['distance']:.2f} ({found[name][r]['attack']:.2f})" for r in RUNGS]
            print(f"{name:20}" + "".join(f"{cell:>18}" for cell in cells), flush=True)
    for how, of in (("mean", statistics.mean), ("median", statistics.median), ("worst", max)):
        print(f"{how:20}" + "".join(f"{of(x[r]['distance'] for x in found.values()):>18.2f}" for r in RUNGS))
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
