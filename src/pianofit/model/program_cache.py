"""Programs, kept between runs: the first fit on a machine traces and compiles for seconds, the next does neither.

JAX keeps what its compiler makes of a traced program, and traces anew in every process, in Python, for longer than the
fit then takes. `kept` functions leave their traced programs beside the compiled ones, as StableHLO.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import sys
import threading
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any

import jax
from jax.core import Tracer

from ..felt import FeltLaw, is_builtin
from .x64 import x64_scope

__all__ = ["LOADED", "cache_folder", "enable_program_cache", "persistent_jit"]

# Shapes of a function whose programs stay in memory: those of one fit. A program takes some hundred memory mappings, of
# which Linux gives a process 65,530; all that a process ever made would end it after some twenty notes.
LOADED = 4


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


def enable_program_cache() -> None:
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


def persistent_jit(function: Callable) -> Callable:
    """`function(*arrays, cfg)` as `jax.jit` makes it, static in `cfg`, with the programs of the last `LOADED` shapes.

    Arguments are trees of arrays, of float64 or integers, `cfg` hashable with a faithful `repr`, the result a tuple of
    arrays. Traced programs are kept in JAX's folder too, where there is one, but for those of a felt law from outside,
    whose code may change between runs. Inside other transformations this is `jax.jit`.
    """
    jitted = jax.jit(function, static_argnums=-1)
    alone = threading.Lock()  # two threads that need one program wait for it, and do not both make it

    @functools.lru_cache(maxsize=LOADED)
    def program(folder: str | None, cfg: Hashable, tree, shapes: tuple) -> Callable:
        whole = jax.jit(lambda *x: function(*jax.tree.unflatten(tree, x), cfg))
        leaves = [jax.ShapeDtypeStruct(*shape) for shape in shapes]
        if folder is None:
            return whole.lower(*leaves).compile()
        key = (cfg, tree, *shapes)
        named = hashlib.sha256(repr((_sources(), jax.default_backend(), function.__name__, key)).encode())
        file = Path(folder) / f"pianofit-{function.__name__}-{named.hexdigest()}.program"
        return _program(file, whole, leaves)

    @functools.wraps(function)
    def call(*args):
        *trees, cfg = args
        leaves, tree = jax.tree.flatten(trees)
        folder = jax.config.values["jax_compilation_cache_dir"] or None
        with x64_scope():
            if any(isinstance(x, Tracer) for x in leaves):
                return jitted(*args)
            with alone:
                shapes = tuple((x.shape, x.dtype) for x in leaves)
                chosen = program(folder if _lasting(cfg) else None, cfg, tree, shapes)
            return chosen(*leaves)

    return call


def _lasting(cfg: tuple | None) -> bool:
    """Whether `cfg` will mean the same in the next run."""
    return all(is_builtin(part) for part in cfg or () if isinstance(part, FeltLaw))


def _program(file: Path, function: Any, leaves: list[jax.ShapeDtypeStruct]) -> Callable:
    """`function`, jitted, of such arrays, compiled; traced if `file` does not hold it whole."""
    from jax import export

    with contextlib.suppress(OSError):
        digest, content = (held := file.read_bytes())[:32], held[32:]
        if hashlib.sha256(content).digest() == digest:
            return jax.jit(export.deserialize(bytearray(content)).call).lower(*leaves).compile()
    traced = export.export(function)(*leaves)
    content = traced.serialize()
    unfinished = file.with_suffix(f".{os.getpid()}-{threading.get_ident()}.tmp")
    with contextlib.suppress(OSError):
        unfinished.write_bytes(hashlib.sha256(content).digest() + content)
        unfinished.replace(file)
    return jax.jit(traced.call).lower(*leaves).compile()


@functools.cache
def _sources() -> str:
    """What a program is made by: this package's code and JAX."""
    package = Path(__file__).parents[1]
    code = hashlib.sha256(jax.__version__.encode())
    for part in sorted(package.rglob("*.py")):
        code.update(part.read_bytes())
    return code.hexdigest()
