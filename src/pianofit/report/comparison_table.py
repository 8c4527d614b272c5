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
from ..io.files import printable, reference_row
from ..result import Quantity, Result
from .build import felt_of, has_intervals, largest_compression
from .figure_data import Felt
from .identifiability_text import half_interval, open_scale
from .text import NOT_FELT, VELOCITY_RATIO

__all__ = ["ComparedQuantity", "Sides", "compared", "messages", "middle"]

# Largest difference of the logarithms of equal numbers, from rounding in a file.
SAME = 1e-9
# The same for a compression that was computed from a force.
SAME_COMPRESSION = 1e-6
NOT_MEASURED = {
    "given": "held fixed in {}", "assumed": "assumed in {}", "at-bound": "at a search bound in {}",
    "not-identifiable": "not identifiable in {}",
}  # fmt: skip
# Parameters in metres of the string: they scale with an assumed length.
SCALES_WITH_LENGTH = ("c", "kappa", "b2", "x0")


@dataclass(frozen=True)
class ComparedQuantity:
    """One quantity in two fits. `difference`, `sd` and `z` are None if `reason` is not empty."""

    name: str
    unit: str
    a: Quantity | None  # None if the fit does not have it
    b: Quantity | None
    difference: float | None  # b - a, in `unit`
    sd: float | None  # standard deviation of the difference, in `unit`
    z: float | None  # difference over sd
    reason: str = ""  # why z is missing

    def to_dict(self) -> dict[str, Any]:
        """Return everything as dicts and numbers."""
        sides = {
            side: None if q is None else {"value": q.value, "interval": q.interval, "status": q.status}
            for side, q in (("a", self.a), ("b", self.b))
        }
        numbers = {"difference": self.difference, "sd": self.sd, "z": self.z, "reason": self.reason}
        return {"name": self.name, "unit": self.unit} | sides | numbers

    @property
    def row(self) -> tuple:
        """Name, both values, unit, difference, sd, z, both statuses, reason."""
        values = [None if q is None else q.value for q in (self.a, self.b)]
        statuses = [None if q is None else q.status for q in (self.a, self.b)]
        return self.name, *values, self.unit, self.difference, self.sd, self.z, *statuses, self.reason


@dataclass(frozen=True)
class Sides:
    """Two fits and their labels."""

    fits: tuple[Result, Result]
    labels: tuple[str, str]

    @property
    def documents(self) -> tuple[dict, dict]:
        """Return the content of both `fit.json` files."""
        return self.fits[0].document, self.fits[1].document

    @property
    def felt_unit(self) -> str:
        """Return the unit of the static force: N, or N/kg (force over string mass) if a mass was assumed."""
        assumed = any(_status(document, "M_S") != "given" for document in self.documents)
        return "N/kg" if assumed else "N"

    def where(self, which: Sequence[bool]) -> str:
        """Return the labels of the fits for which `which` is true."""
        return " and ".join(label for label, holds in zip(self.labels, which, strict=True) if holds)

    def files(self) -> tuple[list[Any], list[Any]]:
        """Return the checksums of the recordings of both fits."""
        first, second = (
            [row.get("sha256") for row in document["recordings"] if isinstance(row, dict)]
            for document in self.documents
        )
        return first, second

    def felts(self) -> tuple[tuple[Felt, Felt] | None, tuple[str, ...]]:
        """Return both static laws up to the smaller of the largest compressions; or None and the reason."""
        try:
            reach = min(map(largest_compression, self.fits))
            return (self._felt(0, reach), self._felt(1, reach)), ()
        except FitError as error:
            return None, (f"The felts are not compared: {printable(error)}.",)

    def _felt(self, at: int, reach: float) -> Felt:
        felt = felt_of(self.fits[at], reach)
        over = float(self.fits[at].note.geometry.mass) if self.felt_unit == "N/kg" else 1.0
        return Felt(felt.compression, felt.force / over, None if felt.slow is None else felt.slow / over)


# --- quantity by quantity ---------------------------------------------------------------------------------------------


def compared(sides: Sides, felts: tuple[Felt, Felt] | None) -> tuple[ComparedQuantity, ...]:
    """Return every quantity of two fits: invariants, force of the felts at one compression, parameters."""
    force = () if felts is None else (_force(sides, felts),)
    return (*_table(sides, "invariants"), *force, *_table(sides, "parameters"))


def _table(sides: Sides, table: str) -> Iterator[ComparedQuantity]:
    first, second = (getattr(fit, table) for fit in sides.fits)
    for name in dict.fromkeys([*first, *second]):
        yield _compared(sides, first.get(name), second.get(name))


def _compared(sides: Sides, a: Quantity | None, b: Quantity | None, objection: str = "") -> ComparedQuantity:
    """Return the difference and z, from the logarithms, unless there is an `objection`."""
    if a is None or b is None:
        present, label = (a, sides.labels[0]) if b is None else (b, sides.labels[1])
        name, unit = ("", "") if present is None else (present.name, present.unit)
        return ComparedQuantity(name, unit, a, b, None, None, None, f"only in {label}")
    if reason := _reason(sides, a, b) or objection:
        return ComparedQuantity(a.name, a.unit, a, b, None, None, None, reason)
    log_ratio = math.log(b.value / a.value)
    sd = math.hypot(*(half_interval({"interval": q.interval}) or 0.0 for q in (a, b))) / HALF_WIDTH_95
    # The logarithmic mean turns a difference of logarithms into one of values, exactly.
    mean = (b.value - a.value) / log_ratio if abs(log_ratio) > SAME else 0.5 * (a.value + b.value)
    return ComparedQuantity(a.name, a.unit, a, b, b.value - a.value, mean * sd, log_ratio / sd)


def _reason(sides: Sides, a: Quantity, b: Quantity) -> str:
    """Return the reason why two values cannot be compared; empty if they can."""
    both = (a, b)
    not_converged = [not document["converged"] for document in sides.documents]
    if any(not_converged):
        return f"the search did not converge in {sides.where(not_converged)}"
    for status, reason in NOT_MEASURED.items():
        if any(which := [q.status == status for q in both]):
            return reason.format(sides.where(which))
    if any(which := [half_interval({"interval": q.interval}) is None or q.value <= 0 for q in both]):
        return f"no interval in {sides.where(which)}"
    if any(which := [bool(q.interval_open) for q in both]):
        return f"the interval ends at a search bound in {sides.where(which)}"
    return _another_quantity(sides, a, b) or _assumptions(sides, a, b)


def _another_quantity(sides: Sides, a: Quantity, b: Quantity) -> str:
    """Return the reason why one name stands for two different quantities; empty if it does not."""
    laws = [document.get("felt") for document in sides.documents]
    if a.name not in NOT_FELT and a.name in sides.fits[0].parameters:
        if laws[0] != laws[1]:
            return f"the felts have different laws: {laws[0]} and {laws[1]}"
        law = LAWS.get(str(laws[0]))
        if law is not None and law.power and a.name == law.power[0] and not _same_exponent(sides, law.power[1]):
            return f"its unit changes with {law.power[1]}; compare the force at one compression"
    if a.name == "F/M_S":
        first, second = (_compression(fit) for fit in sides.fits)
        if first is None or second is None or abs(math.log(first / second)) > SAME_COMPRESSION:
            return "at different compressions; compare the force at one compression"
    if a.name.startswith(VELOCITY_RATIO) and _stroke_checksums(sides, 0, a.name) != _stroke_checksums(sides, 1, b.name):
        return "of different recordings"
    return "" if a.unit == b.unit else f"in different units: {a.unit} and {b.unit}"


def _same_exponent(sides: Sides, name: str) -> bool:
    first, second = (fit.parameters[name] for fit in sides.fits)
    return first.value == second.value and {first.status, second.status} == {"given"}


def _compression(fit: Result) -> float | None:
    """Return the compression of F/M_S, m, if the felt is a power law: (F/K)^(1/p)."""
    law = LAWS.get(str(fit.document.get("felt")))
    if law is None or law.power is None:
        return None
    stiffness, p = (fit.parameters[name].value for name in law.power)
    force = fit.invariants["F/M_S"].value * fit.parameters["M_S"].value
    return (force / stiffness) ** (1 / p)


def _stroke_checksums(sides: Sides, index: int, name: str) -> tuple[Any, Any]:
    """Return the checksums of the recording of a velocity ratio, named by its stroke number, and of the reference."""
    rows = sides.documents[index]["recordings"]
    stroke = int(name.removeprefix(VELOCITY_RATIO).strip() or 0) - 1
    recording = next((row for row in rows if row.get("stroke") == stroke), {})
    return recording.get("sha256"), reference_row(rows)[1].get("sha256")


def _assumptions(sides: Sides, a: Quantity, b: Quantity) -> str:
    """Return the reason why two values depend on different assumptions; empty if they do not."""
    for size, name in (("length", "L"), ("mass", "M_S")):
        scales = [_scales_with(q, name, fit) for q, fit in zip((a, b), sides.fits, strict=True)]
        if any(scales):
            first, second = (fit.parameters[name] for fit in sides.fits)
            if not all(scales):
                return f"scales with the assumed {size} in {sides.where(scales)}"
            if abs(math.log(first.value / second.value)) > SAME:
                values = f"{first.value:.5g} {first.unit} and {second.value:.5g} {second.unit}"
                return f"scales with different assumed values of the {size}: {values}"
    scales = [
        q.status == "scaled" and _scales_with_velocity(q) and open_scale(d)
        for q, d in zip((a, b), sides.documents, strict=True)
    ]
    return f"scales with velocities that were not measured in {sides.where(scales)}" if any(scales) else ""


def _scales_with(quantity: Quantity, size: str, fit: Result) -> bool:
    """Return whether a value scales with the length or the mass of the string, and that size was assumed."""
    if quantity.status != "scaled" or _status(fit.document, size) != "assumed" or quantity.name not in fit.parameters:
        return False
    return quantity.name in SCALES_WITH_LENGTH if size == "L" else _has_unit(quantity.unit, "N|kg")


def _scales_with_velocity(quantity: Quantity) -> bool:
    """Return whether a quantity would scale with an unknown velocity."""
    return quantity.name in ("v_H0", "F/M_S") or (quantity.name not in NOT_FELT and _has_unit(quantity.unit, "N|m"))


def _has_unit(unit: str, symbols: str) -> bool:
    return re.search(rf"(?<![A-Za-z])({symbols})(?![A-Za-z])", unit) is not None


def _status(document: dict, name: str) -> str:
    return document["parameters"].get(name, {}).get("status", "")


# --- the felts --------------------------------------------------------------------------------------------------------


def middle(felt: Felt) -> int:
    """Return the index at which the table compares the felts, half of the common compression."""
    return len(felt.compression) // 2 - 1


def _force(sides: Sides, felts: tuple[Felt, Felt]) -> ComparedQuantity:
    """Return the comparison of the static forces at one compression within the range of both felts."""
    index, name = middle(felts[0]), "F" if sides.felt_unit == "N" else "F/M_S"
    label = f"{name} at {felts[0].compression[index]:.3g} mm"
    forces = [_force_at(felt, index, label, fit, sides.felt_unit) for felt, fit in zip(felts, sides.fits, strict=True)]
    open_scales = [open_scale(document) for document in sides.documents]
    objection = ""
    if any(open_scales):
        objection = f"scales with velocities that were not measured in {sides.where(open_scales)}"
    return _compared(sides, forces[0], forces[1], objection)


def _force_at(felt: Felt, index: int, name: str, fit: Result, unit: str) -> Quantity:
    force, low, high = (float(x) for x in felt.force[:, index])
    statuses = [fit.parameters[q].status for q in fit.parameters if q not in NOT_FELT]
    worst = next((status for status in ("at-bound", "not-identifiable") if status in statuses), "fitted")
    interval = (low, high) if has_intervals(fit) and low < high else None
    is_free = any(status not in ("given", "assumed") for status in statuses)
    meaning = "static force of the felt at a compression that occurs in both fits"
    return Quantity(name, force, unit, interval, worst if is_free else "given", meaning)


# --- messages ---------------------------------------------------------------------------------------------------------


def messages(sides: Sides) -> Iterator[str]:
    """Yield sentences on the limits of the comparison."""
    f0 = [fit.invariants["f0"].value if "f0" in fit.invariants else math.nan for fit in sides.fits]
    cents = cents_above(f0[1], f0[0]) if np.isfinite(f0).all() and min(f0) > 0 else 0.0
    if abs(cents) > SAME_KEY_CENTS:
        yield f"The fits are of different keys: their pitches differ by {cents:+.0f} cents."
    first, second = sides.files()
    if shared := {*first} & {*second} - {None}:
        yield (
            f"Both fits contain {len(shared)} recording{'s' * (len(shared) != 1)} in common. Their errors are not "
            "independent, and z is smaller than for independent recordings."
        )
    open_scales = [open_scale(document) for document in sides.documents]
    if any(open_scales):
        yield (
            f"No hammer velocity was measured in {sides.where(open_scales)}. Compressions and forces of the felt "
            "hold at the reference velocity shown."
        )
