"""Every prior of a fit, with its source. Scales are standard deviations of logarithms unless a unit is given.

A prior describes a piano before its recording is analysed. None of these numbers is fitted to the recordings of a fit.
`benchmarks/path_prior.py` compares the prior of τ with notes recorded at several velocities.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import norm

__all__ = ["Hyperprior"]

# --- hammer: about the literature's values for the key (literature.typical); the felt law has the felt's priors -------
# Hammer masses of neighbouring instruments differ by tens of percent (Chaigne and Askenfelt 1994; Chabassier): standard
# deviations of log(value).
HAMMER_SD = {"M_H": 0.4, "x0": 0.2, "width": 0.3}
# Hammer velocity at the string, m/s: pianissimo to fortissimo is 0.3 to 6 (Askenfelt and Jansson 1991).
VELOCITY = 1.5
VELOCITY_SD = 0.8
# String: about the analysis of one recording, wide enough to have no effect.
STRING_SD = {"c": 0.01, "kappa": 2.0, "b1": 2.0, "b2": 3.0}

# --- between string and table of partials -----------------------------------------------------------------------------
# The gain of an output path is unknown, dB.
GAIN = 60.0
# Gains of recordings through one path: as likely equal, except for variation of single strokes, as normalised one by
# one. Standard deviations from their mean, dB.
GAIN_DEVIATION = (1.0, 20.0)
# Standard deviation of a detected onset from the arrival of the wave, s,
ONSET = 1e-3
# plus this in periods: the first arrival on a stiff string is faint, and the largest of the first period is detected.
ONSET_PERIODS = 0.5
# Degrees of freedom of Student's t: with 4 a search can discard the fundamental and stay there.
STUDENT = 10.0
# Residual standard deviation τ of a path, dB, median and spread, from notes recorded at several velocities
# (benchmarks/path_prior.py).
PATH = (4.5, 0.4)
# Nodes of the quadrature over τ.
PATH_NODES = 3
# A censored partial may exceed the bound of its band by this, dB: leakage of neighbours can cancel it.
CENSORED_MARGIN = 1.0


class Hyperprior(NamedTuple):
    """Log-normal priors of a table's hyperparameters: medians and spreads of the logarithm."""

    median: tuple[float, ...]
    spread: tuple[float, ...]

    @property
    def log_median(self) -> np.ndarray:
        """Logarithms of the medians."""
        return np.log(self.median)


# Levels: excess of a recording, dB; amplitude of the smooth path, dB, and its length, octaves; amplitude of other
# sounds over the loudest partial (53 to 75 dB below it). τ is integrated over: see PATH.
LEVEL = Hyperprior((0.7, 8.0, 0.7, 0.002), (0.7, 0.4, 0.4, 0.9))
# Frequencies: excess over the string model, cents.
FREQUENCY = Hyperprior((0.5,), (1.5,))
# Decays: excess, relative to the string model.
DECAY = Hyperprior((0.2,), (1.0,))
# Partial from which windings and shear make a real string deviate from the string model.
LAW_REACH = 10.0


def path_nodes() -> tuple[np.ndarray, np.ndarray]:
    """Nodes of log τ and their weights: Gauss-Hermite over the log-normal prior."""
    x, weight = np.polynomial.hermite_e.hermegauss(PATH_NODES)
    return np.log(PATH[0]) + PATH[1] * x, weight / weight.sum()


def log_gain(gain: float, others: Sequence[float] = (0.0,)) -> float:
    """Log predictive density of a recording's gain, dB, given those of `others` through its path.

    All recordings of a path either share a gain or do not. As in F, the other recordings decide between the two.
    """
    given, sd = np.asarray(others, float), np.array(GAIN_DEVIATION)
    square = ((given - given.mean()) ** 2).sum()
    regime = -(len(given) - 1) * np.log(sd) - 0.5 * square / sd**2
    predictive = norm.logpdf(gain, given.mean(), sd * np.sqrt(1 + 1 / len(given)))
    return float(np.logaddexp.reduce(regime + predictive) - np.logaddexp.reduce(regime))
