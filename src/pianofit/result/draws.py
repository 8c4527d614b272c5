"""The posterior's draws: by name, with the likelihood of every observation, and as the file beside `fit.json`.

The file is a NumPy archive that is not compressed. It is read without NumPy's own reader, which would run a header
through Python's parser and make an array of any size that a header claims.
"""

from __future__ import annotations

import hashlib
import io
import math
import re
import struct
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import FitError
from ..inference.intervals import Observations
from ..io.files import printable, read_file
from ..io.table_output import require_optional

__all__ = ["DRAWS_FILE", "Draws", "encode_draws", "read_draws"]

DRAWS_FILE = "draws.npz"
# Bytes of the file, and arrays in it, at the most: 2000 draws of 16,000 observations, and more names than a fit has.
LARGEST_DRAWS, MOST_ARRAYS = 2**28, 4096
WAY_OUT = "delete it to read the fit without its draws, or fit again"
# The header of an array as NumPy writes it, of the two kinds of numbers that are stored.
HEADER = re.compile(rb"\{'descr': '(<f8|<i8)', 'fortran_order': False, 'shape': \(([\d, ]*)\), \} *\n")
# What the standard library's reader of archives raises for a broken one.
BROKEN = (
    EOFError, KeyError, NotImplementedError, OSError, OverflowError, RuntimeError, ValueError, struct.error,
    zipfile.BadZipFile,
)  # fmt: skip
MAGIC = b"\x93NUMPY\x01\x00"


@dataclass(frozen=True, eq=False, repr=False)
class Draws(Mapping[str, np.ndarray]):
    """Draws of the posterior [chains, draws] by name: a mapping, in SI units.

    Names are those of the parameters that were searched, `v_H0 N` for the velocity of stroke N, and those of the
    invariants that vary.
    """

    entries: dict[str, np.ndarray]  # [chains, draws] each
    invariants: tuple[str, ...] = ()  # names of `entries` that are no parameters
    # Log density of each observation given all others, by kind: [chains, draws, observations] each.
    log_likelihood: dict[str, np.ndarray] = field(default_factory=dict)
    observed: dict[str, Observations] = field(default_factory=dict)

    def __getitem__(self, name: str) -> np.ndarray:
        return self.entries[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.entries)

    def __len__(self) -> int:
        return len(self.entries)

    def __repr__(self) -> str:
        chains, count = next(iter(self.entries.values())).shape if self.entries else (0, 0)
        return f"Draws of {', '.join(self.entries)}: {chains} chains of {count}"

    def to_arviz(self) -> Any:
        """As `Result.to_arviz` gives them.

        Raises
        ------
        OutputError
            If ArviZ is not installed.
        """
        arviz = require_optional("arviz", "draws for ArviZ")
        observed, constant, coords, dims = {}, {}, {}, {}
        for kind, seen in self.observed.items():
            if not len(seen.value):
                continue
            along = f"{kind}_observation"
            coords[along] = np.arange(len(seen.value))
            own = {kind: seen.value, f"{kind}_recording": seen.recording, f"{kind}_partial": seen.partial}
            dims |= {name: [along] for name in own}
            observed[kind] = own.pop(kind)
            constant |= own
        more = {"observed_data": observed, "constant_data": constant, "coords": coords, "dims": dims}
        if observed:
            more["log_likelihood"] = {kind: self.log_likelihood[kind] for kind in observed}
        return arviz.from_dict(posterior=self.entries, **(more if observed else {}))


def encode_draws(draws: Draws) -> bytes:
    """The file's bytes; the same draws are the same bytes."""
    arrays = {f"posterior/{name}": values for name, values in draws.items()}
    arrays |= {f"log_likelihood/{kind}": values for kind, values in draws.log_likelihood.items()}
    for kind, seen in draws.observed.items():
        arrays |= {f"{column}/{kind}": values for column, values in seen._asdict().items()}
    stream = io.BytesIO()
    np.savez(stream, **{name: _plain(values) for name, values in arrays.items()})  # pyright: ignore[reportArgumentType]
    return stream.getvalue()


def _plain(values: np.ndarray) -> np.ndarray:
    values = np.asarray(values)
    return np.ascontiguousarray(values, "<i8" if values.dtype.kind in "iu" else "<f8")


def read_draws(entry: Any, folder: Path, invariants: Mapping[str, Any]) -> Draws | None:
    """The draws in a `folder` by the `entry` of its `fit.json`; None where the fit has none or the file was deleted.

    Raises
    ------
    FitError
        Naming the file, if it is not the one that was saved with this fit, or holds anything else than draws.
    """
    path = folder / DRAWS_FILE  # wherever the document says, no other file is opened
    if not isinstance(entry, dict) or not path.exists():
        return None
    data = read_file(path, LARGEST_DRAWS, FitError)
    if hashlib.sha256(data).hexdigest() != entry.get("sha256"):
        raise FitError(f"{printable(path)}: is not the file that was saved with this fit (SHA-256); {WAY_OUT}")
    try:
        tables = _tables(data)
        return _draws(tables, invariants)
    except BROKEN as problem:
        reason = printable(problem) or type(problem).__name__
        raise FitError(f"{printable(path)}: holds no draws ({reason}); {WAY_OUT}") from None


def _draws(tables: dict[str, dict[str, np.ndarray]], invariants: Mapping[str, Any]) -> Draws:
    values, seen = tables.pop("posterior", {}), tables.pop("log_likelihood", {})
    shapes = {array.shape for array in values.values()}
    if len(shapes) != 1 or len(shape := shapes.pop()) != 2 or not math.prod(shape):
        raise ValueError("the draws of all parameters must be [chains, draws], as many of each")
    columns = {column: tables.pop(column, {}) for column in Observations._fields}
    if tables or any(column.keys() != seen.keys() for column in columns.values()):
        raise ValueError("every likelihood needs its observations, and nothing else may be there")
    observed = {kind: Observations(**{name: column[kind] for name, column in columns.items()}) for kind in seen}
    for kind, own in observed.items():
        if seen[kind].shape != (*shape, *own.value.shape) or len({(*x.shape, 1)[:2] for x in own}) != 1:
            raise ValueError(f"{kind} must have one likelihood for each draw and observation")
    arrays = [*values.values(), *seen.values(), *(x for own in observed.values() for x in own)]
    if not all(np.isfinite(array).all() for array in arrays):
        raise ValueError("a number is not finite")
    return Draws(values, tuple(name for name in values if name in invariants), seen, observed)


def _tables(data: bytes) -> dict[str, dict[str, np.ndarray]]:
    """Arrays by table and name."""
    tables: dict[str, dict[str, np.ndarray]] = {}
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = archive.infolist()
        stored = all(entry.compress_type == zipfile.ZIP_STORED and not entry.flag_bits & 1 for entry in entries)
        if not stored or len(entries) > MOST_ARRAYS or sum(entry.file_size for entry in entries) > len(data):
            raise ValueError("it is compressed, encrypted or larger than it says")
        for entry in entries:
            table, _, name = entry.filename.removesuffix(".npy").partition("/")
            tables.setdefault(table, {})[name] = _array(archive.read(entry))
    return tables


def _array(content: bytes) -> np.ndarray:
    """An array as NumPy writes it; its header must be to the letter."""
    begin = len(MAGIC) + 2
    end = begin + int.from_bytes(content[len(MAGIC) : begin], "little")
    found = HEADER.fullmatch(content[begin:end])
    if content[: len(MAGIC)] != MAGIC or not found:
        raise ValueError("an array has another header than NumPy writes for whole or real numbers")
    shape = tuple(int(n) for n in found[2].split(b",") if n.strip())
    if 8 * math.prod(shape) != len(content) - end:
        raise ValueError("an array has another size than its header says")
    return np.frombuffer(content, found[1].decode(), offset=end).reshape(shape)
