"""Output of tables: HTML for notebooks, CSV and pandas data frames."""

import csv
import io
import os
from collections.abc import Callable, Iterable, Sequence
from html import escape
from typing import Any

from ..errors import OutputError, PianofitError
from .files import replace_file

Rows = Iterable[Sequence[Any]]


def html_table(header: Sequence[str], rows: Rows, caption: str = "") -> str:
    """Return a table as HTML, with escaped texts and numbers of five significant digits."""
    head = "".join(f"<th>{escape(name)}</th>" for name in header)
    body = "".join("<tr>" + "".join(f"<td>{escape(_cell_text(cell))}</td>" for cell in row) + "</tr>" for row in rows)
    title = f"<caption>{escape(caption)}</caption>" if caption else ""
    return f"<table>{title}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def _cell_text(cell: Any) -> str:
    return "" if cell is None else f"{cell:.5g}" if isinstance(cell, float) else str(cell)


def write_csv(path: str | os.PathLike[str], header: Sequence[str], rows: Rows) -> None:
    """Write a table as CSV (UTF-8, numbers with full precision, None as an empty cell), replacing an existing file.

    Raises `OutputError` if it cannot be written.
    """
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([header, *rows])
    replace_file(path, text.getvalue().encode(errors="backslashreplace"))  # names that are not UTF-8


def data_frame(header: Sequence[str], rows: Rows) -> Any:
    """Return the table as a pandas data frame. The first column is the index.

    Raises `OutputError` if pandas is not installed.
    """
    pandas = require_optional("pandas", "a data frame")
    return pandas.DataFrame(list(rows), columns=list(header)).set_index(header[0])


def require_optional(
    package: str, feature: str, extra: str = "notebook", error: Callable[[str], PianofitError] = OutputError
) -> Any:
    """Import an optional package, which the `extra` installs.

    Raises `error` with the install command if the package is missing.
    """
    from importlib import import_module

    try:
        return import_module(package)
    except ImportError as missing:
        message = f"{feature} needs {package}, which is not installed; pip install 'pianofit[{extra}]'"
        raise error(message) from missing
