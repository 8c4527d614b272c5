r"""Equations of the model, and every symbol of the page with meaning and unit.

Meaning and unit of parameters are those of `parameters.py`. A felt law has its own formula. All other symbols are
listed here. The table of symbols is made from the formulas, so it is complete.

A formula is HTML that looks alike in every browser, without a script or a mathematical font. Its notation is a part of
TeX: letters, numbers and operators, `_` and `^`, braces, and the commands `\frac`, `\sqrt`, `\dot`, `\ddot` and
`\op`, whose argument is upright. Greek letters, signs such as ∫ and spaces stay unchanged.
"""

import re
from html import escape
from unicodedata import normalize

from ..excitation import Excitation
from ..schema.fit import Fit
from ..schema.quantities import MEANINGS, UNITS
from .text import SYMBOLS, VELOCITY_RATIO, format_unit

STRING = (
    r"\frac{∂^2 y}{∂ t^2} = c^2 \frac{∂^2 y}{∂ x^2} - κ^2 \frac{∂^4 y}{∂ x^4} - 2 b_1 \frac{∂ y}{∂ t}"
    r" + 2 b_2 \frac{∂^3 y}{∂ t ∂ x^2} + \frac{L}{M_S} w(x) F",
    r"β_k = \frac{k π}{L}",
    r"f_k = k f_0 \sqrt{1 + B k^2}",
    r"f_0 = \frac{c}{2 L}",
    r"B = \frac{κ^2 π^2}{c^2 L^2}",
    r"α_k = b_1 + b_2 β_k^2",
)
HAMMER = (r"M_H \ddot{y}_H = -F", r"\dot{y}_H(0) = v_{H0}", r"u = y_H - ∫ w(x) y \op{d}x")
# For a user law without a formula.
USER_LAW = (r"F = F(u, \dot{u})",)
PATH = {"Output path": (r"l_k = 10 \op{log}_{10} E_k + 20 \op{log}_{10} g + a_k",)}
GAIN = {"Gain": (r"l_k = 10 \op{log}_{10} E_k + 20 \op{log}_{10} g",)}
MODES = {
    "Modes of the key": (r"s(t) = g F(t) ∗ (\op{Re} ∑_m r_m P_m \op{e}^{λ_m t} + h(t))",),
    "Decay time": (r"T_{60} = \frac{3 \op{ln} 10}{α_k}",),
}
# The response P_m of a mode to the release of 1 N takes the place of that to an impulse.
RELEASED_MODES = {"Modes of the key": (r"s(t) = g F (\op{Re} ∑_m r_m P_m \op{e}^{λ_m t} + h(t))",)}

# Symbol -> meaning and unit of all symbols that are not parameters.
VARIABLES = {
    "y": ("transverse displacement of the string", "m"),
    "x": ("position along the string, from the agraffe", "m"),
    "t": ("time; dots are derivatives with respect to it", "s"),
    "w": ("contact window around x₀, with area 1", "1/m"),
    "F": ("force of the hammer on the string; 0 without contact", "N"),
    "k": ("number of a partial", ""),
    "π": ("circle constant", ""),
    "f_0": (MEANINGS["f0"], "Hz"),
    "β_k": ("wave number of partial k", "1/m"),
    "f_k": ("frequency of partial k", "Hz"),
    "α_k": ("decay rate of the amplitude of partial k", "1/s"),
    "y_H": ("displacement of the hammer", "m"),
    "u": ("compression of the felt", "m"),
    "q": ("state variable of a relaxing felt", "m^p"),
    "l_k": ("level of partial k in the file, over the first 0.35 s", "dB"),
    "E_k": ("energy of partial k in the output of the model, over the first 0.35 s", "output² s"),
    "g": ("gain of a recording", "full scale per output"),
    "a_k": ("output path at partial k, from the string to the file", "dB"),
    "s": ("sound in the file, of one channel", "full scale"),
    "m": ("number of a mode", ""),
    "r_m": ("velocity gain of mode m at the velocity of the stroke", "1"),
    "P_m": ("modal response of mode m: one complex number a channel", "output/(N s)"),
    "λ_m": ("pole of mode m: minus the decay rate, plus i times the angular frequency", "1/s"),
    "h": ("knock: attack noise of the key", "output/(N s)"),
    "T_60": ("time in which the energy falls by 60 dB", "s"),
}
# Those of an excitation that mean something else there.
OTHER_VARIABLES = {
    "pluck": {
        "q_k": ("displacement of mode k", "m"),
        "F": ("static force on the string before the release; 0 afterwards", "N"),
        "ω_k": ("angular frequency of partial k", "1/s"),
    }
}


def equations(fit: Fit, law: Excitation) -> dict[str, list]:
    """Return the equations of a fit as HTML, and the symbols of its page.

    Parameters
    ----------
    fit : the fit. With an output path or measured modes, these have an equation.
    law : the excitation; the formula of a felt law may be empty.

    Returns
    -------
    `lines`: (name, formulas as HTML). `symbols`: (symbol, meaning, unit), first those of the equations in their order.
    """
    has_modes = fit.modal_response is not None and fit.modal_response.response is not None
    hammer: dict[str, tuple[str, ...]] = {"Hammer": HAMMER, f"Felt: {fit.felt}": law.formula or USER_LAW}
    string: dict[str, tuple[str, ...]] = {"String": STRING}
    lines = string | (hammer if law.has_contact else {law.words.player.capitalize(): law.formula})
    modes = MODES if law.has_contact else MODES | RELEASED_MODES
    lines |= (PATH if fit.pickup.path else GAIN) | (modes if has_modes else {})
    return {
        "lines": [(name, [_set(formula) for formula in formulas]) for name, formulas in lines.items()],
        "symbols": _table(fit, lines),
    }


def _set(formula: str) -> str:
    """Return the formula as HTML, or unchanged if a user law writes it in another notation."""
    try:
        return formula_html(formula)
    except ValueError:
        return f'<span class="formula">{escape(formula)}</span>'


def _table(fit: Fit, lines: dict[str, tuple[str, ...]]) -> list[tuple[str, str, str]]:
    """Return the symbols of the equations, then those of the tables that no equation has."""
    common = {SYMBOLS.get(name, name): (meaning, UNITS.get(name, "")) for name, meaning in MEANINGS.items()}
    common |= VARIABLES | OTHER_VARIABLES.get(fit.excitation, {})
    tables = _table_symbols(fit)
    of_law = common | {symbol: (meaning, unit) for symbol, meaning, unit in tables if meaning not in MEANINGS.values()}
    rows = []
    for name, formulas in lines.items():
        meanings = of_law if name.startswith("Felt: ") else common
        rows += [(s, *meanings[s]) for formula in formulas for s in symbols(formula) if s in meanings]
    return [*dict.fromkeys((symbol, meaning, format_unit(unit)) for symbol, meaning, unit in rows + tables)]


def _table_symbols(fit: Fit) -> list[tuple[str, str, str]]:
    """Return symbol, meaning and unit of every invariant and parameter; a user law has its own meanings."""
    rows = []
    for name, quantity in {**fit.invariants, **fit.parameters}.items():
        if name.startswith(VELOCITY_RATIO):
            rows.append(("v/v_ref", "velocity of a stroke over that of the reference recording", "1"))
        else:
            meaning = quantity.meaning or MEANINGS.get(name, "")
            rows.append((SYMBOLS.get(name, name), meaning, UNITS.get(name, quantity.unit)))
    return rows


# --- formulas as HTML -------------------------------------------------------------------------------------------------

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
