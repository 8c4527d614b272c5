"""Terminal output of all commands: help, results, errors on one line, exit codes.

A parameter of a command has the name that the function behind it gives the argument. Messages of functions have
`even=3.0`. The command line writes the option instead: `--even 3.0`.
"""

import itertools
import os
import re
import shlex
import sys
from collections.abc import Callable, Sequence
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from ..errors import PianofitError
from ..io.files import printable
from ..program_folder import enable_program_cache

# Base of click's usage errors; typer has a private copy of click.
UsageError: type[Exception] = typer.BadParameter.__mro__[1]

# An argument with its value, as messages of functions have it: even=3.0, preset='x', path=True, noise_db=(40, 70), or
# around=. Values of other forms, such as the rest of a file name, are none.
ARGUMENT = re.compile(
    r"(?<![\w.'\"/=-])(\w+)=('[^']*'|\"[^\"]*\"|\([^()]*\)|[-+]?[\d.]+(?:e[-+]?\d+)?|\w*)(?=[\s,;:)]|$)"
)


class Commands(TyperGroup):
    """All commands. The help lists them under headings, each heading with its commands in the order of the program."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:  # noqa: ARG002
        """Write a table of commands for every heading."""
        width = max(map(len, self.commands))
        for heading, commands in itertools.groupby(self.commands.items(), lambda item: item[1].rich_help_panel):  # pyright: ignore[reportAttributeAccessIssue]
            with formatter.section(heading):
                formatter.write_dl([(name.ljust(width), command.get_short_help_str(0)) for name, command in commands])


class _Command(TyperCommand):
    """Command with errors of one line, and a help that shows arguments by their metavar, without braces and types."""

    def invoke(self, ctx: Any) -> None:
        """Run the command. Errors and interruptions become one line on stderr and an exit code."""
        enable_program_cache()
        try:
            super().invoke(ctx)
            sys.stdout.flush()
        except PianofitError as error:
            print_error(_with_options(str(error), self.get_params(ctx)))
            raise typer.Exit(1) from None
        except KeyboardInterrupt as interruption:
            print_error(f"interrupted; {str(interruption) or 'nothing more is written'}")
            raise typer.Exit(130) from None
        except BrokenPipeError:  # the reader of the output, such as head, has ended
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit(0) from None
        except OSError as error:
            if error.filename is None:
                raise
            # A name that is too long, or a folder without permission: no question about the file has an answer.
            print_error(f"{printable(error.filename)}: cannot be used ({error.strerror}); check the path")
            raise typer.Exit(1) from None

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


def add(app: typer.Typer, command: Callable, example: str, heading: str | None = None) -> None:
    """Add a command to `app`, under a heading if its help has some. The help of the command ends with an example."""
    first = (command.__doc__ or "").partition("\n")[0]
    name = command.__name__.replace("_", "-")
    epilog = f"\b\nExample:\n  {example}"
    app.command(name, cls=_Command, short_help=first, epilog=epilog, rich_help_panel=heading)(command)


def usage_message(error: Any) -> str:
    """Return the message of a usage error, with the option that it is about and the command whose help lists it."""
    command = "pianofit" if error.ctx is None else error.ctx.command_path
    message = error.format_message()
    if type(error) is typer.BadParameter:
        message = error.message if error.param is None else f"{_spelling(error.param)} {error.message}"
    return f"{message.rstrip('.')}{' See' if message.endswith('?') else '; see'} {command} --help"


def bare(text: str) -> str:
    """Return a text as one would type it: in quotes only where a shell, or a reader, needs them."""
    return text if shlex.quote(text) == text else repr(text)


def _with_options(message: str, params: Sequence[Any]) -> str:
    """Return a message with the options of a command in place of the arguments of a function."""
    known = {param.name: param for param in params}

    def spell(found: re.Match[str]) -> str:
        name, value = found.groups()
        if name not in known:
            return found[0]
        if value == "False" and known[name].secondary_opts:
            return known[name].secondary_opts[0]
        return f"{_spelling(known[name])} {_typed(value)}".rstrip()

    return ARGUMENT.sub(spell, message)


def _typed(value: str) -> str:
    """Return a value as it is typed after its option; empty for True, which the option itself says."""
    if value[:1] in ("'", '"'):
        return bare(value[1:-1])
    return "" if value == "True" else value.strip("()").replace(", ", "-")


def _spelling(param: Any) -> str:
    """Return the option as it is typed, or the metavar of an argument."""
    return param.opts[0] if param.param_type_name == "option" else str(param.metavar).removesuffix("...")


def print_result(record: Any, words: str, as_json: bool) -> None:
    """Print a record or a table of numbers as JSON, or as text that ends with a newline."""
    if as_json:
        from ..schema.decode import encode_json

        words = encode_json(record).decode()
    typer.echo(words, nl=False)


def print_error(message: str) -> None:
    """Print a message on stderr, on one line."""
    typer.echo("pianofit: " + printable(" ".join(message.split())), err=True)
