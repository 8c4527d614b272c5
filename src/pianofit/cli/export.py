"""The command that hands an instrument to other programs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..errors import OutputError, ParameterError
from ..io.files import check_target, printable
from ..io.number_format import counted
from ..progress import progress_bar
from .options import Built, Force, Json, Prefix, number, whole
from .terminal import print_result

if TYPE_CHECKING:
    from ..export import ExportSummary
    from ..export.faust import Program

__all__ = ["export"]


def export(
    built: Built,
    out: Annotated[
        Path, typer.Option(metavar="DIR|FILE.DSP", help="The folder of a sampler to write, or Faust's program.")
    ],
    prefix: Prefix = None,
    to: Annotated[
        str, typer.Option("--format", metavar="FORMAT", help="For what: sfz, decent-sampler or faust.")
    ] = "sfz",
    keys: Annotated[
        str, typer.Option(metavar="KEYS", help="Keys of their own: A0-C8, or C2,E2,G2, or 'every 3' (semitones).")
    ] = "every 3",
    licence: Annotated[
        str | None, typer.Option(metavar="WORDS", help="Licence of the recordings, to be named in what is written.")
    ] = None,
    layers: Annotated[
        int | None, typer.Option(parser=whole, metavar="N", help="How many velocity layers a sampler has; 8.")
    ] = None,
    samples: Annotated[
        str | None,
        typer.Option(metavar="flac|wav", help="Files of a sampler, 24 bit; by default what its players read."),
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(parser=number, metavar="S", help="Length of the longest sample in seconds; 8.")
    ] = None,
    rate: Annotated[
        int | None, typer.Option("--rate", parser=whole, metavar="HZ", help="Sample rate of a sampler in Hz; 48000.")
    ] = None,
    fill: Annotated[
        bool, typer.Option(help="Sample more keys where keys between the chosen ones would be silent.")
    ] = True,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Write an instrument for other programs: a sampler's folder, or a program in Faust."""
    from ..export import SAMPLERS, ExportOptions, export_sampler, parse_keys
    from ..export.faust import write_faust
    from ..export.layers import without_gaps
    from ..instrument import load_instrument
    from ..model.program_cache import enable_program_cache

    given = {"layers": layers, "seconds": seconds, "rate": rate, "kind": samples}
    asked = {name: value for name, value in given.items() if value is not None}
    if to not in (*SAMPLERS, "faust"):
        raise ParameterError(f"--format {to!r} must be one of {', '.join(SAMPLERS)}, faust")
    _check_target(to, out, asked if fill else asked | {"no-fill": True}, force)
    chosen, played = parse_keys(keys), load_instrument(built, prefix)
    enable_program_cache()
    with progress_bar() as bar:
        if to == "faust":
            done = write_faust(out, played, chosen, licence=licence, progress=bar)
            words = _programmed(done)
        else:
            wanted, sampled = (
                ExportOptions(kind=SAMPLERS[to].kind)._replace(**asked),
                without_gaps(chosen) if fill else chosen,
            )
            done = export_sampler(played, out, sampled, wanted, to=to, licence=licence, force=force, progress=bar)
            words = _sampled(done, sorted({*sampled} - {*chosen}))
    print_result(done._asdict(), f"{out}: {words}", as_json)


def _check_target(to: str, out: Path, asked: dict[str, Any], force: bool) -> None:
    """Refuse a name that what is written cannot have, and for Faust what is only a sampler's."""
    name = printable(out)
    if to != "faust" and re.fullmatch(r"\.[A-Za-z]\w*", out.suffix):
        raise OutputError(f"{name}: is called like a file; give --out the name of a folder")
    if to == "faust" and asked:
        options = ("--samples" if option == "kind" else f"--{option}" for option in asked)
        raise ParameterError(f"--format faust has no samples; leave out {', '.join(options)}")
    if to == "faust":
        if out.suffix.lower() != ".dsp":
            raise OutputError(f"{name}: Faust's programs are files; give --out a name that ends in .dsp")
        check_target(out, force)


def _sampled(done: ExportSummary, added: list[int]) -> str:
    from ..export.layers import format_keys

    more = f"{counted(len(added), 'key')} sampled in addition, to fill gaps: {format_keys(added)}\n" if added else ""
    silent = f"{counted(len(done.silent), 'key')} silent: {format_keys(done.silent)}; give more --keys\n"
    return (
        f"{counted(done.keys, 'key')} sampled, {_guesses(done.guesses)}; {done.transposed} transposed from them\n"
        f"{more}{silent if done.silent else ''}"
        f"{counted(done.samples, 'sample')}, {done.seconds:.0f} s, {done.bytes / 1e6:.1f} MB, one gain of "
        f"{done.gain_db:+.1f} dB for all\n"
    )


def _programmed(done: Program) -> str:
    knocks = f"knocks at {done.knock_rate} Hz" if done.knock_rate else "no knocks"
    return (
        f"{counted(done.keys, 'key')} with tables, {_guesses(done.guesses)}\n{done.modes} resonators a voice, "
        f"{counted(done.left_out, 'mode')} left out, {knocks}, {done.numbers} numbers, "
        f"one gain of {done.gain_db:+.1f} dB\n"
    )


def _guesses(count: int) -> str:
    return f"{count} of them {'a guess' if count == 1 else 'guesses'} (never recorded)" if count else "all recorded"
