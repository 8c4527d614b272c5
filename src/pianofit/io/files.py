"""Input and output of files. Files are read completely or rejected, and written completely or not at all."""

import codecs
import contextlib
import csv
import errno
import functools
import hashlib
import io
import itertools
import json
import os
import re
import stat
import sys
from collections.abc import Iterator, Mapping, Sequence
from numbers import Integral
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..errors import OutputError, ParameterError, PianofitError, check_range, check_type
from .interrupts import UNFINISHED, cleanup_on_interrupt

# The header of a WAV file has 32 bits for the rate, and 32 for the bytes of a second.
HIGHEST_RATE = 10_000_000  # Hz
# Most bytes that a part of a name takes over from a text, because file systems allow 255 bytes for several such parts.
LONGEST_NAME = 60
# Most bytes of the name of a given file in that of another: file systems allow 255 with what is added before and after.
LONGEST_STEM = 230
# Bytes of file names that are not UTF-8, as Python has them. UTF-8 cannot encode them.
_NOT_UTF8 = re.compile("[\ud800-\udfff]")
MAX_CHANNELS = 8
# Peak of sounds for listening, full scale = 1. -1 dB leaves headroom for players that resample.
PEAK_LIMIT = 10 ** (-1 / 20)
# Errors for lack of space: full disk, exhausted quota, largest file size.
DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_FOLDERS: set[Path] = set()  # that this process holds
# Files of each block of `output_folder` that began with an empty folder, by the identity of the set.
_WRITTEN: dict[int, set[Path]] = {}
_COUNTER = itertools.count()


def printable(text: object) -> str:
    """Return `text` on one line, with newlines, control characters and invalid bytes escaped."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in str(text))


def as_path(path: str | os.PathLike[str]) -> Path:
    """Return a path. Raise a `ParameterError` for a value that is not a path."""
    check_type("path=", path, str | os.PathLike, "a path: a text or a pathlib.Path")
    return Path(path)


def as_paths(name: str, paths: Sequence[str | os.PathLike[str]]) -> list[Path]:
    """Return a list of paths. Raise a `ParameterError` for anything else, such as a single path."""
    check_type(f"{name}=", paths, list | tuple, "a list of paths")
    return [as_path(path) for path in paths]


def path_name(path: str | os.PathLike[str]) -> str:
    """Return a path on one line for messages. Raise a `ParameterError` for a value that is not a path."""
    return printable(as_path(path))


def read_file(path: str | os.PathLike[str], limit: int, error: type[PianofitError]) -> bytes:
    """Return the bytes of a regular file of 1 to `limit` bytes. Anything else raises `error` without blocking."""
    name = path_name(path)
    try:
        status = Path(path).stat()
        if stat.S_ISDIR(status.st_mode):
            raise error(f"{name}: is a folder; name a file in it")
        if not stat.S_ISREG(status.st_mode):  # a pipe or a device could block, or never end
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
    """Read UTF-8 text. An invalid byte raises `error` with its line."""
    data = read_file(path, limit, error)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as problem:
        line = data.count(b"\n", 0, problem.start) + 1
        wrong = f"byte 0x{data[problem.start]:02x} on line {line} is not UTF-8"
        wrong = "is UTF-16 text" if data[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE) else wrong
        raise error(f"{printable(path)}: {wrong}; save it as UTF-8") from None


@functools.cache
def code_digest() -> str:
    """Return the SHA-256 of the code of this package."""
    code = hashlib.sha256()
    for file in sorted(Path(__file__).parents[1].rglob("*.py")):
        code.update(file.read_bytes())
    return code.hexdigest()


def replace_paths(text: str, paths: Mapping[str, str]) -> str:
    """Return a text with other paths, new by old. The longest is replaced first, because a path may begin another."""
    for old in sorted(paths, key=len, reverse=True):
        text = text.replace(old, paths[old])
    return text


def short_repr(value: Any) -> str:
    """Return a value for an error message, with at most 60 characters."""
    text = printable(repr(value))
    return text if len(text) <= 60 else text[:57] + "..."


def replace_file(path: str | os.PathLike[str], content: bytes) -> None:
    """Write `content` to `path` atomically. If that fails, raise an `OutputError` and leave no temporary file."""
    target = Path(path)
    temporary = temporary_path(target)
    UNFINISHED.add(temporary)
    for written in [*_WRITTEN.values()]:
        written.add(target)
    try:
        try:
            temporary.write_bytes(content)
            temporary.replace(target)
        finally:
            temporary.unlink(missing_ok=True)
            UNFINISHED.discard(temporary)
    except OSError as error:
        raise write_error(target, error, "choose a folder that exists and is writable") from error


def temporary_path(target: Path) -> Path:
    """Return a path for the unfinished content of a file or folder. Its name fits where that of the target does."""
    return target.with_name(f".{os.getpid()}-{next(_COUNTER)}.tmp")


def write_error(path: str | os.PathLike[str], error: OSError, hint: str) -> OutputError:
    """Return the error of a failed write. Its hint is to make room if the disk is full, or else `hint`."""
    hint = "make room, and run the same command again" if error.errno in DISK_FULL else hint
    return OutputError(f"{printable(path)}: cannot be written ({printable(error.strerror or error)}); {hint}")


@contextlib.contextmanager
def output_folder(path: Path, force: bool, listing: str = "") -> Iterator[Path]:
    """Create an output folder if needed, hold it, and remove it again if it stays empty.

    If the block fails, its files are removed from a folder that was empty, so that the same command can run again.

    With `force`, the files of an earlier result that its `listing` names, a CSV with the column `file`, are removed at
    the end, except those of the new one.

    Raises `OutputError` if the folder cannot be created, is a file, is not empty and `force` is False, or if another
    process holds it.
    """
    name = printable(path)
    if path.exists() and not path.is_dir():
        raise OutputError(f"{name}: is a file; give a folder as --out")
    try:
        created = [p for p in (path, *path.parents) if not p.exists()]
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{name}: cannot create the folder ({error.strerror}); choose another --out") from None

    written: set[Path] = set()

    def cleanup() -> None:
        inside = [file for file in written if file.is_relative_to(path)]
        for file in inside:
            with contextlib.suppress(OSError):
                file.unlink(missing_ok=True)
        folders = {folder for file in inside for folder in file.parents if folder.is_relative_to(path)} - {path}
        for folder in [*sorted(folders, reverse=True), *created]:
            with contextlib.suppress(OSError):  # rmdir removes only empty folders
                folder.rmdir()

    with cleanup_on_interrupt(cleanup), _held(path):
        try:
            if not os.access(path, os.R_OK | os.W_OK | os.X_OK):
                raise OutputError(f"{name}: the folder is not writable; choose another --out")
            if next(path.iterdir(), None) is None:
                _WRITTEN[id(written)] = written
            elif not force:
                raise OutputError(
                    f"{name}: the folder is not empty; give another, or force=True to replace a result in it"
                )
            earlier = _listed(path, listing)
            yield path
            for stale in earlier - _listed(path, listing):
                stale.unlink(missing_ok=True)
                with contextlib.suppress(OSError):
                    stale.parent.rmdir()
            written.clear()
        finally:
            _WRITTEN.pop(id(written), None)
            cleanup()


def _listed(folder: Path, listing: str) -> set[Path]:
    """Return the files in `folder` that the column `file` of its `listing` names; none without such a list."""
    try:
        with (folder / listing).open(newline="", encoding="utf-8") as text:
            named = [folder / row["file"] for row in csv.DictReader(text) if row["file"]]
    except (OSError, ValueError, KeyError, csv.Error):
        return set()
    inside = folder.resolve()
    return {file for file in named if file.is_file() and file.resolve().is_relative_to(inside)}


@contextlib.contextmanager
def _held(folder: Path) -> Iterator[None]:
    """Hold a folder for this process, if the system can lock folders; it releases them with the process.

    Raises `OutputError` if another process holds it.
    """
    place = folder.resolve()
    if place in _FOLDERS or sys.platform == "win32":
        yield
        return
    import fcntl

    with contextlib.ExitStack() as stack:
        try:
            handle = os.open(place, os.O_RDONLY)
            stack.callback(os.close, handle)
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            busy = f"{printable(folder)}: another command is writing to this folder"
            raise OutputError(f"{busy}; wait for it, or give another --out") from None
        except OSError:  # a file system without locks, or a folder that cannot be read
            pass
        _FOLDERS.add(place)
        stack.callback(_FOLDERS.discard, place)
        yield


@contextlib.contextmanager
def locked(lock: Path, busy: str) -> Iterator[None]:
    """Hold an SQLite lock on an empty file. The system releases it with the process.

    Raises an `OutputError` if the file cannot be locked, with the message `busy` if another process holds it.
    """
    import sqlite3

    try:
        with contextlib.closing(sqlite3.connect(lock, isolation_level=None, timeout=1.0)) as connection:
            connection.execute("BEGIN EXCLUSIVE")
            yield
    except sqlite3.DatabaseError as error:
        message = (
            busy
            if "locked" in str(error)
            else f"{printable(lock)}: cannot be locked ({error}); make room, or remove it"
        )
        raise OutputError(message) from None


def check_target(path: Path, force: bool, *endings: str) -> None:
    """Raise an `OutputError` if a file cannot be written, before its content is computed.

    That is so if its name has none of the `endings`, if it exists and `force` is False, is a folder, or its folder does
    not exist or is not writable.
    """
    check_ending(path, *endings)
    if path.is_dir():
        raise OutputError(f"{printable(path)}: is a folder; give a file name")
    if path.exists() and not force:
        raise OutputError(f"{printable(path)}: exists; give another --out, or --force to replace it")
    if not path.parent.is_dir():
        raise OutputError(
            f"{printable(path)}: the folder {printable(path.parent)} does not exist; create it, or give another --out"
        )
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise OutputError(f"{printable(path)}: the folder {printable(path.parent)} is not writable; give another --out")


def safe_name(text: str) -> str:
    """Return a text as part of a file name that every file system accepts, at most `LONGEST_NAME` bytes."""
    return shortened(re.sub(r"[^\w.]+", "-", text).strip("-."), LONGEST_NAME)


def shortened(text: str, size: int) -> str:
    """Return the first characters of a text, at most `size` bytes in UTF-8."""
    return text.encode()[:size].decode(errors="ignore")


def check_ending(path: str | os.PathLike[str], *endings: str) -> None:
    """Raise an `OutputError` if the name of an output file has none of the `endings`, if there are any."""
    if endings and as_path(path).suffix.lower() not in endings:
        raise OutputError(f"{printable(path)}: give the output a name that ends in {' or '.join(endings)}")


def json_text(document: dict) -> str:
    """Return `document` as standard JSON in UTF-8, without NaN and infinity. Other bytes are as in `printable`."""
    text = json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    return _NOT_UTF8.sub(lambda byte: "\\" + printable(byte[0]), text)


def encode_wav(samples: np.ndarray, rate: int, *, bits: Literal[32, 64] = 32) -> bytes:
    """Encode a WAV file of floats, without clipping above full scale.

    libsndfile is not used, because it writes the current time into such files. Here equal sounds give equal bytes.

    Parameters
    ----------
    samples : [samples] or [channels, samples], ±1 = full scale.
    rate : Hz.
    bits : size of a float. A size of 64 bits needs no rounding.

    Returns
    -------
    The bytes of the file.

    Raises
    ------
    ParameterError
        If `samples` are not floats of a valid shape, or the rate is invalid.

    Examples
    --------
    >>> import numpy as np, pianofit
    >>> len(pianofit.encode_wav(np.zeros(44_100), 44_100))
    176458
    """
    check_type("rate=", rate, Integral, "a whole number of Hz, such as 44100")
    check_range("rate=", rate, 1, HIGHEST_RATE, " Hz")
    if bits not in (32, 64):
        raise ParameterError(f"bits={short_repr(bits)} must be 32 or 64")
    samples = np.asarray(samples)
    rows = np.atleast_2d(samples)
    if not 1 <= samples.ndim <= 2 or len(rows) > MAX_CHANNELS or not np.issubdtype(samples.dtype, np.floating):
        raise ParameterError(
            f"samples of shape {samples.shape} and type {samples.dtype} must be floats [samples] or [channels, "
            f"samples] with at most {MAX_CHANNELS} channels; transpose them, or divide integers by full scale"
        )
    if not rows.size or not (np.abs(samples) <= np.finfo(np.float32).max).all():
        raise ParameterError(f"samples of shape {samples.shape} must be finite as float32, and at least one")
    from scipy.io import wavfile

    stream = io.BytesIO()
    wavfile.write(stream, rate, np.ascontiguousarray(rows.T, f"<f{bits // 8}"))
    return stream.getvalue()


def write_wav(path: str | os.PathLike[str], samples: np.ndarray, rate: int) -> None:
    """Write a WAV file of 32 bit floats atomically; an existing file is replaced.

    Parameters
    ----------
    path : path of the file.
    samples : [samples] or [channels, samples], ±1 = full scale.
    rate : Hz.

    Returns
    -------
    None

    Raises
    ------
    ParameterError
        If `samples` are not finite floats of a valid shape, or the rate is invalid.
    OutputError
        If the file cannot be written, or its name does not end in .wav.

    Examples
    --------
    >>> import numpy as np, pianofit
    >>> pianofit.write_wav("silence.wav", np.zeros(44_100), 44_100)
    """
    check_ending(path, ".wav")
    replace_file(path, encode_wav(samples, rate))


def encode_pcm(samples: np.ndarray, rate: int, kind: str = "wav", bits: int = 24) -> bytes:
    """Encode integers, or floats within ±1, [channels, samples], as a PCM WAV or FLAC file."""
    import soundfile

    stream = io.BytesIO()
    soundfile.write(stream, samples.T, rate, format=kind.upper(), subtype=f"PCM_{bits}")
    return stream.getvalue()


def limit_peak(samples: np.ndarray) -> tuple[np.ndarray, float]:
    """Scale a sound to a peak of at most `PEAK_LIMIT`. Return it and the gain."""
    peak = float(np.abs(samples).max(initial=0.0))
    gain = PEAK_LIMIT / peak if peak > PEAK_LIMIT else 1.0
    return samples * gain, gain
