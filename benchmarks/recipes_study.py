"""The paper's recipes beside the default one, on measurements whose truth is known.

    python benchmarks/recipes_study.py                    the demo's twin and three strokes of the laboratory, 10 seeds
    python benchmarks/recipes_study.py --seeds 3 --evaluations 5000 --json study.json

For each measurement: the criterion (eq. 19, 0 equal, 1 silence) in each band, on the sounds, and how far the parameters
are off, in per cent. `paper` is `--recipe paper`, over seeds of its annealing: medians, then the least and the largest;
`global` has no seed. μ is compared only where the measurement's felt has one. Times are of the fit alone, in a warm
process: take them on an idle machine.
"""

from __future__ import annotations

import argparse
import json
import time
import tomllib
from pathlib import Path
from typing import NamedTuple

import numpy as np

import pianofit
from pianofit import Analysis, Recording, Setup, analyse, recording_from_samples, setup_from_dict
from pianofit.bensa2005.laboratory import SyntheticMeasurement, make_synthetic_recording, measure, setup_text
from pianofit.bensa2005.recipes import fit_by_paper
from pianofit.bensa2005.search import pose, split
from pianofit.criterion import band_values, line_sigma
from pianofit.criterion import measure as energies
from pianofit.inference.initial_values import starting_values
from pianofit.model import simulate
from pianofit.model.program_cache import enable_program_cache
from pianofit.parameters import FIT_NAMES

VELOCITIES = (0.618, 0.844, 1.299)
# Levels are compared over partials to this frequency, Hz,
LEVEL_TOP = 6000.0
# within so many dB of the strongest.
LEVEL_RANGE = 60.0
BANDS = ("global", "band1", "band2", "band3")


class Measured(NamedTuple):
    """A recording whose truth is known."""

    name: str
    recording: Recording
    analysis: Analysis
    setup: Setup
    true: dict[str, float]


def measurements(velocities: tuple[float, ...] = VELOCITIES) -> list[Measured]:
    """The demo's twin, and the laboratory's strokes, all from the paper's initial values."""
    twin = make_synthetic_recording(60.0, seed=0)
    found = [_measured("demo twin", twin.samples, twin.rate, setup_text(), twin.true)]
    for velocity in velocities:
        stroke = measure(SyntheticMeasurement(), velocity, seed=0)
        text = setup_text(stroke.scale, stroke.nominal_velocity)
        found.append(_measured(f"laboratory, {velocity} m/s", stroke.samples, stroke.rate, text, stroke.true))
    return found


def _measured(name: str, samples: np.ndarray, rate: int, setup: str, true: dict[str, float]) -> Measured:
    recording = recording_from_samples(samples, rate, name=name)
    return Measured(name, recording, analyse(recording), setup_from_dict(tomllib.loads(setup), name), true)


class Closeness(NamedTuple):
    """How far a sound is from its measurement."""

    criterion: dict[str, float]
    level_db: float  # rms difference of the partials' levels


def fit(one: Measured, recipe: str, seed: int, evaluations: int) -> np.ndarray:
    """The nine parameters by a recipe."""
    if recipe == "default":
        table = pianofit.fit(one.recording, analyses=[one.analysis], setup=one.setup, seed=seed).parameters
        return np.array([table[name].value for name in FIT_NAMES])
    start, more = starting_values(one.analysis, one.setup), evaluations if recipe == "paper" else None
    found = fit_by_paper(one.recording, one.analysis, start, recipe, evaluations=more, seed=seed)
    return np.array([*found.string, *found.hammer])


def closeness(one: Measured, values: np.ndarray) -> Closeness:
    """Of a stroke with these nine parameters, laid on the measurement where its attack fits best."""
    r, a, start = one.recording, one.analysis, starting_values(one.analysis, one.setup)
    heard = r.samples[r.onset :] * (start.scale or 1.0)
    late = max(round(pose(r, a, start).first_contact(values) * r.rate), 0)
    stroke = simulate(*split(values), start.geometry, rate=r.rate, quantity=start.quantity)
    sound, last = stroke.waveform(r.rate, len(heard) + late)[late:], int(a.partials.number.max())
    (cells, measured), (_, own) = (energies(x, r.rate, a.f0, a.B, last, line_sigma(a.f0)) for x in (heard, sound))
    level = [10 * np.log10((x.sum(axis=1) * cells.spacing)[a.partials.number - 1]) for x in (own, measured)]
    scored = (a.partials.frequency <= LEVEL_TOP) & (level[1] >= level[1].max() - LEVEL_RANGE)
    difference = (level[0] - level[1])[scored]
    return Closeness(band_values(own, measured, cells.spacing), float(np.sqrt(np.mean(difference**2))))


def study(one: Measured, recipe: str, seeds: int, evaluations: int) -> dict:
    """Criteria [seeds], errors in per cent [seeds], and the median time, s."""
    runs, times = [], []
    for seed in range(seeds if recipe == "paper" else 1):
        begun = time.perf_counter()
        runs.append(fit(one, recipe, seed, evaluations))
        times.append(time.perf_counter() - begun)
    close = [closeness(one, values) for values in runs]
    criterion = {band: [c.criterion[band] for c in close] for band in BANDS if band in close[0].criterion}
    errors = {
        name: [100 * (values[FIT_NAMES.index(name)] / one.true[name] - 1) for values in runs]
        for name in FIT_NAMES
        if name in one.true
    }
    level = [c.level_db for c in close]
    return {"criterion": criterion, "errors": errors, "level_db": level, "seconds": float(np.median(times))}


def line(name: str, result: dict) -> str:
    """One recipe's medians, and the spread over seeds below them."""
    rows = [*result["criterion"].values()], [*result["errors"].values()]
    text = f"{name:9}" + "".join(f"{np.median(x):10.2e}" for x in rows[0])
    text += "".join(f"{np.median(x):+9.3g}" for x in rows[1])
    text += f"{np.median(result['level_db']):8.2f} dB{result['seconds']:7.1f} s"
    if len(result["level_db"]) > 1:
        for end in (np.min, np.max):
            text += "\n" + " " * 9 + "".join(f"{end(x):10.2e}" for x in rows[0])
            text += "".join(f"{end(x):+9.3g}" for x in rows[1])
    return text


def main() -> None:
    """Print a table a measurement."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--evaluations", type=int, default=20_000)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    enable_program_cache()
    everything: dict[str, dict] = {}
    for one in measurements():
        fit(one, "paper", 0, 500)  # what is compiled counts for nobody
        fit(one, "default", 0, 500)
        results = {
            recipe: study(one, recipe, arguments.seeds, arguments.evaluations)
            for recipe in ("default", "paper", "global")
        }
        everything[one.name] = results
        names = [*results["paper"]["criterion"], *results["paper"]["errors"]]
        width = [10] * len(results["paper"]["criterion"]) + [9] * len(results["paper"]["errors"])
        print(f"\n{one.name}\n{'':9}" + "".join(f"{n:>{w}}" for n, w in zip(names, width, strict=True)))
        for recipe, result in results.items():
            print(line(recipe, result), flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(everything, indent=1))


if __name__ == "__main__":
    main()
