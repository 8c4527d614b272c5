"""Rules for the comparison of quantities of two fits.

Intervals of a fit are those of logarithms, so z is the difference of two logarithms over its standard deviation. The
standard deviation that is reported in the quantity's unit is the difference over z. To first order that is the root of
the sum of both variances.

A z is computed only where both fits measured the same thing. A value that was given, assumed, at a search bound or not
identifiable is not a measurement. A value that scales with an assumed length or mass is comparable only if both fits
assumed the same. A value that scales with an unmeasured velocity is not comparable. K_H is not comparable between
different p, because its unit depends on p. The felt force at the reference compression of the key is compared instead.
"""

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ..analysis import SAME_KEY_CENTS, cents_above
from ..conversions import HALF_WIDTH_95
from ..errors import FitError
from ..excitation import HAMMER
from ..felt import LAWS
from ..io.files import printable
from ..io.number_format import log_half_width
from ..result import Result
from ..schema.fit import Fit
from ..schema.quantities import Quantity
from .static_law import StaticLaw, largest_compression, static_law
from .text import NOT_FELT, VELOCITY_RATIO

# Largest difference of the logarithms of equal numbers, from rounding in a file.
SAME = 1e-9
NOT_MEASURED = {
    "given": "held fixed in {}",
    "assumed": "assumed in {}",
    "at-bound": "at a search bound in {}",
    "not-identifiable": "not identifiable in {}",
}
# Parameters in metres of the string: they scale with an assumed length.
SCALES_WITH_LENGTH = ("c", "kappa", "b2", "x0")


@dataclass(frozen=True)
class ComparedQuantity:
    """One quantity in two fits. `difference`, `sd` and `z` are None if `reason` is not empty."""

    name: str
    unit: str
    a: Quantity | None  # None if the fit does not have it
    b: Quantity | None
    difference: float | None = None  # b - a, in `unit`
    sd: float | None = None  # standard deviation of the difference, in `unit`
    z: float | None = None  # difference over sd
    reason: str = ""  # why z is missing

    @property
    def row(self) -> tuple:
        """Name, both values, unit, difference, sd, z, both statuses, reason."""
        values, statuses = ([q and getattr(q, name) for q in (self.a, self.b)] for name in ("value", "status"))
        return self.name, *values, self.unit, self.difference, self.sd, self.z, *statuses, self.reason


@dataclass(frozen=True)
class Sides:
    """Two fits and their labels."""

    results: tuple[Result, Result]
    labels: tuple[str, str]

    @property
    def fits(self) -> tuple[Fit, Fit]:
        """All that both fits report."""
        return self.results[0].fit, self.results[1].fit

    @property
    def felt_unit(self) -> str:
        """Unit of the static force: N, or N/kg (force over string mass) if a mass was assumed."""
        return "N" if all(fit.parameters["M_S"].status == "given" for fit in self.fits) else "N/kg"

    @property
    def compressions_mm(self) -> tuple[float, float]:
        """Reference compressions of both keys, mm."""
        first, second = (fit.derived.reference_compression_mm for fit in self.fits)
        return first, second

    def where(self, which: Sequence[bool]) -> str:
        """Return the labels of the fits for which `which` is true."""
        return " and ".join(label for label, holds in zip(self.labels, which, strict=True) if holds)

    def laws(self) -> tuple[tuple[StaticLaw, StaticLaw] | None, tuple[str, ...]]:
        """Return both static laws up to the smaller of the largest compressions; or None and the reason."""
        if any(without := [fit.excitation != HAMMER for fit in self.fits]):
            return None, (f"The felts are not compared: there is not a hammer in {self.where(without)}.",)
        try:
            reach = min(map(largest_compression, self.results))
            first, second = (static_law(result, reach) for result in self.results)
        except FitError as error:
            return None, (f"The felts are not compared: {printable(error)}.",)
        if self.felt_unit == "N/kg":
            first, second = (
                law.divided_by(float(result.note.geometry.mass))
                for law, result in zip((first, second), self.results, strict=True)
            )
        return (first, second), ()

    def quantities(self) -> tuple[ComparedQuantity, ...]:
        """Return every quantity of two fits: invariants, derived quantities, parameters."""
        tables = zip(*((fit.invariants, fit.derived.quantities, fit.parameters) for fit in self.fits), strict=True)
        return tuple(self._compared(a.get(name), b.get(name)) for a, b in tables for name in dict.fromkeys([*a, *b]))

    def _compared(self, a: Quantity | None, b: Quantity | None) -> ComparedQuantity:
        """Return the difference and z, from the logarithms."""
        if a is None or b is None:
            present, label = (a, self.labels[0]) if b is None else (b, self.labels[1])
            name, unit = ("", "") if present is None else (present.name, present.unit)
            return ComparedQuantity(name, unit, a, b, reason=f"only in {label}")
        if reason := self._reason(a, b):
            return ComparedQuantity(a.name, a.unit, a, b, reason=reason)
        log_ratio = math.log(b.value / a.value)
        sd = math.hypot(*(log_half_width(q.interval) or 0.0 for q in (a, b))) / HALF_WIDTH_95
        # The logarithmic mean turns a difference of logarithms into one of values, exactly.
        mean = (b.value - a.value) / log_ratio if abs(log_ratio) > SAME else 0.5 * (a.value + b.value)
        return ComparedQuantity(a.name, a.unit, a, b, b.value - a.value, mean * sd, log_ratio / sd)

    # --- why z is missing ---------------------------------------------------------------------------------------------

    def _reason(self, a: Quantity, b: Quantity) -> str:
        """Return the reason why two values cannot be compared; empty if they can."""
        both = (a, b)
        if any(which := [not fit.converged for fit in self.fits]):
            return f"the search did not converge in {self.where(which)}"
        for status, reason in NOT_MEASURED.items():
            if any(which := [q.status == status for q in both]):
                return reason.format(self.where(which))
        if any(which := [log_half_width(q.interval) is None or q.value <= 0 for q in both]):
            return f"no interval in {self.where(which)}"
        if any(which := [bool(q.interval_unbounded) for q in both]):
            return f"the interval ends at a search bound in {self.where(which)}"
        return self._other_quantity(a, b) or self._other_assumption(a, b)

    def _other_quantity(self, a: Quantity, b: Quantity) -> str:
        """Return the reason why one name stands for two different quantities; empty if it does not."""
        one, other = self.fits
        if a.name not in NOT_FELT and a.name in one.parameters:
            if one.felt != other.felt:
                return f"the felts have different laws: {one.felt} and {other.felt}"
            law = LAWS.get(one.felt)
            if law is not None and law.power and a.name == law.power[0]:
                first, second = (fit.parameters[law.power[1]] for fit in self.fits)
                if first.value != second.value or {first.status, second.status} != {"given"}:
                    return f"its unit changes with {law.power[1]}; compare F/M_S"
        if a.name in ("F/M_S", "felt_force", "local_exponent"):
            first, second = (fit.derived.reference_compression_mm for fit in self.fits)
            if abs(math.log(first / second)) > SAME:
                return f"at different compressions: {first:.3g} and {second:.3g} mm"
        if a.name.startswith(VELOCITY_RATIO) and _checksums(one, a.name) != _checksums(other, b.name):
            return "of different recordings"
        return "" if a.unit == b.unit else f"in different units: {a.unit} and {b.unit}"

    def _other_assumption(self, a: Quantity, b: Quantity) -> str:
        """Return the reason why two values depend on different assumptions; empty if they do not."""
        pairs = [*zip((a, b), self.fits, strict=True)]
        for size, name in (("length", "L"), ("mass", "M_S")):
            if any(scales := [_scales_with(q, name, fit) for q, fit in pairs]):
                first, second = (fit.parameters[name] for fit in self.fits)
                if not all(scales):
                    return f"scales with the assumed {size} in {self.where(scales)}"
                if abs(math.log(first.value / second.value)) > SAME:
                    values = f"{first.value:.5g} {first.unit} and {second.value:.5g} {second.unit}"
                    return f"scales with different assumed values of the {size}: {values}"
        which = [q.status == "scaled" and _scales_with_velocity(q) and f.velocity_scale_open for q, f in pairs]
        return f"scales with velocities that were not measured in {self.where(which)}" if any(which) else ""

    # --- limits -------------------------------------------------------------------------------------------------------

    def warnings(self) -> Iterator[str]:
        """Yield sentences on the limits of the comparison."""
        f0 = [fit.invariants["f0"].value if "f0" in fit.invariants else math.nan for fit in self.fits]
        cents = cents_above(f0[1], f0[0]) if np.isfinite(f0).all() and min(f0) > 0 else 0.0
        if abs(cents) > SAME_KEY_CENTS:
            yield f"The fits are of different keys: their pitches differ by {cents:+z.0f} cents."
        first, second = ({row.sha256 for row in fit.recordings} for fit in self.fits)
        if shared := first & second:
            yield (
                f"Both fits contain {len(shared)} recording{'s' * (len(shared) != 1)} in common. Their errors are not "
                "independent, and z is smaller than for independent recordings."
            )
        if any(which := [fit.velocity_scale_open for fit in self.fits]):
            yield (
                f"No hammer velocity was measured in {self.where(which)}. Compressions and forces of the felt "
                "hold at the reference velocity shown."
            )


def _checksums(fit: Fit, name: str) -> tuple[str, str]:
    """Return the checksums of the recording of a velocity ratio, named by its stroke number, and of the reference."""
    stroke = int(name.removeprefix(VELOCITY_RATIO).strip() or 0) - 1
    return next((row.sha256 for row in fit.recordings if row.stroke == stroke), ""), fit.reference.sha256


def _scales_with(quantity: Quantity, size: str, fit: Fit) -> bool:
    """Return whether a value scales with the length or the mass of the string, and that size was assumed."""
    known = quantity.name in fit.parameters or quantity.name in fit.derived.quantities
    if quantity.status != "scaled" or fit.parameters[size].status != "assumed" or not known:
        return False
    return quantity.name in SCALES_WITH_LENGTH if size == "L" else _has_unit(quantity.unit, "N|kg")


def _scales_with_velocity(quantity: Quantity) -> bool:
    """Return whether a quantity would scale with an unknown velocity."""
    return quantity.name in ("v_H0", "F/M_S") or (quantity.name not in NOT_FELT and _has_unit(quantity.unit, "N|m|mm"))


def _has_unit(unit: str, symbols: str) -> bool:
    return re.search(rf"(?<![A-Za-z])({symbols})(?![A-Za-z])", unit) is not None
