"""Griffe reads this project's docstrings: units and meanings stand where other projects write types.

The comment at the end of a field's line is its description. In sections, `name : meaning, unit` is a name and its
description, and the text of `Returns` describes the annotated type.
"""

from __future__ import annotations

import io
import re
import tokenize
from functools import cache
from pathlib import Path
from typing import Any

import griffe

SECTION = re.compile(r"^(Parameters|Attributes|Returns|Raises|Examples)\n-+$", re.MULTILINE)
ENTRY = re.compile(r"^([\w*][\w*, ]*?) : (.+)$", re.MULTILINE)


@cache
def comments(file: Path) -> dict[int, str]:
    """Return the comment of each line of a Python file that has code before it."""
    text = file.read_text(encoding="utf-8")
    found = (token for token in tokenize.generate_tokens(io.StringIO(text).readline) if token.type == tokenize.COMMENT)
    return {
        token.start[0]: token.string.lstrip("# ")
        for token in found
        if token.line[: token.start[1]].strip() and not token.string.startswith(("# noqa", "# type:"))
    }


def described(text: str, returned: str) -> str:
    """Return a docstring with its descriptions on lines of their own.

    Parameters
    ----------
    text : the docstring, without indentation.
    returned : annotation of the value that is returned; empty if there is none.
    """
    first, *rest = SECTION.split(text)
    done = first
    for title, body in zip(rest[::2], rest[1::2], strict=True):
        if title in ("Parameters", "Attributes"):
            body = ENTRY.sub(r"\1\n    \2", body)
        elif title == "Returns" and returned:
            body = "\n" + returned + re.sub(r"^(?=.)", "    ", body, flags=re.MULTILINE)
        done += f"{title}\n{'-' * len(title)}{body}"
    return done


class ProjectDocstrings(griffe.Extension):
    """Gives griffe the descriptions where it looks for them."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """Rewrite the sections of a docstring."""
        if obj.docstring:
            returned = obj.returns if isinstance(obj, griffe.Function) else None
            obj.docstring.value = described(obj.docstring.value, str(returned or ""))

    def on_attribute(self, *, attr: griffe.Attribute, **kwargs: Any) -> None:
        """Give a field without a docstring the comment of its last line."""
        if attr.docstring or not attr.parent or not attr.parent.is_class or not isinstance(attr.filepath, Path):
            return
        if text := comments(attr.filepath).get(attr.endlineno or attr.lineno or 0):
            attr.docstring = griffe.Docstring(text, lineno=attr.lineno, parent=attr)
