"""Reported quantities: value, unit, interval and status of each, tables of them by name, and their covariance."""

from __future__ import annotations

import difflib
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal, get_args

import numpy as np

from ..conversions import HALF_WIDTH_95
from ..excitation import Excitation
from ..felt import ALL_PARAMETERS
from ..io.number_format import format_with_interval
from ..io.table_output import data_frame, html_table, write_csv
from ..io.uncertainty_format import format_interval, format_with_sd, latex_name, latex_unit, parse_format_spec
from .decode import Number

Status = Literal["fitted", "scaled", "given", "assumed", "at-bound", "not-identifiable"]
STATUSES: tuple[str, ...] = get_args(Status)
# Unit and meaning of the quantities that are not in `ALL_PARAMETERS`.
SIZES = {
    "x0": ("m", "strike position, from the agraffe"),
    "width": ("m", "full width of the contact window"),
    "M_S": ("kg", "mass of the whole string"),
    "L": ("m", "length of the string"),
    "pickup": ("m", "position of the pickup, from the agraffe"),
}
UNITS = {name: p.unit for name, p in ALL_PARAMETERS.items()} | {name: unit for name, (unit, _) in SIZES.items()}
MEANINGS = (
    {name: p.meaning for name, p in ALL_PARAMETERS.items()}
    | {name: text for name, (_, text) in SIZES.items()}
    | {
        "f0": "fundamental frequency of the string without stiffness",
        "B": "inharmonicity",
        "M_H/M_S": "hammer mass over string mass",
        "x0/L": "strike position over string length",
        "pickup/L": "position of the pickup over string length",
        "width/L": "width of the contact window over string length",
        "F/M_S": "static felt force at the reference compression, over the string mass",
        "felt_force": "static felt force at the reference compression",
        "local_exponent": "exponent of the static felt force at the reference compression",
        "contact_time": "duration of the first contact",
        "peak_force": "largest force of the hammer",
        "peak_compression": "largest compression of the felt",
        "felt_loss": "energy lost in the felt over the energy of the hammer",
    }
)
# Beginning of the name of the T60 of a partial, before its number.
T60 = "T60_"
# Largest distance of a value from the middle of its interval, relative to half of the interval, for which a standard
# uncertainty is stated. A Gaussian of the logarithm reaches it at a standard deviation of 10 %.
MAX_ASYMMETRY = 0.1
# A conditional variance below this share of the marginal variance is rounding error.
ROUNDING = 1e-10
# The same for correlations in a file, whose numbers were rounded.
PSD_ROUNDING = 1e-6
COLUMNS = ("name", "value", "low", "high", "unit", "status", "meaning", "note")
TABLE_HEADING = ("", "value", "95 % from", "to", "unit", "status", "", "")


@dataclass(frozen=True)
class Quantity:
    """One number that a fit reports.

    It converts to `float` and takes the format specifications of the package `uncertainties`. `S` is the short form
    with the uncertainty in parentheses, `L` is LaTeX, `P` uses ±, and `.2u` gives two digits of the uncertainty.

    >>> import pianofit
    >>> mass = pianofit.Quantity("M_H", 2.277, "g", (2.2692, 2.2848), "fitted", "hammer mass")
    >>> f"{mass:S}", f"{mass:.2uP}", round(mass.sd, 4), float(mass)
    ('2.277(4)', '2.2770±0.0040', 0.004, 2.277)

    If the interval is open or asymmetric, it is written instead of an uncertainty:

    >>> loose = pianofit.Quantity("M_H", 2.277, "g", (1.9, 3.1), "fitted", "hammer mass", interval_unbounded=("high",))
    >>> f"{loose:S}", loose.sd
    ('2.28 (> 1.90)', None)
    """

    name: str
    value: Number  # in `unit`
    unit: str = "1"
    interval: tuple[Number, Number] | None = None  # 95 %, in `unit`; None if not fitted
    status: Status = "fitted"
    meaning: str = ""
    note: str = ""
    initial: Number | None = None  # before the fit
    interval_method: Literal["laplace", "profile", "posterior"] | None = None
    interval_unbounded: tuple[Literal["low", "high"], ...] = ()  # ends that are limits of the search range

    @property
    def sd(self) -> float | None:
        """Standard uncertainty in `unit`: half of the 95 % interval over 1.96.

        None if the quantity was not fitted, if an end of the interval is open, or if the value is not in its middle.
        """
        if self.interval is None or self.interval_unbounded:
            return None
        low, high = self.interval
        half = (high - low) / 2
        middle = abs((low + high) / 2 - self.value)
        return half / HALF_WIDTH_95 if 0 < half < math.inf and middle <= MAX_ASYMMETRY * half else None

    def __float__(self) -> float:
        return float(self.value)

    def __format__(self, spec: str) -> str:
        """The value with its uncertainty; `str(self)` without a specification.

        If `sd` is None the 95 % interval is written. A half-open interval is written as a bound.

        Raises
        ------
        ParameterError
            For an invalid specification.
        """
        if not spec:
            return str(self)
        parsed, sd = parse_format_spec(spec), self.sd
        if sd is not None:
            return format_with_sd(float(self.value), sd, parsed)
        return format_interval(float(self.value), self.interval, self.interval_unbounded, parsed)

    def _repr_latex_(self) -> str:
        return f"${latex_name(self.name)} = {self:L}{latex_unit(self.unit)}$"

    def __str__(self) -> str:
        value, span = format_with_interval(self.value, self.interval)
        unit = "" if self.unit == "1" else f" {self.unit}"
        return f"{self.name} = {value}{unit}{'' if self.interval is None else ' ' + span}, {self.status}"

    @property
    def as_row(self) -> tuple:
        """Values in the order of `COLUMNS`."""
        low, high = self.interval or (None, None)
        return self.name, self.value, low, high, self.unit, self.status, self.meaning, self.note


class Quantities(Mapping[str, Quantity]):
    """Quantities by name, in order: a mapping, `table["K_H"]`, whose names are attributes too."""

    entry_type = Quantity
    entries: dict[str, Quantity]

    def __init__(self, entries: Mapping[str, Quantity]) -> None:
        vars(self)["entries"] = dict(entries)

    @classmethod
    def of(cls, quantities: Iterable[Quantity]) -> Quantities:
        """Return a table of quantities."""
        return cls({quantity.name: quantity for quantity in quantities})

    @classmethod
    def from_builtins(cls, value: Any, convert: Callable[[Any, type[Quantity], str], Quantity]) -> Quantities:
        """Read a table of a file: the entries by name."""
        if not isinstance(value, dict) or not all(isinstance(entry, dict) for entry in value.values()):
            raise ValueError("Expected a table of quantities by name")
        return cls.of(
            convert({"meaning": meaning_of(name)} | entry | {"name": name}, Quantity, name)
            for name, entry in value.items()
        )

    def to_builtins(self) -> dict[str, dict[str, Any]]:
        """Return the table of a file: the entries by name."""
        return {
            name: {own.name: getattr(quantity, own.name) for own in fields(Quantity) if own.name != "name"}
            for name, quantity in self.items()
        }

    def __getitem__(self, name: str) -> Quantity:
        if name not in self.entries:
            raise KeyError(_missing(name, tuple(self)))
        return self.entries[name]

    def __getattr__(self, name: str) -> Quantity:
        if name.startswith("_") or name == "entries":  # while it is copied it has no entries yet
            raise AttributeError(name)
        if name not in self.entries:
            raise AttributeError(_missing(name, tuple(self)))
        return self.entries[name]

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(f"{name} cannot be changed; make other Quantities")

    def __iter__(self) -> Iterator[str]:
        return iter(self.entries)

    def __len__(self) -> int:
        return len(self.entries)

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *(name for name in self if name.isidentifier())]

    def __repr__(self) -> str:
        return "\n".join(map(str, self.values()))

    def _repr_html_(self) -> str:
        return html_table(TABLE_HEADING, (q.as_row for q in self.values()))

    def to_dataframe(self) -> Any:
        """One row for each quantity, by name: value, ends of the 95 % interval, unit, status, meaning, note.

        Raises
        ------
        OutputError
            If pandas is not installed.
        """
        return data_frame(COLUMNS, (q.as_row for q in self.values()))

    def to_csv(self, path: str | os.PathLike[str]) -> None:
        """Write the table of `to_dataframe`; pandas is not needed.

        Raises
        ------
        OutputError
            If the file cannot be written.
        """
        write_csv(path, COLUMNS, (q.as_row for q in self.values()))


def _missing(name: object, available: Sequence[str]) -> str:
    """Error text for a name that does not exist."""
    near = difflib.get_close_matches(str(name), available, 1)
    return f"{name!r} does not exist; " + (f"did you mean {near[0]}?" if near else f"use one of {', '.join(available)}")


def unit_of(name: str, law: Excitation) -> str:
    """Return the unit of a parameter of a fit with `law`."""
    return law.parameters[name].unit if name in law.parameters else UNITS[name]


def meaning_of(name: str, law: Excitation | None = None) -> str:
    """Return the meaning of a quantity; empty for a parameter of a felt law that is unknown here."""
    if law is not None and name in law.parameters:
        return law.parameters[name].meaning
    if name.startswith("v/v_ref"):
        return "velocity of a stroke over that of the reference"
    if name.startswith(T60):
        return f"time in which partial {name.removeprefix(T60)} falls by 60 dB in the string model"
    return MEANINGS.get(name, "")


@dataclass(frozen=True, eq=False, repr=False)
class Covariance:
    """Covariance of the logarithms of values at the best minimum, by name; zero for values that were not fitted."""

    names: tuple[str, ...]
    matrix: np.ndarray  # [names, names], 1

    def __post_init__(self) -> None:
        if self.matrix.shape != (len(self.names),) * 2:
            raise ValueError("Expected a square matrix with a row for each name")
        matrix = self.matrix.view()
        matrix.setflags(write=False)
        object.__setattr__(self, "matrix", matrix)

    @property
    def is_valid(self) -> bool:
        """True if the matrix is finite and symmetric and has no negative eigenvalue, apart from rounding errors."""
        if not np.isfinite(self.matrix).all() or np.diag(self.matrix).min(initial=0.0) < 0:
            return False
        sd = np.sqrt(np.maximum(np.diag(self.matrix), 0.0))
        unit = self.matrix / np.outer(*(np.where(sd > 0, sd, 1.0),) * 2)
        return bool(np.allclose(unit, unit.T, atol=PSD_ROUNDING) and np.linalg.eigvalsh(unit).min() > -PSD_ROUNDING)

    def __getitem__(self, pair: tuple[str, str]) -> float:
        for name in pair:
            if name not in self.names:
                raise KeyError(_missing(name, self.names))
        row, column = (self.names.index(name) for name in pair)
        return float(self.matrix[row, column])

    def __repr__(self) -> str:
        return f"Covariance of log {', '.join(self.names)}"

    def of_shared(self, scale_open: bool) -> Covariance:
        """Return the covariance of the parameters that all strokes share.

        Parameters
        ----------
        scale_open : True if the common scale of the velocities is unknown. The covariance is then conditional on the
            velocity of the reference recording. Otherwise the scale, which only the prior determines, would dominate.
        """
        cov = self.matrix
        if scale_open and "v_H0" in self.names and self["v_H0", "v_H0"] > 0:
            fixed = self.names.index("v_H0")
            cov = cov - np.outer(cov[fixed], cov[fixed]) / cov[fixed, fixed]
            # Parameters that vary only with the scale are fixed now, apart from rounding errors.
            varies = np.diag(cov) > ROUNDING * np.diag(self.matrix)
            cov = np.where(varies[:, None] & varies, cov, 0.0)
        shared = [i for i, name in enumerate(self.names) if not name.startswith("v_H0")]
        return Covariance(tuple(self.names[i] for i in shared), cov[np.ix_(shared, shared)])

    @property
    def normalised(self) -> Covariance:
        """Correlations of the values that vary [varying, varying]; for those of a fit see `Result.correlation`."""
        free = np.flatnonzero(np.diag(self.matrix) > 0)
        sd = np.sqrt(np.diag(self.matrix)[free])
        matrix = np.clip(self.matrix[np.ix_(free, free)] / np.outer(sd, sd), -1.0, 1.0)
        return Covariance(tuple(self.names[i] for i in free), matrix)

    def to_dataframe(self) -> Any:
        """The matrix with rows and columns by name.

        Raises
        ------
        OutputError
            If pandas is not installed.
        """
        rows = ((name, *row) for name, row in zip(self.names, self.matrix.tolist(), strict=True))
        return data_frame(("name", *self.names), rows)
