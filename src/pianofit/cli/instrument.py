"""The commands of an instrument: put one together, play it, hand it to a browser."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any

import typer

from ..errors import OutputError
from ..io.files import (
    check_sound_target,
    check_target,
    encode_pcm,
    json_text,
    output_folder,
    printable,
    replace_file,
    write_file,
)
from ..io.number_format import counted
from ..progress import progress_bar
from .options import RATE, Built, Force, Json, Prefix, Sound
from .terminal import print_result

__all__ = ["instrument", "page", "play"]

PAGE = "piano.html"


def instrument(
    fits: Annotated[
        list[Path], typer.Argument(metavar="DIR|FIT.JSON...", help="What pianofit batch wrote, or single fits.")
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="The folder for instrument.json and instrument.html.")],
    prefix: Prefix = None,
    name: Annotated[
        str | None, typer.Option(metavar="NAME", help="What it is called; else the prefix, or the folder.")
    ] = None,
    page: Annotated[bool, typer.Option(help="Write instrument.html.")] = True,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Put the fits of single keys together: one instrument, every key of it, by smooth laws over the keyboard."""
    from ..instrument import build_instrument, find_fits, instrument_name, load_keys
    from ..instrument.page import write_page
    from ..instrument.text import summary

    files, first = find_fits(fits, prefix), fits[0].resolve()
    keys = load_keys(files)
    folder_name = printable(first.name if first.is_dir() else first.parent.name)
    document = build_instrument(keys, name or prefix or instrument_name(files[0]) or folder_name)
    with output_folder(out, force) as folder:
        replace_file(folder / "instrument.json", json_text(document).encode())
        if page:
            write_page(folder / "instrument.html", document)
    print_result(document, f"{summary(document)}\nwritten to {out}\n", as_json)


def play(
    built: Built,
    song: Annotated[Path, typer.Argument(metavar="SONG.MID", help="A standard MIDI file.")],
    out: Sound,
    prefix: Prefix = None,
    rate: Annotated[int, RATE] = 48_000,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Play a MIDI file on a fitted instrument."""
    from ..instrument import load_instrument
    from ..model.program_cache import enable_program_cache
    from ..playback import load_song, render_song

    with progress_bar() as bar:
        check_sound_target(out, force)
        played, notes = load_instrument(built, prefix), load_song(song)
        enable_program_cache()
        start = time.perf_counter()
        found = render_song(played, notes, rate, bar)
        took = time.perf_counter() - start
    write_file(out, encode_pcm(found.samples, rate), force)
    seconds = found.samples.shape[-1] / rate
    done = {
        "file": str(out), "seconds": seconds, "rate": rate, "channels": len(found.samples), "notes": notes.notes,
        "notes_beyond": notes.ignored_notes, "remarks": list(notes.remarks), "strikes": found.strikes,
        "on_moving_strings": found.restrikes, "gain_db": found.gain_db, "limited_db": found.limited_db,
        "peak": float(abs(found.samples).max(initial=0.0)), "computed_in_s": took, "real_time_factor": took / seconds,
    }  # fmt: skip
    print_result(done, _played(out, done), as_json)


def _played(out: Path, done: dict[str, Any]) -> str:
    turned = f", turned down by {-done['gain_db']:.1f} dB" if done["gain_db"] < 0 else ""
    limited = f", peaks limited by up to {done['limited_db']:.1f} dB" if done["limited_db"] > 0 else ""
    before = "".join(f"{remark}\n" for remark in done["remarks"])
    before += f"{counted(done['notes_beyond'], 'note')} beyond A0 to C8 left out\n" if done["notes_beyond"] else ""
    return before + (
        f"{out}: {done['seconds']:.1f} s at {done['rate']} Hz, {counted(done['notes'], 'note')}, "
        f"{done['on_moving_strings']} of them on a string still sounding{turned}{limited}\n"
        f"computed in {done['computed_in_s']:.1f} s, {done['real_time_factor']:.2g} s for each second of sound\n"
    )


def page(
    built: Built,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE.HTML", help=f"The HTML file to write; {PAGE} beside the instrument if not given."),
    ] = None,
    prefix: Prefix = None,
    recordings: Annotated[
        bool,
        typer.Option("--recordings", help="Put the recordings into the page, to switch between them and the keys."),
    ] = False,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Write an instrument to play in a browser: one HTML file that needs no server and no network.

    It has at most 1.5 MB; recordings come on top of that.
    """
    from ..instrument import load_instrument
    from ..web import write_page

    if out is not None:
        if out.suffix.lower() not in (".html", ".htm"):
            raise OutputError(f"{printable(out)}: a page is an HTML file; give --out a name that ends in .html")
        check_target(out, force)
    loaded = load_instrument(built, prefix)
    if out is None:
        out = (built if built.is_dir() else built.parent) / (f"piano-{prefix}.html" if prefix else PAGE)
        check_target(out, force)
    found = write_page(out, loaded, recordings)
    done = {
        "file": str(out), "bytes": out.stat().st_size, "keys": found.keys, "recorded": found.recorded,
        "guesses": {"between": found.between, "beyond": found.beyond},
        "knocks": None if found.knocks is None else {"bits": found.knocks.bits, "rate": found.knocks.rate},
        "layers": found.layers,
    }  # fmt: skip
    print_result(done, _written(done), as_json)


def _written(done: dict[str, Any]) -> str:
    from ..instrument.text import unrecorded_text

    kept = done["knocks"]
    knocks = f"; knocks at {kept['rate']:g} Hz and {kept['bits']} bits" if kept else ""
    knocks += f"; {counted(done['layers'], 'recording')} next to them" if done["layers"] else ""
    return (
        f"{done['file']}: {counted(done['keys'], 'key')}, {done['recorded']} of them recorded; "
        f"{unrecorded_text(**done['guesses'])}{knocks}; {done['bytes'] / 1e6:.2f} MB, open it in a browser\n"
    )
