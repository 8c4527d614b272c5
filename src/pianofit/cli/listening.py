"""The command of the blind listening test: make one, and count its answers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..errors import ParameterError
from ..io.files import output_folder
from ..io.number_format import counted
from ..parameters import check_seed
from .options import Force, Json, Seed, number, whole
from .terminal import print_error, print_result

__all__ = ["listen"]


def listen(
    a: Annotated[
        Path | None, typer.Argument(metavar="A", help="A folder of sounds, or one file; the reference.")
    ] = None,
    b: Annotated[
        Path | None,
        typer.Argument(metavar="B", help="A folder with files of the same names, or the fits of the recordings in A."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="The folder for the page, listen.html, and its key.")
    ] = None,
    reference: Annotated[
        Path | None,
        typer.Option(metavar="R", help="A third folder: it is also asked whether A or B is nearer to its sounds."),
    ] = None,
    trials: Annotated[
        int, typer.Option(parser=whole, metavar="N", help="Questions of each kind, over all sounds.")
    ] = 16,
    seconds: Annotated[float, typer.Option(parser=number, metavar="S", help="What is heard of each sound, s.")] = 4.0,
    seed: Seed = 0,
    leave_out: Annotated[
        bool, typer.Option("--leave-out", help="Leave out sounds that cannot be compared fairly.")
    ] = False,
    result: Annotated[
        list[Path], typer.Option(metavar="ANSWERS.json", help="Count saved answers; may be given several times.")
    ] = [],  # noqa: B006
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Ask blindly whether two folders of sounds can be told apart: a page. With --result: what came of it."""
    check_seed(seed)
    if result:
        if a or b or out or reference:
            raise ParameterError(f"--result {result[0]}: stands alone; make a test and count its answers one by one")
        _count(result, as_json)
        return
    if a is None or b is None or out is None:
        raise typer.BadParameter("A, B and --out are needed to make a test, or --result to count its answers")
    if as_json:
        raise typer.BadParameter("--json goes with --result")

    with output_folder(out, force) as folder:
        from ..listening.sounds import listening_test

        made = listening_test(
            a, b, folder, reference=reference, trials=trials, seconds=seconds, seed=seed, leave_out=leave_out
        )
    for line in made.failed:
        print_error(f"left out: {line}")
    if made.alone:
        print_error(f"left out, not in all folders: {', '.join(made.alone)}")
    typer.echo(f"{counted(made.trials, 'question')} about {counted(len(made.names), 'sound')}: {', '.join(made.names)}")
    typer.echo(f"written to {folder}: give listen.html to listeners; key.json says what it hides; webmushra/")


def _count(files: list[Path], as_json: bool) -> None:
    from ..listening.result import count_answers

    counts = count_answers(files)
    width = max(len(count.condition) for count in counts)
    lines = [f"{'':{width}}  hits   of   share  95 % interval    p, two-sided"]
    for c in counts:
        low, high = c.interval
        share = f"{c.hits / c.of:7.3f}  [{low:.3f}, {high:.3f}]"
        lines.append(f"{c.condition:{width}} {c.hits:5} {c.of:4} {share}  {c.p:12.4g}")
    document = {"files": [str(file) for file in files], "conditions": [c._asdict() for c in counts]}
    print_result(document, "\n".join(lines) + "\n", as_json)
