"""Numbers of processes and threads, and the settings of numerical libraries that computations need."""

import functools
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from .errors import FitError

# Largest number of processes of a command: more than an ordinary machine has cores.
MAX_PROCESSES = 256
# Limits of a process of a batch: memory, GiB, and time of a job, s. A fit takes at most 1.5 GiB and a minute: they end
# what went wrong.
MEMORY, TIME_LIMIT = 4.0, 3600.0
_forked = False  # True in a process that was forked after JAX had started
# Blocks that limit the BLAS at present. The limit holds for all threads of a process, except in an OpenBLAS that was
# built with OpenMP, where it is that of the thread that set it.
_limit_lock = threading.Lock()
_limited_blocks = 0
_limit: Any = None  # of threadpoolctl, with the number of threads of the caller


def _after_fork() -> None:
    global _forked
    started = getattr(sys.modules.get("jax._src.xla_bridge"), "backends_are_initialized", None)
    _forked = _forked or bool(started and started())


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def check_process() -> None:
    """Raise an error in a process that was forked after JAX had started, because a fork lacks the threads of JAX.

    Raises
    ------
    FitError
        If the process was forked. The message says how to start processes instead.
    """
    if _forked:
        raise FitError(
            "this process was forked after JAX had started, and JAX would block; start processes with "
            "multiprocessing.get_context('spawn')"
        )


def cores() -> int:
    """Return the number of threads to use: NPROC, which XLA uses too, or the cores available to this process."""
    if (count := os.environ.get("NPROC", "")).isdecimal() and int(count):
        return int(count)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def numerical_settings() -> Iterator[None]:
    """Limit the BLAS of NumPy and SciPy to one thread, and handle errors of floats as NumPy does by default.

    The settings of the caller are restored. Also a decorator.

    A fit processes several matrices of about 20 to 200 rows at once. Otherwise OpenBLAS waits for busy cores, and a fit
    can take ten times as long. Decayed sounds underflow, which a caller may have made an error by `numpy.seterr`.
    """
    import numpy as np

    with _one_blas_thread(), np.errstate(divide="warn", over="warn", under="ignore", invalid="warn"):
        yield


@functools.cache
def _libraries() -> Any:
    """Return the libraries of NumPy and SciPy. A search through all libraries of the process takes milliseconds."""
    import numpy  # noqa: F401 - loaded before the search
    import scipy.linalg  # noqa: F401
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


@contextmanager
def _one_blas_thread() -> Iterator[None]:
    """Limit the BLAS to one thread. Blocks of several threads overlap in any order: the last one ends the limit."""
    global _limited_blocks, _limit
    with _limit_lock:
        if not _limited_blocks:
            libraries = _libraries()
            _release_openblas()
            _limit = libraries.limit(limits=1, user_api="blas")
        _limited_blocks += 1
    try:
        yield
    finally:
        with _limit_lock:
            _limited_blocks -= 1
            if not _limited_blocks:
                _release_openblas()
                _limit.restore_original_limits()
                _release_openblas()


def _release_openblas() -> None:
    """Let this thread change the threads of OpenBLAS: from 3.8 on threadpoolctl ignores all but one thread."""
    from threadpoolctl import OpenBLASController

    if hasattr(OpenBLASController, "clear_controlling_thread"):
        OpenBLASController.clear_controlling_thread(force=True)
