"""A given value with its standard deviation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ..errors import SetupError

# Largest standard deviation over the value. The prior is Gaussian in the logarithm. The ends of its 95 % interval differ
# from those of a Gaussian in the value by 0.2 standard deviations at 10 %, and by 0.7 at this limit.
MOST_RELATIVE_SD = 0.3


@dataclass(frozen=True)
class Measured:
    """A measured value with its standard deviation, for every quantity that a `Setup` gives. `Setup` checks it.

    The intervals, the correlations and the draws of a fit include the uncertainty of the value. A plain number is
    exact.

    Parameters
    ----------
    value : the value, in the unit of the quantity.
    sd : its standard deviation, in the same unit; 0 for an exact value.

    Examples
    --------
    >>> import pianofit
    >>> setup = pianofit.Setup(length=pianofit.Measured(1.602, sd=0.001))
    >>> setup.length
    Measured(value=1.602, sd=0.001)
    >>> setup == pianofit.Setup.from_dict({"string": {"length": {"value": 1.602, "sd": 0.001}}})
    True
    """

    value: float
    sd: float

    def __float__(self) -> float:
        return float(self.value)


# A given quantity: exact, or with a standard deviation.
Given = float | Measured


def value_of(given: Given) -> float:
    """Return a given value without its standard deviation."""
    return given.value if isinstance(given, Measured) else given


def relative_sd(given: object) -> float:
    """Return the standard deviation over the value: that of the logarithm; 0 for an exact value and for None."""
    return given.sd / given.value if isinstance(given, Measured) else 0.0


def parts(given: object) -> tuple[Any, Any] | None:
    """Return value and standard deviation of a `Measured`, or of a table with these keys; None for anything else.

    Raises
    ------
    SetupError
        If a table lacks one of the two.
    """
    if isinstance(given, Measured):
        return given.value, given.sd
    if not isinstance(given, Mapping):
        return None
    for key, what in (("value", "the standard deviation of an assumed value is not used"), ("sd", "give both")):
        if key not in given:
            raise SetupError(f"{key} is missing; {what}, as in {{value = 1.602, sd = 0.001}}")
    return given["value"], given["sd"]
