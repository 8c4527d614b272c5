"""Every prior of a fit, with its source: scales are logarithms' standard deviations unless a unit stands beside them.

A prior is what is known of a piano before its recording is seen. None of these numbers is fitted to
the recordings at hand; `benchmarks/path_prior.py` compares τ's with notes recorded at several velocities.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import norm

__all__ = ["Hyperprior"]

# --- hammer: about the literature's for the key (published.typical); the felt's parameters have theirs in its law -----
# Hammer masses of neighbouring instruments differ by tens of percent (Chaigne and Askenfelt 1994; Chabassier): standard
# deviations of log(value).
HAMMER_SPREAD = {"M_H": 0.4, "x0": 0.2, "width": 0.3}
# Hammer velocity at the string, m/s: pianissimo to fortissimo is 0.3 to 6 (Askenfelt and Jansson 1991).
VELOCITY = 1.5
VELOCITY_SPREAD = 0.8
# String: about what the analysis reads off one recording, wide enough to decide nothing.
STRING_SPREAD = {"c": 0.01, "kappa": 2.0, "b1": 2.0, "b2": 3.0}

# --- what lies between string and table of partials -------------------------------------------------------------------
# The gain of a path is unknown, dB.
GAIN = 60.0
# Gains of recordings through one path are as likely to be one, but for what a stroke's loudness has of its own, as to
# have been levelled one by one: standard deviations from their mean, dB.
GAINS_APART = (1.0, 20.0)
# A detected onset may lie this far from the arrival of the wave, s,
ONSET = 1e-3
# and so many periods: of a stiff string what arrives first is faint, and the largest of the first period is seen.
ONSET_PERIODS = 0.5
# Degrees of freedom of Student's t: with 4 a search discards the fundamental and stays there.
STUDENT = 10.0
# Residual standard deviation τ of a path, dB, median and spread: of the notes recorded at several velocities, as
# benchmarks/path_prior.py reads it off them.
PATH = (4.5, 0.4)
# Nodes of the quadrature over it.
PATH_NODES = 3
# An absent partial may be this much louder than the bound of its band, dB: neighbours' leakage can cancel it.
ABSENT_MARGIN = 1.0


class Hyperprior(NamedTuple):
    """Log-normal priors of a table's hyperparameters: medians and spreads of the logarithm."""

    median: tuple[float, ...]
    spread: tuple[float, ...]

    @property
    def log_median(self) -> np.ndarray:
        """Logarithms of the medians."""
        return np.log(self.median)


# Levels: a recording's own excess, dB; the smooth path's amplitude, dB, and length, octaves; amplitude of other sounds
# over the loudest partial (they lie 53 to 75 dB below it). `common` is integrated over: see PATH.
LEVEL = Hyperprior((0.7, 8.0, 0.7, 0.002), (0.7, 0.4, 0.4, 0.9))
# Frequencies: excess over the law, cents
FREQUENCY = Hyperprior((0.5,), (1.5,))
# Decays: excess, relative to the law.
DECAY = Hyperprior((0.2,), (1.0,))
# Partial from which on windings and shear let a real string leave the frequency law.
LAW_REACH = 10.0


def path_nodes() -> tuple[np.ndarray, np.ndarray]:
    """Nodes of log τ and their weights: Gauss-Hermite over the log-normal prior."""
    x, weight = np.polynomial.hermite_e.hermegauss(PATH_NODES)
    return np.log(PATH[0]) + PATH[1] * x, weight / weight.sum()


def log_gain(gain: float, others: Sequence[float] = (0.0,)) -> float:
    """Log predictive density of a recording's gain, dB, where those of `others` through its path are known.

    Whether recordings of a path share a gain is one question for all of them: the others answer it, as they do in F.
    """
    known, sd = np.asarray(others, float), np.array(GAINS_APART)
    square = ((known - known.mean()) ** 2).sum()
    regime = -(len(known) - 1) * np.log(sd) - 0.5 * square / sd**2
    each = norm.logpdf(gain, known.mean(), sd * np.sqrt(1 + 1 / len(known)))
    return float(np.logaddexp.reduce(regime + each) - np.logaddexp.reduce(regime))
