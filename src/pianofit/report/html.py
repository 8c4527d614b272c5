"""Self-contained HTML pages: one file that contains all its pictures, sounds, styles and scripts.

The content security policy of a page (`kit.html.j2`) forbids loading anything. It allows only the script of the page,
identified by its hash, and parts that this script creates. All text from outside passes through Jinja's autoescape, and
none of it is put into a script.

A figure of matplotlib becomes one SVG element with selectable text. Every colour of the style becomes a property of
`page.css`, which has one value for light and one for dark pages. Therefore a swatch in a caption always has the colour
of its line. Colour maps keep their numbers. They get the class `shades`, which the style inverts on dark pages.
"""

import base64
import hashlib
import os
import re
from collections.abc import Callable, Iterable, Mapping
from importlib.resources import files
from typing import Any
from xml.etree import ElementTree

from ..io.files import replace_file
from ..io.number_format import counted, number
from .drawing import COLOURS, Panel, page_style, saved

KIT = "pianofit.report"
# A heading with an id, for the table of contents.
HEADING = re.compile(r'<h[23] id="([^"]+)">([^<]+)</h[23]>')
SVG = "{http://www.w3.org/2000/svg}"
REFERENCE = re.compile(r"url\(#([^)]+)\)")


def write_page(path: str | os.PathLike[str], template: str, **page: Any) -> None:
    """Write one self-contained page (`page_bytes`) completely, or raise an `OutputError`."""
    replace_file(path, page_bytes(template, **page))


def page_bytes(
    template: str,
    *,
    package: str = KIT,
    styles: tuple[str, ...] = (),
    scripts: tuple[str, ...] = (),
    filters: dict[str, Callable] | None = None,
    title: str,
    contents: bool = False,
    **content: Any,
) -> bytes:
    """Return one self-contained page.

    Parameters
    ----------
    title : plain text.
    template : a file of `package` that extends `kit.html.j2`.
    contents : whether the page has a table of contents, made of all headings with an id.
    styles, scripts : names of files. The styles follow `page.css`. The scripts are joined to one.
    filters : additional filters of the template.
    """
    from jinja2 import Environment, FunctionLoader, StrictUndefined

    script = "".join(asset(name, package) for name in scripts)
    environment = Environment(
        loader=FunctionLoader(lambda name: asset(name, package)),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    environment.filters |= {"number": number, "counted": counted, "headings": HEADING.findall} | (filters or {})
    html = environment.get_template(template).render(
        title=title,
        contents=contents,
        style="".join(asset(name, package) for name in ("page.css", *styles)),
        script=script,
        script_hash=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
        **content,
    )
    return html.encode("utf-8", errors="replace")


def data_uri(kind: str, content: bytes) -> str:
    """Return `content` as a data URI."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def asset(name: str, package: str) -> str:
    """Return the text of a file of `package`, or of this package if that one does not have it."""
    file = files(package).joinpath(name)
    return (file if file.is_file() else files(KIT).joinpath(name)).read_text(encoding="utf-8")


# --- figures ----------------------------------------------------------------------------------------------------------


def pictures(panels: Mapping[str, Iterable[Panel]]) -> dict[str, list[str]]:
    """Draw the panels of the pictures of a page, by name, as HTML elements for the macro `picture`.

    Each is as wide as its frame, and its ids differ from those of all other figures.
    """
    with page_style():
        return {name: [_svg_element(saved(panel.figure(), "svg")) for panel in own] for name, own in panels.items()}


def _svg_element(content: bytes) -> str:
    root = ElementTree.fromstring(content)  # noqa: S314  (written by matplotlib just now)
    values = [value for node in root.iter() for value in node.attrib.values()]
    referenced = {value[1:] for value in values if value.startswith("#")}
    referenced |= {name for value in values for name in REFERENCE.findall(value)}
    _clean(root, f"f{hashlib.sha256(content).hexdigest()[:8]}-", referenced)
    for name in ("width", "height", "version"):
        root.attrib.pop(name, None)
    return ElementTree.tostring(root, encoding="unicode")


def _clean(node: ElementTree.Element, prefix: str, referenced: set[str]) -> None:
    """Convert an element and its children to HTML: no namespaces, no unused ids, colours by property."""
    # A style sheet would apply to the whole page.
    for child in [child for child in node if child.tag in (f"{SVG}metadata", f"{SVG}style")]:
        node.remove(child)
    node.tag = node.tag.removeprefix(SVG)
    node.attrib = _attributes(node.attrib, prefix, referenced)
    for child in node:
        _clean(child, prefix, referenced)
    if node.tag not in ("text", "tspan"):  # white space between elements
        node.text = None
    elif parts := list(node):  # parts of a formula, sorted from left to right for selecting and copying
        node.text = None
        node[:] = sorted(parts, key=lambda part: float(part.get("x", "0").split()[0]))
    node.tail = None


def _attributes(given: dict[str, str], prefix: str, referenced: set[str]) -> dict[str, str]:
    attributes = {}
    for name, value in given.items():
        if name == "id":
            if value.startswith("QuadMesh"):
                attributes["class"] = "shades"
            if value in referenced:
                attributes["id"] = prefix + value
        elif name == "{http://www.w3.org/1999/xlink}href":
            attributes["href"] = value.replace("#", f"#{prefix}", 1) if value.startswith("#") else value
        else:
            value = REFERENCE.sub(rf"url(#{prefix}\1)", value)
            is_style = name == "style"
            attributes[name] = re.sub(r"#[0-9a-f]{6}\b", _property, value) if is_style else " ".join(value.split())
    return attributes


def _property(colour: re.Match[str]) -> str:
    return f"var(--{COLOURS[colour[0]]})" if colour[0] in COLOURS else colour[0]
