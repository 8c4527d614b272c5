"""Compiled programs, kept between runs: the first fit on a machine compiles for seconds, the next does not."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import jax

__all__ = ["cache_folder", "keep_programs"]


def cache_folder() -> Path:
    """Where this user's caches belong; PIANOFIT_CACHE overrides it."""
    if own := os.environ.get("PIANOFIT_CACHE"):
        return Path(own)
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local"))
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    return base / "pianofit"


def keep_programs() -> None:
    """Let JAX keep its programs in `cache_folder`. Where that cannot be written, it compiles anew, and says nothing.

    A folder that JAX was already told of (JAX_COMPILATION_CACHE_DIR) stays.
    """
    if jax.config.values["jax_compilation_cache_dir"]:
        return
    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f".{os.getpid()}"
        probe.touch()
        probe.unlink()
    except OSError:
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
