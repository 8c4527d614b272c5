"""An analysis as plain data and as rows of a printed table."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, NamedTuple

import numpy as np

from .analysis_result import Analysis, Partials
from .inharmonicity import CENTS, law_frequency

__all__ = ["COLUMNS", "Column", "analysis_to_dict", "partial_rows"]


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
    Column("decay", "1/s", 3, 11),
    Column("±", "1/s", 3, 8, error=True),
    Column("level", "dB", 2, 10),
    Column("±", "dB", 2, 7, error=True),
    Column("SNR", "dB", 1, 8),
    Column("beating", "dB", 2, 12),
)


def analysis_to_dict(analysis: Analysis) -> dict[str, Any]:
    """JSON-ready copy. Values that are not finite (unbounded errors) become None.

    Systematic covariances are replaced by standard deviations [partials], in Hz, 1/s and dB: `frequency_systematic`,
    `decay_systematic` and `level_systematic`.
    """
    data = {field.name: _plain(getattr(analysis, field.name)) for field in dataclasses.fields(analysis)}
    for name in ("frequency_systematic", "decay_systematic", "level_systematic"):
        data["partials"][name] = _plain(np.sqrt(np.diag(getattr(analysis.partials, name))))
    return {"schema": 1, **data}


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, np.ndarray):
        return [_plain(item) for item in value.tolist()]
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value


def partial_rows(analysis: Analysis) -> list[tuple[float, ...]]:
    """One tuple per partial, in the order of `COLUMNS`. Standard errors include noise and systematic errors."""
    table = analysis.partials
    cents = CENTS * np.log(table.frequency / law_frequency(analysis.f0, analysis.B, table.number))
    columns = (
        table.number, table.frequency, _error(table, "frequency"), cents, table.decay, _error(table, "decay"),
        table.level, _error(table, "level"), table.snr, table.beating,
    )  # fmt: skip
    return [tuple(float(x) for x in row) for row in zip(*columns, strict=True)]


def _error(table: Partials, name: str) -> np.ndarray:
    return np.hypot(getattr(table, f"{name}_error"), np.sqrt(np.diag(getattr(table, f"{name}_systematic"))))
