"""From a name in a manifest to a file inside the root folder.

A manifest was often written on another system: its separators may be backslashes, and its names may differ from those
on the disk in case or in how accents are composed. Separators are translated. Other names are only suggested.
"""

from __future__ import annotations

import functools
import unicodedata
from pathlib import Path

from ..errors import SetupError
from ..io.files import printable

__all__ = ["find_file", "suggestion"]


def find_file(text: str, base: Path, root: Path) -> Path:
    """Absolute path of the file that a manifest names, links followed.

    Parameters
    ----------
    text : as it stands in the manifest; a backslash separates folders unless the disk has a file of that very name.
    base : the folder that the name is relative to.
    root : the folder, resolved, that the file must lie in.

    Raises
    ------
    SetupError
        If the file does not exist, is not a file, or lies outside `root`.
    """
    shown = printable(text)
    try:
        file = (base / text).resolve()
        if "\\" in text and not file.exists():
            file = (base / text.replace("\\", "/")).resolve()
        if not file.is_relative_to(root):
            raise SetupError(f"{shown} leads out of {printable(root)}; allow a larger folder with --root")
        if not file.is_file():
            if file.exists():
                raise SetupError(f"{shown}: is a folder or a device")
            near = suggestion(file, base, root)
            raise SetupError(f"{shown}: no such file" + (f"; did you mean {printable(near)}?" if near else ""))
        str(file).encode()
    except (OSError, ValueError, RuntimeError):  # a name too long, links in a circle, a name that is not UTF-8
        raise SetupError(f"{shown} is no usable path; rename it") from None
    return file


def suggestion(file: Path, base: Path, root: Path) -> str:
    """The path on the disk that differs from `file` in case or composition only; empty without one.

    Only folders inside `root` are listed.
    """
    here = root
    for part in file.relative_to(root).parts:
        if not (here / part).exists():
            part = _names(here, here.stat().st_mtime_ns).get(_folded(part), "") if here.is_dir() else ""
            if not part:
                return ""
        here = here / part
    base = base.resolve()
    return (here.relative_to(base) if here.is_relative_to(base) else here).as_posix()


@functools.lru_cache(maxsize=16)
def _names(folder: Path, _changed: int) -> dict[str, str]:
    """Names in a folder by their folded form, until the folder is changed."""
    return {_folded(entry.name): entry.name for entry in sorted(folder.iterdir(), reverse=True)}


def _folded(name: str) -> str:
    """A name without case, its accents composed."""
    return unicodedata.normalize("NFC", name).casefold()
