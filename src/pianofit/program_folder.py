"""The folder in which JAX keeps compiled programs between runs. Nothing here imports JAX."""

import os
import sys
from pathlib import Path

# Settings of JAX: every program is kept, even a small one that compiles fast.
SETTINGS = {
    "jax_persistent_cache_min_compile_time_secs": 0.0,
    "jax_persistent_cache_min_entry_size_bytes": -1,
}
FOLDER = "jax_compilation_cache_dir"


def cache_folder() -> Path:
    """Return the cache folder of this user; PIANOFIT_CACHE overrides it.

    Raises `RuntimeError` if the user has no home folder.
    """
    if chosen := os.environ.get("PIANOFIT_CACHE"):
        return Path(chosen)
    if sys.platform == "win32":
        variable, below_home = "LOCALAPPDATA", "AppData/Local"
    elif sys.platform == "darwin":
        variable, below_home = "", "Library/Caches"
    else:
        variable, below_home = "XDG_CACHE_HOME", ".cache"
    chosen = os.environ.get(variable)
    return (Path.home() / below_home if chosen is None else Path(chosen)) / "pianofit"


def enable_program_cache() -> None:
    """Set `cache_folder` as the compilation cache of JAX. If it is not writable, JAX compiles in every process.

    A folder that is already set (JAX_COMPILATION_CACHE_DIR) stays. If JAX is not imported yet, this sets environment
    variables, which processes that start later inherit.
    """
    jax = sys.modules.get("jax")
    if jax.config.values[FOLDER] if jax else os.environ.get(FOLDER.upper()):
        return
    try:
        folder = cache_folder()
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f".{os.getpid()}"
        probe.touch()
        probe.unlink()
    except (OSError, RuntimeError):
        return
    for name, value in {FOLDER: str(folder), **SETTINGS}.items():
        if jax:
            jax.config.update(name, value)
        else:
            os.environ[name.upper()] = str(value)
