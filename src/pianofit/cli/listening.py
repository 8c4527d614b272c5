"""Command for blind listening tests: make a test, or count its answers."""

from pathlib import Path
from typing import Annotated

import typer

from ..errors import ParameterError
from ..io.files import output_folder, printable
from ..io.number_format import counted
from ..parameters import check_seed
from .options import Force, Json, Seed, flag, integer, real, text
from .terminal import print_error, print_result


def listen(
    a: Annotated[
        Path | None, typer.Argument(metavar="A", help="A folder of sounds, or one file; the reference.")
    ] = None,
    b: Annotated[
        Path | None,
        typer.Argument(metavar="B", help="A folder with files of the same names, or the fits of the recordings in A."),
    ] = None,
    out: Annotated[Path | None, text("DIR", "Folder for the page, listen.html, and its key.")] = None,
    reference: Annotated[
        Path | None, text("DIR", "A third folder: the test also asks whether A or B is nearer to its sounds.")
    ] = None,
    trials: Annotated[int, integer("N", "Number of questions of each kind, over all sounds.")] = 16,
    seconds: Annotated[float, real("S", "Length of each sound in seconds.")] = 4.0,
    seed: Seed = 0,
    exclude_invalid: Annotated[
        bool, flag("--exclude-invalid", "Leave out sounds that fail a check, instead of stopping.")
    ] = False,
    result: Annotated[list[Path], text("ANSWERS.JSON", "Count saved answers; may be given several times.")] = [],  # noqa: B006
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Make a blind listening test of two folders of sounds. With --result: count its answers."""
    check_seed(seed)
    if result:
        if a or b or out or reference:
            raise ParameterError(
                f"--result {result[0]}: cannot be combined with A, B, --out or --reference; remove them"
            )
        _count(result, as_json)
        return
    if a is None or b is None or out is None:
        raise typer.BadParameter("give A, B and --out to make a test, or --result to count its answers")
    if as_json:
        raise typer.BadParameter("--json needs --result")

    with output_folder(out, force) as folder:
        from ..listening.sounds import write_listening_test

        sizes = {"trials": trials, "seconds": seconds, "seed": seed}
        test = write_listening_test(a, b, folder, reference=reference, **sizes, exclude_invalid=exclude_invalid)
    for line in test.failed:
        print_error(f"left out: {line}")
    if test.alone:
        print_error(f"left out, not in all folders: {', '.join(test.alone)}")
    typer.echo(f"{counted(test.trials, 'question')} about {counted(len(test.names), 'sound')}: {', '.join(test.names)}")
    typer.echo(
        f"written to {printable(folder)}: give listen.html to listeners; key.json has the answers; "
        "webmushra/ is for webMUSHRA"
    )


def _count(files: list[Path], as_json: bool) -> None:
    from ..listening.result import count_answers

    counts = count_answers(files)
    width = max(len(count.condition) for count in counts)
    lines = [f"{'':{width}}  hits   of   share  95 % interval    p, two-sided"]
    for c in counts:
        low, high = c.interval
        share = f"{c.hits / c.of:7.3f}  [{low:.3f}, {high:.3f}]"
        lines.append(f"{c.condition:{width}} {c.hits:5} {c.of:4} {share}  {c.p:12.4g}")
    document = {"files": [str(file) for file in files], "conditions": [vars(c) for c in counts]}
    print_result(document, "\n".join(lines) + "\n", as_json)
