"""What every command does alike at a terminal: errors in one line, and an exit code."""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Callable
from typing import Any

import typer

from ..errors import PianofitError

__all__ = ["complain", "plainly"]


def complain(message: str) -> None:
    """Say what is wrong, on one line whatever is in it."""
    words = " ".join(message.split())
    typer.echo("pianofit: " + "".join(c if c.isprintable() else repr(c)[1:-1] for c in words), err=True)


def plainly(command: Callable, interrupted: str = "nothing more is written") -> Callable:
    """A command whose errors are one line on stderr and an exit code."""

    @functools.wraps(command)
    def run(*args: Any, **kwargs: Any) -> None:
        try:
            command(*args, **kwargs)
            sys.stdout.flush()
        except PianofitError as error:
            complain(str(error))
            raise typer.Exit(1) from None
        except KeyboardInterrupt:
            complain(f"interrupted; {interrupted}")
            raise typer.Exit(130) from None
        except BrokenPipeError:  # whoever read our output has had enough
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit(0) from None

    return run
