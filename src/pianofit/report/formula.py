r"""Formulas as HTML that looks alike in every browser, without a script or a mathematical font.

The notation is a part of TeX: letters, numbers and operators, `_` and `^`, braces, and the commands `\frac`, `\sqrt`,
`\dot`, `\ddot` and `\op`, whose argument is upright. Greek letters, signs such as ∫ and spaces stay unchanged.
"""

from __future__ import annotations

import re
from html import escape
from unicodedata import normalize

__all__ = ["formula_html", "symbols"]

TOKEN = re.compile(r"\\[a-z]+|\s+|\d+(?:\.\d+)?|.")
# A letter with its index, after commands and upright words have been removed.
SYMBOL = re.compile(r"[^\W\d_](?:_(?:\{[^{}]*\}|\w))?")
ACCENTED = re.compile(r"\\d?dot\{(\w)\}")  # so that the letter below an accent keeps its index
UPRIGHT = re.compile(r"\\op\{[^{}]*\}|\\[a-z]+")
DOTS = {r"\dot": "\u0307", r"\ddot": "\u0308"}  # combining
SCRIPTS = {"_": "sub", "^": "sup"}


def formula_html(formula: str) -> str:
    r"""Return the formula as an HTML element.

    Raises
    ------
    ValueError
        If braces do not match, an argument is missing, or a command is not one of these.

    Examples
    --------
    >>> formula_html(r"F = K_H u^2")
    '<span class="formula"><i>F</i> = <i>K</i><sub><i>H</i></sub> <i>u</i><sup>2</sup></span>'
    """
    tokens = TOKEN.findall(formula)[::-1]
    content = _row(tokens, formula)
    if tokens:
        raise ValueError(f"formula {formula!r}: a closing brace has no opening one")
    return f'<span class="formula">{content}</span>'


def symbols(formula: str) -> list[str]:
    r"""Return the symbols of a formula with their indices, without repetition, in order.

    Examples
    --------
    >>> symbols(r"F = K_H u^p (1 + μ \dot{u})")
    ['F', 'K_H', 'u', 'p', 'μ']
    """
    names = SYMBOL.findall(UPRIGHT.sub(" ", ACCENTED.sub(r"\1", formula)))
    return [*dict.fromkeys(symbol.replace("{", "").replace("}", "") for symbol in names)]


def _row(tokens: list[str], formula: str) -> str:
    """Convert everything up to a closing brace, which is not consumed. `tokens` are in reverse order."""
    parts = []
    while tokens and tokens[-1] != "}":
        tag = SCRIPTS.get(tokens[-1])
        if tag:
            tokens.pop()
            parts.append(f"<{tag}>{_element(tokens, formula)}</{tag}>")
        else:
            parts.append(_element(tokens, formula))
    return "".join(parts)


def _element(tokens: list[str], formula: str) -> str:
    """Convert one sign, group or command with its arguments."""
    if not tokens:
        raise ValueError(f"formula {formula!r}: an argument is missing at the end")
    sign = tokens.pop()
    if sign == "{":
        content = _row(tokens, formula)
        if not tokens:
            raise ValueError(f"formula {formula!r}: a brace is not closed")
        tokens.pop()
        return content
    if sign.startswith("\\"):
        return _command(sign, tokens, formula)
    if sign.isspace():
        return " "
    text = escape("−" if sign == "-" else sign)
    return f"<i>{text}</i>" if sign.isalpha() else text


def _command(name: str, tokens: list[str], formula: str) -> str:
    if name == r"\frac":
        above, below = _element(tokens, formula), _element(tokens, formula)
        return f'<span class="frac"><span>{above}</span><span>{below}</span></span>'
    if name == r"\sqrt":
        return f'√<span class="root">{_element(tokens, formula)}</span>'
    if name == r"\op":
        return re.sub("</?i>", "", _element(tokens, formula))
    if name in DOTS:
        return normalize("NFC", _element(tokens, formula).replace("</i>", f"{DOTS[name]}</i>"))
    raise ValueError(f"formula {formula!r}: {name} must be one of \\frac, \\sqrt, \\op, {', '.join(DOTS)}")
