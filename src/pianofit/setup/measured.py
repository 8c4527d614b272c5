"""A given value with its standard deviation."""

from __future__ import annotations

import math
from numbers import Real

from ..errors import ParameterError

# Largest standard deviation over the value. The prior is Gaussian in the logarithm. The ends of its 95 % interval
# differ from those of a Gaussian in the value by 0.2 standard deviations at 10 %, and by 0.7 at this limit.
MOST_RELATIVE_SD = 0.3


class Measured(float):
    """A measured value with its standard deviation, for every quantity that a `Setup` gives.

    It is a number. The intervals, the correlations and the draws of a fit include its uncertainty. A plain number is
    exact. Arithmetic gives plain numbers.

    Parameters
    ----------
    value : the value, in the unit of the quantity.
    sd : its standard deviation, in the same unit; 0 for an exact value.

    Raises
    ------
    ParameterError
        If the value is not a finite number, or `sd` is not a number from 0.

    Examples
    --------
    >>> import pianofit
    >>> setup = pianofit.Setup(length=pianofit.Measured(1.602, sd=0.001))
    >>> setup.length
    Measured(1.602, sd=0.001)
    >>> setup == pianofit.Setup.from_dict({"string": {"length": {"value": 1.602, "sd": 0.001}}})
    True
    """

    __slots__ = ("sd",)
    sd: float

    def __new__(cls, value: float, sd: float) -> Measured:
        """Check value and standard deviation."""
        for name, number, lowest in (("value", value, -math.inf), ("sd", sd, 0.0)):
            if not isinstance(number, Real) or isinstance(number, bool) or not lowest <= number < math.inf:
                limit = " from 0" if name == "sd" else ""
                raise ParameterError(f"Measured: {name}={number!r} must be a finite number{limit}, in the unit of both")
        measured = super().__new__(cls, value)
        object.__setattr__(measured, "sd", float(sd))
        return measured

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(f"Measured: {name} cannot be changed; make another")

    def __reduce__(self) -> tuple[type[Measured], tuple[float, float]]:
        return Measured, (float(self), self.sd)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Real):
            return NotImplemented
        return float(self) == float(other) and self.sd == getattr(other, "sd", 0.0)

    def __ne__(self, other: object) -> bool:
        return not self == other

    def __hash__(self) -> int:
        return hash((float(self), self.sd)) if self.sd else hash(float(self))

    def __repr__(self) -> str:
        return f"Measured({float(self)!r}, sd={self.sd!r})"


def relative_sd(given: float | None) -> float:
    """Return the standard deviation over the value: that of the logarithm; 0 for an exact value and for None."""
    return given.sd / float(given) if isinstance(given, Measured) else 0.0
