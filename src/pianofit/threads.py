"""One thread for BLAS, where its own would wait for each other or for ours."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["one_blas_thread"]


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """NumPy's and SciPy's BLAS use one thread within it, and what the caller had set after it. Also a decorator.

    The matrices of a fit are some 20 to 200 wide, and several are worked on at once. Left to itself, OpenBLAS waits for
    cores that are taken, and a fit can take ten times as long.
    """
    from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1, user_api="blas"):
        yield
