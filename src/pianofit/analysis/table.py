"""An analysis as plain data, and as rows to print."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from .inharmonicity import CENTS, law_frequency
from .result import Analysis

__all__ = ["COLUMNS", "as_dict", "rows"]

# heading, unit, digits after the point
COLUMNS = (
    ("k", "", 0),
    ("frequency", "Hz", 3),
    ("from law", "cents", 2),
    ("decay", "1/s", 3),
    ("level", "dB", 2),
    ("SNR", "dB", 1),
    ("beating", "dB", 2),
)


def as_dict(analysis: Analysis) -> dict[str, Any]:
    """JSON-ready copy; what is not finite (an error that nothing bounds) becomes None.

    Of the systematic covariances it has the standard deviations, as `frequency_systematic` and so on: [partials], Hz,
    1/s and dB.
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


def rows(analysis: Analysis) -> list[tuple[float, ...]]:
    """One tuple per partial, in the order of `COLUMNS`."""
    table = analysis.partials
    cents = CENTS * np.log(table.frequency / law_frequency(analysis.f0, analysis.B, table.number))
    columns = (table.number, table.frequency, cents, table.decay, table.level, table.snr, table.beating)
    return [tuple(float(x) for x in row) for row in zip(*columns, strict=True)]
