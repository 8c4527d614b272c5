"""Files appear whole or not at all: written beside their place under another name, then renamed onto it."""

from __future__ import annotations

import os
from pathlib import Path

from ..errors import OutputError

__all__ = ["replace_file"]


def replace_file(path: str | os.PathLike[str], content: bytes) -> None:
    """Write `content` to `path`, replacing what was there in one step.

    Raises
    ------
    OutputError
        If the folder is missing, is no folder, or does not let us write; nothing is left behind.
    """
    target = Path(path)
    temporary = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    try:
        try:
            temporary.write_bytes(content)
            temporary.replace(target)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        reason = error.strerror or error
        raise OutputError(
            f"{target}: cannot be written ({reason}); choose a folder that exists and is yours"
        ) from error
