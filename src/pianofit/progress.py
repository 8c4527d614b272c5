"""How far a long job has come: a bar in a terminal, a line in a notebook, nothing where neither is."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator

__all__ = ["Progress", "progress_bar"]

# Called with a stage's name and the fraction done.
Progress = Callable[[str, float], None]


@contextlib.contextmanager
def progress_bar(progress: Progress | bool | None = None) -> Iterator[Progress]:
    """Where a job reports to: a function of one's own, nowhere for False, or what suits the place by default."""
    if callable(progress):
        yield progress
    elif progress is False:
        yield lambda *_: None
    elif sys.stderr.isatty():
        yield from _bar()
    elif "ipykernel" in sys.modules:  # a notebook, whose stderr is no terminal but knows a carriage return
        yield _line
        sys.stderr.write("\r" + " " * 40 + "\r")
    else:
        yield lambda *_: None


def _bar() -> Iterator[Progress]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description:<18}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("starting", total=1.0)
        yield lambda stage, done: bar.update(task, description=stage, completed=done)


def _line(stage: str, done: float) -> None:
    sys.stderr.write(f"\r{stage:<32} {done:4.0%}")
    sys.stderr.flush()
