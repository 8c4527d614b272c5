"""How many threads there are: for our own work, and for BLAS, whose threads would wait for each other or for ours."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from .errors import FitError

__all__ = ["check_process", "cores", "one_blas_thread"]

_forked = False  # whether this process is a copy of one in which JAX had started


def _after_fork() -> None:
    global _forked
    started = getattr(sys.modules.get("jax._src.xla_bridge"), "backends_are_initialized", None)
    _forked = _forked or bool(started and started())


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def check_process() -> None:
    """Refuse to compute in a process that was forked after JAX had started: JAX's threads are not in the copy.

    Raises
    ------
    FitError
        Saying how to start processes instead.
    """
    if _forked:
        raise FitError(
            "this process was forked after JAX had started, and JAX would wait for ever; start processes by "
            "multiprocessing.get_context('spawn')"
        )


def cores() -> int:
    """Threads that this process may keep busy: what NPROC says, by which XLA goes too, or the cores it is let use."""
    if (said := os.environ.get("NPROC", "")).isdecimal() and int(said):
        return int(said)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """NumPy's and SciPy's BLAS use one thread within it, and what the caller had set after it. Also a decorator.

    The matrices of a fit are some 20 to 200 wide, and several are worked on at once. Left to itself, OpenBLAS waits for
    cores that are taken, and a fit can take ten times as long.
    """
    from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1, user_api="blas"):
        yield
