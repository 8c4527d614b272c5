"""A fit as a folder: `fit.json`, what it sounds like, and the page."""

from __future__ import annotations

from pathlib import Path

from ..io import encode_wav, json_text, one_line, output_folder, replace_file
from ..result import Result
from ..ringing_file import KNOCK_FILE, encode_knock
from .build import curves_of
from .page import report_bytes

__all__ = ["save", "write_page"]


def save(result: Result, folder: Path, *, force: bool, page: bool) -> Path:
    """Write the sounds, `fit.json` and the page; of several recordings `fitted-NAME.wav` is each one's own.

    What an earlier fit left stays until what replaces it is there: the page, which takes seconds, is made first.

    Raises `OutputError` if the folder cannot be written, or holds something and `force` is not given; `FitError` if the
    fit was read back, without its recordings.
    """
    _ = result.reference  # refused before anything is written
    with output_folder(folder, force):
        made = report_bytes(result.document, curves_of(result), _title(result)) if page else None
        written = _write_sounds(result, folder)
        replace_file(folder / "fit.json", json_text(result.document).encode())
        if made is not None:
            replace_file(folder / "report.html", made)
            written.add("report.html")
        for old in (folder / "report.html", folder / KNOCK_FILE, *folder.glob("fitted-*.wav")):
            if old.name not in written:
                old.unlink(missing_ok=True)
    return folder


def write_page(result: Result, path: Path, title: str | None, held_out: dict | None) -> Path:
    """Write the page to `path`, or to `report.html` in it.

    Raises `OutputError` if it cannot be written; `FitError` if the fit was read back, without its recordings.
    """
    path = path / "report.html" if path.is_dir() else path
    replace_file(path, report_bytes(result.document, curves_of(result), title or _title(result), held_out))
    return path


def _title(result: Result) -> str:
    """The names of the recordings, and the note if one was given."""
    names = ", ".join(one_line(Path(heard.recording.path).name) for heard in result.recordings)
    return names + (f", {result.analysis.note}" if result.analysis.note else "")


def _write_sounds(result: Result, folder: Path) -> set[str]:
    """What was before and after the fit, in sound; the files' names."""
    rate = result.recording.rate
    files = {
        "initial.wav": encode_wav(result.initial.samples, rate), "fitted.wav": encode_wav(result.reference.sound, rate)
    }  # fmt: skip
    ringing = result.note.ringing
    if ringing is not None and (knock := encode_knock(ringing)):
        files[KNOCK_FILE] = knock
    stems = [Path(heard.recording.path).stem for heard in result.recordings]
    for place, (stem, heard) in enumerate(zip(stems, result.recordings, strict=True), 1):
        if len(stems) > 1:
            name = stem if stems.count(stem) == 1 else f"{stem}-{place}"  # of one name in two folders
            files[f"fitted-{name}.wav"] = encode_wav(heard.sound, heard.recording.rate)
    for name, content in files.items():
        replace_file(folder / name, content)
    return set(files)
