"""Values that the user gives: sizes, fixed and initial values, bounds and recordings.

A mistyped length must not silently become an assumed one. `Setup` therefore checks every table, key, type, range and
contradiction. Its errors name the key as a `setup.toml` has it, the value, and what to do. A setup comes from Python, a
dict or a `setup.toml`. All values are in SI units, so a length in centimetres or a mass in grams is out of range.
"""

from __future__ import annotations

import difflib
import os
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from numbers import Real
from pathlib import Path
from typing import Any

from ..conversions import MIDI_VELOCITIES
from ..errors import ParameterError, SetupError, check_type
from ..excitation import HAMMER, NAMES, OTHERS, Excitation
from ..felt import ALL_PARAMETERS, DEFAULT_LAW, LAWS, FeltLaw, is_builtin
from ..io.files import path_name, printable, read_text
from ..io.number_format import filled
from ..key_prior import KeyPrior
from ..parameters import Parameter
from ..transducer import QUANTITIES
from .contradictions import contradictions
from .measured import MOST_RELATIVE_SD, Measured, relative_sd

MAX_BYTES = 2**20

Range = tuple[float, float, str]  # lower, upper, unit
# A piano's strings are 0.05 to 2.3 m long and weigh 0.1 to 300 g.
RANGES: dict[str, Range] = {
    "length": (0.01, 5.0, "m"),
    "mass": (1e-6, 1.0, "kg"),
    "position": (1e-4, 5.0, "m"),
    "width": (1e-5, 1.0, "m"),
    "scale": (1e-12, 1e12, "units at digital full scale"),
}
# Table and key of an attribute in a file. The other attributes have a table each.
SETUP_KEYS = {
    "length": ("string", "length"),
    "mass": ("string", "mass"),
    "strike_position": ("strike", "position"),
    "strike_width": ("strike", "width"),
    "pickup_quantity": ("pickup", "quantity"),
    "pickup_position": ("pickup", "position"),
    "pickup_scale": ("pickup", "scale"),
    "felt": ("felt", "law"),
    "excitation": ("excitation", "kind"),
}
# Attributes that can have a standard deviation, with their names among the parameters of a fit.
SIZES = {
    "length": "L",
    "mass": "M_S",
    "strike_position": "x0",
    "strike_width": "width",
    "pickup_position": "pickup",
    "pickup_scale": "scale",
}


@dataclass(frozen=True, repr=False)
class RecordingInfo:
    """Setup of one recording. `Setup` checks it."""

    file: str | None = None
    v_H0: float | None = None  # m/s, measured
    group: str | None = None  # path group: its recordings share one output path
    gain_group: str | None = None  # recordings of a gain group share one gain
    stroke: str | None = None  # the same name marks recordings of one stroke by several microphones
    midi_velocity: float | None = None  # 1 to 127, of the layer in its library; no part of the fit

    def __repr__(self) -> str:
        return filled(self)


# Tables of a file and their keys.
KEYS: dict[str, tuple[str, ...]] = {
    **{table: tuple(key for other, key in SETUP_KEYS.values() if other == table) for table, _ in SETUP_KEYS.values()},
    **dict.fromkeys(("fixed", "initial", "bounds"), tuple(ALL_PARAMETERS)),
    "prior": tuple(entry.name for entry in fields(KeyPrior)),
    "recording": tuple(entry.name for entry in fields(RecordingInfo)),
}


@dataclass(frozen=True, repr=False)
class Setup:
    """Sizes, fixed and initial values, bounds and recordings, in SI units. None or empty means not given.

    Sizes, fixed values and measured velocities are plain numbers, which are exact, or `Measured` values with a standard
    deviation.

    Raises
    ------
    SetupError
        If a value is invalid. The message names the table and key of a `setup.toml`, the value, and what to do.
    """

    length: float | None = None  # m
    mass: float | None = None  # kg
    strike_position: float | None = None  # m, from the agraffe
    strike_width: float | None = None  # m, full width of the contact window
    pickup_quantity: str = "pressure"  # one of `transducer.QUANTITIES`
    pickup_position: float | None = None  # m, from the agraffe
    pickup_scale: float | None = None  # units (m/s, m or N) at digital full scale; None = uncalibrated
    fixed: dict[str, float] = field(default_factory=dict)  # measured, held fixed or within its uncertainty
    initial: dict[str, float] = field(default_factory=dict)  # starting values
    bounds: dict[str, tuple[float, float]] = field(default_factory=dict)
    recordings: tuple[RecordingInfo, ...] = ()
    felt: str | FeltLaw | None = None  # a name in `felt.LAWS`, or your own law
    excitation: str = HAMMER  # "hammer" or "pluck"
    prior: KeyPrior | None = None  # of the other keys of the keyboard, in place of the literature's

    def __repr__(self) -> str:
        return filled(self)

    def __post_init__(self) -> None:
        checked: dict[str, Any] = {}
        for name, (table, key) in SETUP_KEYS.items():
            if key in RANGES and getattr(self, name) is not None:
                checked[name] = _given(getattr(self, name), key, f"[{table}]", RANGES[key])
        _check_choice(self.pickup_quantity, QUANTITIES, "[pickup] quantity")
        _check_choice(self.excitation, NAMES, "[excitation] kind")
        _check_law(self.felt)
        if self.prior is not None:
            checked["prior"] = _key_prior(self.prior)
        boxes = ALL_PARAMETERS | self.law.hammer_parameters
        for name, check in (("fixed", _given), ("initial", _number), ("bounds", _bounds)):
            table = _table(name, getattr(self, name), tuple(boxes))
            checked[name] = {key: check(value, key, f"[{name}]", _range(boxes[key])) for key, value in table.items()}
        if not isinstance(self.recordings, list | tuple):
            raise SetupError(f"recordings = {_show(self.recordings)} must be a list of RecordingInfo")
        checked["recordings"] = tuple(_recording_info(entry, n) for n, entry in enumerate(self.recordings, 1))
        for name, value in checked.items():
            object.__setattr__(self, name, value)  # numbers became floats
        for contradiction in contradictions(self.exact):
            raise SetupError(contradiction)

    @property
    def law(self) -> Excitation:
        """The excitation: the felt law of the hammer, or the pluck."""
        if self.excitation != HAMMER:
            return OTHERS[self.excitation]
        return self.felt if isinstance(self.felt, FeltLaw) else LAWS.get(self.felt or "", DEFAULT_LAW)

    @property
    def exact(self) -> Setup:
        """The setup without standard deviations."""
        sizes = {name: float(getattr(self, name)) for name in SIZES if isinstance(getattr(self, name), Measured)}
        fixed = {name: float(value) for name, value in self.fixed.items()}
        recordings = tuple(
            replace(entry, v_H0=float(entry.v_H0)) if isinstance(entry.v_H0, Measured) else entry
            for entry in self.recordings
        )
        if not sizes and fixed == self.fixed and recordings == self.recordings:
            return self
        return replace(self, **sizes, fixed=fixed, recordings=recordings)

    @property
    def relative_sds(self) -> dict[str, float]:
        """Standard deviations of the logarithms of sizes and fixed values, by name, without exact ones."""
        given = {name: getattr(self, attribute) for attribute, name in SIZES.items()} | self.fixed
        return {name: relative_sd(value) for name, value in given.items() if relative_sd(value)}

    @classmethod
    def from_toml(cls, path: str | os.PathLike[str], felt: str | None = None) -> Setup:
        """Read a `setup.toml`.

        Parameters
        ----------
        path : path of the file. docs/files.md lists tables, keys and units.
        felt : name of the felt law, if the file has none.

        Returns
        -------
        A `Setup`, all values in SI units.

        Raises
        ------
        SetupError
            If the file is invalid. The message names the file, the key, the value, and what to do.

        Examples
        --------
        >>> import pianofit
        >>> from pathlib import Path
        >>> _ = Path("setup.toml").write_text("string.length = 0.96")
        >>> pianofit.Setup.from_toml("setup.toml").length
        0.96
        """
        name = path_name(path)
        try:
            tables = tomllib.loads(read_text(path, MAX_BYTES, SetupError))
        except (ValueError, RecursionError) as problem:  # RecursionError: deeply nested brackets
            raise SetupError(f"{name}: not valid TOML: {printable(problem)[:200]}; correct that line") from None
        if felt is None:
            return cls.from_dict(tables, name)
        given = tables.get("felt", {})
        setup = cls.from_dict(tables | {"felt": {"law": felt} | given if isinstance(given, dict) else given}, name)
        if setup.law.name != felt:  # the file has a law of its own
            raise SetupError(f'{name}: [felt] law = "{setup.law.name}" contradicts felt={felt!r}; remove one of them')
        return setup

    @classmethod
    def from_dict(cls, tables: Mapping[str, Any], where: str = "setup") -> Setup:
        """Make a setup from nested dicts.

        Parameters
        ----------
        tables : tables and keys as in a `setup.toml`, SI units.
        where : beginning of every error message.

        Returns
        -------
        A `Setup`.

        Raises
        ------
        SetupError
            As `from_toml`.

        Examples
        --------
        >>> import pianofit
        >>> pianofit.Setup.from_dict({"string": {"length": 0.96}, "fixed": {"M_H": 0.0087}}).fixed
        {'M_H': 0.0087}
        """
        check_type("setup=", tables, Mapping, "a Setup, tables as in a setup.toml, or the path of one")
        try:
            checked = {name: _entries(name, content) for name, content in tables.items()}
            given = {
                name: checked[table][key] for name, (table, key) in SETUP_KEYS.items() if key in checked.get(table, ())
            }
            given |= {name: checked[name] for name in ("fixed", "initial", "bounds", "prior") if name in checked}
            return cls(**given, recordings=tuple(checked.get("recording", ())))
        except SetupError as error:
            raise SetupError(f"{where}: {error}") from None


def recording_info_for(setup: Setup, file: str, alone: bool) -> RecordingInfo:
    """Return the entry with the name of `file`. If `alone`, the first entry without a file is the second choice."""
    named = [entry for entry in setup.recordings if entry.file and Path(entry.file).name == Path(file).name]
    nameless = [entry for entry in setup.recordings if alone and not entry.file]
    return next(iter([*named, *nameless]), RecordingInfo())


def to_setup(given: Setup | Mapping[str, Any] | str | os.PathLike[str] | None) -> Setup:
    """Return the setup that a caller gives: a `Setup`, tables as in a `setup.toml`, the path of one, or None."""
    if given is None or isinstance(given, Setup):
        return given or Setup()
    return Setup.from_toml(given) if isinstance(given, str | os.PathLike) else Setup.from_dict(given)


def _entries(name: str, content: object) -> Any:
    """Check the name of a table, and its keys if the table is not an attribute, which `Setup` checks."""
    if name not in KEYS:
        raise SetupError(f"{_show(name)} is not known; {_suggest(name, tuple(KEYS))}")
    if name == "recording" and not isinstance(content, list):
        raise SetupError(f"{name} = {_show(content)} must be a list; begin each entry with a line [[{name}]]")
    return content if name in ("fixed", "initial", "bounds", "prior", "recording") else _table(name, content)


def _table(name: str, content: object, keys: tuple[str, ...] = ()) -> Mapping[str, Any]:
    """Check the keys of a table against `keys`, or against `KEYS`."""
    allowed = keys or KEYS[name]
    if not isinstance(content, Mapping):
        header = f"[[{name}]]" if name == "recording" else f"[{name}]"
        raise SetupError(f"{name} = {_show(content)} must be a table; begin it with a line {header}")
    for key in content:
        if key not in allowed:
            raise SetupError(f"[{name}] {_show(key)} is not known; {_suggest(key, allowed)}")
    return content


def _suggest(key: object, allowed: tuple[str, ...]) -> str:
    """Suggest the nearest allowed key, the right table, or list all allowed keys."""
    lower = {name.lower(): name for name in allowed}
    near = difflib.get_close_matches(str(key).lower(), lower, 1, 0.7)
    if near:
        return f"did you mean {lower[near[0]]}?"
    homes = [f"[{table}]" for table, keys in KEYS.items() if key in keys]
    return f"it belongs in {' or '.join(homes)}" if homes else f"allowed: {', '.join(allowed)}"


def _show(value: object) -> str:
    """Return a value as one short line."""
    text = printable(value if isinstance(value, str) else repr(value))
    text = text if len(text) <= 60 else text[:57] + "..."
    return f'"{text}"' if isinstance(value, str) else text


def _range(box: Parameter) -> Range:
    return box.lower, box.upper, box.unit


def _number(value: Any, key: str, where: str, allowed: Range) -> float:
    """Return a number within its range. Comparing before converting rejects integers too large for a float."""
    lower, upper, unit = allowed
    if not _is_number(value) or not lower <= value <= upper:
        unit = "" if unit == "1" else f" {unit}"
        quotes = " (no quotes)" if isinstance(value, str) else ""
        if isinstance(value, Measured | Mapping):
            quotes = " without an sd; for a measured value use [fixed]"
        raise SetupError(f"{where} {key} = {_show(value)} must be a number from {lower:g} to {upper:g}{unit}{quotes}")
    return float(value)


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool | Measured)  # includes NumPy's numbers


def _check_choice(value: object, allowed: tuple[str, ...], where: str) -> None:
    if not isinstance(value, str) or value not in allowed:
        raise SetupError(f"{where} = {_show(value)} must be one of {', '.join(allowed)}")


def _check_law(felt: object) -> None:
    """Reject a value that is not a law, and a user's law with the name of a built-in one."""
    if felt is None:
        return
    if not isinstance(felt, FeltLaw):
        _check_choice(felt, tuple(LAWS), "[felt] law")
    elif felt.name in LAWS and not is_builtin(felt):
        raise SetupError(f"[felt] law = {_show(felt.name)} is the name of a built-in law; give yours another name")


def _given(value: Any, key: str, where: str, allowed: Range) -> float:
    """Return a number within its range, or a `Measured` if it has a standard deviation above 0."""
    if isinstance(value, Mapping):
        value = _measured(value, f"{where} {key}")
    if not isinstance(value, Measured):
        return _number(value, key, where, allowed)
    number = _number(float(value), key, where, allowed)
    sd = _number(value.sd, f"{key}: sd", where, (0.0, MOST_RELATIVE_SD * number, allowed[2]))
    return Measured(number, sd) if sd else number


def _measured(table: Mapping[Any, Any], where: str) -> Measured:
    """Return the value of a table, {value = 1.602, sd = 0.001}."""
    for key in table:
        if key not in ("value", "sd"):
            raise SetupError(f"{where}: {_show(key)} is not known; {_suggest(key, ('value', 'sd'))}")
    for key in ("value", "sd"):
        if key not in table:
            reason = "an assumed value has no sd" if key == "value" else "an exact value is a plain number"
            raise SetupError(f"{where} = {_show(dict(table))} has no {key}, but {reason}; give value and sd")
    try:
        return Measured(table["value"], table["sd"])
    except ParameterError as error:
        raise SetupError(f"{where}: {error}") from None


def _bounds(pair: object, key: str, where: str, allowed: Range) -> tuple[float, float]:
    if not isinstance(pair, list | tuple) or len(pair) != 2:
        raise SetupError(f"{where} {key} = {_show(pair)} must be two numbers, [lower, upper]")
    lower, upper = (_number(value, key, where, allowed) for value in pair)
    if lower >= upper:
        raise SetupError(f"{where} {key} = {_show([*pair])}: lower must be below upper; to hold a value, use [fixed]")
    return lower, upper


def _key_prior(prior: object) -> KeyPrior:
    if isinstance(prior, KeyPrior):
        return prior
    table = _table("prior", prior)
    if missing := [key for key in KEYS["prior"] if key not in table]:
        raise SetupError(f"[prior] needs {', '.join(missing)} too; give the table that pianofit batch --joint wrote")
    try:
        return KeyPrior(**table)
    except ParameterError as error:
        raise SetupError(f"[prior] {error}") from None


def _recording_info(entry: object, number: int) -> RecordingInfo:
    where = f"[[recording]] {number}"
    given = vars(entry) if isinstance(entry, RecordingInfo) else _table("recording", entry)
    table = {key: value for key, value in given.items() if value is not None}
    for key, value in table.items():
        if key == "v_H0":
            table[key] = _given(value, key, where, _range(ALL_PARAMETERS[key]))
        elif key == "midi_velocity":
            table[key] = _number(value, key, where, (*MIDI_VELOCITIES, "1"))
        elif not (isinstance(value, str) and value.strip()):
            raise SetupError(f"{where} {key} = {_show(value)} must be a text in quotes, not empty")
    if not table:
        raise SetupError(f"{where} is empty; give its file or v_H0, or remove it")
    return RecordingInfo(**table)
