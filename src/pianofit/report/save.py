"""A fit as a folder: `fit.json`, what it sounds like, and the page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..errors import OutputError, PianofitError
from ..io import LARGEST_FIT, encode_wav, json_text, load_json, one_line, output_folder, replace_file
from ..result import Result
from ..ringing_file import KNOCK_FILE, encode_knock
from .build import curves_of
from .page import report_bytes

__all__ = ["save", "stroke_names", "write_page"]


def save(result: Result, folder: Path, *, force: bool, page: bool) -> Path:
    """Write the sounds, `fit.json` and the page; of several recordings `fitted-NAME.wav` is each one's own.

    What an earlier fit left stays until what replaces it is there: the page, which takes seconds, is made first.

    Raises `OutputError` if the folder cannot be written, holds something and `force` is not given, or holds one of the
    recordings under a name that is to be written; `FitError` if the fit was read back, without its recordings.
    """
    earlier = _earlier(folder)
    _check_inputs(result, folder, earlier)
    with output_folder(folder, force):
        made = report_bytes(result.document, curves_of(result), _title(result)) if page else None
        written = _write_sounds(result, folder)
        replace_file(folder / "fit.json", json_text(result.document).encode())
        if made is not None:
            replace_file(folder / "report.html", made)
            written.add("report.html")
        for old in earlier - written:
            (folder / old).unlink(missing_ok=True)
    return folder


def _check_inputs(result: Result, folder: Path, earlier: set[str]) -> None:
    """Refuse to write over one of the recordings, or to delete it with what an earlier fit left."""
    own = {*_sound_names(result), *earlier}
    for heard in result.recordings or (result.reference,):  # a fit that was read back has none, and says so
        path = Path(heard.recording.path)
        if path.name in own and (folder / path.name).resolve() == path.resolve():
            raise OutputError(
                f"{one_line(str(path))} is a recording of this fit and would be replaced; use another folder"
            )


def _earlier(folder: Path) -> set[str]:
    """What an earlier fit may have left there: of recordings' own sounds only those that its `fit.json` names."""
    own = {"report.html", KNOCK_FILE}
    try:
        rows = load_json(folder / "fit.json", LARGEST_FIT, "a fit.json", "")["recordings"]
        return own | {*stroke_names([Path(row["file"]).stem for row in rows])}
    except (PianofitError, KeyError, TypeError):
        return own


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


def stroke_names(stems: Sequence[str]) -> list[str]:
    """The files of the sounds fitted to each of several recordings, by their names; none for a single one."""
    # Some have one name, in two folders.
    names = [stem if stems.count(stem) == 1 else f"{stem}-{place}" for place, stem in enumerate(stems, 1)]
    return [f"fitted-{name}.wav" for name in names] * (len(stems) > 1)


def _sound_names(result: Result) -> list[str]:
    """The sounds that a fit writes, knock apart."""
    stems = [Path(heard.recording.path).stem for heard in result.recordings]
    return ["initial.wav", "fitted.wav", *stroke_names(stems)]


def _write_sounds(result: Result, folder: Path) -> set[str]:
    """What was before and after the fit, in sound; the files' names."""
    rate = result.recording.rate
    files = {
        "initial.wav": encode_wav(result.initial.samples, rate), "fitted.wav": encode_wav(result.reference.sound, rate)
    }  # fmt: skip
    ringing = result.note.ringing
    if ringing is not None and (knock := encode_knock(ringing)):
        files[KNOCK_FILE] = knock
    for name, heard in zip(_sound_names(result)[2:], result.recordings, strict=False):
        files[name] = encode_wav(heard.sound, heard.recording.rate)
    for name, content in files.items():
        replace_file(folder / name, content)
    return set(files)
