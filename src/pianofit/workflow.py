"""Whole jobs, as the command line runs them: files in, a folder of files out."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .errors import ParameterError, SetupError
from .io import encode_wav, json_text, one_line, replace_file, write_file

if TYPE_CHECKING:
    from .analysis import Analysis
    from .inference import Result
    from .recording import Recording
    from .setup import Setup

__all__ = ["OUTPUTS", "cross_validate_files", "fit_file", "fit_files", "predict_file"]

OUTPUTS = ("initial.wav", "fitted.wav", "fit.json", "report.html")


def _check_velocity(velocity: float | None, known: Setup, setup: Path | None) -> None:
    """Refuse a measured velocity that the setup rules out."""
    low, high = known.bounds.get("v_H0", (0.0, math.inf))
    if velocity is not None and not low <= velocity <= high:
        raise SetupError(
            f"{one_line(setup)}: velocity={velocity} m/s lies outside its [bounds] v_H0 = [{low:g}, {high:g}]; "
            "change one of them"
        )


def fit_file(file: Path, out: Path, **options: Any) -> Result:
    """`fit_files` of one recording."""
    return fit_files([file], out, **options)


def fit_files(
    files: Sequence[Path],
    out: Path,
    *,
    note: str | None = None,
    f0: float | None = None,
    setup: Path | None = None,
    velocity: float | None = None,
    channel: str = "average",
    felt: str | None = None,
    recipe: str = "default",
    evaluations: int | None = None,
    intervals: str = "laplace",
    seed: int = 0,
    report: bool = True,
    progress: Callable[[str, float], None] = lambda *_: None,
) -> Result:
    """Fit one recording, or several of one key, and write `OUTPUTS` to the folder `out`; the page comes last.

    Of several, `initial.wav` and `fitted.wav` are those of the reference, and `fitted-NAME.wav` is each one's own.

    Raises
    ------
    PianofitError
        For any input that cannot be used; nothing is then written.
    """
    if recipe != "default" or evaluations is not None:
        from .fitting import check_recipe

        check_recipe(recipe, evaluations)
    if intervals != "laplace":
        from .inference.views import check_intervals

        check_intervals(intervals, recipe)
    if len(files) > 1 and velocity is not None:
        raise ParameterError(f"velocity={velocity} m/s is of one take; give each its own in the setup's [[take]]")
    if len(files) > 1 and recipe != "default":
        raise ParameterError(f"recipe={recipe!r} fits one recording; {len(files)} were given")
    recordings, analyses, known = _takes(files, note, f0, setup, channel, felt, velocity, progress)
    from .fitting import fit_recording
    from .inference.fit import fit_takes
    from .model.cache import keep_programs

    keep_programs()
    if len(files) > 1:
        result = fit_takes(recordings, analyses, known, intervals=intervals, seed=seed, progress=progress)
    else:
        result = fit_recording(
            recordings[0], analyses[0], known, velocity=velocity, recipe=recipe, evaluations=evaluations,
            intervals=intervals, seed=seed, progress=progress,
        )  # fmt: skip
    progress("page", 0.95)
    _write(out, files, result, note, report)
    progress("done", 1.0)
    return result


def _takes(
    files: Sequence[Path], note: str | None, f0: float | None, setup: Path | None, channel: str,
    felt: str | None = None, velocity: float | None = None, progress: Callable[[str, float], None] = lambda *_: None,
) -> tuple[list[Recording], list[Analysis], Setup]:  # fmt: skip
    """Recordings and their analyses, and what was known."""
    from .recording import load_recording
    from .setup import Setup, load_setup, with_law

    known = with_law(Setup() if setup is None else load_setup(setup), felt, one_line(setup))
    _check_velocity(velocity, known, setup)
    progress("reading", 0.0)
    recordings = [load_recording(file, channel=channel) for file in files]
    from .analysis import analyse

    progress("partials", 0.02)
    with ThreadPoolExecutor(os.cpu_count()) as threads:
        analyses = list(threads.map(lambda recording: analyse(recording, note=note, f0=f0), recordings))
    return recordings, analyses, known


def _write(
    out: Path, files: Sequence[Path], result: Result, note: str | None, report: bool, held_out: dict | None = None
) -> None:
    """The sounds, `fit.json`, and the page, which comes last."""
    _write_sounds(out, files, result)
    replace_file(out / "fit.json", json_text(result.document).encode())
    if report:
        from .report.build import curves_of
        from .report.page import write_report

        title = ", ".join(one_line(file.name) for file in files) + (f", {note}" if note else "")
        write_report(out / "report.html", result.document, curves_of(result), title, held_out=held_out)


def _write_sounds(out: Path, files: Sequence[Path], result: Result) -> None:
    """What was before and after the fit, in sound; what an earlier fit left of its page and takes goes."""
    for old in (out / "report.html", *out.glob("fitted-*.wav")):
        with contextlib.suppress(FileNotFoundError):
            old.unlink()
    rate = result.recording.rate
    replace_file(out / "initial.wav", encode_wav(result.initial.samples, rate))
    replace_file(out / "fitted.wav", encode_wav(result.fitted.samples, rate))
    if len(files) > 1:
        for file, take in zip(files, result.takes, strict=True):
            content = encode_wav(take.fitted.samples, take.recording.rate)
            replace_file(out / f"fitted-{file.stem}.wav", content)


def predict_file(fit: Path, file: Path, out: Path | None, *, channel: str = "average", force: bool = False) -> dict:
    """Predict a recording from a `fit.json`, write the sound if asked to, and return what came of it.

    Raises
    ------
    PianofitError
        For any input that cannot be used; nothing is then written.
    """
    from .recording import load_recording
    from .render import load_mixture

    mixture = load_mixture(fit)
    note = mixture[0][1]
    recording = load_recording(file, channel=channel)
    from .analysis import analyse
    from .inference.align import touched
    from .inference.predict import predict_take
    from .model.cache import keep_programs

    keep_programs()
    analysis = analyse(recording, f0=note.string.c / (2 * note.geometry.length))
    found = predict_take(mixture, analysis)
    if out is not None:
        strike = found.note.strike(recording.rate)
        touch = touched(found.note, strike, recording)
        samples = found.note.heard(strike, recording.rate, len(recording.samples), touch)
        write_file(out, encode_wav(samples, recording.rate), force)
    return {
        "file": recording.path, "sha256": recording.sha256, "predicted_db": found.error_db,
        "partials": found.partials, "v_H0": found.velocity, "gain_db": found.gain_db, "cents": found.cents,
    }  # fmt: skip


def cross_validate_files(
    files: Sequence[Path],
    out: Path | None = None,
    *,
    note: str | None = None,
    f0: float | None = None,
    setup: Path | None = None,
    channel: str = "average",
    felt: str | None = None,
    seed: int = 0,
    progress: Callable[[str, float], None] = lambda *_: None,
) -> dict:
    """Leave out each recording of a key in turn, and predict it; see `predict.cross_validate`.

    To the folder `out`, if there is one, go the fit of all and its page, with what came of it.

    Raises
    ------
    PianofitError
        For any input that cannot be used.
    """
    recordings, analyses, known = _takes(files, note, f0, setup, channel, felt)
    from .inference.predict import cross_validate
    from .model.cache import keep_programs

    keep_programs()
    found, whole = cross_validate(recordings, analyses, known, seed=seed, progress=progress)
    if out is not None:
        _write(out, files, whole, note, True, found)

        replace_file(out / "crossval.json", json_text(found).encode())
    return found
