"""Whole jobs, as the command line runs them: files in, a folder of files out."""

from __future__ import annotations

import contextlib
import json
import math
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from .errors import OutputError, SetupError
from .recording import one_line

if TYPE_CHECKING:
    from .fit import Result
    from .setup_file import Setup

__all__ = ["OUTPUTS", "check_target", "fit_file", "json_text", "output_folder", "write_file"]

OUTPUTS = ("initial.wav", "fitted.wav", "fit.json", "report.html")


@contextlib.contextmanager
def output_folder(path: Path, force: bool) -> Iterator[Path]:
    """A folder to write to, made if need be; taken away again if nothing came of it.

    Raises
    ------
    OutputError
        If it cannot be made, is a file, or holds something and `force` is not given.
    """
    name = one_line(path)
    try:
        made = [p for p in (path, *path.parents) if not p.exists()]
        path.mkdir(parents=True, exist_ok=True)
        held = next(path.iterdir(), None)
        if held is not None and not force:
            raise OutputError(f"{name}: the folder is not empty; give another --out, or --force to replace a fit in it")
        if not os.access(path, os.W_OK | os.X_OK):
            raise OutputError(f"{name}: the folder cannot be written to; choose one that is yours")
    except OSError as error:
        raise OutputError(f"{name}: no folder can be made here ({error.strerror}); choose another --out") from None

    def tidy() -> None:
        for unfinished in path.glob(f".*.{os.getpid()}.tmp"):
            unfinished.unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # only empty folders go
            for folder in made:
                folder.rmdir()

    with _interrupted_by(tidy):
        try:
            yield path
        finally:
            tidy()


@contextlib.contextmanager
def _interrupted_by(tidy: Callable[[], None]) -> Iterator[None]:
    """Ctrl-C tidies up and ends the program at once with 130.

    Raised as an exception it would unwind through the compiler, or end Python while that still works in another thread:
    either takes the process down with a signal of its own.
    """

    def stop(*_: object) -> None:
        tidy()
        shown = "\x1b[?25h" if sys.stderr.isatty() else ""  # a progress bar hides the cursor
        os.write(2, f"{shown}pianofit: interrupted; nothing more is written\n".encode())
        os._exit(130)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def check_target(path: Path, force: bool) -> None:
    """Refuse a file that could not be written, before anything is computed for it.

    Raises
    ------
    OutputError
        If it exists and `force` is not given, is a folder, or has no folder to be in.
    """
    if path.is_dir():
        raise OutputError(f"{one_line(path)}: is a folder; give a file name")
    if path.exists() and not force:
        raise OutputError(f"{one_line(path)}: exists; give another --out, or --force to replace it")
    if not path.parent.is_dir():
        raise OutputError(
            f"{one_line(path)}: there is no folder {one_line(path.parent)}; make it, or give another --out"
        )


def write_file(path: Path, content: bytes, force: bool) -> None:
    """Write one file, whole or not at all.

    Raises
    ------
    OutputError
        If it exists and `force` is not given, or cannot be written.
    """
    from .report.output import replace_file

    check_target(path, force)
    replace_file(path, content)


def json_text(document: dict) -> str:
    """`document` as JSON that any reader takes: no NaN, no infinity."""
    return json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def _check_velocity(velocity: float | None, known: Setup, setup: Path | None) -> None:
    """Refuse a measured velocity that the setup rules out."""
    low, high = known.bounds.get("v_H0", (0.0, math.inf))
    if velocity is not None and not low <= velocity <= high:
        raise SetupError(
            f"{one_line(setup)}: velocity={velocity} m/s lies outside its [bounds] v_H0 = [{low:g}, {high:g}]; "
            "change one of them"
        )


def fit_file(
    file: Path,
    out: Path,
    *,
    note: str | None = None,
    f0: float | None = None,
    setup: Path | None = None,
    velocity: float | None = None,
    channel: str = "average",
    seed: int = 0,
    report: bool = True,
    progress: Callable[[str, float], None] = lambda *_: None,
) -> Result:
    """Fit one recording and write `OUTPUTS` to the folder `out`; `fit.json` and the sounds come before the page.

    Raises
    ------
    PianofitError
        For any input that cannot be used; nothing is then written.
    """
    from .recording import load_recording
    from .setup_file import Setup, load_setup

    known = Setup() if setup is None else load_setup(setup)
    _check_velocity(velocity, known, setup)
    progress("reading", 0.0)
    recording = load_recording(file, channel=channel)
    from .analysis import analyse

    progress("partials", 0.02)
    analysis = analyse(recording, note=note, f0=f0)
    from .fit import fit_recording
    from .model.cache import keep_programs

    keep_programs()
    result = fit_recording(recording, analysis, known, velocity=velocity, seed=seed, progress=progress)
    from .render import encode_wav
    from .report.output import replace_file

    with contextlib.suppress(FileNotFoundError):  # a page of an earlier fit must not stand beside this one
        (out / "report.html").unlink()
    replace_file(out / "initial.wav", encode_wav(result.initial.samples, recording.rate))
    replace_file(out / "fitted.wav", encode_wav(result.fitted.samples, recording.rate))
    replace_file(out / "fit.json", json_text(result.document).encode())
    if report:
        from .report.build import curves_of
        from .report.page import write_report

        progress("page", 0.95)
        name = one_line(file.name)
        write_report(out / "report.html", result.document, curves_of(result), f"{name}, {note}" if note else name)
    progress("done", 1.0)
    return result
