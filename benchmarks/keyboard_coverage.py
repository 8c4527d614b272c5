"""Whether the intervals of all 88 keys hold the truth, over instruments drawn from the keyboard laws.

    python benchmarks/keyboard_coverage.py FITS [--prefix headroom] [--instruments 100] [--seed 1] [--keep-prior]

FITS holds `KEY/fit.json` of one real instrument, as `pianofit fit` or `pianofit batch` left them. Only the errors of
these fits are used. Each instrument is drawn from the model of `keyboard_posterior`: an offset, a tilt and a smooth
function for every quantity, and single keys that deviate by a Student's t. Sizes and lengths are drawn from their
priors. Five to nine keys are recorded. The recordings of each measure its quantities with the joint covariance of the
nearest real fit, an error drawn from it, and an unknown velocity scale. Its fit combines them with the literature, and
the keyboard removes that prior again. With `--keep-prior` it does not. Half of the fits have a second minimum, as far
away as one of the real fits had, and its weight is the probability that it holds the truth.

For every quantity and three groups, the laws, the recorded keys and the unrecorded keys, the table shows the
percentage of 95 % intervals that hold the truth, the rms error in standard deviations and the largest one.
Percentages outside 90 to 99 have an asterisk.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from pianofit.instrument.keyboard_posterior import KeyMeasurements
    from pianofit.instrument.quantity_law import Prior

KEYS = np.arange(21, 109)
FEWEST, MOST = 5, 9
# Share of the keys that have a second minimum.
SECOND = 0.5
GROUPS = ("law", "recorded", "unrecorded")
# Half width of a 95 % interval, standard deviations, and percentages of intervals that should hold the truth.
HALF_WIDTH, WANTED = 1.959964, (90.0, 99.0)
# Quantities for which a fit has a prior from the literature, and the parameter with its standard deviation.
FIT_PRIOR = {"M_H/M_S": "M_H", "F/M_S": "K_H", "local_exponent": "p", "mu": "mu", "skin": "skin", "x0/L": "x0"}


class Truth(NamedTuple):
    """A drawn instrument, relative to the literature."""

    law: np.ndarray  # [quantities, 88]
    value: np.ndarray  # [quantities, 88]


def draw_instrument(random: np.random.Generator, priors: Sequence[Prior]) -> Truth:
    """Draw laws and values of 88 keys."""
    from pianofit.instrument.quantity_law import SHAPE_SD, STUDENT

    place, distance = np.linspace(-1, 1, len(KEYS)), (KEYS[:, None] - KEYS) ** 2
    law, value = [], []
    for prior in priors:
        smooth, scatter, length = prior.medians * np.exp(SHAPE_SD * random.normal(size=3))
        root = np.linalg.cholesky(np.exp(-0.5 * distance / length**2) + 1e-8 * np.eye(len(KEYS)))
        straight = prior.offset * random.normal() + prior.slope_sd * random.normal() * place
        law.append(straight + smooth * root @ random.normal(size=len(KEYS)))
        value.append(law[-1] + scatter * random.standard_t(STUDENT, size=len(KEYS)))
    return Truth(np.array(law), np.array(value))


def fitted(mean: np.ndarray, covariance: np.ndarray, keep_prior: bool) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance that a fit hands over, from those of its recordings alone."""
    from pianofit.felt import DEFAULT_LAW
    from pianofit.felt.published import HAMMER_SD
    from pianofit.instrument.fit_prior import FitPrior, remove_prior
    from pianofit.instrument.key_quantities import LAW_QUANTITIES

    spread = HAMMER_SD | {name: parameter.prior_sd for name, parameter in DEFAULT_LAW.parameters.items()}
    sd = np.array([spread[name] for name in FIT_PRIOR.values()])
    rows = np.array([[float(name == other) for other in LAW_QUANTITIES] for name in FIT_PRIOR]) / sd[:, None]
    likelihood = np.linalg.inv(covariance)
    posterior = np.linalg.inv(likelihood + rows.T @ rows)
    mean = posterior @ likelihood @ mean
    if keep_prior:
        return mean, posterior
    removal = remove_prior(FitPrior(rows, rows @ mean), posterior)
    return mean + removal.shift, removal.covariance


def draw_fit(
    random: np.random.Generator,
    midi: int,
    truth: np.ndarray,
    templates: Sequence[KeyMeasurements],
    keep_prior: bool = False,
) -> KeyMeasurements:
    """Draw the fit of a key with these true values [quantities]."""
    from pianofit.instrument.keyboard_posterior import VELOCITY_SCALE_SD, KeyMeasurements, Measurement

    like = min(templates, key=lambda template: abs(template.midi - midi))
    covariance, direction = like.minima[0].covariance, like.scale_direction
    error = random.multivariate_normal(np.zeros(len(truth)), covariance, method="cholesky")
    mean = truth - random.normal(0, VELOCITY_SCALE_SD) * direction + error
    mean, covariance = fitted(mean, covariance, keep_prior)
    if random.uniform() > SECOND:
        return KeyMeasurements(midi, (Measurement(1.0, mean, covariance),), direction)
    apart = [other.mean - one.minima[0].mean for one in templates for other in one.minima[1:]]
    other = mean + random.choice([-1, 1]) * apart[random.integers(len(apart))]
    share = random.uniform(0.1, 0.9)
    if random.uniform() > share:  # the first minimum does not hold the truth
        mean, other = other, mean
    minima = (Measurement(share, mean, covariance), Measurement(1 - share, other, covariance))
    return KeyMeasurements(midi, minima, direction)


def errors_of_one(
    seed: Sequence[int], priors: Sequence[Prior], templates: Sequence[KeyMeasurements], keep_prior: bool
) -> dict[str, np.ndarray]:
    """Errors of one instrument, in standard deviations, by group [quantities, keys]."""
    from pianofit.instrument.keyboard_posterior import keyboard_posterior

    random = np.random.default_rng(seed)
    truth = draw_instrument(random, priors)
    places = np.sort(random.choice(len(KEYS), random.integers(FEWEST, MOST + 1), replace=False))
    fits = [draw_fit(random, int(KEYS[i]), truth.value[:, i], templates, keep_prior) for i in places]
    found = keyboard_posterior(fits, np.zeros(truth.law.shape), priors, KEYS.tolist())
    law, value = (found.mean - [truth.law, truth.value]) / found.sd
    return {
        "law": law,
        "recorded": value[:, places],
        "unrecorded": np.delete(value, places, axis=1),
    }


def summary(z: np.ndarray) -> dict[str, float]:
    """Percentage of intervals that hold the truth, rms and largest error in standard deviations."""
    return {
        "held": 100 * float(np.mean(np.abs(z) < HALF_WIDTH)),
        "rms": float(np.sqrt(np.mean(z**2))),
        "worst": float(np.abs(z).max()),
    }


def row(name: str, groups: dict[str, Any]) -> str:
    """One line of the table."""
    cells = []
    for group in GROUPS:
        one = groups[group]
        mark = " " if WANTED[0] <= one["held"] <= WANTED[1] else "*"
        cells.append(f"{one['held']:8.1f}{mark} {one['rms']:5.2f} {one['worst']:6.1f}")
    return f"{name:16}" + "".join(cells)


def main() -> None:
    """Print the table."""
    from pianofit.instrument import find_fits, load_keys
    from pianofit.instrument.key_quantities import LAW_QUANTITIES

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("fits", type=Path)
    parser.add_argument("--prefix")
    parser.add_argument("--instruments", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep-prior", action="store_true", help="the keyboard gets fits with their prior")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    templates = [key.measured for key in load_keys(find_fits([options.fits], options.prefix))]
    priors = [quantity.prior for quantity in LAW_QUANTITIES.values()]
    begun = time.perf_counter()
    errors = [
        errors_of_one((options.seed, i), priors, templates, options.keep_prior) for i in range(options.instruments)
    ]
    seconds = (time.perf_counter() - begun) / options.instruments
    z = {group: np.concatenate([one[group] for one in errors], axis=1) for group in GROUPS}
    found = {n: {group: summary(z[group][q]) for group in GROUPS} for q, n in enumerate(LAW_QUANTITIES)}
    found["all"] = {group: summary(z[group]) for group in GROUPS}
    print(f"{'':16}" + "".join(f"{group:>10}{'rms':>5}{'worst':>7}" for group in GROUPS))
    for name, groups in found.items():
        print(row(name, groups))
    print(f"{options.instruments} instruments, {seconds:.2f} s each")
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
