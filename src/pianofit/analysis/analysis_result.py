"""The result of an analysis: plain numbers with their standard errors, also as JSON and as rows of a printed table."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from ..conversions import CENTS, DB, T60_NEPERS
from ..io.number_format import counted
from ..io.table_output import data_frame, html_table
from .glide import PitchGlide
from .inharmonicity import law_frequency

# Largest change of a level by another law of decays, dB. The change is a series in the difference of the laws, and this
# is two nepers. Layers of one key of a piano differ by at most 1.4 nepers. A partial that is not of the string, at a
# high number and without decay, differs by tens.
LARGEST_LAW_CHANGE = 17.4
# Columns of `Partials` with one number for each partial, and their headings in a notebook.
PER_PARTIAL = {
    "number": "k",
    "frequency": "frequency, Hz",
    "frequency_error": "± noise",
    "decay": "early decay, 1/s",
    "decay_error": "± noise",
    "late_decay": "late decay, 1/s",
    "late_decay_error": "±",
    "level": "level, dB",
    "level_error": "± noise",
    "snr": "SNR, dB",
    "beating": "beating, dB",
}


class Column(NamedTuple):
    """One column of the printed table."""

    name: str
    unit: str
    digits: int  # after the point; fewer if the standard error supports fewer
    width: int  # characters
    error: bool = False  # True for the standard error of the preceding column


COLUMNS = (
    Column("k", "", 0, 4),
    Column("frequency", "Hz", 3, 14),
    Column("±", "Hz", 3, 9, error=True),
    Column("from law", "cents", 2, 15),
    Column("T60 early", "s", 2, 12),
    Column("±", "s", 2, 7, error=True),
    Column("T60 late", "s", 2, 11),
    Column("±", "s", 2, 7, error=True),
    Column("level", "dB", 2, 10),
    Column("±", "dB", 2, 7, error=True),
    Column("SNR", "dB", 1, 8),
    Column("beating", "dB", 2, 12),
)


@dataclass(frozen=True, eq=False, repr=False)
class Partials:
    """The table of detected partials, ascending in number, and bounds on the absent ones.

    Errors come in two kinds. A standard error `_error` is due to noise alone. It is independent between partials and
    between recordings. A covariance `_systematic` describes the effect of beats, a second polarisation or a glide that
    was not removed. Neighbouring partials share it, and so do all recordings of a key. It does not include
    `Analysis.glide_error`. It is zero where the residuals do not exceed the noise.
    """

    number: np.ndarray  # int [partials], k
    frequency: np.ndarray  # [partials], Hz
    frequency_error: np.ndarray  # [partials], Hz
    frequency_systematic: np.ndarray  # [partials, partials], Hz²
    decay: np.ndarray  # [partials], 1/s, slope of the early part of the log envelope, in nepers
    decay_error: np.ndarray  # [partials], 1/s
    decay_systematic: np.ndarray  # [partials, partials], 1/s²: from the decay rate of the energy, due to beats
    late_decay: np.ndarray  # [partials], 1/s, the same of the late part; NaN where it is not visible
    late_decay_error: np.ndarray  # [partials], 1/s, due to noise and beats
    slope_times: np.ndarray  # [partials, 3], s: start of the early part, its end and the start of the late part, end
    level: np.ndarray  # [partials], dB re full scale² · s: ∫_0^0.35s of its mean power · exp(−16 t) dt, from the onset
    level_error: np.ndarray  # [partials], dB
    level_systematic: np.ndarray  # [partials, partials], dB²: from the level of the string's single mode
    # [partials], s: mean time of the measured energy minus that of the level's span, under the decay law
    level_decay_sensitivity_s: np.ndarray
    snr: np.ndarray  # [partials], dB, amplitude at the onset over its standard error due to noise
    beating: np.ndarray  # [partials], dB, rms deviation of the log envelope from one exponential
    absent: np.ndarray  # int [absent], numbers of the partials within the searched range that were not detected
    absent_bound: np.ndarray  # [absent], dB as `level`: all energy in the band of each, including noise

    def __len__(self) -> int:
        return len(self.number)

    def __repr__(self) -> str:
        span = f", {self.frequency[0]:.5g} to {self.frequency[-1]:.5g} Hz" if len(self) else ""
        return f"{counted(len(self), 'partial')}{span}; {len(self.absent)} not detected"

    def t60(self) -> tuple[np.ndarray, np.ndarray]:
        """T60 of the early and the late part of each envelope, s, with standard errors [2, partials] each.

        Returns
        -------
        Values and errors. NaN where a part is not visible, or decays by less than one standard error.
        """
        rate = np.stack([self.decay, self.late_decay])
        error = np.stack([self.total_error("decay"), self.late_decay_error])
        t60 = T60_NEPERS / np.where(rate > error, rate, np.nan)
        return t60, t60 * error / rate

    def total_error(self, column: str) -> np.ndarray:
        """Total standard deviation of "frequency", "decay" or "level": noise and systematic error [partials]."""
        return np.hypot(getattr(self, f"{column}_error"), np.sqrt(np.diag(getattr(self, f"{column}_systematic"))))

    def _rows(self) -> list[tuple]:
        return list(zip(*(getattr(self, name).tolist() for name in PER_PARTIAL), strict=True))

    def _repr_html_(self) -> str:
        return html_table(tuple(PER_PARTIAL.values()), self._rows())

    def to_dataframe(self) -> Any:
        """One row per partial, by number; frequency in Hz, decays in 1/s, levels, SNR and beating in dB.

        Raises
        ------
        OutputError
            If pandas is not installed.
        """
        return data_frame(tuple(PER_PARTIAL), self._rows())


@dataclass(frozen=True, eq=False, repr=False)
class Analysis:
    """One recording of one note: the two laws of the string, the partials, and their scatter about the laws."""

    f0: float  # Hz, of f_k = k f0 √(1 + B k²), over 0.2 to 1.0 s after the onset if the note lasts that long
    f0_error: float
    B: float
    B_error: float
    b1: float  # 1/s, of α_k = b1 + d2 k²
    b1_error: float
    d2: float  # 1/s, = b2 π²/L²
    d2_error: float
    partials: Partials
    scatter_cents: float  # robust deviation of the partials from the frequency law, beyond their noise
    scatter_decay: float  # relative robust deviation of the decay rates from their law, beyond their noise
    glide_cents: float  # fall of the pitch from the first 0.35 s to the last window in which it can be measured
    glide: tuple[tuple[float, float, float], ...]  # windows (start s, stop s, f0 Hz)
    noise_density: np.ndarray  # [partials], one-sided noise power density at each partial, full scale²/Hz
    note: str | None
    warnings: tuple[str, ...]
    glide_error: float = 0.0  # cents of f0: error of a glide that was removed
    glide_start: float = 0.0  # cents above f0 at which a glide that was removed began
    glide_tau: float = 1.0  # s, time constant of a glide that was removed
    level_law: tuple[float, float] = (0.0, 0.0)  # 1/s, b1 and d2 over the whole file, which the levels are based on
    knock: float = math.nan  # dB re full scale² · s, energy of the attack below the lowest partial; NaN if not measured
    knock_error: float = math.inf  # dB, due to noise

    def with_decay_law(self, other: Analysis) -> Analysis:
        """A copy whose levels are based on the `level_law` of `other`; exact to third order in their difference.

        The decay of the string is the same in all recordings of a key. Their laws differ because of noise and beats.
        Where they differ by more than `LARGEST_LAW_CHANGE`, a level keeps its own law, with the difference as an error.
        """
        p, q = self.partials, other.partials
        lag = 0.5 * (p.level_decay_sensitivity_s + np.interp(p.number, q.number, q.level_decay_sensitivity_s))
        b1, d2 = np.subtract(other.level_law, self.level_law)
        change = DB * lag * (b1 + d2 * p.number**2.0)
        small = np.abs(change) <= LARGEST_LAW_CHANGE
        level = p.level + np.where(small, change, 0.0)
        error = np.hypot(p.level_error, np.where(small, 0.0, change))
        return replace(self, partials=replace(p, level=level, level_error=error), level_law=other.level_law)

    @property
    def glide_model(self) -> PitchGlide:
        """The glide that was removed; 0 cents if none was."""
        return PitchGlide(self.glide_start, self.glide_tau)

    def __repr__(self) -> str:
        note = "" if self.note is None else f"{self.note}, "
        return (
            f"Analysis: {note}f0 {self.f0:.3f} ± {self.f0_error:.2g} Hz, B {self.B:.4g} ± {self.B_error:.2g}, "
            f"b1 {self.b1:.3g} ± {self.b1_error:.2g} 1/s, d2 {self.d2:.3g} ± {self.d2_error:.2g} 1/s\n{self.partials!r}"
        )

    def _repr_html_(self) -> str:
        units = {"f0": "Hz", "B": "1", "b1": "1/s", "d2": "1/s"}
        laws = [(name, getattr(self, name), getattr(self, f"{name}_error"), unit) for name, unit in units.items()]
        return html_table(("", "value", "±", "unit"), laws, self.note or "") + self.partials._repr_html_()

    def to_dataframe(self) -> Any:
        """The partials, as from `Partials.to_dataframe`."""
        return self.partials.to_dataframe()


def analysis_to_dict(analysis: Analysis) -> dict[str, Any]:
    """JSON-ready copy. Values that are not finite (unbounded errors, invisible parts of a decay) become None.

    `early_t60` and `late_t60` are added, s. Systematic covariances are replaced by standard deviations [partials], in
    Hz, 1/s and dB: `frequency_systematic`, `decay_systematic` and `level_systematic`.
    """
    data = {"schema": 3, **dataclasses.asdict(analysis)}
    (data["partials"]["early_t60"], data["partials"]["late_t60"]), _ = analysis.partials.t60()
    for name in ("frequency_systematic", "decay_systematic", "level_systematic"):
        data["partials"][name] = np.sqrt(np.diag(data["partials"][name]))
    return _plain(data)


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | tuple | list):
        return [_plain(item) for item in (value.tolist() if isinstance(value, np.ndarray) else value)]
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value


def partial_rows(analysis: Analysis) -> list[tuple[float, ...]]:
    """One tuple per partial, in the order of `COLUMNS`. Standard errors include noise and systematic errors."""
    table = analysis.partials
    cents = CENTS * np.log(table.frequency / law_frequency(analysis.f0, analysis.B, table.number))
    error = table.total_error
    t60, t60_error = table.t60()
    columns = [table.number, table.frequency, error("frequency"), cents, t60[0], t60_error[0], t60[1], t60_error[1]]
    columns += [table.level, error("level"), table.snr, table.beating]
    return [tuple(float(x) for x in row) for row in zip(*columns, strict=True)]
