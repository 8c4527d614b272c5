"""Command that exports an instrument to other programs."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..errors import OutputError, ParameterError
from ..io.files import check_target, printable
from ..io.number_format import counted
from ..progress import progress_bar
from .options import Built, Even, Force, Json, Prefix, choice, flag, integer, real, text
from .terminal import print_result

if TYPE_CHECKING:
    from ..export import ExportSummary
    from ..export.faust import FaustSummary

# Formats that are one file, and the ending of its name.
ENDINGS = {"faust": ".dsp", "modal-json": ".json"}


def export(
    ctx: typer.Context,
    built: Built,
    out: Annotated[Path, text("DIR|FILE", "Folder of a sampler, or file: .dsp for Faust, .json for modal-json.")],
    prefix: Prefix = None,
    even: Even = 0.0,
    to: Annotated[
        str, choice("FORMAT", "Format", ("sfz", "decent-sampler", "faust", "modal-json"), "--format")
    ] = "sfz",
    keys: Annotated[
        str, text("KEYS", "Sampled keys: A0-C8, or C2,E2,G2, or 'every 3' (semitones). Others are transposed.")
    ] = "every 3",
    licence: Annotated[str | None, text("WORDS", "Licence of the recordings, for the exported files.")] = None,
    layers: Annotated[int, integer("N", "Velocity layers of a sampler.", "--velocity-layers")] = 8,
    blend: Annotated[
        str,
        choice("BLEND", "Neighbouring layers over velocity", ("curves", "xfade", "plain"), "--velocity-blend"),
    ] = "curves",
    resonance: Annotated[bool, typer.Option(help="Sample the free strings under the right pedal.")] = True,
    una_corda: Annotated[bool, flag("--una-corda", "Sample the left pedal too, which doubles the samples.")] = False,
    kind: Annotated[
        str | None,
        choice(
            "FORMAT",
            "Format of the samples, 24 bit",
            ("flac", "wav"),
            "--sample-format",
            default="flac, or wav for decent-sampler",
        ),
    ] = None,
    seconds: Annotated[float, real("S", "Longest sample in seconds.")] = 8.0,
    peak_db: Annotated[float, real("DB", "Peak of the loudest sample, dB re full scale.", "--peak")] = -1.0,
    trim_db: Annotated[float, real("DB", "A sample ends this far below its peak, dB.", "--trim")] = 110.0,
    rate: Annotated[int, integer("HZ", "Sample rate of a sampler in Hz.", "--rate")] = 48_000,
    fill: Annotated[
        bool, typer.Option(help="Sample additional keys, so that no key between the chosen ones is silent.")
    ] = True,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Export an instrument as a sampler, as a Faust program, or as modes for other engines."""
    from ..analysis.note_names import parse_keys
    from ..export import SAMPLERS, ExportOptions, export_sampler
    from ..export.faust import write_faust
    from ..export.layers import fill_gaps
    from ..export.modal_json import write_modal_json
    from ..instrument import load_instrument

    _check_target(to, out, _given(ctx, (*ExportOptions._fields, "fill")), force)
    chosen, loaded = parse_keys(keys), load_instrument(built, prefix, even)
    with progress_bar() as bar:
        if to == "faust":
            summary = write_faust(out, loaded, chosen, licence=licence, progress=bar)
            words = _faust_summary(summary)
        elif to == "modal-json":
            summary = write_modal_json(out, loaded, chosen, licence=licence, progress=bar)
            words = (
                f"{counted(summary.keys, 'key')}, {_count_guesses(summary.unrecorded)}; "
                f"{counted(summary.modes, 'mode')}, {summary.bytes / 1e6:.1f} MB\n"
            )
        else:
            kind = SAMPLERS[to].kind if kind is None else kind
            wanted = ExportOptions(layers, seconds, rate, kind, blend, resonance, una_corda, peak_db, trim_db)
            sampled = fill_gaps(chosen) if fill else chosen
            summary = export_sampler(loaded, out, sampled, wanted, to=to, licence=licence, force=force, progress=bar)
            words = _sampler_summary(summary, sorted({*sampled} - {*chosen}))
    print_result(summary._asdict(), f"{printable(out)}: {words}", as_json)


def _given(ctx: typer.Context, names: Sequence[str]) -> list[str]:
    """Return those of some arguments that the command line states, with their values."""
    sources = {name: getattr(ctx.get_parameter_source(name), "name", "") for name in names}
    return [f"{name}={ctx.params[name]!r}" for name, source in sources.items() if source == "COMMANDLINE"]


def _check_target(to: str, out: Path, given: list[str], force: bool) -> None:
    """Check the name of the output, and reject sampler options for formats without samples."""
    if to not in ENDINGS:
        if re.fullmatch(r"\.[A-Za-z]\w*", out.suffix):
            raise OutputError(f"{printable(out)}: is called like a file; give --out the name of a folder")
        return
    if given:
        raise ParameterError(f"to={to!r} has no samples; leave out {', '.join(given)}")
    check_target(out, force, ENDINGS[to])


def _sampler_summary(summary: ExportSummary, added: list[int]) -> str:
    from ..export.layers import format_keys

    more = f"{counted(len(added), 'key')} sampled additionally, to fill gaps: {format_keys(added)}\n" if added else ""
    silent = (
        f"{counted(len(summary.silent_keys), 'key')} silent: {format_keys(summary.silent_keys)}; give more --keys\n"
    )
    return (
        f"{counted(summary.keys, 'key')} sampled, {_count_guesses(summary.unrecorded)}; "
        f"{summary.transposed} transposed from them\n"
        f"{more}{silent if summary.silent_keys else ''}"
        f"{counted(summary.samples, 'sample')}, {summary.seconds:.0f} s, {summary.bytes / 1e6:.1f} MB, "
        f"a common gain of {summary.gain_db:+z.1f} dB\n"
    )


def _faust_summary(summary: FaustSummary) -> str:
    knocks = f"knocks at {summary.knock_rate} Hz" if summary.knock_rate else "no knocks"
    return (
        f"{counted(summary.keys, 'key')} with tables, {_count_guesses(summary.unrecorded)}\n"
        f"{summary.modes} resonators for each voice, {counted(summary.omitted_modes, 'mode')} left out, {knocks}, "
        f"{summary.table_entries} numbers, a common gain of {summary.gain_db:+z.1f} dB\n"
    )


def _count_guesses(count: int) -> str:
    return f"{count} of them {'a guess' if count == 1 else 'guesses'} (never recorded)" if count else "all recorded"
