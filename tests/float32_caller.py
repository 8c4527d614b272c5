"""A program of somebody else's, in float32, around ours: what a process of its own sees of JAX before and after."""

from __future__ import annotations

import os
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

PATHS = (Path(__file__).parent, Path(__file__).parents[1] / "benchmarks")


def environment() -> dict[str, str]:
    """Of a process that finds this module and the benchmarks, without settings of JAX."""
    paths = [*map(str, PATHS), os.environ.get("PYTHONPATH", "")]
    own = {name: x for name, x in os.environ.items() if not name.startswith("JAX_")}
    return own | {"PYTHONPATH": os.pathsep.join(path for path in paths if path)}


def own() -> tuple[jax.Array, jax.Array]:
    """The caller's own computation."""

    def step(x, drive):
        x = 0.99 * x + jnp.sin(drive)
        return x, x * x

    return jax.jit(lambda d: jax.lax.scan(step, 0.1, d))(jnp.linspace(0.0, 3.0, 100))


def state() -> tuple[dict[str, Any], list]:
    """JAX's settings, and the bytes of the caller's results; a new thread has them too. Warnings are errors."""
    warnings.simplefilter("error")
    inside = ThreadPoolExecutor(1).submit(lambda: jnp.zeros(1).dtype).result()
    assert inside == jnp.zeros(1).dtype == np.float32
    assert not jax.config.values["jax_enable_x64"]
    return dict(jax.config.values), [(np.asarray(x).tobytes(), x.dtype) for x in own()]
