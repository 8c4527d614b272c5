"""Where a reader should not trust a fitted number: κ through the paper's grid and step, and b2 through its criterion.

**κ.** The five-point differences on N points and Crank-Nicolson at a step of 1/44,100 s flatten high partials. A fit
by that scheme bends κ upwards until its partials lie where the measured ones lie. How far is found by laying the
scheme's own table of modes (`finite_difference`) on the partials of a continuous string, partial by partial: no sound,
no noise, no hammer. The same the other way round says which continuous string sounds like the scheme at the paper's κ.

**b2.** The paper's final value is 1.6e-6 m²/s. The criterion of eq. 19 is laid on a measurement for values over many
decades, all other parameters at their truth, and its change is set beside what noise alone does to it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from ...criterion import band_values, line_sigma, measure
from ...model import mode_table, simulate
from ...parameters import Geometry, String
from ..laboratory import Laboratory
from ..laboratory import measure as record
from ..laboratory.chosen import FINAL

__all__ = ["DECADES", "GRIDS", "Bend", "Blindness", "bends", "blindness", "inverse_bend", "partials_of", "string_of"]

# (N, rate in Hz) of the paper's scheme; the paper gives neither. The first is what is asked about.
GRIDS = ((100, 44_100.0), (100, 88_200.0), (200, 44_100.0), (200, 88_200.0), (400, 176_400.0))
# A prewarped table of so many modes at the first rate, for comparison.
CONTINUOUS = (100, 44_100.0)
# Prewarped, a table has the continuous string's partials wherever they lie well below the rate.
FINE = (64, 441_000.0)
# Partials on which κ is fitted: the paper's band 2, and all to about 4 kHz.
BAND2, ALL = np.arange(2, 9), np.arange(1, 25)
# b2, m²/s: decades about the paper's 1.6e-6.
DECADES = (-10, -3)
# Steps of the model's contact for each sample: enough that noise, not the step, is what is left.
OVERSAMPLING = 8


class Bend(NamedTuple):
    """What a scheme makes of a string's partials."""

    kind: str  # of the table: finite_difference or continuous
    points: int  # N
    rate: float  # Hz
    partials: tuple[int, int]  # first and last, on which it was fitted
    c: float  # m/s, found
    kappa: float  # m²/s, found
    kappa_true: float
    rms_cents: float  # left over

    @property
    def off(self) -> float:
        """How far κ is off, relative."""
        return self.kappa / self.kappa_true - 1


class Blindness(NamedTuple):
    """Eq. 19 over b2."""

    b2: np.ndarray  # m²/s [values]
    criterion: dict[str, np.ndarray]  # `global` and each band -> [values]
    noise: dict[str, float]  # the same at the truth, by noise alone: the mean over measurements that differ in it
    spread: dict[str, float]  # and its standard deviation over them
    true: float


def partials_of(string: String, geometry: Geometry, kind: str, points: int, rate: float) -> np.ndarray:
    """Frequencies of the partials that a table of modes really has, Hz [modes]."""
    table = mode_table(string, geometry, rate=rate, n_modes=points, kind=kind)
    return np.imag(np.asarray(table.pole)) / (2 * np.pi)


def string_of(
    frequency: np.ndarray, number: np.ndarray, start: String, geometry: Geometry, kind: str, points: int, rate: float
) -> tuple[String, float]:
    """The string whose table lies closest to partials at `frequency`, Hz, in cents; and the rms of what is left."""

    def cents(log: np.ndarray) -> np.ndarray:
        string = start._replace(c=np.exp(log[0]), kappa=np.exp(log[1]))
        return 1200 * np.log2(partials_of(string, geometry, kind, points, rate)[number - 1] / frequency)

    found = least_squares(cents, np.log([start.c, start.kappa]), x_scale=[1e-3, 0.1], xtol=1e-10, ftol=1e-10)
    c, kappa = np.exp(found.x)
    return start._replace(c=float(c), kappa=float(kappa)), float(np.sqrt(np.mean(found.fun**2)))


def bends(number: np.ndarray = BAND2) -> list[Bend]:
    """κ by the paper's scheme from a continuous string's partials `number`, grid by grid; the last is prewarped."""
    exact = partials_of(FINAL.string, FINAL.geometry, "continuous", *FINE)[number - 1]
    schemes = [("finite_difference", *grid) for grid in GRIDS] + [("continuous", *CONTINUOUS)]
    return [_bend(exact, number, *scheme) for scheme in schemes]


def inverse_bend(number: np.ndarray = BAND2) -> Bend:
    """The continuous string that sounds as the paper's scheme does with the paper's κ, on the first of `GRIDS`."""
    heard = partials_of(FINAL.string, FINAL.geometry, "finite_difference", *GRIDS[0])[number - 1]
    return _bend(heard, number, "continuous", *FINE)


def _bend(frequency: np.ndarray, number: np.ndarray, kind: str, points: int, rate: float) -> Bend:
    found, left = string_of(frequency, number, FINAL.string, FINAL.geometry, kind, points, rate)
    ends = int(number[0]), int(number[-1])
    return Bend(kind, points, rate, ends, float(found.c), float(found.kappa), float(FINAL.string.kappa), left)


def blindness(lab: Laboratory, seed: int, *, repeats: int, values: int) -> Blindness:
    """Eq. 19 over so many `values` of b2, on a measurement of the ideal laboratory: the model lacks nothing but noise.

    Parameters
    ----------
    repeats : measurements that differ in their noise alone.
    """
    b2 = np.logspace(*DECADES, values)
    true = float(FINAL.string.b2)
    measured = [record(lab, float(FINAL.hammer.v_H0), seed + n) for n in range(repeats)]
    rate, length = lab.rate, round(lab.seconds * lab.rate)
    heard = [_energies(m.samples[m.onset :] * m.scale, rate)[1] for m in measured]
    spacing, truth = _energies(_sound(true, rate, length), rate)
    table = [band_values(_energies(_sound(value, rate, length), rate)[1], heard[0], spacing) for value in b2]
    by_noise = [band_values(truth, energy, spacing) for energy in heard]
    return Blindness(
        b2=b2,
        criterion={name: np.array([row[name] for row in table]) for name in table[0]},
        noise={name: float(np.mean([row[name] for row in by_noise])) for name in table[0]},
        spread={name: float(np.std([row[name] for row in by_noise], ddof=1)) for name in table[0]},
        true=true,
    )


def _sound(b2: float, rate: int, samples: int) -> np.ndarray:
    """The paper's string and hammer with another b2, m/s [samples]."""
    string = FINAL.string._replace(b2=b2)
    done = simulate(string, FINAL.hammer, FINAL.geometry, rate=rate, oversampling=OVERSAMPLING)
    return done.waveform(rate, samples)


def _energies(sound: np.ndarray, rate: int) -> tuple[np.ndarray, np.ndarray]:
    """Spacing, Hz [partials], and |Y|² [partials, nodes] of the cells of the true partials."""
    c, kappa, *_ = FINAL.string
    f0, B = float(FINAL.f0), float((kappa * np.pi / (c * FINAL.geometry.length)) ** 2)
    cells, energy = measure(sound, rate, f0, B, int(ALL[-1]), line_sigma(f0))
    return cells.spacing, energy
