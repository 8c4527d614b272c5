"""Compare the paper's recipes and the default recipe on synthetic recordings.

    python -m studies.bensa2005.recipes                   the demo and three strokes of the laboratory, 10 seeds
    python -m studies.bensa2005.recipes --seeds 3 --evaluations 5000 --json study.json

For each recording the table gives the criterion (eq. 19, 0 equal, 1 silence) of the sounds in each band, and the errors
of the parameters in per cent. `paper` is `--recipe paper`, over seeds of its annealing: medians, then the least and the
largest. `global` has no seed. μ is compared only for a felt with μ. Times are those of the fit alone, without
compilation: run the study on an idle machine.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

import pianofit
from pianofit import Analysis, Recording, Setup, analyse, recording_from_samples
from pianofit.bensa2005.method import search_parameters
from pianofit.bensa2005.search import make_search, split
from pianofit.criterion import band_values, damping_for
from pianofit.criterion import measure as energies
from pianofit.felt.hunt_crossley import HUNT_CROSSLEY
from pianofit.inference import starting_values
from pianofit.model import simulate
from pianofit.parameters import FIT_NAMES
from pianofit.program_folder import enable_program_cache
from pianofit.synthetic import demo_recording

from .laboratory import SyntheticMeasurement, measure

VELOCITIES = (0.618, 0.844, 1.299)
# Levels are compared over partials to this frequency, Hz,
LEVEL_TOP = 6000.0
# within this range below the strongest, dB.
LEVEL_RANGE = 60.0
BANDS = ("global", "band1", "band2", "band3")


class Measured(NamedTuple):
    """A synthetic recording."""

    name: str
    recording: Recording
    analysis: Analysis
    setup: Setup
    true: dict[str, float]


def measurements(velocities: tuple[float, ...] = VELOCITIES) -> list[Measured]:
    """Return the demo and the strokes of the laboratory, all with the paper's initial values."""
    demo = demo_recording(60.0, seed=0)
    cases = [_measured("demo", demo.samples, demo.rate, demo.setup, demo.true)]
    for velocity in velocities:
        stroke = measure(SyntheticMeasurement(), velocity, seed=0)
        name = f"laboratory, {velocity} m/s"
        cases.append(_measured(name, stroke.samples, stroke.rate, stroke.setup(), stroke.true))
    return cases


def _measured(name: str, samples: np.ndarray, rate: int, setup: Setup, true: dict[str, float]) -> Measured:
    recording = recording_from_samples(samples, rate, name=name)
    # All recipes fit the paper's felt.
    return Measured(name, recording, analyse(recording), replace(setup, felt=HUNT_CROSSLEY.name), true)


class Closeness(NamedTuple):
    """Difference between a sound and its measurement."""

    criterion: dict[str, float]
    level_db: float  # rms difference of the partials' levels


def fit(case: Measured, recipe: str, seed: int, evaluations: int) -> np.ndarray:
    """Fit the nine parameters by a recipe."""
    if recipe == "default":
        table = pianofit.fit(case.recording, analyses=[case.analysis], setup=case.setup, seed=seed).parameters
        return np.array([table[name].value for name in FIT_NAMES])
    start, more = starting_values(case.analysis, case.setup), evaluations if recipe == "paper" else None
    end = search_parameters(case.recording, case.analysis, start, recipe, evaluations=more, seed=seed)
    return np.array([*end.string, *end.hammer])


def closeness(case: Measured, values: np.ndarray) -> Closeness:
    """Compare a stroke with these nine parameters, aligned at the attack, with its measurement."""
    r, a, start = case.recording, case.analysis, starting_values(case.analysis, case.setup)
    recorded = r.samples[r.onset :] * (start.scale or 1.0)
    late = max(round(make_search(r, a, start).first_contact(values) * r.rate), 0)
    stroke = simulate(*split(values), start.geometry, rate=r.rate, quantity=start.quantity)
    sound, last = stroke.waveform(r.rate, len(recorded) + late)[late:], int(a.partials.number.max())
    (cells, measured), (_, own) = (energies(x, r.rate, a.f0, a.B, last, damping_for(a.f0)) for x in (recorded, sound))
    level = [10 * np.log10((x.sum(axis=1) * cells.spacing)[a.partials.number - 1]) for x in (own, measured)]
    scored = (a.partials.frequency <= LEVEL_TOP) & (level[1] >= level[1].max() - LEVEL_RANGE)
    difference = (level[0] - level[1])[scored]
    return Closeness(band_values(own, measured, cells.spacing), float(np.sqrt(np.mean(difference**2))))


def study(case: Measured, recipe: str, seeds: int, evaluations: int) -> dict:
    """Return criteria [seeds], errors in per cent [seeds], and the median time, s."""
    runs, times = [], []
    for seed in range(seeds if recipe == "paper" else 1):
        begun = time.perf_counter()
        runs.append(fit(case, recipe, seed, evaluations))
        times.append(time.perf_counter() - begun)
    close = [closeness(case, values) for values in runs]
    criterion = {band: [c.criterion[band] for c in close] for band in BANDS if band in close[0].criterion}
    errors = {
        name: [100 * (values[FIT_NAMES.index(name)] / case.true[name] - 1) for values in runs]
        for name in FIT_NAMES
        if name in case.true
    }
    level = [c.level_db for c in close]
    return {"criterion": criterion, "errors": errors, "level_db": level, "seconds": float(np.median(times))}


def line(name: str, result: dict) -> str:
    """Format the medians of one recipe, and the range over seeds below them."""
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
    """Print a table for each recording."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--evaluations", type=int, default=20_000)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    enable_program_cache()
    everything: dict[str, dict] = {}
    for case in measurements():
        fit(case, "paper", 0, 500)  # excludes compilation from the times
        fit(case, "default", 0, 500)
        results = {
            recipe: study(case, recipe, arguments.seeds, arguments.evaluations)
            for recipe in ("default", "paper", "global")
        }
        everything[case.name] = results
        names = [*results["paper"]["criterion"], *results["paper"]["errors"]]
        width = [10] * len(results["paper"]["criterion"]) + [9] * len(results["paper"]["errors"])
        print(f"\n{case.name}\n{'':9}" + "".join(f"{n:>{w}}" for n, w in zip(names, width, strict=True)))
        for recipe, result in results.items():
            print(line(recipe, result), flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(everything, indent=1))


if __name__ == "__main__":
    main()
