"""Terminal output of all commands: results, errors on one line, exit codes."""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Callable
from typing import Any

import typer
from typer.core import TyperCommand

from ..errors import PianofitError
from ..io.files import printable


class _Command(TyperCommand):
    """Command whose help shows arguments by their metavar, without braces and types."""

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Words after the command name on the usage line."""
        return [str(self.options_metavar), *(name for name, _ in self._records(ctx, "argument"))]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the tables of arguments and of options."""
        for kind, title in (("argument", "Arguments"), ("option", "Options")):
            records = self._records(ctx, kind)
            if records:
                with formatter.section(title):
                    formatter.write_dl(records)

    def _records(self, ctx: Any, kind: str) -> list[tuple[str, str]]:
        params = [param for param in self.get_params(ctx) if param.param_type_name == kind]
        records = [(param.metavar or str(param.name), param.get_help_record(ctx)) for param in params]
        return [(metavar if kind == "argument" else record[0], record[1]) for metavar, record in records if record]


def add(app: typer.Typer, command: Callable, example: str) -> None:
    """Add a command to `app`. Its help ends with an example, and its errors are one line."""
    first = (command.__doc__ or "").partition("\n")[0]
    name = command.__name__.replace("_", "-")
    app.command(name, cls=_Command, short_help=first, epilog=f"\b\nExample:\n  {example}")(_catch_errors(command))


def print_result(record: Any, words: str, as_json: bool) -> None:
    """Print a record or a table of numbers as JSON, or as text that ends with a newline."""
    if as_json:
        from ..schema.decode import encode_json

        words = encode_json(record).decode()
    typer.echo(words, nl=False)


def print_error(message: str) -> None:
    """Print a message on stderr, on one line."""
    typer.echo("pianofit: " + printable(" ".join(message.split())), err=True)


def _catch_errors(command: Callable) -> Callable:
    """Wrap a command, so that errors and interruptions become one line on stderr and an exit code."""

    @functools.wraps(command)
    def run(*args: Any, **kwargs: Any) -> None:
        try:
            command(*args, **kwargs)
            sys.stdout.flush()
        except PianofitError as error:
            print_error(str(error))
            raise typer.Exit(1) from None
        except KeyboardInterrupt as interruption:
            print_error(f"interrupted; {str(interruption) or 'nothing more is written'}")
            raise typer.Exit(130) from None
        except BrokenPipeError:  # the reader of the output, such as head, has ended
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit(0) from None

    return run
