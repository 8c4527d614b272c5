"""Names of files that a build keeps, made of the contents that they depend on."""

from __future__ import annotations

import hashlib
from pathlib import Path


def digest(*files: Path) -> str:
    """Return a name for the contents of files."""
    return hashlib.sha256(b"\0".join(file.read_bytes() for file in files)).hexdigest()[:16]
