"""Posterior draws by name, with the likelihood of every observation, and their file next to `fit.json`.

The file is an uncompressed NumPy archive. NumPy's own reader is not used: it passes headers to Python's parser and
allocates any array size that a header states.
"""

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
from ..felt.law import scale_velocity
from ..inference import InferenceResult, ObservedValues
from ..io.files import printable, read_file
from ..io.table_output import require_optional
from ..schema.fit import DrawsFile, Fit

DRAWS_FILE = "draws.npz"
# Upper limits of the file in bytes and in arrays: 2000 draws of 16,000 observations, and more names than a fit has.
LARGEST_DRAWS, MOST_ARRAYS = 2**28, 4096
_HINT = "delete it to read the fit without its draws, or fit again"
# Array header as NumPy writes it, for the two stored number types.
HEADER = re.compile(rb"\{'descr': '(<f8|<i8)', 'fortran_order': False, 'shape': \(([\d, ]*)\), \} *\n")
# Exceptions that the standard library's zip reader raises for a damaged archive.
BROKEN = (
    EOFError,
    KeyError,
    NotImplementedError,
    OSError,
    OverflowError,
    RuntimeError,
    ValueError,
    struct.error,
    zipfile.BadZipFile,
)
MAGIC = b"\x93NUMPY\x01\x00"


@dataclass(frozen=True, eq=False, repr=False)
class Draws(Mapping[str, np.ndarray]):
    """Posterior draws [chains, draws] by name: a mapping, in SI units.

    Names are those of the searched parameters, `v_H0 N` for the velocity of stroke N, and those of the invariants that
    vary.
    """

    entries: dict[str, np.ndarray]  # [chains, draws] each
    # Log density of each observation given all others, by kind [chains, draws, observations].
    log_likelihood: dict[str, np.ndarray] = field(default_factory=dict)
    observed: dict[str, ObservedValues] = field(default_factory=dict)

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
        """The draws for ArviZ; see `Result.to_arviz`."""
        arviz = require_optional("arviz_base", "draws for ArviZ")
        groups: dict[str, dict[str, np.ndarray]] = {
            # A name in a tree of xarray must not contain a slash.
            "posterior": {name.replace("/", " over "): values for name, values in self.entries.items()}
        }
        coords, dims = {}, {}
        for kind, data in self.observed.items():
            if not len(data.value):
                continue
            columns = {kind: data.value, f"{kind}_recording": data.recording, f"{kind}_partial": data.partial}
            coords[f"{kind}_observation"] = np.arange(len(data.value))
            dims |= {name: [f"{kind}_observation"] for name in columns}
            groups.setdefault("observed_data", {})[kind] = columns.pop(kind)
            groups.setdefault("log_likelihood", {})[kind] = self.log_likelihood[kind]
            groups.setdefault("constant_data", {}).update(columns)
        return arviz.from_dict(groups, coords=coords, dims=dims)


def draws_of(fit: InferenceResult, record: Fit) -> Draws | None:
    """The posterior draws, with those of the invariants that vary; None for a fit without a sampler."""
    view, u = fit.alternative, fit.problem.parametrisation
    if view is None or view.draws is None:
        return None
    draws = view.draws

    def drawn(name: str) -> np.ndarray:
        return np.asarray(draws[name] if name in draws else record.parameters[name].value)

    length, mass = drawn("L"), drawn("M_S")
    table = {"f0": drawn("c") / (2 * length), "B": (drawn("kappa") * np.pi / (drawn("c") * length)) ** 2}
    if u.law.has_contact:
        table |= {"M_H/M_S": drawn("M_H") / mass}
        strokes = {f"v/v_ref {n}": f"v_H0 {n}" for n in range(1, u.strokes + 1)}
        table |= {name: draws[own] / drawn("v_H0") for name, own in strokes.items() if own in draws}
    places = [name for name in (*record.parameters, *draws) if name.partition(" ")[0] in ("x0", "width", "pickup")]
    for name in places:
        of, _, number = name.partition(" ")
        table[f"{of}/L {number}".rstrip()] = drawn(name) / length
    if "F/M_S" in record.invariants:
        # At the reference velocity shown, if a common scale of the velocities is unknown.
        scale = record.parameters["v_H0"].value / drawn("v_H0") if fit.problem.velocity_scale_open else 1.0
        felt = scale_velocity({name: drawn(name) for name in u.law.parameters}, u.law, scale)
        stiffness = felt[(u.law.power or ("",))[0]]
        table["F/M_S"] = stiffness * np.exp(u.law.log_power(u.reference_compression, felt)) / mass
    varying = {name: table[name] for name in record.invariants if name in table and np.ptp(table[name]) > 0}
    return Draws({**draws, **varying}, view.log_likelihood, view.observed)


def encode_draws(draws: Draws) -> bytes:
    """Content of the file; equal draws give equal bytes."""
    arrays = {f"posterior/{name}": values for name, values in draws.items()}
    arrays |= {f"log_likelihood/{kind}": values for kind, values in draws.log_likelihood.items()}
    for kind, data in draws.observed.items():
        arrays |= {f"{column}/{kind}": values for column, values in data._asdict().items()}
    stream = io.BytesIO()
    np.savez(stream, **{name: _little_endian(values) for name, values in arrays.items()})  # pyright: ignore[reportArgumentType]
    return stream.getvalue()


def _little_endian(values: np.ndarray) -> np.ndarray:
    values = np.asarray(values)
    return np.ascontiguousarray(values, "<i8" if values.dtype.kind in "iu" else "<f8")


def read_draws(entry: DrawsFile | None, folder: Path) -> Draws | None:
    """Read the draws in a `folder` that `entry` of its fit describes; None without entry or file.

    Raises `FitError` if the file is not the one that was saved with this fit, or does not hold draws.
    """
    path = folder / DRAWS_FILE  # a fit cannot name another file
    if entry is None or not path.exists():
        return None
    data = read_file(path, LARGEST_DRAWS, FitError)
    if hashlib.sha256(data).hexdigest() != entry.sha256:
        raise FitError(f"{printable(path)}: is not the file that was saved with this fit (SHA-256); {_HINT}")
    try:
        return _draws(_tables(data))
    except BROKEN as problem:
        reason = printable(problem) or type(problem).__name__
        raise FitError(f"{printable(path)}: does not hold draws ({reason}); {_HINT}") from None


def _draws(tables: dict[str, dict[str, np.ndarray]]) -> Draws:
    values, likelihood = tables.pop("posterior", {}), tables.pop("log_likelihood", {})
    shapes = {array.shape for array in values.values()}
    if len(shapes) != 1 or len(shape := shapes.pop()) != 2 or not math.prod(shape):
        raise ValueError("the draws of all parameters must be [chains, draws] of one shape")
    columns = {column: tables.pop(column, {}) for column in ObservedValues._fields}
    if tables or any(column.keys() != likelihood.keys() for column in columns.values()):
        raise ValueError("every likelihood needs its observations, and no other array is allowed")
    observed = {kind: ObservedValues(**{name: column[kind] for name, column in columns.items()}) for kind in likelihood}
    for kind, data in observed.items():
        if likelihood[kind].shape != (*shape, *data.value.shape) or len({(*x.shape, 1)[:2] for x in data}) != 1:
            raise ValueError(f"{kind} must have one likelihood for each draw and observation")
    arrays = [*values.values(), *likelihood.values(), *(x for data in observed.values() for x in data)]
    if not all(np.isfinite(array).all() for array in arrays):
        raise ValueError("a number is not finite")
    return Draws(values, likelihood, observed)


def _tables(data: bytes) -> dict[str, dict[str, np.ndarray]]:
    """Arrays by table and name."""
    tables: dict[str, dict[str, np.ndarray]] = {}
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = archive.infolist()
        stored = all(entry.compress_type == zipfile.ZIP_STORED and not entry.flag_bits & 1 for entry in entries)
        if not stored or len(entries) > MOST_ARRAYS or sum(entry.file_size for entry in entries) > len(data):
            raise ValueError("it is compressed, encrypted or larger than stated")
        for entry in entries:
            table, _, name = entry.filename.removesuffix(".npy").partition("/")
            tables.setdefault(table, {})[name] = _array(archive.read(entry))
    return tables


def _array(content: bytes) -> np.ndarray:
    """Decode an array; its header must be exactly as NumPy writes it."""
    begin = len(MAGIC) + 2
    end = begin + int.from_bytes(content[len(MAGIC) : begin], "little")
    header = HEADER.fullmatch(content[begin:end])
    if content[: len(MAGIC)] != MAGIC or not header:
        raise ValueError("the header of an array is not one of NumPy for float64 or int64")
    shape = tuple(int(n) for n in header[2].split(b",") if n.strip())
    if 8 * math.prod(shape) != len(content) - end:
        raise ValueError("the size of an array differs from its header")
    return np.frombuffer(content, header[1].decode(), offset=end).reshape(shape)
