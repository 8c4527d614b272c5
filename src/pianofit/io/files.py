"""Every file in and out: read whole or refused, written whole or not at all, and the bytes of a sound."""

from __future__ import annotations

import codecs
import contextlib
import errno
import io
import json
import os
import signal
import stat
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from numbers import Integral
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import FitError, OutputError, ParameterError, PianofitError, check_range, check_type
from .number_format import LARGEST, is_number

__all__ = [
    "PEAK_LIMIT",
    "FIT_SCHEMA",
    "LARGEST_FIT",
    "MOST_CHANNELS",
    "DISK_FULL",
    "array_of",
    "check_sound_target",
    "check_target",
    "encode_pcm",
    "encode_wav",
    "require_finite",
    "cleanup_on_interrupt",
    "json_text",
    "limit_peak",
    "load_json",
    "printable",
    "output_folder",
    "read_file",
    "read_text",
    "reference_of",
    "replace_file",
    "is_increasing",
    "short_repr",
    "table_of",
    "write_error",
    "replace_strings",
    "write_file",
]

# Channels of a sound at the most.
# The header of a WAV file holds the rate in 32 bits, and the bytes of a second too.
HIGHEST_RATE = 10_000_000  # Hz
MOST_CHANNELS = 8
# Largest sample of what is written to be heard, full scale = 1: -1 dB leaves room for players that resample.
PEAK_LIMIT = 10 ** (-1 / 20)
# Schema of the fit.json that this version writes.
FIT_SCHEMA = 4
# Of a fit.json, bytes.
LARGEST_FIT = 2**24
# What a system says where there is no room: the disk is full, a quota is used up, a file has all the size it may have.
DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def printable(text: object) -> str:
    """Return `text` with all that a terminal would not print on one line escaped (newlines, controls, stray bytes)."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in str(text))


def path_name(path: str | os.PathLike[str]) -> str:
    """A path on one line, as messages show it; a `ParameterError` for what is no path."""
    check_type("path=", path, str | os.PathLike, "a path: a text or a pathlib.Path")
    return printable(os.fspath(path))


def read_file(path: str | os.PathLike[str], limit: int, error: type[PianofitError]) -> bytes:
    """Return the bytes of a regular file of 1 to `limit` bytes; anything else raises `error` without blocking."""
    name = path_name(path)
    try:
        status = Path(path).stat()
        if stat.S_ISDIR(status.st_mode):
            raise error(f"{name}: is a folder; name a file in it")
        if not stat.S_ISREG(status.st_mode):  # a pipe or a device could block for ever, or never end
            raise error(f"{name}: is a pipe or a device; copy its content to a file first")
        if status.st_size > limit:
            raise error(f"{name}: has {status.st_size / 2**20:.1f} MiB, more than {limit / 2**20:g} MiB; shorten it")
        data = Path(path).read_bytes()
    except FileNotFoundError:
        raise error(f"{name}: no such file; check the path") from None
    except (OSError, ValueError) as problem:  # ValueError: a zero byte in the path
        reason = getattr(problem, "strerror", None) or str(problem)
        raise error(f"{name}: cannot be read ({printable(reason)}); check it") from None
    if not data:
        raise error(f"{name}: is empty (0 bytes); check what wrote it")
    return data


def read_text(path: str | os.PathLike[str], limit: int, error: type[PianofitError]) -> str:
    """`read_file` of UTF-8 text; a byte that is none raises `error`, naming its line."""
    data = read_file(path, limit, error)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as problem:
        line = data.count(b"\n", 0, problem.start) + 1
        wrong = f"byte 0x{data[problem.start]:02x} on line {line} is not UTF-8"
        wrong = "is UTF-16 text" if data[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE) else wrong
        raise error(f"{printable(path)}: {wrong}; save it as UTF-8") from None


def load_json(
    path: str | os.PathLike[str], most: int, kind: str, hint: str, error: type[PianofitError] = FitError
) -> Any:
    """What a file of at most `most` bytes holds, or an `error` that names the file, `kind` and the `way_out`."""
    try:
        return json.loads(read_file(path, most, error).decode("utf-8"))
    except (ValueError, RecursionError) as problem:
        reason = printable(str(problem).splitlines()[0])
        raise error(f"{printable(path)}: not {kind} ({reason}); {hint}") from None


def table_of(document: dict, key: str, where: str, hint: str) -> dict[str, Any]:
    """The table `key` of a document, or a `FitError`."""
    table = document.get(key)
    if not isinstance(table, dict):
        raise FitError(f"{where}: {key} is missing or no table; {hint}")
    return table


def reference_of(rows: Any) -> tuple[int, dict[str, Any]]:
    """Place and row of the reference, whose v_H0 the fit has: the one marked so, or the first; empty without any."""
    found = [(at, row) for at, row in enumerate(rows if isinstance(rows, list) else ()) if isinstance(row, dict)]
    return next((one for one in found if one[1].get("first") is True), found[0] if found else (0, {}))


def require_finite(value: Any, where: str, hint: str) -> float:
    """A number that can be computed with, or a `FitError`."""
    if not is_number(value):
        raise FitError(f"{where} is {short_repr(value)}, no finite number; {hint}")
    return float(value)


def array_of(value: Any, *shape: int | None) -> np.ndarray:
    """Lists of numbers that can be computed with, as an array of that shape, None for any length; empty, if not so."""
    with contextlib.suppress(ValueError):  # rows of different lengths
        array = np.array(value)
        fits = array.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, array.shape, strict=True))
        if fits and array.dtype.kind in "iuf" and (np.abs(array) <= LARGEST).all():
            return array.astype(float)
    return np.empty((0,) * len(shape))


def is_increasing(values: np.ndarray) -> bool:
    """Whether there are values, and they rise from above 0."""
    return bool((np.diff(values, prepend=0.0) > 0).all()) and len(values) > 0


def replace_strings(value: Any, names: Mapping[str, str]) -> Any:
    """A document in all whose texts one name stands for another: a path for another path, or a name for a path."""
    if isinstance(value, dict):
        return {key: replace_strings(entry, names) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [replace_strings(entry, names) for entry in value]
    if isinstance(value, str):
        for old, new in names.items():
            value = value.replace(old, new)
    return value


def short_repr(value: Any) -> str:
    """A value as an error shows it: not the whole of a hostile one."""
    text = printable(repr(value))
    return text if len(text) <= 60 else text[:57] + "..."


def replace_file(path: str | os.PathLike[str], content: bytes) -> None:
    """Write `content` to `path`, replacing what was there in one step, or raise an `OutputError`; nothing is left."""
    target = Path(path)
    temporary = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    try:
        try:
            temporary.write_bytes(content)
            temporary.replace(target)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise write_error(target, error, "choose a folder that exists and is yours") from error


def write_error(path: str | os.PathLike[str], error: OSError, hint: str) -> OutputError:
    """What to tell of a file or folder that the system did not let be written: to make room, or else the `way_out`."""
    hint = "make room, and run the same command again" if error.errno in DISK_FULL else hint
    return OutputError(f"{printable(path)}: cannot be written ({printable(error.strerror or error)}); {hint}")


@contextlib.contextmanager
def output_folder(path: Path, force: bool) -> Iterator[Path]:
    """A folder to write to, made if need be; taken away again if nothing came of it.

    An `OutputError` if it cannot be made, is a file, or holds something and `force` is not given.
    """
    name = printable(path)
    try:
        made = [p for p in (path, *path.parents) if not p.exists()]
        path.mkdir(parents=True, exist_ok=True)
        held = next(path.iterdir(), None)
        if held is not None and not force:
            raise OutputError(
                f"{name}: the folder is not empty; give another --out, or --force to replace a result in it"
            )
        if not os.access(path, os.W_OK | os.X_OK):
            raise OutputError(f"{name}: the folder cannot be written to; choose one that is yours")
    except OSError as error:
        raise OutputError(f"{name}: no folder can be made here ({error.strerror}); choose another --out") from None

    def cleanup() -> None:
        for unfinished in path.glob(f".*.{os.getpid()}.tmp"):
            unfinished.unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # only empty folders go
            for folder in made:
                folder.rmdir()

    with cleanup_on_interrupt(cleanup):
        try:
            yield path
        finally:
            cleanup()


@contextlib.contextmanager
def cleanup_on_interrupt(tidy: Callable[[], None]) -> Iterator[None]:
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
    """Refuse a file that could not be written, before anything is computed for it: by an `OutputError`.

    It exists and `force` is not given, is a folder, or has no folder to be in.
    """
    if path.is_dir():
        raise OutputError(f"{printable(path)}: is a folder; give a file name")
    if path.exists() and not force:
        raise OutputError(f"{printable(path)}: exists; give another --out, or --force to replace it")
    if not path.parent.is_dir():
        raise OutputError(
            f"{printable(path)}: there is no folder {printable(path.parent)}; make it, or give another --out"
        )


def check_sound_target(path: Path, force: bool) -> None:
    """`check_target` of a sound, whose name must end in .wav."""
    if path.suffix.lower() != ".wav":
        raise OutputError(f"{printable(path)}: sounds are written as WAV files; give --out a name that ends in .wav")
    check_target(path, force)


def write_file(path: Path, content: bytes, force: bool) -> None:
    """Write one file, whole or not at all, if `check_target` lets it."""
    check_target(path, force)
    replace_file(path, content)


def json_text(document: dict) -> str:
    """`document` as JSON that any reader takes: no NaN, no infinity."""
    return json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def encode_wav(samples: np.ndarray, rate: int) -> bytes:
    """A WAV file of 32 bit floats: nothing is rounded, and a level above full scale survives.

    Not by libsndfile, which puts the time of day into such files: the same sound is the same bytes.

    Parameters
    ----------
    samples : [samples] or [channels, samples], ±1 = full scale.
    rate : Hz.

    Returns
    -------
    The file's bytes.

    Raises
    ------
    ParameterError
        Where `samples` are not floats, or are no rows of them, a channel each, and for a rate that no WAV file has.

    Examples
    --------
    >>> import numpy as np, pianofit
    >>> len(pianofit.encode_wav(np.zeros(44_100), 44_100))
    176458
    """
    from scipy.io import wavfile

    check_type("rate=", rate, Integral, "a whole number of Hz, such as 44100")
    check_range("rate=", rate, 1, HIGHEST_RATE, " Hz")
    samples = np.asarray(samples)
    rows = np.atleast_2d(samples)
    if not 1 <= samples.ndim <= 2 or len(rows) > MOST_CHANNELS or not np.issubdtype(samples.dtype, np.floating):
        raise ParameterError(
            f"samples of shape {samples.shape} and type {samples.dtype} must be floats [samples] or [channels, "
            f"samples] of at most {MOST_CHANNELS} channels; transpose them, divide integers by their full scale"
        )
    stream = io.BytesIO()
    wavfile.write(stream, rate, samples.T.astype(np.float32))
    return stream.getvalue()


def encode_pcm(samples: np.ndarray, rate: int, kind: str = "wav", bits: int = 24) -> bytes:
    """A WAV or FLAC file of whole numbers of so many bits: of them, or of floats within ±1 [channels, samples]."""
    import soundfile

    stream = io.BytesIO()
    soundfile.write(stream, samples.T, rate, format=kind.upper(), subtype=f"PCM_{bits}")
    return stream.getvalue()


def limit_peak(samples: np.ndarray) -> tuple[np.ndarray, float]:
    """A sound whose peak is `CEILING` at the most, and the gain that took."""
    peak = float(np.abs(samples).max(initial=0.0))
    gain = PEAK_LIMIT / peak if peak > PEAK_LIMIT else 1.0
    return samples * gain, gain
