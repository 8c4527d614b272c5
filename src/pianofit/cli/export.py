"""Command that exports an instrument to other programs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..errors import OutputError, ParameterError
from ..io.files import check_target, printable
from ..io.number_format import counted
from ..progress import progress_bar
from .options import Built, Even, Force, Json, Prefix, integer, real, text
from .terminal import print_result

if TYPE_CHECKING:
    from ..export import ExportSummary
    from ..export.faust import FaustSummary

# Options whose names differ from those of `ExportOptions`.
OPTION_NAMES = {
    "layers": "--velocity-layers",
    "kind": "--samples",
    "blend": "--velocity-blend",
    "una_corda": "--una-corda",
    "peak_db": "--peak",
    "trim_db": "--trim",
}
# Formats that are one file, and the ending of its name.
ENDINGS = {"faust": ".dsp", "modal-json": ".json"}


def export(
    built: Built,
    out: Annotated[Path, text("DIR|FILE", "Folder of a sampler, or file: .dsp for Faust, .json for modal-json.")],
    prefix: Prefix = None,
    even: Even = 0.0,
    to: Annotated[str, text("FORMAT", "Format: sfz, decent-sampler, faust or modal-json.", "--format")] = "sfz",
    keys: Annotated[
        str, text("KEYS", "Sampled keys: A0-C8, or C2,E2,G2, or 'every 3' (semitones). Others are transposed.")
    ] = "every 3",
    licence: Annotated[str | None, text("WORDS", "Licence of the recordings, for the exported files.")] = None,
    velocity_layers: Annotated[int | None, integer("N", "Velocity layers of a sampler; default 8.")] = None,
    velocity_blend: Annotated[
        str | None, text("curves|xfade|plain", "How neighbouring layers meet over velocity; default curves.")
    ] = None,
    resonance: Annotated[
        bool | None, typer.Option(help="Sample the free strings under the right pedal; default yes.")
    ] = None,
    una_corda: Annotated[
        bool | None, typer.Option("--una-corda", help="Sample the left pedal too, which doubles the samples.")
    ] = None,
    samples: Annotated[str | None, text("flac|wav", "Format of the samples, 24 bit. Default: by --format.")] = None,
    seconds: Annotated[float | None, real("S", "Longest sample in seconds; default 8.")] = None,
    peak: Annotated[float | None, real("DB", "Peak of the loudest sample, dB re full scale; default -1.")] = None,
    trim: Annotated[float | None, real("DB", "A sample ends this far below its peak, dB; default 110.")] = None,
    rate: Annotated[int | None, integer("HZ", "Sample rate of a sampler in Hz; default 48000.", "--rate")] = None,
    fill: Annotated[
        bool, typer.Option(help="Sample additional keys, so that no key between the chosen ones is silent.")
    ] = True,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Export an instrument as a sampler, as a Faust program, or as modes for other engines."""
    from ..export import SAMPLERS, ExportOptions, export_sampler, parse_keys
    from ..export.faust import write_faust
    from ..export.layers import fill_gaps
    from ..export.modal_json import write_modal_json
    from ..instrument import load_instrument
    from ..model.program_cache import enable_program_cache

    options = {"layers": velocity_layers, "seconds": seconds, "rate": rate, "kind": samples}
    options |= {"peak_db": peak, "trim_db": trim}
    options |= {"blend": velocity_blend, "resonance": resonance, "una_corda": una_corda}
    given = {name: value for name, value in options.items() if value is not None}
    if to not in (*SAMPLERS, *ENDINGS):
        raise ParameterError(f"--format {to!r} must be one of {', '.join([*SAMPLERS, *ENDINGS])}")
    _check_target(to, out, given if fill else given | {"no-fill": True}, force)
    chosen, loaded = parse_keys(keys), load_instrument(built, prefix, even)
    enable_program_cache()
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
            wanted, sampled = (
                ExportOptions(kind=SAMPLERS[to].kind)._replace(**given),
                fill_gaps(chosen) if fill else chosen,
            )
            summary = export_sampler(loaded, out, sampled, wanted, to=to, licence=licence, force=force, progress=bar)
            words = _sampler_summary(summary, sorted({*sampled} - {*chosen}))
    print_result(summary._asdict(), f"{out}: {words}", as_json)


def _check_target(to: str, out: Path, given: dict[str, Any], force: bool) -> None:
    """Check the name of the output, and reject sampler options for formats without samples."""
    name, ending = printable(out), ENDINGS.get(to)
    if ending is None:
        if re.fullmatch(r"\.[A-Za-z]\w*", out.suffix):
            raise OutputError(f"{name}: is called like a file; give --out the name of a folder")
        return
    if given:
        options = (OPTION_NAMES.get(name, f"--{name}") for name in given)
        raise ParameterError(f"--format {to} has no samples; leave out {', '.join(options)}")
    if out.suffix.lower() != ending:
        raise OutputError(f"{name}: --format {to} writes a file; give --out a name that ends in {ending}")
    check_target(out, force)


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
        f"a common gain of {summary.gain_db:+.1f} dB\n"
    )


def _faust_summary(summary: FaustSummary) -> str:
    knocks = f"knocks at {summary.knock_rate} Hz" if summary.knock_rate else "no knocks"
    return (
        f"{counted(summary.keys, 'key')} with tables, {_count_guesses(summary.unrecorded)}\n"
        f"{summary.modes} resonators for each voice, {counted(summary.omitted_modes, 'mode')} left out, {knocks}, "
        f"{summary.table_entries} numbers, a common gain of {summary.gain_db:+.1f} dB\n"
    )


def _count_guesses(count: int) -> str:
    return f"{count} of them {'a guess' if count == 1 else 'guesses'} (never recorded)" if count else "all recorded"
