"""The command that hands an instrument to other programs."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from ..progress import progress_bar
from .options import Built, Force, Json, number, whole
from .terminal import add

__all__ = ["register"]


def register(app: typer.Typer) -> None:
    """Add the command to `app`."""
    add(app, export, "pianofit export cp80/instrument.json --keys 'every 3' --layers 8 --out sampler")


def export(
    built: Built,
    out: Annotated[Path, typer.Option(metavar="DIR", help="The folder to write: a text, samples and a readme.")],
    to: Annotated[str, typer.Option("--format", metavar="FORMAT", help="For what: sfz or decent-sampler.")] = "sfz",
    layers: Annotated[int, typer.Option(parser=whole, metavar="N", help="How many velocity layers.")] = 8,
    keys: Annotated[
        str, typer.Option(metavar="KEYS", help="Keys to sample: A0-C8, or C2,E2,G2, or 'every 3' (semitones).")
    ] = "every 3",
    samples: Annotated[
        str | None, typer.Option(metavar="flac|wav", help="Files of the samples, 24 bit; by default what players read.")
    ] = None,
    seconds: Annotated[
        float, typer.Option(parser=number, metavar="S", help="Length of the longest sample in seconds.")
    ] = 8.0,
    rate: Annotated[int, typer.Option("--rate", parser=whole, metavar="HZ", help="Sample rate in Hz.")] = 48_000,
    licence: Annotated[
        str | None, typer.Option(metavar="WORDS", help="Licence of the recordings, for the folder's README.txt.")
    ] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Write a sampler instrument whose loudness and timbre follow velocity without steps."""
    asked = {"layers": layers, "seconds": seconds, "rate": rate, "kind": samples}
    with progress_bar() as bar:
        done = _export(built, out, to, keys, asked, licence, force, bar)
    if as_json:
        from ..io import json_text

        typer.echo(json_text(done._asdict()), nl=False)
        return
    typer.echo(
        f"{out}: {done.keys} keys sampled, {_guesses(done.guesses)}; {done.transposed} transposed from them\n"
        f"{done.samples} samples, {done.seconds:.0f} s, {done.bytes / 1e6:.1f} MB, one gain of {done.gain_db:+.1f} dB "
        "for all"
    )


def _guesses(count: int) -> str:
    return f"{count} of them {'a guess' if count == 1 else 'guesses'} (never recorded)" if count else "all recorded"


def _export(
    built: Path, out: Path, to: str, keys: str, asked: dict[str, Any], licence: str | None, force: bool,
    progress: Callable,
) -> Any:  # fmt: skip
    from ..errors import OutputError, ParameterError
    from ..io import one_line
    from ..keyboard import load_instrument
    from ..model.cache import keep_programs
    from ..play import SAMPLERS, Asked, export_sampler, parse_keys

    if to not in SAMPLERS:
        raise ParameterError(f"--format {to!r} must be {' or '.join(SAMPLERS)}")
    if re.fullmatch(r"\.[A-Za-z]\w*", out.suffix):
        raise OutputError(f"{one_line(out)}: is called like a file; give --out the name of a folder")
    chosen, played = parse_keys(keys), load_instrument(built)
    keep_programs()
    asked["kind"] = asked["kind"] or SAMPLERS[to].kind
    return export_sampler(played, out, chosen, Asked(**asked), to=to, licence=licence, force=force, progress=progress)
