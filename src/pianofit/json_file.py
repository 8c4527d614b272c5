"""JSON that the program once wrote, read back strictly: nothing in it is trusted before it was checked."""

from __future__ import annotations

import json
import os
from typing import Any

from .errors import FitError
from .recording import one_line, read_file

__all__ = ["LARGEST", "finite", "load_json", "shown", "table_of"]

# Larger numbers overflow when they are squared.
LARGEST = 1e300


def load_json(path: str | os.PathLike[str], most: int, kind: str, way_out: str) -> Any:
    """What a file of at most `most` bytes holds.

    Raises
    ------
    FitError
        Naming the file, `kind` and the `way_out`.
    """
    try:
        return json.loads(read_file(path, most, FitError).decode("utf-8"))
    except (ValueError, RecursionError) as error:
        reason = one_line(str(error).splitlines()[0])
        raise FitError(f"{one_line(path)}: not {kind} ({reason}); {way_out}") from None


def table_of(document: dict, key: str, where: str, way_out: str) -> dict[str, Any]:
    """The table `key` of a document, or a `FitError`."""
    table = document.get(key)
    if not isinstance(table, dict):
        raise FitError(f"{where}: {key} is missing or no table; {way_out}")
    return table


def finite(value: Any, where: str, way_out: str) -> float:
    """A number that can be computed with, or a `FitError`."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < LARGEST:
        raise FitError(f"{where} is {shown(value)}, no finite number; {way_out}")
    return float(value)


def shown(value: Any) -> str:
    """A value as an error shows it: not the whole of a hostile one."""
    text = one_line(repr(value))
    return text if len(text) <= 60 else text[:57] + "..."
