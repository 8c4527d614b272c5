"""Sensitivity of predictions and of fits of synthetic recordings to each constant, at half and at twice its value.

    python benchmarks/constants.py                               all constants, on the panel
    python benchmarks/constants.py --names '`STUDENT`;`ONSET`' --page docs/fitting.md

The panel has two parts. The layers `LAYERS` are predicted from the other layers of their notes, if the recordings exist
(see `crossval.py`). The synthetic recordings `SEEDS` of the kind `model` (`coverage_twins.py`) are fitted. The table
shows the median error of the predictions, dB, and the rms error of the fits, in standard errors. A constant that
changes neither number may be wrong by a factor without effect. A constant that changes them has its reason at its
definition in `inference/` or `analysis/`.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import os
import statistics
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from pianofit.felt import DEFAULT_LAW

LAYERS = {"cp80-Fs2": ("MP", "F"), "headroom-C4-close": ("L2", "L3", "L4")}
SEEDS = (4, 5, 9)


class _Felt:
    """Prior standard deviations of all felt parameters, as one attribute."""

    @property
    def spread(self) -> dict[str, float]:
        return {name: parameter.prior_sd for name, parameter in DEFAULT_LAW.parameters.items()}

    @spread.setter
    def spread(self, spread: dict[str, float]) -> None:
        own: Any = DEFAULT_LAW.parameters
        own |= {name: parameter._replace(spread=spread[name]) for name, parameter in own.items()}


def constants() -> dict[str, tuple[Any, str, Callable[[Any, float], Any]]]:
    """Return module, attribute and scaling function by the first cell of the row in docs/fitting.md."""
    from pianofit.analysis import baseband_fit, envelope_slopes, inharmonicity, partials
    from pianofit.excitation import hammer
    from pianofit.felt import FeltLaw, soft_skin
    from pianofit.inference import (
        batched_model,
        hyperparameters,
        laplace,
        multistart,
        objective,
        observation_tables,
        optimiser,
        pipeline,
        priors,
    )

    def plain(value: Any, factor: float) -> Any:
        return type(value)(value * factor) if not isinstance(value, int) else max(1, round(value * factor))

    def place(which: int) -> Callable[[Any, float], Any]:
        return lambda value, factor: tuple(plain(x, factor) if i == which else x for i, x in enumerate(value))

    def median(which: int) -> Callable[[Any, float], Any]:
        return lambda value, factor: value._replace(median=place(which)(value.median, factor))

    def loss(value: float, factor: float) -> float:
        return 1 - (1 - value) / factor

    def spread(value: Any, factor: float) -> Any:
        return value._replace(spread=tuple(x * factor for x in value.spread))

    def every(value: dict[str, float], factor: float) -> dict[str, float]:
        return {name: x * factor for name, x in value.items()}

    def points(value: Any, factor: float) -> Any:
        return np.geomspace(value[0], value[-1], round(factor * len(value)))

    def whole(value: Any, factor: float) -> Any:
        return tuple(x * factor for x in value)

    return {
        "`FELT_SPREAD`, all of the felt": (_Felt(), "spread", every),
        "`SKIN`": (soft_skin, "SKIN", plain),
        "`HAMMER_SD`, all": (priors, "HAMMER_SD", every),
        "`VELOCITY`": (hammer, "VELOCITY", plain),
        "`VELOCITY_SD`": (hammer, "VELOCITY_SD", plain),
        "`STRING_SD`, all": (priors, "STRING_SD", every),
        "`GAIN`": (priors, "GAIN", plain),
        "`GAIN_DEVIATION`, one gain": (FeltLaw, "gain_deviations", place(0)),
        "`GAIN_DEVIATION`, levelled": (FeltLaw, "gain_deviations", place(1)),
        "`ONSET`": (priors, "ONSET", plain),
        "`ONSET_PERIODS`": (priors, "ONSET_PERIODS", plain),
        "`STUDENT`": (priors, "STUDENT", plain),
        "`PATH`, median": (FeltLaw, "roughness", place(0)),
        "`PATH`, spread": (FeltLaw, "roughness", place(1)),
        "`KNOCK_SD`": (priors, "KNOCK_SD", plain),
        "`KNOCK_PATH_SD`": (priors, "KNOCK_PATH_SD", plain),
        "`CENSORED_MARGIN`": (priors, "CENSORED_MARGIN", plain),
        "`LEVEL`, σ": (priors, "LEVEL", median(0)),
        "`LEVEL`, A": (priors, "LEVEL", median(1)),
        "`LEVEL`, ℓ": (priors, "LEVEL", median(2)),
        "`LEVEL`, η": (priors, "LEVEL", median(3)),
        "`LEVEL`, ρ": (priors, "LEVEL", median(4)),
        "`LEVEL`, all spreads": (priors, "LEVEL", spread),
        "`FREQUENCY`, σ": (priors, "FREQUENCY", median(0)),
        "`FREQUENCY`, A": (priors, "FREQUENCY", median(1)),
        "`FREQUENCY`, ℓ": (priors, "FREQUENCY", median(2)),
        "`DECAY`, σ": (priors, "DECAY", median(0)),
        "`DECAY`, A": (priors, "DECAY", median(1)),
        "`REFERENCE_PARTIAL`": (priors, "REFERENCE_PARTIAL", plain),
        "`DEVIATION_GROWTH`": (priors, "DEVIATION_GROWTH", plain),
        "`HIGHEST_HZ`": (observation_tables, "HIGHEST_HZ", plain),
        "`SAMPLES`": (multistart, "SAMPLES", plain),
        "`VELOCITIES`": (hammer, "VELOCITIES", points),
        "`FINE_VELOCITIES`": (hammer, "FINE_VELOCITIES", points),
        "`TAIL`": (multistart, "TAIL", plain),
        "`WIDE_EXCESS`": (multistart, "WIDE_EXCESS", plain),
        "`STEP_COARSENING`": (batched_model, "STEP_COARSENING", plain),
        "`FIRST`": (multistart, "FIRST", plain),
        "`FIRST_STEPS`": (multistart, "FIRST_STEPS", plain),
        "`SECOND`": (multistart, "SECOND", plain),
        "`SECOND_FLOOR`, of σ": (multistart, "SECOND_FLOOR", plain),
        "`MERGE_DISTANCE`": (multistart, "MERGE_DISTANCE", plain),
        "`LEAST_DECREASE`": (multistart, "LEAST_DECREASE", plain),
        "`RESTARTS`": (multistart, "RESTARTS", plain),
        "`REACH`": (multistart, "REACH", plain),
        "`ALONG`": (multistart, "ALONG", plain),
        "`SCAN`": (multistart, "SCAN", whole),
        "`NEAR`": (multistart, "NEAR", plain),
        "`GOING`": (multistart, "GOING", plain),
        "`LONGEST_STEP`": (optimiser, "LONGEST_STEP", plain),
        "`LONGEST_PHI`": (objective, "LONGEST_PHI", plain),
        "`FINER`": (batched_model, "FINER", plain),
        "`CONVERGED`": (optimiser, "CONVERGED", plain),
        "`HYPER_REACH`": (objective, "HYPER_REACH", plain),
        "`DRAWS`": (hyperparameters, "DRAWS", plain),
        "`DEGREES`": (hyperparameters, "DEGREES", plain),
        "`WIDENING`": (hyperparameters, "WIDENING", plain),
        "`MODE_STEPS`": (hyperparameters, "MODE_STEPS", plain),
        "`LONGEST`": (hyperparameters, "LONGEST", plain),
        "`LEAST_PRECISION`": (hyperparameters, "LEAST_PRECISION", plain),
        "`LARGEST_LOSS`": (laplace, "LARGEST_LOSS", loss),
        "`MAX_LOG_MASS_GAP`": (pipeline, "MAX_LOG_MASS_GAP", plain),
        "`MAX_OFFSET_CHANGE`": (pipeline, "MAX_OFFSET_CHANGE", plain),
        "`LAST_TRUSTED_PARTIAL`": (inharmonicity, "LAST_TRUSTED_PARTIAL", plain),
        "`NEIGHBOURS`": (inharmonicity, "NEIGHBOURS", plain),
        "`LEVEL_FRAMES_SECONDS`": (baseband_fit, "LEVEL_FRAMES_SECONDS", plain),
        "`_COMMON`": (partials, "_COMMON", plain),
        "`LEAST_DECAY_RATIO`": (priors, "LEAST_DECAY_RATIO", plain),
        "`EARLY_RANGE`": (envelope_slopes, "EARLY_RANGE", plain),
    }


def panel() -> tuple[float, float]:
    """Return the median error of predictions, dB, and the rms error of fits, standard errors; NaN if not available."""
    import crossval
    import interval_coverage

    errors = []
    if os.environ.get("PIANOFIT_RECORDINGS") or Path(crossval.FOLDERS.split(":")[0]).is_dir():
        for folder in crossval.folders():
            for key, note in crossval.notes(folder).items():
                errors += predicted(*note, LAYERS.get(key, ()))
    misses = [
        row["miss"]
        for seed in SEEDS
        for row in interval_coverage.judge(("model", seed, 0.0)).get("rows", [])
        if row["miss"] is not None and row["status"] in ("fitted", "scaled")
    ]
    error = statistics.median(errors) if errors else float("nan")
    return error, float(np.sqrt(np.mean(np.square(misses)))) if misses else float("nan")


def predicted(note: str, files: list[Path], setup: Any, layers: tuple[str, ...]) -> list[float]:
    """Return errors, dB, of the layers whose file names contain one of `layers`, each predicted from all others."""
    from pianofit import analyse, load_recording, predict_recording
    from pianofit.inference import run_inference
    from pianofit.result import build_result

    if not layers:
        return []
    recordings = [load_recording(file) for file in files]
    analyses = [analyse(recording, note=note) for recording in recordings]
    errors = []
    for i, file in enumerate(files):
        if not set(layers) & set(file.stem.split("-")):
            continue
        rest = [j for j in range(len(files)) if j != i]
        fit = build_result(run_inference([recordings[j] for j in rest], [analyses[j] for j in rest], setup))
        notes = [(weight, parts[0]) for weight, parts in zip(fit.weights, fit.minima_notes, strict=True)]
        errors.append(predict_recording(notes, analyses[i], gains=fit.fit.relative_gains(0)).error_db)
    return errors


def scaled_panel(job: tuple[str, float]) -> tuple[float, float]:
    """Return the panel with one constant times a factor; unchanged if the factor is 1, and NaN if a fit is refused."""
    import coverage_twins  # noqa: F401 - it must read the unchanged priors

    from pianofit import FitError
    from pianofit.program_folder import enable_program_cache

    enable_program_cache()
    name, factor = job
    if factor == 1.0:
        return panel()
    module, attribute, scaled = constants()[name]
    value = getattr(module, attribute)
    setattr(module, attribute, scaled(value, factor))
    try:
        return panel()
    except FitError:
        return float("nan"), float("nan")
    finally:
        setattr(module, attribute, value)


def main() -> None:
    """Print the table, and write it to a page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--names", default="", help="names of constants, separated by semicolons; all if empty")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--page", type=Path, help="fill the last columns of this page's table")
    options = parser.parse_args()
    available = constants()
    wanted = [n for n in options.names.split(";") if n] or list(available)
    if unknown := set(wanted) - set(available):
        sys.exit(f"--names: {', '.join(sorted(unknown))} not available; use {', '.join(available)}")
    jobs = [("", 1.0), *((name, factor) for name in wanted for factor in (0.5, 2.0))]
    with ProcessPoolExecutor(options.workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        results = pool.map(scaled_panel, jobs)
        usual = cell(next(results))
        print(f"{'median error, dB; rms error of fits, standard errors':32}\nunchanged: {usual}", flush=True)
        for name in wanted:
            half, twice = cell(next(results)), cell(next(results))
            print(f"{name:28} half: {half:12} twice: {twice}", flush=True)
            if options.page:
                fill(options.page, usual, name, (half, twice))


def cell(panel: tuple[float, float]) -> str:
    """Format the two numbers of a panel."""
    return "a fit is refused" if math.isnan(panel[1]) else f"{panel[0]:.2f}; {panel[1]:.2f}"


def fill(page: Path, usual: str, name: str, row: tuple[str, str]) -> None:
    """Write the last two cells of the row of this constant, and the unchanged panel above the table."""
    lines, filled = page.read_text(encoding="utf-8").splitlines(), False
    for i, line in enumerate(lines):
        cells = [part.strip() for part in line.strip("|").split("|")]
        if line.startswith("|") and cells[0] == name:
            lines[i], filled = "| " + " | ".join([*cells[:-2], *row]) + " |", True
        if line.startswith("Unchanged: "):
            lines[i] = f"Unchanged: {usual} (`python benchmarks/constants.py --page docs/fitting.md`)."
    if not filled:
        sys.exit(f"{page}: no row for {name}; add one to the table of constants")
    page.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
