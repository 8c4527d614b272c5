"""Commands for an instrument: build it, play a MIDI file, write a page to play in a browser."""

import time
from pathlib import Path
from typing import Annotated, Any

import typer

from ..io.files import check_target, encode_pcm, output_folder, printable, replace_file
from ..io.number_format import counted
from ..progress import progress_bar
from . import options
from .options import flag, integer, number_range, parse_as, real, text
from .terminal import print_result

PAGE = "piano.html"


def instrument(
    fits: Annotated[
        list[Path], typer.Argument(metavar="DIR|FIT.JSON...", help="The folder of a batch, or single fits.")
    ],
    out: Annotated[Path, text("DIR", "Folder for instrument.json and instrument.html.")],
    prefix: options.Prefix = None,
    even: options.Even = 0.0,
    name: Annotated[
        str | None, text("NAME", "Name of the instrument.", default="that of --prefix, or of the folder")
    ] = None,
    page: Annotated[bool, typer.Option(help="Write instrument.html.")] = True,
    force: options.Force = False,
    as_json: options.Json = False,
) -> None:
    """Build an instrument from fits of single keys, with smooth keyboard laws for the other keys."""
    from ..instrument import write_instrument
    from ..instrument.files import instrument_of_fits
    from ..instrument.page import write_page
    from ..schema.instrument import INSTRUMENT_FILE

    built = instrument_of_fits(fits, prefix, even, name)
    with output_folder(out, force) as folder:
        record = write_instrument(folder / INSTRUMENT_FILE, built)
        if page:
            write_page(folder / "instrument.html", built)
    print_result(record, f"{built.summary()}\nwritten to {printable(out)}\n", as_json)


def play(
    built: options.Built,
    song: Annotated[Path, typer.Argument(metavar="SONG.MID", help="A standard MIDI file.")],
    out: Annotated[Path, text("FILE", "Sound file to write, .wav or .flac.")],
    prefix: options.Prefix = None,
    even: options.Even = 0.0,
    rate: Annotated[int, options.RATE] = 48_000,
    gain_db: Annotated[float, real("DB", "Gain before the limiter, dB.", "--gain")] = 0.0,
    tempo: Annotated[float, real("FACTOR", "Speed, relative to that of the file.")] = 1.0,
    touch: Annotated[float, real("EXPONENT", "Exponent of the MIDI velocities: below 1 louder, above 1 softer.")] = 1.0,
    pedal_range: Annotated[
        Any,
        text(
            "LOW-HIGH",
            "Half pedal: values of controller 64 at which dampers begin to lift, and are up.",
            parser=parse_as(number_range, "two values of controller 64, such as 24-64"),
        ),
    ] = "24-64",
    resonance: Annotated[
        float, real("AMOUNT", "Sound of strings without a damper that others excite: 0 (none) to 1 (full).")
    ] = 0.3,
    noise: Annotated[bool, flag("--noise-floor", "Add the noise floor of the recordings.")] = False,
    seed: Annotated[int, integer("N", "Seed of the noise floor.")] = 0,
    force: options.Force = False,
    as_json: options.Json = False,
) -> None:
    """Play a MIDI file on a fitted instrument, with all three pedals."""
    from ..instrument import load_instrument
    from ..playback import PedalRange, PlayOptions, load_song, render_song

    with progress_bar() as bar:
        check_target(out, force, ".wav", ".flac")
        loaded, notes = load_instrument(built, prefix, even), load_song(song)
        start = time.perf_counter()
        options = PlayOptions(PedalRange(*pedal_range), resonance, noise, seed, gain_db, tempo, touch)
        rendered = render_song(loaded, notes, rate, bar, options)
        elapsed = time.perf_counter() - start
    replace_file(out, encode_pcm(rendered.samples, rate, out.suffix[1:].lower()))
    seconds = rendered.samples.shape[-1] / rate
    info = {
        "file": str(out),
        "seconds": seconds,
        "rate": rate,
        "channels": len(rendered.samples),
        "notes": notes.notes,
        "notes_beyond": notes.ignored_notes,
        "remarks": list(notes.remarks),
        "strikes": rendered.strikes,
        "on_moving_strings": rendered.restrikes,
        "gain_db": rendered.gain_db,
        "limited_db": rendered.limited_db,
        "peak": float(abs(rendered.samples).max(initial=0.0)),
        "computed_in_s": elapsed,
        "real_time_factor": elapsed / seconds,
    }
    print_result(info, _play_summary(out, info), as_json)


def _play_summary(out: Path, info: dict[str, Any]) -> str:
    attenuated = f", attenuated by {-info['gain_db']:.1f} dB" if info["gain_db"] < 0 else ""
    limited = f", peaks limited by up to {info['limited_db']:.1f} dB" if info["limited_db"] > 0 else ""
    remarks = "".join(f"{remark}\n" for remark in info["remarks"])
    remarks += f"{counted(info['notes_beyond'], 'note')} beyond A0 to C8 left out\n" if info["notes_beyond"] else ""
    return remarks + (
        f"{printable(out)}: {info['seconds']:.1f} s at {info['rate']} Hz, {counted(info['notes'], 'note')}, "
        f"{info['on_moving_strings']} of them on a string still sounding{attenuated}{limited}\n"
        f"computed in {info['computed_in_s']:.1f} s, {info['real_time_factor']:.2g} s for each second of sound\n"
    )


def page(
    built: options.Built,
    out: Annotated[
        Path | None, text("FILE.HTML", "HTML file to write.", default=f"{PAGE} next to the instrument")
    ] = None,
    prefix: options.Prefix = None,
    even: options.Even = 0.0,
    recordings: Annotated[
        bool, flag("--recordings", "Include the recordings in the page, to compare them with the keys.")
    ] = False,
    force: options.Force = False,
    as_json: options.Json = False,
) -> None:
    """Write an instrument to play in a browser: one HTML file that needs no server and no network.

    The file has at most 1.5 MB. Recordings add to that.
    """
    from ..instrument import load_instrument
    from ..web import write_playable_page

    if out is not None:
        check_target(out, force, ".html", ".htm")
    loaded = load_instrument(built, prefix, even)
    if out is None:
        out = (built if built.is_dir() else built.parent) / (f"piano-{prefix}.html" if prefix else PAGE)
        check_target(out, force)
    written = write_playable_page(out, loaded, recordings)
    info = {
        "file": str(out),
        "bytes": out.stat().st_size,
        "keys": len(loaded.keys),
        "recorded": len(loaded.recorded),
        "guesses": dict(zip(("between", "beyond"), loaded.unrecorded_counts, strict=True)),
        "knock_error_db": written.knock_error_db,
        "layers": written.layers,
    }
    print_result(info, _page_summary(info, loaded.guesses), as_json)


def _page_summary(info: dict[str, Any], guesses: str) -> str:
    error = info["knock_error_db"]
    knocks = "" if error is None else f"; knocks within {error:.0f} dB of their notes"
    knocks += f"; {counted(info['layers'], 'recording')} next to them" if info["layers"] else ""
    return (
        f"{printable(info['file'])}: {counted(info['keys'], 'key')}, {info['recorded']} of them recorded; "
        f"{guesses}{knocks}; {info['bytes'] / 1e6:.2f} MB, open it in a browser\n"
    )
