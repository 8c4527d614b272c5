"""What all pages have in common: one file that holds everything it shows, and loads nothing.

Pictures, sounds, style and script are inside the file. Its content security policy (`kit.html.j2`) lets nothing be
loaded from anywhere and runs no script but its own, named by its hash, and the parts that this one makes itself. All
text from outside goes through Jinja's autoescape, and none of it into a script.
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
# A heading that can be led to: its id and its words.
HEADING = re.compile(r'<h[23] id="([^"]+)">([^<]+)</h[23]>')


def write_page(path: str | os.PathLike[str], template: str, **page: Any) -> None:
    """Write one self-contained page (`page_bytes`), whole or not at all; an `OutputError` where it cannot be."""
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
    contents : whether the page lists its headings, those that have an id.
    styles, scripts : names of files; the styles follow `page.css`, and the scripts are run as one.
    filters : of the template, beside `number`.
    strict : a missing entry of `content` is an error; otherwise it is empty.
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
    """The templates of a package and those of the kit, with numbers as a reader likes them."""
    from jinja2 import Environment, FunctionLoader, StrictUndefined, Undefined

    from ..io.number_format import counted, number

    environment = Environment(
        loader=FunctionLoader(lambda name: asset(name, package)), autoescape=True, trim_blocks=True,
        lstrip_blocks=True, undefined=StrictUndefined if strict else Undefined,
    )  # fmt: skip
    environment.filters |= {"number": number, "counted": counted, "headings": HEADING.findall} | (filters or {})
    return environment


def picture(panels: Sequence[bytes]) -> list[str]:
    """The panels of a picture as elements of a page; the macro of this name frames them."""
    return [inlined(svg) for svg in panels]


def data_uri(kind: str, content: bytes) -> str:
    """`content` as an address within the page."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def asset(name: str, package: str) -> str:
    """A file of `package`, or else of the kit."""
    own = files(package).joinpath(name)
    return (own if own.is_file() else files(KIT).joinpath(name)).read_text(encoding="utf-8")
