"""How far a synthesised layer that took no part in anything is from its recording.

    python benchmarks/realism.py                       all notes of the recordings
    python benchmarks/realism.py --notes C4,A0 --json realism.json
    python benchmarks/realism.py --constants           what halving and doubling each constant of the ringing does

Of every note with three layers or more one inner layer is left out entirely: string, hammer, modes and knock come from
the others, its velocity from `predict_recording`. The distance is that of `../shared/tools/realism.py` (or of the file
that PIANOFIT_REALISM names), dB: the mean of three log-mel distances, attack, early and late, blind to gain and shift.
Beside it stands the nearer of the two neighbouring recordings. Recordings are found as `crossval.py` finds them.
Constants are judged on every second note and checked on the others.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
import os
import statistics
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, NamedTuple

import crossval
import numpy as np
from scipy import signal

if TYPE_CHECKING:
    from pianofit.model.modal import Force, Ringing

TOOL = Path(__file__).parents[2] / "shared" / "tools" / "realism.py"
SECONDS = 3.3
RUNGS = ("law", "modes", "modes and knock", "nearest layer")
CONSTANTS = {
    "bands": ("KERNEL",),
    "tuning": ("COHERENT", "DETUNED", "TUNED", "HALF_COHERENT"),
    "cut": ("EVEN", "RANGE", "LEAST_SNR", "ENVELOPE", "CONTACT", "LOST", "FINE"),
    "modes": ("FASTEST", "FASTER", "FAINTEST", "AHEAD", "OF_SPACING", "OF_BAND"),
    "key": ("KNOCK", "FADE", "DRIVEN", "FLOOR", "ATTACK", "FAR", "LATEST", "ALIGNED", "LOUDNESS"),
}


class LeftOut(NamedTuple):
    """A layer that was left out, and what the others say of it."""

    key: Callable[[], Ringing]  # how the others ring
    force: Force  # of the stroke that was left out
    law: np.ndarray  # what its partials by the string's law sound like [samples]
    rate: int  # Hz
    target: np.ndarray  # the recording [samples]
    near: dict  # distances of the nearer neighbour


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


def left_out(note: str, files: list[Path], setup, tool: ModuleType) -> LeftOut:
    """The layer in the middle left out, the others fitted."""
    from pianofit import analyse, fit, load_recording, predict_recording
    from pianofit.model.modal import force_of
    from pianofit.ringing import ringing_of

    pairs = [(recording, analyse(recording, note=note)) for recording in map(load_recording, files)]
    order = sorted(range(len(files)), key=lambda i: brightness(pairs[i][1]))
    files, pairs = [files[i] for i in order], [pairs[i] for i in order]
    recordings, analyses = zip(*pairs, strict=True)
    out = (len(files) - 1) // 2
    rest = [i for i in range(len(files)) if i != out]
    result = fit(*(recordings[i] for i in rest), analyses=[analyses[i] for i in rest], setup=setup)
    played = predict_recording(result.mixture, analyses[out], gains=result.gains).note
    rate, target = recordings[out].rate, tool.load(str(files[out]))
    stroke = played.strike(rate)
    near = [tool.compare(target, tool.load(str(files[i]))) for i in (out - 1, out + 1)]
    best = min(near, key=lambda x: x["distance_db"])
    law = played._replace(ringing=None).heard(stroke, rate, round(SECONDS * rate), round(0.01 * rate))
    return LeftOut(
        lambda: ringing_of(result), force_of(stroke), law, rate, target,
        {"distance": best["distance_db"], **best["logmel_db"]},
    )  # fmt: skip


def distance(samples: np.ndarray, left: LeftOut, tool: ModuleType) -> dict[str, float]:
    """Of a synthesis from the recording, dB: mean, attack, early and late."""
    by = np.gcd(tool.RATE, left.rate)
    recorded, played, *_ = tool.align(left.target, signal.resample_poly(samples, tool.RATE // by, left.rate // by))
    mean, parts = tool.logmel(recorded, played)
    return {"distance": mean, **parts}


def rungs(left: LeftOut, tool: ModuleType) -> dict:
    """Distances of the layer that was left out, by what it is made of."""
    key, count = left.key(), round(SECONDS * left.rate)
    return {
        "law": distance(left.law, left, tool),
        "modes": distance(key.without_knock().sound(left.force, left.rate, count).mean(axis=0), left, tool),
        "modes and knock": distance(key.sound(left.force, left.rate, count).mean(axis=0), left, tool),
        "nearest layer": left.near,
        "modes_count": len(key.pole),
    }


def constants(left: dict[str, LeftOut], tool: ModuleType) -> dict:
    """Mean distances of both halves of the notes with each constant halved and doubled."""

    def halves() -> list[float]:
        each = [
            distance(x.key().sound(x.force, x.rate, round(SECONDS * x.rate)).mean(axis=0), x, tool)["distance"]
            for x in left.values()
        ]
        return [float(np.mean(each[half::2])) for half in (0, 1)]

    judged, checked = list(left)[::2], list(left)[1::2]
    print(f"judged on {', '.join(judged)}\nchecked on {', '.join(checked)}")
    found = {"as they are": halves()}
    print("as they are: {:.3f} {:.3f} dB".format(*found["as they are"]), flush=True)
    for room, names in CONSTANTS.items():
        module = importlib.import_module(f"pianofit.ringing.{room}")
        for name in names:
            own = getattr(module, name)
            for factor in (0.5, 2.0):
                value = own * factor if isinstance(own, float) else round(own * factor) | 1
                setattr(module, name, value)
                now = found[f"{name} {own:g} -> {value:g}"] = halves()
                print(
                    f"{name:12}{own:9g}{value:9g}"
                    + "".join(f"{x - y:+9.3f}" for x, y in zip(now, found["as they are"], strict=True)),
                    flush=True,
                )
            setattr(module, name, own)
    return found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--notes", default="", help="only notes whose names contain one of these, separated by commas")
    parser.add_argument("--constants", action="store_true", help="what each constant of the ringing does")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    from pianofit.model.cache import keep_programs

    keep_programs()
    tool, wanted = measure(), [x for x in options.notes.split(",") if x]
    chosen = {
        name: job
        for folder in crossval.folders()
        for name, job in crossval.notes(folder).items()
        if not wanted or any(x in name for x in wanted)
    }
    if options.constants:
        found = constants({name: left_out(*job, tool) for name, job in chosen.items()}, tool)
    else:
        found = table({name: (lambda job=job: left_out(*job, tool)) for name, job in chosen.items()}, tool)
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


def table(jobs: dict[str, Callable[[], LeftOut]], tool: ModuleType) -> dict:
    """A row a note, and the means."""
    found = {}
    print(f"{'':20}" + "".join(f"{rung:>18}" for rung in RUNGS) + "   dB, attack in brackets", flush=True)
    for name, job in jobs.items():
        found[name] = rungs(job(), tool)
        cells = [f"{found[name][r]['distance']:.2f} ({found[name][r]['attack']:.2f})" for r in RUNGS]
        print(f"{name:20}" + "".join(f"{cell:>18}" for cell in cells), flush=True)
    for how, of in (("mean", statistics.mean), ("median", statistics.median), ("worst", max)):
        print(f"{how:20}" + "".join(f"{of(x[r]['distance'] for x in found.values()):>18.2f}" for r in RUNGS))
    return found


if __name__ == "__main__":
    main()
