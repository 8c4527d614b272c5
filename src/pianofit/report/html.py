"""Self-contained HTML pages: one file that contains all its pictures, sounds, styles and scripts.

The content security policy of a page (`kit.html.j2`) forbids loading anything. It allows only the script of the page,
identified by its hash, and parts that this script creates. All text from outside passes through Jinja's autoescape, and
none of it is put into a script.
"""

from __future__ import annotations

import base64
import hashlib
import os
import re
from collections.abc import Callable, Sequence
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from ..io.files import replace_file
from .inline_svg import inlined

if TYPE_CHECKING:
    from jinja2 import Environment

__all__ = ["asset", "data_uri", "page_bytes", "picture", "templates", "write_page"]

KIT = "pianofit.report"
# A heading with an id, for the table of contents.
HEADING = re.compile(r'<h[23] id="([^"]+)">([^<]+)</h[23]>')


def write_page(path: str | os.PathLike[str], template: str, **page: Any) -> None:
    """Write one self-contained page (`page_bytes`) completely, or raise an `OutputError`."""
    replace_file(path, page_bytes(template, **page))


def page_bytes(
    template: str, *, package: str = KIT, styles: tuple[str, ...] = (), scripts: tuple[str, ...] = (),
    filters: dict[str, Callable] | None = None, strict: bool = True, title: str, contents: bool = False, **content: Any,
) -> bytes:  # fmt: skip
    """Return one self-contained page.

    Parameters
    ----------
    title : plain text.
    template : a file of `package` that extends `kit.html.j2`.
    contents : whether the page has a table of contents, made of all headings with an id.
    styles, scripts : names of files. The styles follow `page.css`. The scripts are joined to one.
    filters : additional filters of the template.
    strict : if True, a missing entry of `content` is an error; otherwise it is empty.
    """
    script = "".join(asset(name, package) for name in scripts)
    html = templates(package, strict=strict, filters=filters).get_template(template).render(
        title=title,
        contents=contents,
        style="".join(asset(name, package) for name in ("page.css", *styles)),
        script=script,
        script_hash=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
        **content,
    )  # fmt: skip
    return html.encode("utf-8", errors="replace")


def templates(package: str, *, strict: bool = True, filters: dict[str, Callable] | None = None) -> Environment:
    """Return the environment of the templates of a package and of this one, with filters for numbers."""
    from jinja2 import Environment, FunctionLoader, StrictUndefined, Undefined

    from ..io.number_format import counted, number

    environment = Environment(
        loader=FunctionLoader(lambda name: asset(name, package)), autoescape=True, trim_blocks=True,
        lstrip_blocks=True, undefined=StrictUndefined if strict else Undefined,
    )  # fmt: skip
    environment.filters |= {"number": number, "counted": counted, "headings": HEADING.findall} | (filters or {})
    return environment


def picture(panels: Sequence[bytes]) -> list[str]:
    """Return the panels of a picture as HTML elements, for the macro `picture`."""
    return [inlined(svg) for svg in panels]


def data_uri(kind: str, content: bytes) -> str:
    """Return `content` as a data URI."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def asset(name: str, package: str) -> str:
    """Return the text of a file of `package`, or of this package if that one does not have it."""
    file = files(package).joinpath(name)
    return (file if file.is_file() else files(KIT).joinpath(name)).read_text(encoding="utf-8")
