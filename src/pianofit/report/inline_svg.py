"""Conversion of a matplotlib figure to SVG within the HTML, with selectable text and the colours of the page.

matplotlib writes each colour as a number. Here every colour of the style becomes a property of `page.css`, which has
one value for light and one for dark pages. Therefore a swatch in a caption always has the colour of its line. Colour
maps keep their numbers. They get the class `shades`, which the style inverts as a whole on dark pages.
"""

from __future__ import annotations

import hashlib
import re
from xml.etree import ElementTree

from .drawing import COLOURS

__all__ = ["inlined"]

SVG, LINK = "{http://www.w3.org/2000/svg}", "{http://www.w3.org/1999/xlink}href"
# Elements that are removed: metadata, and a style sheet that would apply to the whole page.
REMOVED = (f"{SVG}metadata", f"{SVG}style")
LETTERS = ("text", "tspan")
COLOUR = re.compile(r"#[0-9a-f]{6}\b")
REFERENCE = re.compile(r"url\(#([^)]+)\)")
# Hexadecimal digits of the prefix of a figure's ids, enough for the fewer than a hundred figures of a page.
DIGITS = 8


def inlined(svg: bytes) -> str:
    """Return the figure as an HTML element.

    Parameters
    ----------
    svg : bytes
        Output of `drawing.svg`.

    Returns
    -------
    str
        One `svg` element. It is as wide as its frame, and its ids differ from those of all other figures.
    """
    root = ElementTree.fromstring(svg)  # noqa: S314  (written by matplotlib just now)
    prefix = f"f{hashlib.sha256(svg).hexdigest()[:DIGITS]}-"
    _clean(root, prefix, _referenced(root))
    for name in ("width", "height", "version"):
        root.attrib.pop(name, None)
    return ElementTree.tostring(root, encoding="unicode")


def _referenced(root: ElementTree.Element) -> set[str]:
    """Return the ids that the figure refers to."""
    values = [value for node in root.iter() for value in node.attrib.values()]
    return {value[1:] for value in values if value.startswith("#")} | {
        name for value in values for name in REFERENCE.findall(value)
    }


def _clean(node: ElementTree.Element, prefix: str, referenced: set[str]) -> None:
    """Convert an element and its children to HTML: no namespaces, no unused ids, colours by property."""
    for child in [child for child in node if child.tag in REMOVED]:
        node.remove(child)
    node.tag = node.tag.removeprefix(SVG)
    node.attrib = _attributes(node.attrib, prefix, referenced)
    for child in node:
        _clean(child, prefix, referenced)
    if node.tag in LETTERS:
        _sort_text(node)
    else:  # white space between elements
        node.text = None
    node.tail = None


def _attributes(given: dict[str, str], prefix: str, referenced: set[str]) -> dict[str, str]:
    attributes = {}
    for name, value in given.items():
        if name == "id":
            if value.startswith("QuadMesh"):
                attributes["class"] = "shades"
            if value in referenced:
                attributes["id"] = prefix + value
        elif name == LINK:
            attributes["href"] = value.replace("#", f"#{prefix}", 1) if value.startswith("#") else value
        else:
            value = REFERENCE.sub(rf"url(#{prefix}\1)", value)
            attributes[name] = COLOUR.sub(_property, value) if name == "style" else " ".join(value.split())
    return attributes


def _property(colour: re.Match[str]) -> str:
    return f"var(--{COLOURS[colour[0]]})" if colour[0] in COLOURS else colour[0]


def _sort_text(text: ElementTree.Element) -> None:
    """Sort the parts of a formula from left to right, for selecting and copying."""
    parts = list(text)
    if parts:
        text.text = None
        text[:] = sorted(parts, key=lambda part: float(part.get("x", "0").split()[0]))
