"""Numbers as text, with as many digits as their interval supports, for pages and terminals.

A value and both ends of its interval get the same decimal place: the second significant digit of the half-width (JCGM
100:2008, GUM, 7.2.6). An end then never rounds to the value.
"""

import math
from collections.abc import Sequence
from dataclasses import fields
from decimal import Decimal
from fractions import Fraction
from numbers import Real
from typing import Any

# Larger numbers overflow when squared.
LARGEST = 1e300
MAX_LISTED = 5  # texts listed in one message
FEWEST, MOST = 3, 15  # significant digits of a value with an interval; a float has 15 to 17
# If the ends of an interval differ by more than this factor, each has its own power of ten.
WIDE_INTERVAL = 1e3
# Numbers from 0.0001 to 999999 are written without a power of ten.
LOWEST_POWER, HIGHEST_POWER = -4, 6
# Half-width of an interval of a logarithm: per cent up to the first value, a factor up to the second.
PERCENT_LIMIT, FACTOR_LIMIT = 0.2, 10.0
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def is_number(value: Any) -> bool:
    """Return True for a finite number, of NumPy too, but not a bool, that can be squared without overflow."""
    if isinstance(value, bool) or not isinstance(value, Real):
        return False
    return -LARGEST <= (value if isinstance(value, int | Fraction) else float(value)) <= LARGEST  # float32 has no 1e300


def first_of(texts: Sequence[str], separator: str = ", ") -> str:
    """Return the first `MAX_LISTED` texts, and the number of further ones."""
    more = [f"and {len(texts) - MAX_LISTED} more"] if len(texts) > MAX_LISTED else []
    return separator.join([*texts[:MAX_LISTED], *more])


def counted(count: int, noun: str) -> str:
    """Return a count with its noun: "1 key", "2 keys"."""
    return f"{count} {noun if count == 1 else noun + 's'}"


def number(value: Any, digits: int = 4, *, with_power: bool = False) -> str:
    """Return `value` with up to `digits` significant digits: 0.12, 304.1, 1.099 × 10¹⁰.

    `with_power` writes a power of ten where the value does not need one.
    """
    if not is_number(value):
        return "–"
    power, decimals = _scale(value, digits, with_power)
    text = _fixed(value, power, decimals)
    return (text.rstrip("0").rstrip(".") if "." in text else text) + _times(power)


def with_interval(value: Any, interval: Any) -> tuple[str, str]:
    """Return `value` and its interval for a page, with a common power of ten. A missing interval is an empty text."""
    if not (is_number(value) and interval and all(map(is_number, interval))):
        return number(value), ""
    digits = _supported(value, interval)
    if digits is None:
        with_power = any(end and _needs_power(end) for end in interval)
        return number(value), " to ".join(number(end, 3, with_power=with_power) for end in interval)
    power, decimals = _scale(value, digits)
    ends = " to ".join(_fixed(end, power, decimals) for end in interval)
    return _fixed(value, power, decimals) + _times(power), (f"({ends}){_times(power)}" if power else ends)


def log_half_width(interval: Sequence[float] | None) -> float | None:
    """Return half of an interval of a logarithm; None if it is missing, empty or not above 0."""
    if not interval or not 0 < interval[0] < interval[1] <= LARGEST:
        return None
    return 0.5 * math.log(interval[1] / interval[0])


def format_relative_uncertainty(half: float, factor: str = "× or ÷ {}") -> str:
    """Return the half-width of an interval of a logarithm as "± 0.61 %", or if large as "× or ÷ 3.3"."""
    if half < PERCENT_LIMIT:
        return f"± {number(100 * half, 2)} %"
    return factor.format(f"{float(f'{math.exp(half):.2g}'):g}" if half < FACTOR_LIMIT else "many powers of ten")


def with_half_interval(value: float, half: float, unit: str = "") -> str:
    """Return `value` with the digits that the half-width of its logarithm supports: "7.02 N (± 0.61 %)"."""
    near = (value * math.exp(-half), value * math.exp(half)) if half < PERCENT_LIMIT else None
    text = with_interval(value, near)[0] if near else number(value, 3)
    return f"{text}{f' {unit}' if unit else ''} ({format_relative_uncertainty(half)})"


def format_with_interval(value: float, interval: Sequence[float] | None) -> tuple[str, str]:
    """Return `value` and its interval for a terminal: "304.1002" and "[304.0998, 304.1006]", or "-" without one."""
    if not interval or not all(map(is_number, interval)):
        return f"{value:.5g}", "-"
    digits = _supported(value, interval)
    if digits is None:
        return f"{value:.3g}" if interval[0] < interval[1] else f"{value:.5g}", "[{:.3g}, {:.3g}]".format(*interval)
    place = digits - 1 - exponent_of(value)  # decimals of the last digit
    return _to_place(value, place, value), f"[{', '.join(_to_place(end, place, value) for end in interval)}]"


def format_like(other: float, value: float, interval: Sequence[float] | None) -> str:
    """Return `other` with the decimal place that `format_with_interval` gives `value`."""
    digits = _supported(value, interval) if interval and all(map(is_number, interval)) else None
    return f"{other:.5g}" if digits is None else _to_place(other, digits - 1 - exponent_of(value), value)


def with_standard_error(value: float, error: float) -> tuple[str, str]:
    """Return `value` and its standard error for a terminal, to two significant digits of the error."""
    if not (is_number(error) and error > 0):
        return f"{value:.6g}" if math.isfinite(value) else "-", "-"
    place = 1 - exponent_of(error)
    if value and exponent_of(value) + place > MOST:
        place = MOST - exponent_of(value)
    return _to_place(value, place, value), f"{error:.1e}" if _needs_power(error) else f"{error:.{max(0, place)}f}"


def columns(rows: Sequence[Sequence[str]], right: int) -> list[str]:
    """Align rows of text in columns, two spaces apart. The column with index `right` is aligned to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            f"{x:>{w}}" if i == right else f"{x:{w}}" for i, (x, w) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


def summary(it: Any, *, lines: bool = False, exact: bool = False) -> str:
    """Return the repr of a named tuple: arrays as shapes, numbers with six digits, or `exact`.

    With `lines` every field has its own line.
    """
    comma, ends = (",\n  ", ("\n  ", "\n")) if lines else (", ", ("", ""))
    inside = comma.join(f"{name}={_summarised(value, exact)}" for name, value in zip(it._fields, it, strict=True))
    return f"{type(it).__name__}({ends[0]}{inside}{ends[1]})"


def filled(it: Any) -> str:
    """Return the repr of a dataclass, without empty fields."""
    values = {field.name: getattr(it, field.name) for field in fields(it)}
    given = (f"{name}={value!r}" for name, value in values.items() if not _is_empty(value))
    return f"{type(it).__name__}({', '.join(given)})"


def _is_empty(value: Any) -> bool:
    """True for None, and for a dict or tuple without entries. An array does not equal a tuple."""
    return value is None or (isinstance(value, dict | tuple) and not value)


def _summarised(value: Any, exact: bool) -> str:
    if shape := getattr(value, "shape", ()):
        return str(list(shape))
    if hasattr(value, "_fields") and not exact:
        return summary(value)
    if exact:
        return repr(value)
    try:
        return str(bool(value)) if str(getattr(value, "dtype", "")) == "bool" else f"{value:.6g}"
    except (TypeError, ValueError):  # a text, None, or a tracer of JAX
        return repr(value)


def _supported(value: float, interval: Sequence[float]) -> int | None:
    """Return the significant digits of `value` down to the second of the half-width; None for very wide intervals."""
    low, high = interval
    half = (high - low) / 2
    if not half > 0 or max(abs(low), abs(high)) >= 1e4 * abs(value) or 0 < low < high / WIDE_INTERVAL:
        return None
    return min(MOST, max(FEWEST, exponent_of(value) - exponent_of(half) + 2))


def exponent_of(value: float, decimals: int = 1) -> int:
    """Return the exponent of the leading digit, after rounding of the mantissa to `decimals`: 2 for 304.1."""
    return int(f"{value:.{decimals}e}".split("e")[1])


def _needs_power(value: float) -> bool:
    """Return True if a value needs a power of ten."""
    return not LOWEST_POWER < exponent_of(value) < HIGHEST_POWER


def _to_place(value: float, place: int, like: float) -> str:
    """Return `value` with `place` decimals, and with a power of ten if `like` needs one."""
    power = exponent_of(like) if _needs_power(like) or place < 0 else 0
    text = f"{Decimal(float(value)).scaleb(-power):.{max(0, place + power)}f}"
    return f"{text}e{power:+03d}" if power else text


def _scale(value: float, digits: int, with_power: bool = False) -> tuple[int, int]:
    """Return the power of ten to factor out, and the decimals, for `digits` significant digits of `value`."""
    exponent = exponent_of(value, digits - 1) if value else 0
    power = 0 if LOWEST_POWER < exponent < HIGHEST_POWER and not with_power else exponent
    return power, max(0, digits - 1 - exponent + power)


def _fixed(value: float, power: int, decimals: int) -> str:
    return f"{Decimal(float(value)).scaleb(-power):.{decimals}f}".replace("-", "−")


def _times(power: int) -> str:
    return f"\u00a0×\u00a010{str(power).translate(SUPERSCRIPTS)}" if power else ""
