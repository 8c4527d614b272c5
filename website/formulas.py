"""Formulas: `$$` blocks of LaTeX become MathML, which browsers set without a script."""

from __future__ import annotations

import re

from latex2mathml.converter import convert

BLOCK = re.compile(r"^\$\$\n(.*?)\n\$\$$", re.MULTILINE | re.DOTALL)


def with_mathml(markdown: str) -> str:
    """Return a page with its formulas as MathML, one line each.

    Parameters
    ----------
    markdown : a page. A formula stands between two lines `$$`.
    """
    return BLOCK.sub(_mathml, markdown)


def _mathml(found: re.Match[str]) -> str:
    latex = found[1].replace("{aligned}", "{align*}")  # the converter knows only the latter
    return f'<div class="formula">{convert(latex, display="block")}</div>'
