"""A matplotlib figure as part of a page: SVG within the HTML, whose text can be selected and whose colours follow.

matplotlib writes each colour as a number. Here every colour of the style becomes a property of `page.css`, which has
one value for light and one for dark pages; so a swatch in a caption and the line that it names always agree. Colour
maps keep their numbers: they get the class `shades`, which the style inverts on dark pages as a whole.
"""

from __future__ import annotations

import hashlib
import re
from xml.etree import ElementTree

from .drawing import COLOURS

__all__ = ["inlined"]

SVG, LINK = "{http://www.w3.org/2000/svg}", "{http://www.w3.org/1999/xlink}href"
# What a page has no use for: matplotlib's remarks on the file, and a style sheet that would style the whole page.
DROPPED = (f"{SVG}metadata", f"{SVG}style")
LETTERS = ("text", "tspan")
COLOUR = re.compile(r"#[0-9a-f]{6}\b")
REFERENCE = re.compile(r"url\(#([^)]+)\)")
# Hexadecimal digits of a figure's own prefix to its ids: a page has fewer than a hundred figures.
DIGITS = 8


def inlined(svg: bytes) -> str:
    """The figure as an element of a page.

    Parameters
    ----------
    svg : bytes
        What `drawing.svg` returned.

    Returns
    -------
    str
        One `svg` element. It is as wide as its frame, and its ids are unlike those of any other figure.
    """
    root = ElementTree.fromstring(svg)  # noqa: S314  (written by matplotlib a moment ago)
    prefix = f"f{hashlib.sha256(svg).hexdigest()[:DIGITS]}-"
    _clean(root, prefix, _referenced(root))
    for name in ("width", "height", "version"):
        root.attrib.pop(name, None)
    return ElementTree.tostring(root, encoding="unicode")


def _referenced(root: ElementTree.Element) -> set[str]:
    """The ids that something within the figure leads to."""
    values = [value for node in root.iter() for value in node.attrib.values()]
    return {value[1:] for value in values if value.startswith("#")} | {
        name for value in values for name in REFERENCE.findall(value)
    }


def _clean(node: ElementTree.Element, prefix: str, referenced: set[str]) -> None:
    """Make an element and all within it HTML: no namespaces, no idle ids, colours by property."""
    for child in [child for child in node if child.tag in DROPPED]:
        node.remove(child)
    node.tag = node.tag.removeprefix(SVG)
    node.attrib = _attributes(node.attrib, prefix, referenced)
    for child in node:
        _clean(child, prefix, referenced)
    if node.tag in LETTERS:
        _in_reading_order(node)
    else:  # spaces between elements
        node.text = None
    node.tail = None


def _attributes(given: dict[str, str], prefix: str, referenced: set[str]) -> dict[str, str]:
    found = {}
    for name, value in given.items():
        if name == "id":
            if value.startswith("QuadMesh"):
                found["class"] = "shades"
            if value in referenced:
                found["id"] = prefix + value
        elif name == LINK:
            found["href"] = value.replace("#", f"#{prefix}", 1) if value.startswith("#") else value
        else:
            value = REFERENCE.sub(rf"url(#{prefix}\1)", value)
            found[name] = COLOUR.sub(_property, value) if name == "style" else " ".join(value.split())
    return found


def _property(colour: re.Match[str]) -> str:
    return f"var(--{COLOURS[colour[0]]})" if colour[0] in COLOURS else colour[0]


def _in_reading_order(text: ElementTree.Element) -> None:
    """Put the pieces of a formula from left to right, as they are selected and copied."""
    pieces = list(text)
    if pieces:
        text.text = None
        text[:] = sorted(pieces, key=lambda piece: float(piece.get("x", "0").split()[0]))
