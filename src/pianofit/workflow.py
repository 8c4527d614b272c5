"""Predictions and the demonstration as the command line runs them: files in, files out."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from .errors import AnalysisError, FitError, WrongNoteError
from .io import check_sound_target, encode_wav, json_text, one_line, replace_file, write_file

if TYPE_CHECKING:
    from .model.note import Note
    from .recording import Recording
    from .result import Result
    from .setup import Setup

__all__ = ["cross_validate_files", "predict_file", "run_demo"]


def predict_file(fit: Path, file: Path, out: Path | None, *, channel: str = "average", force: bool = False) -> dict:
    """Predict a recording from a `fit.json`, write the sound if asked to, and return what came of it.

    Raises `PianofitError` for any input that cannot be used; nothing is then written.
    """
    from .fit_file import fit_path, gains_of, mixture_of, read_fit
    from .recording import load_recording

    if out is not None:
        check_sound_target(out, force)
    fit = fit_path(fit)
    document = read_fit(fit)
    mixture, gains = mixture_of(document, fit), gains_of(document)
    note = mixture[0][1]
    recording = load_recording(file, channel=channel)
    from .analysis import analyse
    from .model.cache import keep_programs
    from .result.align import touched
    from .result.predict import predict_recording

    keep_programs()
    try:
        analysis = analyse(recording, f0=note.string.c / (2 * note.geometry.length))
    except WrongNoteError:
        raise FitError(_other_key(recording, note, fit)) from None
    found = predict_recording(mixture, analysis, gains=gains)
    if out is not None:
        strike = found.note.strike(recording.rate)
        touch = touched(found.note, strike, recording)
        samples = found.note.heard(strike, recording.rate, len(recording.samples), touch)
        write_file(out, encode_wav(samples, recording.rate), force)
    rows = document.get("recordings")
    known = {row.get("sha256") for row in rows if isinstance(row, dict)} if isinstance(rows, list) else set()
    return {
        "file": recording.path, "sha256": recording.sha256, "was_fitted": recording.sha256 in known,
        "predicted_db": found.error_db, "partials": found.partials, "v_H0": found.velocity, "v_H0_at_end": found.at_end,
        "gain_db": found.gain_db, "cents": found.cents,
    }  # fmt: skip


def _other_key(recording: Recording, note: Note, fit: Path) -> str:
    """Says that a recording is not of the key that was fitted, and what it sounds like."""
    from .analysis import analyse, hz_to_note

    f0 = note.string.c / (2 * note.geometry.length)
    like = ""
    with contextlib.suppress(AnalysisError):
        found = analyse(recording).f0
        like = f" and sounds like {hz_to_note(found)} ({found:.1f} Hz)"
    return (
        f"{recording.path}: is not of the key of {one_line(fit)}, {hz_to_note(f0)} ({f0:.1f} Hz),{like}; give a "
        "recording of the same key"
    ).replace(",;", ";")


def cross_validate_files(
    files: Sequence[Path],
    out: Path | None,
    known: Setup,
    *,
    note: str | None = None,
    f0: float | None = None,
    channel: str = "average",
    seed: int = 0,
    progress: Callable[[str, float], None] = lambda *_: None,
) -> dict:
    """Leave out each recording of a key in turn, and predict it; see `crossval.cross_validate`.

    To the folder `out`, if there is one, go the fit of all and its page, with what came of it.

    Raises `PianofitError` for any input that cannot be used.
    """
    from .fitting import listen
    from .sources import read

    recordings = read(files, channel)
    analyses = listen(recordings, note, f0)
    from .model.cache import keep_programs
    from .result.crossval import cross_validate

    keep_programs()
    found, whole = cross_validate(recordings, analyses, known, seed=seed, progress=progress)
    if out is not None:
        whole.save(out, force=True, page=False)
        whole.report(out, held_out=found)
        replace_file(out / "crossval.json", json_text(found).encode())
    return found


def run_demo(
    folder: Path, noise_db: float | None, seed: int, progress: Callable[[str, float], None]
) -> tuple[Result, dict[str, float]]:
    """Make a measurement, fit it as any other, and return the result and the true values behind it.

    `twin.wav` and `setup.toml` are written to `folder`, and fitted there.
    """
    from .fitting import fit
    from .model.cache import keep_programs
    from .paper.laboratory import make_twin, setup_text

    keep_programs()
    progress("making the twin", 0.0)
    twin = make_twin(noise_db, seed)
    replace_file(folder / "twin.wav", encode_wav(twin.samples, twin.rate))
    replace_file(folder / "setup.toml", setup_text().encode())
    result = fit(folder / "twin.wav", setup=folder / "setup.toml", seed=seed, progress=progress)
    progress("page", 0.95)
    result.save(folder, force=True)
    return result, twin.true
