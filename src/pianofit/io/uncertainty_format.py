"""A value with its uncertainty as text, by the format specifications of the package `uncertainties`.

    [width][.precision][u][e | f | g][S | L | P | p]

Without a precision the uncertainty is rounded by the rule of the Particle Data Group: first three digits 100 to 354
keep two digits, 355 to 949 one, and 950 to 999 become 1000 and keep two (Review of Particle Physics, introduction).
With `u` the precision counts digits of the uncertainty, otherwise it is that of the value. `S` is the short form
2.277(4), `L` is LaTeX, `P` uses ± and superscript exponents, `p` adds parentheses. Value and uncertainty end at the
same decimal place and share one power of ten.
"""

import re
from collections.abc import Sequence
from decimal import Decimal
from typing import NamedTuple

from ..errors import ParameterError
from .number_format import SUPERSCRIPTS, exponent_of, format_with_interval

SPEC = re.compile(r"(?P<pad>(?:.?[<>=^])?\d*)(?:\.(?P<digits>\d+))?(?P<u>u?)(?P<kind>[efg]?)(?P<style>[SLPp]*)")
# Largest first three digits of an uncertainty written with two digits, and smallest that are rounded up to 1000.
TWO_DIGITS_UP_TO, ROUNDED_UP_FROM = 354, 950
# Largest number of digits: those of a float.
MOST_DIGITS = 17
# Powers of ten below this are written with an exponent, as Python's `g` does.
LOWEST_POWER = -4
GREEK = {"kappa", "mu", "epsilon", "tau"}
POWER = re.compile(r"e([+-]\d+)")


class FormatSpec(NamedTuple):
    """A parsed format specification."""

    pad: str  # fill, alignment and width, as in Python's format of texts
    digits: int | None
    of_sd: bool  # if True, `digits` counts digits of the uncertainty
    kind: str  # e, f or g
    style: str  # letters of S, L, P, p


def parse_format_spec(text: str) -> FormatSpec:
    """Parse a format specification, or raise a `ParameterError` if it is invalid."""
    match = SPEC.fullmatch(text)
    digits = None if not match or match["digits"] is None else int(match["digits"])
    if not match or (match["u"] and not digits) or (digits or 0) > MOST_DIGITS:
        raise ParameterError(
            f"format {text!r} must have the form [width][.precision][u][e|f|g][S|L|P|p], such as '.2uS'"
        )
    pad = f">{match['pad']}" if match["pad"].isdigit() else match["pad"]
    return FormatSpec(pad, digits, bool(match["u"]), match["kind"] or "g", match["style"])


def format_with_sd(value: float, sd: float, spec: FormatSpec) -> str:
    """Format `value` with its standard uncertainty; both finite, `sd` above 0."""
    if spec.digits is None and _first_three(sd) >= ROUNDED_UP_FROM:
        sd = 10.0 ** (exponent_of(sd, 2) + 1)
    place = _place(value, sd, spec)
    power = _power(value, sd, place, spec.kind)
    body = _joined(_fixed(value, power, place), _fixed(sd, power, place), spec.style, power)
    return format(_superscript(f"{body}e{power:+03d}" if power else body, spec.style), spec.pad)


def format_interval(value: float, ends: Sequence[float] | None, open_ends: Sequence[str], spec: FormatSpec) -> str:
    """Format `value` with an asymmetric interval, as tables do; a half-open interval becomes a bound."""
    if ends is None:
        return format(_superscript(_plain(value, spec), spec.style), spec.pad)
    number, span = format_with_interval(value, ends)
    low, _, high = span.strip("[]").partition(", ")
    text = {(): span, ("low",): f"(< {high})", ("high",): f"(> {low})"}.get(tuple(open_ends), "(not bounded)")
    if "L" in spec.style:
        text = text.replace(", ", r",\,").replace("not bounded", r"\text{not bounded}")
    return format(_superscript(f"{number}{chr(92) + ';' if 'L' in spec.style else ' '}{text}", spec.style), spec.pad)


def _plain(value: float, spec: FormatSpec) -> str:
    """Format a value without an uncertainty; digits of the uncertainty are ignored."""
    digits = 6 if spec.digits is None or spec.of_sd else spec.digits
    return f"{value:.{digits}{spec.kind}}"


def _place(value: float, sd: float, spec: FormatSpec) -> int:
    """The decimal place of the last digit: 3 for 2.277."""
    if spec.digits is None:
        return (1 if _first_three(sd) <= TWO_DIGITS_UP_TO else 0) - exponent_of(sd, 2)
    if spec.of_sd:
        return spec.digits - 1 - exponent_of(sd, spec.digits - 1)
    if spec.kind == "f":
        return spec.digits
    digits = spec.digits if spec.kind == "e" else max(spec.digits, 1) - 1
    return digits - exponent_of(max(abs(value), sd), digits)


def _first_three(value: float) -> int:
    return int(f"{value:.2e}".replace(".", "").split("e")[0])


def _power(value: float, sd: float, place: int, kind: str) -> int:
    """The common power of ten; 0 if the numbers are written in full."""
    largest = max(abs(value), sd)
    exponent = exponent_of(largest, max(place + exponent_of(largest, MOST_DIGITS), 0))
    if kind == "f" or (kind == "g" and exponent >= LOWEST_POWER and place >= 0):
        return 0
    return exponent


def _fixed(value: float, power: int, place: int) -> str:
    return f"{Decimal(repr(float(value))).scaleb(-power):.{max(0, place + power)}f}"


def _joined(value: str, sd: str, style: str, power: int) -> str:
    """Value and uncertainty in the given style, in parentheses before a power of ten or with `p`."""
    if "S" in style:
        last = len(value.partition(".")[2])
        digits = sd if not last or not sd.startswith("0.") else sd.partition(".")[2].lstrip("0")
        return f"{value}({digits or sd})"
    sign = r" \pm " if "L" in style else "±" if "P" in style else "+/-"
    ends = (r"\left(", r"\right)") if "L" in style else ("(", ")")
    body = f"{value}{sign}{sd}"
    return f"{ends[0]}{body}{ends[1]}" if power or "p" in style else body


def _superscript(text: str, style: str) -> str:
    """Powers of ten in LaTeX (style `L`) or with superscript digits (style `P`)."""
    if "L" in style:
        return POWER.sub(lambda match: rf" \times 10^{{{int(match[1])}}}", text)
    if "P" in style:
        return POWER.sub(lambda match: f"×10{str(int(match[1])).translate(SUPERSCRIPTS)}", text)
    return text


# --- names and units --------------------------------------------------------------------------------------------------


def latex_name(name: str) -> str:
    """The name of a parameter in LaTeX, without unsafe characters, since names come from files."""
    return "/".join(_symbol(part) for part in name.split("/"))


def _symbol(name: str) -> str:
    """One factor of a name, with a subscript from its first underscore or digit on."""
    word, _, subscript = re.sub(r"[^\w ]", "", name).partition("_")
    if not subscript and (match := re.fullmatch(r"([A-Za-z]+?)(\d+)", word)):
        word, subscript = match[1], match[2]
    word = rf"\{word}" if word in GREEK else word if len(word) == 1 else rf"\mathrm{{{word}}}"
    subscript = subscript.replace("_", " ").replace(" ", r"\,")
    if not subscript:
        return word
    return word + (rf"_{{{subscript}}}" if subscript.isdigit() else rf"_{{\mathrm{{{subscript}}}}}")


def latex_unit(unit: str) -> str:
    """A unit in LaTeX with a leading space, without unsafe characters; empty for 1."""
    plain = re.sub(r"[^A-Za-z0-9/^·% ]", "", unit.replace("²", "^2").replace("³", "^3")).replace("%", r"\%")
    if plain in ("", "1"):
        return ""
    return r"\,\mathrm{" + re.sub(r"\^(\w+)|\^", lambda match: f"^{{{match[1] or ''}}}", plain) + "}"
