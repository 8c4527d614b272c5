"""A value with its uncertainty as text, by the format specifications of the package `uncertainties`.

    [width][.precision][u][e | f | g][S | L | P | p]

Without a precision the uncertainty is rounded by the rule of the Particle Data Group: its first three digits 100 to 354
leave two digits, 355 to 949 one, and 950 to 999 become 1000 and leave two (Review of Particle Physics, introduction).
With `u` the precision counts the digits of the uncertainty, else it is that of the value. `S` is the short form
2.277(4), `L` is LaTeX, `P` uses ± and raised exponents, `p` sets parentheses. The value and its uncertainty end at the
same decimal place and share one power of ten.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from decimal import Decimal
from typing import NamedTuple

from ..errors import ParameterError
from ..io.number_format import RAISED, format_with_interval

__all__ = ["Spec", "latex_name", "latex_unit", "spec_of", "with_interval", "with_sd"]

SPEC = re.compile(r"(?P<pad>(?:.?[<>=^])?\d*)(?:\.(?P<digits>\d+))?(?P<u>u?)(?P<kind>[efg]?)(?P<style>[SLPp]*)")
# The first three digits of an uncertainty up to which two are written, and from which it becomes 1000.
TWO, UP = 354, 950
# Digits at the most, those that a float has.
MOST = 17
# Powers of ten below this are written with an exponent, as Python's `g` does.
LOWEST_POWER = -4
GREEK = {"kappa", "mu", "epsilon", "tau"}
POWER = re.compile(r"e([+-]\d+)")


class Spec(NamedTuple):
    """A format specification, read."""

    pad: str  # what Python's format takes for texts: fill, alignment, width
    digits: int | None
    of_sd: bool  # whether `digits` are those of the uncertainty
    kind: str  # e, f or g
    style: str  # letters of S, L, P, p


def spec_of(text: str) -> Spec:
    """Read a format specification.

    Raises
    ------
    ParameterError
        Naming the specification and what can be used.
    """
    found = SPEC.fullmatch(text)
    digits = None if not found or found["digits"] is None else int(found["digits"])
    if not found or (found["u"] and not digits) or (digits or 0) > MOST:
        raise ParameterError(f"format {text!r} must be as [width][.precision][u][e|f|g][S|L|P|p], such as '.2uS'")
    pad = f">{found['pad']}" if found["pad"].isdigit() else found["pad"]
    return Spec(pad, digits, bool(found["u"]), found["kind"] or "g", found["style"])


def with_sd(value: float, sd: float, spec: Spec) -> str:
    """`value` and its standard uncertainty, both finite, `sd` above 0."""
    if spec.digits is None and _first_three(sd) >= UP:
        sd = 10.0 ** (_exponent(sd, 2) + 1)
    place = _place(value, sd, spec)
    power = _power(value, sd, place, spec.kind)
    body = _joined(_fixed(value, power, place), _fixed(sd, power, place), spec.style, power)
    return format(_times(body, power, spec.style), spec.pad)


def with_interval(value: float, ends: Sequence[float] | None, open_ends: Sequence[str], spec: Spec) -> str:
    """`value` with an interval that no ± describes, as tables write it; of an open one the other end as a bound."""
    if ends is None:
        return format(_raised(_plain(value, spec), spec.style), spec.pad)
    number, span = format_with_interval(value, ends)
    low, _, high = span.strip("[]").partition(", ")
    said = {(): span, ("low",): f"(< {high})", ("high",): f"(> {low})"}.get(tuple(open_ends), "(not bounded)")
    if "L" in spec.style:
        said = said.replace(", ", r",\,").replace("not bounded", r"\text{not bounded}")
    return format(_raised(f"{number}{chr(92) + ';' if 'L' in spec.style else ' '}{said}", spec.style), spec.pad)


def _plain(value: float, spec: Spec) -> str:
    """A value without an uncertainty; digits of an uncertainty mean nothing to it."""
    digits = 6 if spec.digits is None or spec.of_sd else spec.digits
    return f"{value:.{digits}{spec.kind}}"


def _place(value: float, sd: float, spec: Spec) -> int:
    """The decimal place of the last digit: 3 of 2.277."""
    if spec.digits is None:
        return (1 if _first_three(sd) <= TWO else 0) - _exponent(sd, 2)
    if spec.of_sd:
        return spec.digits - 1 - _exponent(sd, spec.digits - 1)
    if spec.kind == "f":
        return spec.digits
    digits = spec.digits if spec.kind == "e" else max(spec.digits, 1) - 1
    return digits - _exponent(max(abs(value), sd), digits)


def _first_three(value: float) -> int:
    return int(f"{value:.2e}".replace(".", "").split("e")[0])


def _exponent(value: float, decimals: int) -> int:
    """Of the leading digit, after rounding to so many decimals of the mantissa."""
    return int(f"{value:.{decimals}e}".split("e")[1])


def _power(value: float, sd: float, place: int, kind: str) -> int:
    """The common power of ten, 0 where the numbers are written out."""
    largest = max(abs(value), sd)
    exponent = _exponent(largest, max(place + _exponent(largest, MOST), 0))
    if kind == "f" or (kind == "g" and exponent >= LOWEST_POWER and place >= 0):
        return 0
    return exponent


def _fixed(value: float, power: int, place: int) -> str:
    return f"{Decimal(repr(float(value))).scaleb(-power):.{max(0, place + power)}f}"


def _joined(value: str, sd: str, style: str, power: int) -> str:
    """Value and uncertainty by the style; in parentheses where a power of ten follows, or `p` asks for them."""
    if "S" in style:
        last = len(value.partition(".")[2])
        own = sd if not last or not sd.startswith("0.") else sd.partition(".")[2].lstrip("0")
        return f"{value}({own or sd})"
    sign = r" \pm " if "L" in style else "±" if "P" in style else "+/-"
    ends = (r"\left(", r"\right)") if "L" in style else ("(", ")")
    body = f"{value}{sign}{sd}"
    return f"{ends[0]}{body}{ends[1]}" if power or "p" in style else body


def _times(body: str, power: int, style: str) -> str:
    return _raised(f"{body}e{power:+03d}", style) if power else body


def _raised(text: str, style: str) -> str:
    """Powers of ten as LaTeX or a page writes them, where the style asks for it."""
    if "L" in style:
        return POWER.sub(lambda found: rf" \times 10^{{{int(found[1])}}}", text)
    if "P" in style:
        return POWER.sub(lambda found: f"×10{str(int(found[1])).translate(RAISED)}", text)
    return text


# --- names and units --------------------------------------------------------------------------------------------------


def latex_name(name: str) -> str:
    """A parameter's name in LaTeX; of a name from a file only letters, digits and a few signs are left."""
    return "/".join(_symbol(part) for part in name.split("/"))


def _symbol(name: str) -> str:
    """One factor of a name: what follows the first underscore, or a digit, stands below."""
    word, _, below = re.sub(r"[^\w ]", "", name).partition("_")
    if not below and (found := re.fullmatch(r"([A-Za-z]+?)(\d+)", word)):
        word, below = found[1], found[2]
    word = rf"\{word}" if word in GREEK else word if len(word) == 1 else rf"\mathrm{{{word}}}"
    below = below.replace("_", " ").replace(" ", r"\,")
    return word + (rf"_{{{below}}}" if below.isdigit() else rf"_{{\mathrm{{{below}}}}}" if below else "")


def latex_unit(unit: str) -> str:
    """A unit in LaTeX, with a space before it; empty for 1. Of a unit from a file only what a unit needs is left."""
    plain = re.sub(r"[^A-Za-z0-9/^·% ]", "", unit.replace("²", "^2").replace("³", "^3")).replace("%", r"\%")
    if plain in ("", "1"):
        return ""
    return r"\,\mathrm{" + re.sub(r"\^(\w+)|\^", lambda found: f"^{{{found[1] or ''}}}", plain) + "}"
