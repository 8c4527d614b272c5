"""Where a reader should not trust a fitted number: κ through the paper's grid and step, and b2 through its criterion.

**κ.** The five-point differences on N points and Crank-Nicolson at a step of 1/44,100 s flatten high partials. A fit
by that scheme bends κ upwards until its partials lie where the measured ones lie. How far is found by laying the
scheme's own table of modes (`finite_difference`) on the partials of a continuous string, partial by partial: no sound,
no noise, no hammer. The same the other way round says which continuous string sounds like the scheme at the paper's κ.

**b2.** The paper's final value is 1.6e-6 m²/s. The criterion of eq. 19 is laid on a measurement for values over many
decades, all other parameters at their truth, and its change is set beside what noise alone does to it.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from ...criterion import Cells, band_values, line_sigma, measure
from ...model import mode_table, simulate
from ...parameters import String
from ..laboratory import FINAL, SyntheticMeasurement, chosen
from ..laboratory import measure as record

__all__ = ["ALL", "BAND2", "GRIDS", "DispersionError", "B2Sensitivity", "bends", "blindness", "inverse_bend"]

# (kind of table, N, rate in Hz). The paper gives neither N nor rate; the first is what is asked about.
GRIDS = tuple(
    ("finite_difference", points, rate)
    for points, rate in ((100, 44_100.0), (100, 88_200.0), (200, 44_100.0), (200, 88_200.0), (400, 176_400.0))
)
PREWARPED = ("continuous", *GRIDS[0][1:])
# Prewarped, a table of so many modes has the continuous string's partials wherever they lie well below the rate.
FINE = ("continuous", 64, 441_000.0)
# Partials on which κ is fitted: the paper's band 2, and all to about 4 kHz.
BAND2 = np.arange(2, 9)
ALL = np.arange(1, 25)
# b2, m²/s: decades about the paper's 1.6e-6.
DECADES = (-10, -3)
# Steps of the model's contact for each sample: enough that noise, not the step, is what is left.
OVERSAMPLING = 8


class DispersionError(NamedTuple):
    """What a scheme makes of a string's partials."""

    kind: str  # of table: continuous, or finite_difference
    points: int  # N
    rate: float  # Hz
    first: int  # partial on which it was fitted
    last: int
    c: float  # m/s, found
    kappa: float  # m²/s, found
    kappa_true: float
    rms_cents: float  # left over

    @property
    def off(self) -> float:
        """How far κ is off, relative."""
        return self.kappa / self.kappa_true - 1


class B2Sensitivity(NamedTuple):
    """Eq. 19 over b2."""

    b2: np.ndarray  # m²/s [values]
    criterion: dict[str, np.ndarray]  # `global` and each band -> [values]
    noise: dict[str, float]  # the same at the truth, by noise alone: the mean over measurements that differ in it
    spread: dict[str, float]  # and its standard deviation over them
    true: float


def partials(string: String, number: np.ndarray, kind: str, points: int, rate: float) -> np.ndarray:
    """Frequencies of the partials `number` that a table of modes really has, Hz."""
    table = mode_table(string, FINAL.geometry, rate=rate, n_modes=points, kind=kind)
    return np.imag(np.asarray(table.pole))[number - 1] / (2 * np.pi)


def bends(number: np.ndarray = BAND2) -> list[DispersionError]:
    """κ by the paper's scheme from a continuous string's partials `number`, grid by grid; the last is prewarped."""
    exact = partials(FINAL.string, number, *FINE)
    return [_bend(exact, number, *grid) for grid in (*GRIDS, PREWARPED)]


def inverse_bend(number: np.ndarray = BAND2) -> DispersionError:
    """The continuous string that sounds as the paper's scheme does with the paper's κ, on the first of `GRIDS`."""
    return _bend(partials(FINAL.string, number, *GRIDS[0]), number, *FINE)


def _bend(frequency: np.ndarray, number: np.ndarray, *table: *tuple[str, int, float]) -> DispersionError:
    """The string whose table lies closest to partials at `frequency`, Hz, in cents."""
    start = FINAL.string

    def cents(log: np.ndarray) -> np.ndarray:
        string = start._replace(c=np.exp(log[0]), kappa=np.exp(log[1]))
        return 1200 * np.log2(partials(string, number, *table) / frequency)

    found = least_squares(cents, np.log([start.c, start.kappa]), x_scale=[1e-3, 0.1], xtol=1e-10, ftol=1e-10)
    (c, kappa), left = np.exp(found.x).tolist(), float(np.sqrt(np.mean(found.fun**2)))
    return DispersionError(*table, int(number[0]), int(number[-1]), c, kappa, float(start.kappa), left)


def blindness(lab: SyntheticMeasurement, seed: int, *, repeats: int, values: int) -> B2Sensitivity:
    """Eq. 19 over so many `values` of b2, on a measurement of the ideal laboratory: the model lacks nothing but noise.

    `repeats` measurements differ in their noise alone.
    """
    c, kappa, _, true = map(float, FINAL.string)
    f0, B = float(FINAL.f0), (kappa * np.pi / (c * FINAL.geometry.length)) ** 2

    def energies(sound: np.ndarray) -> tuple[Cells, np.ndarray]:
        return measure(sound, chosen.RATE, f0, B, int(ALL[-1]), line_sigma(f0))

    def by_model(b2: float) -> tuple[Cells, np.ndarray]:
        string = FINAL.string._replace(b2=b2)
        done = simulate(string, FINAL.hammer, FINAL.geometry, rate=chosen.RATE, oversampling=OVERSAMPLING)
        return energies(done.waveform(chosen.RATE, round(lab.seconds * chosen.RATE)))

    measured = [record(lab, float(FINAL.hammer.v_H0), seed + n) for n in range(repeats)]
    heard = [energies(m.samples[m.onset :] * m.scale)[1] for m in measured]
    b2, (cells, truth) = np.logspace(*DECADES, values), by_model(true)

    def columns(pairs: Iterable[tuple[np.ndarray, np.ndarray]]) -> dict[str, np.ndarray]:
        rows = [band_values(model, energy, cells.spacing) for model, energy in pairs]
        return {name: np.array([row[name] for row in rows]) for name in rows[0]}

    curve = columns((by_model(value)[1], heard[0]) for value in b2)
    by_noise = columns((truth, energy) for energy in heard)
    mean, spread = ({name: float(of(x)) for name, x in by_noise.items()} for of in (np.mean, partial(np.std, ddof=1)))
    return B2Sensitivity(b2, curve, mean, spread, true)
