"""Limits of two fitted values: the bias of κ by the paper's grid and step, and the sensitivity of its criterion to b2.

**κ.** The five-point differences on N points and Crank-Nicolson at a step of 1/44,100 s lower the frequencies of high
partials. A fit with that scheme increases κ until its partials match the measured ones. The bias is computed by fitting
the modes of the scheme (`finite_difference`) to the partials of a continuous string, without sound, noise or hammer.
The inverse fit gives the continuous string that has the partials of the scheme at the paper's κ.

**b2.** The paper's final value is 1.6e-6 m²/s. The criterion of eq. 19 is computed on a measurement for b2 over many
decades, with all other parameters at their true values. Its change is compared with its change by noise alone.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from pianofit.criterion import SpectralCells, band_values, damping_for, measure
from pianofit.model import mode_table, simulate
from pianofit.parameters import String

from .laboratory import FINAL, RATE, SyntheticMeasurement
from .laboratory import measure as record

__all__ = [
    "ALL",
    "BAND2",
    "GRIDS",
    "B2Sensitivity",
    "DispersionError",
    "b2_sensitivity",
    "dispersion_errors",
    "inverse_dispersion_error",
]

# (kind of table, N, rate in Hz). The paper gives neither N nor rate. The claims use the first.
GRIDS = tuple(
    ("finite_difference", points, rate)
    for points, rate in ((100, 44_100.0), (100, 88_200.0), (200, 44_100.0), (200, 88_200.0), (400, 176_400.0))
)
PREWARPED = ("continuous", *GRIDS[0][1:])
# The prewarped modes of this table have the partials of the continuous string well below the rate.
FINE = ("continuous", 64, 441_000.0)
# Partials to which κ is fitted: the paper's band 2, and all to about 4 kHz.
BAND2 = np.arange(2, 9)
ALL = np.arange(1, 25)
# b2, m²/s: decades about the paper's 1.6e-6.
DECADES = (-10, -3)
# Contact steps per sample: enough that the noise dominates the error of the step.
OVERSAMPLING = 8


class DispersionError(NamedTuple):
    """Bias of a fit by a scheme to the partials of a string."""

    kind: str  # of table: continuous, or finite_difference
    points: int  # N
    rate: float  # Hz
    first: int  # first partial of the fit
    last: int
    c: float  # m/s, fitted
    kappa: float  # m²/s, fitted
    kappa_true: float
    rms_cents: float  # residual

    @property
    def off(self) -> float:
        """Relative error of κ."""
        return self.kappa / self.kappa_true - 1


class B2Sensitivity(NamedTuple):
    """Eq. 19 over b2."""

    b2: np.ndarray  # m²/s [values]
    criterion: dict[str, np.ndarray]  # `global` and each band -> [values]
    noise: dict[str, float]  # criterion at the true values: mean over measurements that differ only in their noise
    spread: dict[str, float]  # and its standard deviation over these measurements
    true: float


def partials(string: String, number: np.ndarray, kind: str, points: int, rate: float) -> np.ndarray:
    """Return the frequencies of the partials `number` of a table of modes, Hz."""
    table = mode_table(string, FINAL.geometry, rate=rate, n_modes=points, kind=kind)
    return np.imag(np.asarray(table.pole))[number - 1] / (2 * np.pi)


def dispersion_errors(number: np.ndarray = BAND2) -> list[DispersionError]:
    """Fit each grid of the paper's scheme to the partials `number` of a continuous string; the last is prewarped."""
    exact = partials(FINAL.string, number, *FINE)
    return [_fit_dispersion(exact, number, *grid) for grid in (*GRIDS, PREWARPED)]


def inverse_dispersion_error(number: np.ndarray = BAND2) -> DispersionError:
    """Fit a continuous string to the partials of the paper's scheme with the paper's κ, on the first of `GRIDS`."""
    return _fit_dispersion(partials(FINAL.string, number, *GRIDS[0]), number, *FINE)


def _fit_dispersion(frequency: np.ndarray, number: np.ndarray, *table: *tuple[str, int, float]) -> DispersionError:
    """Fit the string of a table to partials at `frequency`, Hz, in cents."""
    start = FINAL.string

    def cents(log: np.ndarray) -> np.ndarray:
        string = start._replace(c=np.exp(log[0]), kappa=np.exp(log[1]))
        return 1200 * np.log2(partials(string, number, *table) / frequency)

    fit = least_squares(cents, np.log([start.c, start.kappa]), x_scale=[1e-3, 0.1], xtol=1e-10, ftol=1e-10)
    (c, kappa), residual = np.exp(fit.x).tolist(), float(np.sqrt(np.mean(fit.fun**2)))
    return DispersionError(*table, int(number[0]), int(number[-1]), c, kappa, float(start.kappa), residual)


def b2_sensitivity(lab: SyntheticMeasurement, seed: int, *, repeats: int, values: int) -> B2Sensitivity:
    """Compute eq. 19 for a number `values` of values of b2, on a measurement that the model describes except for noise.

    `repeats` is the number of measurements that differ only in their noise.
    """
    c, kappa, _, true = map(float, FINAL.string)
    f0, B = float(FINAL.f0), (kappa * np.pi / (c * FINAL.geometry.length)) ** 2

    def energies(sound: np.ndarray) -> tuple[SpectralCells, np.ndarray]:
        return measure(sound, RATE, f0, B, int(ALL[-1]), damping_for(f0))

    def by_model(b2: float) -> tuple[SpectralCells, np.ndarray]:
        string = FINAL.string._replace(b2=b2)
        simulation = simulate(string, FINAL.hammer, FINAL.geometry, rate=RATE, oversampling=OVERSAMPLING)
        return energies(simulation.waveform(RATE, round(lab.seconds * RATE)))

    measured = [record(lab, float(FINAL.hammer.v_H0), seed + n) for n in range(repeats)]
    recorded = [energies(m.samples[m.onset :] * m.scale)[1] for m in measured]
    b2, (cells, truth) = np.logspace(*DECADES, values), by_model(true)

    def columns(pairs: Iterable[tuple[np.ndarray, np.ndarray]]) -> dict[str, np.ndarray]:
        rows = [band_values(model, energy, cells.spacing) for model, energy in pairs]
        return {name: np.array([row[name] for row in rows]) for name in rows[0]}

    curve = columns((by_model(value)[1], recorded[0]) for value in b2)
    noise = columns((truth, energy) for energy in recorded)
    mean = {name: float(np.mean(x)) for name, x in noise.items()}
    spread = {name: float(np.std(x, ddof=1)) for name, x in noise.items()}
    return B2Sensitivity(b2, curve, mean, spread, true)
