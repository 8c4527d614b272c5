"""Admittance of the bridge of an instrument, as it stands in an `instrument.json` and in memory."""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

# Largest driving-point admittance, s/kg: that of one gram at 20 Hz.
LARGEST_ADMITTANCE = 10.0
Admittance = Annotated[float, Meta(gt=0.0, le=LARGEST_ADMITTANCE)]
Hertz = Annotated[float, Meta(gt=0.0, le=1e5)]
# Mean driving-point admittance of a soundboard at the bridge, s/kg: Skudrzyk's mean value, modal density over four
# times the mass, of measured soundboards up to 1.1 kHz (Ege and Boutillon, 2010, arXiv:1210.5688). Impedances at the
# bridge of some 1000 kg/s agree (Wogram 1980; Giordano 1998).
LITERATURE = 1e-3
# Standard deviation of its logarithm: pianos and places on a bridge differ by a factor of two. Chosen.
LITERATURE_SD = 0.7


@dataclass(frozen=True)
class BridgeAdmittance:
    """Real part of the driving-point admittance of the bridge over frequency, s/kg. The default is the literature's."""

    hz: tuple[Hertz, ...] = (1000.0,)  # ascending
    value: tuple[Admittance, ...] = (LITERATURE,)
    low: tuple[Admittance, ...] = (2.5e-4,)  # ends of the 95 % intervals
    high: tuple[Admittance, ...] = (4e-3,)
    source: Literal["literature", "recordings"] = "literature"
    partials: int = 0  # number of measured partials

    def __post_init__(self) -> None:
        if len({len(self.hz), len(self.value), len(self.low), len(self.high)}) != 1 or not self.hz:
            raise ValueError("Expected hz, value, low and high of one length, at least 1")
        if list(self.hz) != sorted(self.hz):
            raise ValueError("Expected ascending frequencies in hz")

    def at(self, hz: np.ndarray) -> np.ndarray:
        """Return the admittance at these frequencies, s/kg. Beyond the first and last frequency it is constant."""
        return self._interpolated(self.value, hz)

    def interval(self, hz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the ends of the 95 % intervals of `at`, s/kg [frequencies]."""
        return self._interpolated(self.low, hz), self._interpolated(self.high, hz)

    def _interpolated(self, column: tuple[float, ...], hz: np.ndarray) -> np.ndarray:
        return np.exp(np.interp(np.log(hz), np.log(self.hz), np.log(column)))
