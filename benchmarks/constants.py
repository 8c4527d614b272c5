"""What predictions and twins become with each telling constant at half and at twice its value.

    python benchmarks/constants.py                               all constants, on the panel
    python benchmarks/constants.py --names STUDENT,ONSET --page docs/fitting.md

The panel: the inner layers of `NOTES`, each predicted from the others, where the recordings are there (see
`crossval.py`), and the model twins `TWINS` of `coverage_twins.py`. Shown are the median error of the predictions, dB,
and the rms of the twins' misses in standard errors. A constant that moves neither may be wrong by a factor and nobody
would notice; one that moves them has its reason beside it in `inference/` or `analysis/`.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from pianofit.felt import DEFAULT_LAW

NOTES = ("cp80-Fs2", "headroom-C4-close")
TWINS = (4, 5, 9)


class _Felt:
    """The priors' spreads of the felt's parameters, as one attribute."""

    @property
    def spread(self) -> dict[str, float]:
        return {name: parameter.deviation for name, parameter in DEFAULT_LAW.parameters.items()}

    @spread.setter
    def spread(self, spread: dict[str, float]) -> None:
        own: Any = DEFAULT_LAW.parameters
        own |= {name: parameter._replace(spread=spread[name]) for name, parameter in own.items()}


def constants() -> dict[str, tuple[Any, str, Callable[[Any, float], Any]]]:
    """By name: the module, the attribute, and how its value is scaled."""
    from pianofit.analysis import fits, inharmonicity, partials
    from pianofit.inference import descent, finish, nuisances, observations, predict, priors, screen, search

    def plain(value: Any, factor: float) -> Any:
        return type(value)(value * factor) if not isinstance(value, int) else max(1, round(value * factor))

    def place(which: int) -> Callable[[Any, float], Any]:
        return lambda value, factor: tuple(x * factor if i == which else x for i, x in enumerate(value))

    def hyper(place: int) -> Callable[[Any, float], Any]:
        def scaled(value: Any, factor: float) -> Any:
            return value._replace(median=tuple(m * factor if i == place else m for i, m in enumerate(value.median)))

        return scaled

    def spreads(value: dict[str, float], factor: float) -> dict[str, float]:
        return {name: x * factor for name, x in value.items()}

    return {
        "STUDENT": (priors, "STUDENT", plain),
        "PATH": (priors, "PATH", place(0)),
        "ONSET": (priors, "ONSET", plain),
        "ONSET_PERIODS": (priors, "ONSET_PERIODS", plain),
        "GAINS_APART one": (priors, "GAINS_APART", place(0)),
        "GAINS_APART levelled": (priors, "GAINS_APART", place(1)),
        "ABSENT_MARGIN": (priors, "ABSENT_MARGIN", plain),
        "VELOCITY": (priors, "VELOCITY", plain),
        "VELOCITY_SPREAD": (priors, "VELOCITY_SPREAD", plain),
        "HAMMER_SPREAD": (priors, "HAMMER_SPREAD", spreads),
        "SPREAD": (_Felt(), "spread", spreads),
        "LEVEL excess": (priors, "LEVEL", hyper(0)),
        "LEVEL smooth": (priors, "LEVEL", hyper(1)),
        "LEVEL octaves": (priors, "LEVEL", hyper(2)),
        "LEVEL floor": (priors, "LEVEL", hyper(3)),
        "HIGHEST": (observations, "HIGHEST", plain),
        "SAMPLES": (screen, "SAMPLES", plain),
        "WIDE_EXCESS": (screen, "WIDE_EXCESS", plain),
        "REACH": (search, "REACH", plain),
        "ONE_VALLEY": (search, "ONE_VALLEY", plain),
        "GAIN": (search, "GAIN", plain),
        "LONGEST_STEP": (descent, "LONGEST_STEP", plain),
        "LONGEST_PHI": (descent, "LONGEST_PHI", plain),
        "HYPER_REACH": (descent, "HYPER_REACH", plain),
        "NEGATIVE": (nuisances, "NEGATIVE", plain),
        "WITHIN": (finish, "WITHIN", plain),
        "PULSE": (predict, "PULSE", plain),
        "LEFT": (finish, "LEFT", plain),
        "TRUSTED": (inharmonicity, "TRUSTED", plain),
        "NEIGHBOURS": (inharmonicity, "NEIGHBOURS", plain),
        "LONG": (fits, "LONG", plain),
        "FAST": (partials, "_FAST", plain),
        "SLOW": (partials, "_SLOW", plain),
    }


def panel() -> tuple[float, float]:
    """Median error of predictions, dB, and rms miss of twins, standard errors; NaN where there is nothing."""
    import coverage
    import crossval

    layers = []
    if os.environ.get("PIANOFIT_RECORDINGS") or Path(crossval.FOLDERS.split(":")[0]).is_dir():
        for folder in crossval.folders():
            for key, note in crossval.notes(folder).items():
                if key in NOTES:
                    layers += crossval.scored(crossval.validate((key, *note, "hunt-crossley", 0)))
    misses = [
        row["miss"]
        for seed in TWINS
        for row in coverage.judge(("model", seed, 0.0)).get("rows", [])
        if row["miss"] is not None and row["status"] in ("fitted", "scaled")
    ]
    error = statistics.median(layer["predicted_db"] for layer in layers) if layers else float("nan")
    return error, float(np.sqrt(np.mean(np.square(misses)))) if misses else float("nan")


def main() -> None:
    """Print the table, and put it into a page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--names", default="", help="separated by commas; all if not given")
    parser.add_argument("--page", type=Path, help="put what is printed between this page's markers")
    options = parser.parse_args()
    known = constants()
    wanted = [n for n in options.names.split(",") if n] or list(known)
    if unknown := set(wanted) - set(known):
        sys.exit(f"--names: {', '.join(sorted(unknown))} is none of {', '.join(known)}")
    lines = [f"{'constant':18}{'value':>26}{'half: dB':>10}{'σ':>6}{'as it is':>14}{'σ':>6}{'twice: dB':>11}{'σ':>6}"]
    usual = panel()
    print(lines[0], flush=True)
    for name in wanted:
        module, attribute, scaled = known[name]
        value, found = getattr(module, attribute), []
        for factor in (0.5, 2.0):
            setattr(module, attribute, scaled(value, factor))
            try:
                found.append(panel())
            finally:
                setattr(module, attribute, value)
        shown = str(value if not hasattr(value, "median") else value.median)
        shown = "several" if len(shown) > 24 else shown
        lines.append(
            f"{name:18}{shown:>26}{found[0][0]:10.2f}{found[0][1]:6.2f}{usual[0]:14.2f}{usual[1]:6.2f}"
            f"{found[1][0]:11.2f}{found[1][1]:6.2f}"
        )
        print(lines[-1], flush=True)
    if options.page:
        from coverage_table import into_page

        into_page(options.page, "constants", lines)


if __name__ == "__main__":
    main()
