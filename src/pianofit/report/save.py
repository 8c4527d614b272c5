"""Saving a fit to a folder: `fit.json`, its sounds and the page."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import FitError, OutputError, PianofitError
from ..io.files import LONGEST_STEM, encode_wav, output_folder, printable, read_file, replace_file, shortened
from ..result import Result
from ..result.draws import DRAWS_FILE, encode_draws
from ..schema.decode import encode_json
from ..schema.fit import DrawsFile, read_fit
from ..schema.modal_response import KNOCK_FILE, encode_knock
from .page import report_bytes

if TYPE_CHECKING:
    from ..result.cross_validation import CrossValidation

# Largest sound that is copied, bytes.
LARGEST_SOUND = 2**30


def save(result: Result, folder: Path, *, force: bool, page: bool) -> Path:
    """Write the sounds, `fit.json`, the draws and the page.

    Several recordings have a sound `fitted-NAME.wav` each. Files of an earlier fit are replaced only after the page,
    which takes seconds, is complete.

    Raises `OutputError` if the folder cannot be written, is not empty and `force` is not given, or a recording of this
    fit would be replaced. Raises `FitError` if the fit was loaded from a file and a recording is missing.
    """
    earlier = _previous_outputs(folder)
    result = result.with_recordings() if page else result
    _check_inputs(result, folder, earlier)
    with output_folder(folder, force):
        report = report_bytes(result) if page else None
        files = _sounds(result) if result.recordings else _copied(result)
        fit = replace(result.fit, draws=None)
        if result.draws is not None:
            files[DRAWS_FILE] = encode_draws(result.draws)
            fit = replace(fit, draws=DrawsFile(DRAWS_FILE, hashlib.sha256(files[DRAWS_FILE]).hexdigest()))
        files["fit.json"] = encode_json(fit)
        if report is not None:
            files["report.html"] = report
        for name, content in files.items():
            replace_file(folder / name, content)
        for old in earlier - {*files}:
            (folder / old).unlink(missing_ok=True)
    return folder


def _check_inputs(result: Result, folder: Path, earlier: set[str]) -> None:
    """Raise an `OutputError` if a recording would be replaced, or deleted with the files of an earlier fit."""
    affected = {*_sound_names(result), *earlier}
    for path in _inputs(result):
        if path.name in affected and (folder / path.name).resolve() == path.resolve():
            raise OutputError(
                f"{printable(str(path))} is a recording of this fit and would be replaced; use another folder"
            )


def _previous_outputs(folder: Path) -> set[str]:
    """Return the files of an earlier fit. The sounds of recordings are those that its `fit.json` names."""
    names = {"report.html", KNOCK_FILE, DRAWS_FILE}
    try:
        return names | {*stroke_names([Path(own.file).stem for own in read_fit(folder / "fit.json").recordings])}
    except PianofitError:
        return names


def write_page(result: Result, path: Path, title: str | None, held_out: CrossValidation | None) -> Path:
    """Write the page to `path`, or to `report.html` in it if it is a folder.

    Raises `OutputError` if it cannot be written, and `FitError` if the fit was loaded from a file and a recording is
    missing.
    """
    path = path / "report.html" if path.is_dir() else path
    replace_file(path, report_bytes(result, title, held_out))
    return path


def stroke_names(stems: Sequence[str]) -> list[str]:
    """Return the files of the fitted sounds of several recordings, from their names; empty for a single recording."""
    names: list[str] = []
    stems = [shortened(printable(stem), LONGEST_STEM) for stem in stems]
    for place, stem in enumerate(stems, 1):
        # Files in different folders can have the same name. The number must not make the name of another file.
        numbered = (f"{stem}-{number}" for number in itertools.count(place))
        free = (name for name in numbered if name not in (*stems, *names))
        names.append(stem if stems.count(stem) == 1 else next(free))
    return [f"fitted-{name}.wav" for name in names] * (len(stems) > 1)


def _inputs(result: Result) -> list[Path]:
    """Return the paths of the recordings."""
    if result.recordings:
        return [Path(fitted.recording.path) for fitted in result.recordings]
    return [Path(own.file) for own in result.fit.recordings]


def _sound_names(result: Result) -> list[str]:
    """Return the names of the sounds that a fit writes, except the knock."""
    return ["initial.wav", "fitted.wav", *stroke_names([path.stem for path in _inputs(result)])]


def _sounds(result: Result) -> dict[str, bytes]:
    """Return the sounds before and after the fit, by file name."""
    rate = result.recording.rate
    sounds = {"initial.wav": result.initial.samples, "fitted.wav": result.reference.sound}
    files = {name: encode_wav(samples, rate) for name, samples in sounds.items()}
    for name, fitted in zip(_sound_names(result)[2:], result.recordings, strict=False):
        files[name] = encode_wav(fitted.sound, fitted.recording.rate)
    return files | _knock(result)


def _copied(result: Result) -> dict[str, bytes]:
    """Return the sounds of a fit that was loaded from a file, copied from its folder."""
    folder = result.folder or Path()
    existing = [name for name in _sound_names(result) if (folder / name).is_file()]
    return {name: read_file(folder / name, LARGEST_SOUND, FitError) for name in existing} | _knock(result)


def _knock(result: Result) -> dict[str, bytes]:
    """Return the file of the knock, by name.

    It is copied if the fit was loaded from a file, because its scale is in `fit.json`.
    """
    response, path = result.note.modal_response, result.folder and result.folder / KNOCK_FILE
    if response is not None and path and path.is_file():
        return {KNOCK_FILE: read_file(path, LARGEST_SOUND, FitError)}
    return {} if response is None or not (knock := encode_knock(response)) else {KNOCK_FILE: knock}
