"""Files inside the root folder by their names in a manifest.

Manifests are often written on another system. Their separators may be backslashes, and their names may differ from the
disk in case or in the composition of accents. Separators are translated. Differing names are only suggested.
"""

from __future__ import annotations

import functools
import unicodedata
from pathlib import Path

from ..errors import SetupError
from ..io.files import printable

__all__ = ["find_file", "suggestion"]


def find_file(text: str, base: Path, root: Path) -> Path:
    """Absolute path of the file that a manifest names, after links are followed.

    Parameters
    ----------
    text : name in the manifest. A backslash separates folders, unless the disk has a file of exactly that name.
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
                raise SetupError(f"{shown}: is a folder or a device; name a file")
            near = suggestion(file, base, root)
            raise SetupError(f"{shown}: no such file" + (f"; did you mean {printable(near)}?" if near else ""))
        str(file).encode()
    except (OSError, ValueError, RuntimeError):  # a name too long, circular links, a name that is not UTF-8
        raise SetupError(f"{shown} is not a usable path; rename the file") from None
    return file


def suggestion(file: Path, base: Path, root: Path) -> str:
    """Path on the disk that differs from `file` only in case or composition; empty if none exists.

    Only folders inside `root` are listed.
    """
    path = root
    for part in file.relative_to(root).parts:
        if not (path / part).exists():
            part = _names(path, path.stat().st_mtime_ns).get(_folded(part), "") if path.is_dir() else ""
            if not part:
                return ""
        path = path / part
    base = base.resolve()
    return (path.relative_to(base) if path.is_relative_to(base) else path).as_posix()


@functools.lru_cache(maxsize=16)
def _names(folder: Path, _changed: int) -> dict[str, str]:
    """Names in a folder by their folded form, cached until the folder changes."""
    return {_folded(entry.name): entry.name for entry in sorted(folder.iterdir(), reverse=True)}


def _folded(name: str) -> str:
    """A name without case and with composed accents."""
    return unicodedata.normalize("NFC", name).casefold()
