"""Progress of long computations: a bar in a terminal, a line in a notebook, nothing elsewhere."""

import contextlib
import sys
from collections.abc import Callable, Iterator

from .errors import check_type

# Called with the name of a stage and the completed fraction.
Progress = Callable[[str, float], None]


@contextlib.contextmanager
def progress_bar(progress: Progress | bool | None = None) -> Iterator[Progress]:
    """Return the function to report progress to: the given one, none for False, or by default a bar or a line."""
    check_type("progress=", progress, Callable | bool | None, "a function of stage and fraction, True, False or None")
    if callable(progress):
        yield progress
    elif progress is False:
        yield lambda *_: None
    elif sys.stderr.isatty():
        yield from _bar()
    elif "ipykernel" in sys.modules:  # the stderr of a notebook is not a terminal, but supports carriage returns
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
