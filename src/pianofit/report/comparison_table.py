"""Rules for the comparison of quantities of two fits.

Intervals of a fit are those of logarithms, so z is the difference of two logarithms over its standard deviation. The
standard deviation that is reported in the quantity's unit is the difference over z. To first order that is the root of
the sum of both variances.

A z is computed only where both fits measured the same thing. A value that was given, assumed, at a search bound or not
identifiable is not a measurement. A value that scales with an assumed length or mass is comparable only if both fits
assumed the same. A value that scales with an unmeasured velocity is not comparable. K_H is not comparable between
different p, because its unit depends on p. The static force of the felt at one compression is compared instead.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..analysis import SAME_KEY_CENTS, cents_above
from ..conversions import HALF_WIDTH_95
from ..errors import FitError
from ..felt import LAWS
from ..io.files import printable
from ..io.number_format import log_half_width
from ..result import Result
from ..schema.fit import Fit
from ..schema.quantities import Quantity
from .identifiability import is_scale_open
from .static_law import StaticLaw, largest_compression, static_law
from .text import NOT_FELT, VELOCITY_RATIO

# Largest difference of the logarithms of equal numbers, from rounding in a file; and of a compression that was computed
# from a force.
SAME, SAME_COMPRESSION = 1e-9, 1e-6
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
        values, statuses = zip(
            *((None, None) if q is None else (q.value, q.status) for q in (self.a, self.b)), strict=True
        )
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

    def where(self, which: Sequence[bool]) -> str:
        """Return the labels of the fits for which `which` is true."""
        return " and ".join(label for label, holds in zip(self.labels, which, strict=True) if holds)

    def laws(self) -> tuple[tuple[StaticLaw, StaticLaw] | None, tuple[str, ...]]:
        """Return both static laws up to the smaller of the largest compressions; or None and the reason."""
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

    def quantities(self, laws: tuple[StaticLaw, StaticLaw] | None) -> tuple[ComparedQuantity, ...]:
        """Return every quantity of two fits: invariants, force of the felts at one compression, parameters."""
        force = () if laws is None else (self._force(laws),)
        first, second = self.fits
        tables = (first.invariants, second.invariants), (first.parameters, second.parameters)
        invariants, parameters = (
            [self._compared(a.get(name), b.get(name)) for name in dict.fromkeys([*a, *b])] for a, b in tables
        )
        return (*invariants, *force, *parameters)

    def _compared(self, a: Quantity | None, b: Quantity | None, objection: str = "") -> ComparedQuantity:
        """Return the difference and z, from the logarithms, unless there is an `objection`."""
        if a is None or b is None:
            present, label = (a, self.labels[0]) if b is None else (b, self.labels[1])
            name, unit = ("", "") if present is None else (present.name, present.unit)
            return ComparedQuantity(name, unit, a, b, reason=f"only in {label}")
        if reason := self._reason(a, b) or objection:
            return ComparedQuantity(a.name, a.unit, a, b, reason=reason)
        log_ratio = math.log(b.value / a.value)
        sd = math.hypot(*(log_half_width(q.interval) or 0.0 for q in (a, b))) / HALF_WIDTH_95
        # The logarithmic mean turns a difference of logarithms into one of values, exactly.
        mean = (b.value - a.value) / log_ratio if abs(log_ratio) > SAME else 0.5 * (a.value + b.value)
        return ComparedQuantity(a.name, a.unit, a, b, b.value - a.value, mean * sd, log_ratio / sd)

    def _force(self, laws: tuple[StaticLaw, StaticLaw]) -> ComparedQuantity:
        """Return the comparison of the static forces at one compression within the range of both felts."""
        index, name = laws[0].middle, "F" if self.felt_unit == "N" else "F/M_S"
        label = f"{name} at {laws[0].compression_mm[index]:.3g} mm"
        first, second = (
            _force_at(law, index, label, fit, self.felt_unit) for law, fit in zip(laws, self.fits, strict=True)
        )
        return self._compared(first, second, self._open_scales([is_scale_open(fit) for fit in self.fits]))

    def _open_scales(self, which: Sequence[bool]) -> str:
        return f"scales with velocities that were not measured in {self.where(which)}" if any(which) else ""

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
                    return f"its unit changes with {law.power[1]}; compare the force at one compression"
        if a.name == "F/M_S":
            first, second = map(_compression, self.fits)
            if first is None or second is None or abs(math.log(first / second)) > SAME_COMPRESSION:
                return "at different compressions; compare the force at one compression"
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
        return self._open_scales(
            [q.status == "scaled" and _scales_with_velocity(q) and is_scale_open(f) for q, f in pairs]
        )

    # --- limits -------------------------------------------------------------------------------------------------------

    def warnings(self) -> Iterator[str]:
        """Yield sentences on the limits of the comparison."""
        f0 = [fit.invariants["f0"].value if "f0" in fit.invariants else math.nan for fit in self.fits]
        cents = cents_above(f0[1], f0[0]) if np.isfinite(f0).all() and min(f0) > 0 else 0.0
        if abs(cents) > SAME_KEY_CENTS:
            yield f"The fits are of different keys: their pitches differ by {cents:+.0f} cents."
        first, second = ({row.sha256 for row in fit.recordings} for fit in self.fits)
        if shared := first & second:
            yield (
                f"Both fits contain {len(shared)} recording{'s' * (len(shared) != 1)} in common. Their errors are not "
                "independent, and z is smaller than for independent recordings."
            )
        if any(which := [is_scale_open(fit) for fit in self.fits]):
            yield (
                f"No hammer velocity was measured in {self.where(which)}. Compressions and forces of the felt "
                "hold at the reference velocity shown."
            )


def _force_at(law: StaticLaw, index: int, name: str, fit: Fit, unit: str) -> Quantity:
    force, low, high = law.force[:, index].tolist()
    statuses = [quantity.status for own, quantity in fit.parameters.items() if own not in NOT_FELT]
    worst: Any = next((status for status in ("at-bound", "not-identifiable") if status in statuses), "fitted")
    interval = (low, high) if fit.has_intervals and low < high else None
    is_free = any(status not in ("given", "assumed") for status in statuses)
    meaning = "static force of the felt at a compression that occurs in both fits"
    return Quantity(name, force, unit, interval, worst if is_free else "given", meaning)


def _compression(fit: Fit) -> float | None:
    """Return the compression of F/M_S, m, if the felt is a power law: (F/K)^(1/p)."""
    law = LAWS.get(fit.felt)
    if law is None or law.power is None:
        return None
    stiffness, p = (fit.parameters[name].value for name in law.power)
    return (fit.invariants["F/M_S"].value * fit.parameters["M_S"].value / stiffness) ** (1 / p)


def _checksums(fit: Fit, name: str) -> tuple[str, str]:
    """Return the checksums of the recording of a velocity ratio, named by its stroke number, and of the reference."""
    stroke = int(name.removeprefix(VELOCITY_RATIO).strip() or 0) - 1
    return next((row.sha256 for row in fit.recordings if row.stroke == stroke), ""), fit.reference.sha256


def _scales_with(quantity: Quantity, size: str, fit: Fit) -> bool:
    """Return whether a value scales with the length or the mass of the string, and that size was assumed."""
    if quantity.status != "scaled" or fit.parameters[size].status != "assumed" or quantity.name not in fit.parameters:
        return False
    return quantity.name in SCALES_WITH_LENGTH if size == "L" else _has_unit(quantity.unit, "N|kg")


def _scales_with_velocity(quantity: Quantity) -> bool:
    """Return whether a quantity would scale with an unknown velocity."""
    return quantity.name in ("v_H0", "F/M_S") or (quantity.name not in NOT_FELT and _has_unit(quantity.unit, "N|m"))


def _has_unit(unit: str, symbols: str) -> bool:
    return re.search(rf"(?<![A-Za-z])({symbols})(?![A-Za-z])", unit) is not None
