"""A cache of traced programs between runs: only the first fit on a machine traces and compiles, for seconds.

JAX caches compiled programs, but traces again in every process, which takes longer than the fit. Functions with
`persistent_jit` store their traced programs next to the compiled ones, as StableHLO.
"""

import contextlib
import functools
import hashlib
import os
import threading
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any

import jax
from jax.core import Tracer

from ..felt import FeltLaw, is_builtin
from ..io.files import code_digest
from ..x64 import x64_scope

# Number of shapes per function whose programs stay in memory: those of one fit. A program takes some hundred memory
# mappings, and Linux allows 65,530 per process: without this limit a process would fail after some twenty notes.
MAX_LOADED = 4
# The same for functions of any key: all shapes of a keyboard, which an instrument or a data set needs again and again.
# Fewer cost time, more cost memory; benchmarks/library.py measures both.
KEYBOARD_SHAPES = 32
# Options of XLA. A program runs once or some hundred times for a few milliseconds, so its compilation counts most. With
# the older emitters of loops, with basic optimisation and in one part it takes two fifths of the time, at equal speed.
COMPILER_OPTIONS = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_backend_optimization_level": 1,
    "xla_cpu_parallel_codegen_split_count": 1,
}


def persistent_jit(function: Callable, loaded: int = MAX_LOADED) -> Callable:
    """Jit `function(*arrays, cfg)`, static in `cfg`, and keep the programs of the last `loaded` shapes.

    Arguments are trees of arrays, of float64 or integers. `cfg` is hashable and its `repr` determines its value. The
    result is a tuple of arrays, None and such tuples. Traced programs are also stored in the folder of JAX, if it is
    set. Programs with a user's felt law are not stored, since its code may change between runs. Inside transformations
    this is `jax.jit`.
    """
    jitted = jax.jit(function, static_argnums=-1)
    lock = threading.Lock()  # threads that need the same program compile it once

    @functools.lru_cache(maxsize=loaded)
    def program(folder: str | None, cfg: Hashable, tree, shapes: tuple) -> Callable:
        whole = jax.jit(lambda *x: function(*jax.tree.unflatten(tree, x), cfg))
        leaves = [jax.ShapeDtypeStruct(*shape) for shape in shapes]
        if folder is None:
            return _compiled(whole.lower(*leaves))
        key = (cfg, tree, *shapes)
        versions = (code_digest(), jax.__version__, jax.default_backend())
        digest = hashlib.sha256(repr((*versions, function.__name__, key)).encode())
        file = Path(folder) / f"pianofit-{function.__name__}-{digest.hexdigest()}.program"
        return _program(file, whole, leaves)

    @functools.wraps(function)
    def call(*args):
        *trees, cfg = args
        leaves, tree = jax.tree.flatten(trees)
        folder = jax.config.jax_compilation_cache_dir or None  # pyright: ignore[reportAttributeAccessIssue]
        with x64_scope():
            if any(isinstance(x, Tracer) for x in leaves):
                return jitted(*args)
            with lock:
                shapes = tuple((x.shape, x.dtype) for x in leaves)
                chosen = program(folder if _is_persistent(cfg) else None, cfg, tree, shapes)
            return chosen(*leaves)

    return call


def _is_persistent(cfg: tuple | None) -> bool:
    """Return true if `cfg` has the same meaning in the next run."""
    return all(is_builtin(part) for part in cfg or () if isinstance(part, FeltLaw))


def _program(file: Path, function: Any, leaves: list[jax.ShapeDtypeStruct]) -> Callable:
    """Compile a jitted `function` for such arrays; trace it only if `file` is absent or damaged."""
    from jax import export

    with contextlib.suppress(OSError):
        digest, content = (stored := file.read_bytes())[:32], stored[32:]
        if hashlib.sha256(content).digest() == digest:
            return _compiled(jax.jit(export.deserialize(bytearray(content)).call).lower(*leaves))
    traced = export.export(function)(*leaves)
    content = traced.serialize()
    unfinished = file.with_suffix(f".{os.getpid()}-{threading.get_ident()}.tmp")
    with contextlib.suppress(OSError):
        unfinished.write_bytes(hashlib.sha256(content).digest() + content)
        unfinished.replace(file)
    return _compiled(jax.jit(traced.call).lower(*leaves))


def _compiled(lowered: Any) -> Callable:
    """Compile with `COMPILER_OPTIONS`, or without them if this version of XLA or its device does not have them."""
    try:
        return lowered.compile(COMPILER_OPTIONS if jax.default_backend() == "cpu" else None)
    except jax.errors.JaxRuntimeError:
        return lowered.compile()
