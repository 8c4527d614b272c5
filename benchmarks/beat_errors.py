"""Whether errors of decay rates due to beats are alike in neighbouring partials, decided by the evidence of recordings.

    python benchmarks/beat_errors.py ../shared/recordings ../shared/pianos ../shared/keyboard

A folder has a `recordings.csv` with the columns `file` and `note`. Recordings of key releases are left out. The
logarithms of a recording's early decay rates differ from those of a string by noise, by deviations of the string with
the priors of the fit, and by beats. The standard deviations of the errors due to beats are those of the analysis. Their
correlation between partials is

    alike        exp(−distance / 10 partials)
    own          none
    in phase     one half common to all partials, one half as `own`: the covariance of the analysis
    none         no errors due to beats

The evidence is the largest probability of the rates over the two losses and the two sizes of the deviations, under
their priors. The table has the sum over the recordings of its logarithm relative to `alike`, the median, and the share
of recordings where it is larger.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable
from pathlib import Path

import numpy as np
import scipy.linalg
import scipy.optimize

from pianofit.analysis import Analysis, analyse
from pianofit.errors import PianofitError
from pianofit.inference import priors

FEWEST = 6  # partials
NEAR = 10.0  # partials over which the correlation of `alike` falls to 1/e
FLAT = 1e-4  # least standard deviation of a logarithm
LOSS_SPREAD = 2.0  # spread of the logarithms of b1 and d2 about those of the analysis
STARTS = (0.05, 0.2)  # sizes of the deviations


def correlations(number: np.ndarray) -> dict[str, np.ndarray]:
    """Correlation of the errors of partials `number` by each assumption [partials, partials]."""
    own = np.eye(len(number))
    return {
        "alike": np.exp(-np.abs(number[:, None] - number) / NEAR),
        "own": own,
        "in phase": 0.5 + 0.5 * own,
        "none": 0 * own,
    }


def evidences(analysis: Analysis) -> dict[str, float]:
    """Log evidence of the early decay rates of a recording by each assumption, with one constant for all."""
    table, size = analysis.partials, np.array([priors.DECAY.log_median[:2], priors.DECAY.spread[:2]])
    square = table.number.astype(float) ** 2
    losses = np.log([analysis.b1, max(analysis.d2, analysis.b1 * 1e-9)])
    law = np.exp(losses[0]) + np.exp(losses[1]) * square
    ratio = np.maximum(table.decay / law, priors.LEAST_DECAY_RATIO)
    noise = np.hypot(table.decay_error / (ratio * law), FLAT)
    beats = np.sqrt(np.diag(table.decay_systematic)) / law
    x = np.sqrt(3) * np.abs(np.log2(square)[:, None] - np.log2(square)) / 2 / priors.DECAY.median[2]
    smooth = (1 + x) * np.exp(-x)

    def log_probability(correlation: np.ndarray) -> Callable[[np.ndarray], float]:
        def negative(at: np.ndarray) -> float:
            deviation = np.exp(2 * at[2:])
            covariance = np.diag(noise**2 + deviation[0]) + deviation[1] * smooth
            factor = scipy.linalg.cholesky(covariance + np.outer(beats, beats) * correlation, lower=True)
            away = np.log(ratio * law / (np.exp(at[0]) + np.exp(at[1]) * square))
            z = scipy.linalg.solve_triangular(factor, away, lower=True)
            prior = np.append((at[:2] - losses) / LOSS_SPREAD, (at[2:] - size[0]) / size[1])
            return float(0.5 * z @ z + np.log(np.diag(factor)).sum() + 0.5 * prior @ prior)

        return negative

    def best(correlation: np.ndarray) -> float:
        starts = [np.append(losses, np.log([start, start])) for start in STARTS]
        return -min(scipy.optimize.minimize(log_probability(correlation), start).fun for start in starts)

    return {name: best(correlation) for name, correlation in correlations(table.number).items()}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    found: list[dict[str, float]] = []
    for folder in parser.parse_args().folders:
        for row in csv.DictReader((folder / "recordings.csv").read_text().splitlines()):
            if "release" in row["file"]:
                continue
            try:
                analysis = analyse(folder / row["file"], note=row["note"])
            except PianofitError as error:
                print(f"{row['file']}: {error}")
                continue
            if len(analysis.partials.number) >= FEWEST:
                found.append(evidences(analysis))
    print(f"{len(found)} recordings\n{'':12}{'sum':>8}{'median':>8}{'larger':>8}")
    for name in found[0]:
        gain = np.array([row[name] - row["alike"] for row in found])
        print(f"{name:12}{gain.sum():8.0f}{np.median(gain):8.2f}{np.mean(gain > 0):8.0%}")


if __name__ == "__main__":
    main()
