"""A fit as a folder: `fit.json`, what it sounds like, and the page."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

from ..errors import FitError, OutputError, PianofitError
from ..io.files import (
    LARGEST_FIT,
    encode_wav,
    json_text,
    load_json,
    output_folder,
    printable,
    read_file,
    replace_file,
)
from ..modal_response_file import KNOCK_FILE, encode_knock
from ..result import Result
from ..result.draws import DRAWS_FILE, encode_draws
from .build import curves_of
from .page import report_bytes

__all__ = ["save", "stroke_names", "write_page"]

# Of a sound that is copied, bytes.
LARGEST_SOUND = 2**30


def save(result: Result, folder: Path, *, force: bool, page: bool) -> Path:
    """Write the sounds, `fit.json`, the draws and the page; of several recordings `fitted-NAME.wav` is each one's own.

    What an earlier fit left stays until what replaces it is there: the page, which takes seconds, is made first.

    Raises `OutputError` if the folder cannot be written, holds something and `force` is not given, or holds one of the
    recordings under a name that is to be written; `FitError` if the fit was read back and a recording is not there.
    """
    earlier = _previous_outputs(folder)
    result = result.with_recordings() if page else result
    _check_inputs(result, folder, earlier)
    with output_folder(folder, force):
        made = report_bytes(result.document, curves_of(result), _title(result)) if page else None
        files = _sounds(result) if result.recordings else _copied(result)
        document = {name: entry for name, entry in result.document.items() if name != "draws"}
        if result.draws is not None:
            files[DRAWS_FILE] = encode_draws(result.draws)
            document["draws"] = {"file": DRAWS_FILE, "sha256": hashlib.sha256(files[DRAWS_FILE]).hexdigest()}
        files["fit.json"] = json_text(document).encode()
        files |= {} if made is None else {"report.html": made}
        for name, content in files.items():
            replace_file(folder / name, content)
        written = {*files}
        for old in earlier - written:
            (folder / old).unlink(missing_ok=True)
    return folder


def _check_inputs(result: Result, folder: Path, earlier: set[str]) -> None:
    """Refuse to write over one of the recordings, or to delete it with what an earlier fit left."""
    own = {*_sound_names(result), *earlier}
    for path in _inputs(result):
        if path.name in own and (folder / path.name).resolve() == path.resolve():
            raise OutputError(
                f"{printable(str(path))} is a recording of this fit and would be replaced; use another folder"
            )


def _previous_outputs(folder: Path) -> set[str]:
    """What an earlier fit may have left there: of recordings' own sounds only those that its `fit.json` names."""
    own = {"report.html", KNOCK_FILE, DRAWS_FILE}
    try:
        rows = load_json(folder / "fit.json", LARGEST_FIT, "a fit.json", "")["recordings"]
        return own | {*stroke_names([Path(row["file"]).stem for row in rows])}
    except (PianofitError, KeyError, TypeError):
        return own


def write_page(result: Result, path: Path, title: str | None, held_out: dict | None) -> Path:
    """Write the page to `path`, or to `report.html` in it.

    Raises `OutputError` if it cannot be written; `FitError` if the fit was read back and a recording is not there.
    """
    result = result.with_recordings()
    path = path / "report.html" if path.is_dir() else path
    replace_file(path, report_bytes(result.document, curves_of(result), title or _title(result), held_out))
    return path


def _title(result: Result) -> str:
    """The names of the recordings, and the note if one was given."""
    names = ", ".join(printable(Path(heard.recording.path).name) for heard in result.recordings)
    return names + (f", {result.analysis.note}" if result.analysis.note else "")


def stroke_names(stems: Sequence[str]) -> list[str]:
    """The files of the sounds fitted to each of several recordings, by their names; none for a single one."""
    # Some have one name, in two folders.
    names = [stem if stems.count(stem) == 1 else f"{stem}-{place}" for place, stem in enumerate(stems, 1)]
    return [f"fitted-{name}.wav" for name in names] * (len(stems) > 1)


def _inputs(result: Result) -> list[Path]:
    """Where the recordings are or were."""
    if result.recordings:
        return [Path(heard.recording.path) for heard in result.recordings]
    return [Path(str(row.get("file"))) for row in result.document["recordings"]]


def _sound_names(result: Result) -> list[str]:
    """The sounds that a fit writes, knock apart."""
    return ["initial.wav", "fitted.wav", *stroke_names([path.stem for path in _inputs(result)])]


def _sounds(result: Result) -> dict[str, bytes]:
    """What was before and after the fit, in sound: files by name."""
    rate = result.recording.rate
    files = {
        "initial.wav": encode_wav(result.initial.samples, rate), "fitted.wav": encode_wav(result.reference.sound, rate)
    }  # fmt: skip
    for name, heard in zip(_sound_names(result)[2:], result.recordings, strict=False):
        files[name] = encode_wav(heard.sound, heard.recording.rate)
    return files | _knock(result)


def _copied(result: Result) -> dict[str, bytes]:
    """The sounds of a fit that was read back, as they are in its folder."""
    folder = result.folder or Path()
    there = [name for name in _sound_names(result) if (folder / name).is_file()]
    return {name: read_file(folder / name, LARGEST_SOUND, FitError) for name in there} | _knock(result)


def _knock(result: Result) -> dict[str, bytes]:
    """The knock's file: as it is in the folder of a fit that was read back, since the document holds its scale."""
    ringing, there = result.note.ringing, result.folder and result.folder / KNOCK_FILE
    if ringing is not None and there and there.is_file():
        return {KNOCK_FILE: read_file(there, LARGEST_SOUND, FitError)}
    return {} if ringing is None or not (knock := encode_knock(ringing)) else {KNOCK_FILE: knock}
