"""What was known before the recording: `setup.toml`, read strictly.

A measured length that is mistyped must not silently become an assumed one. So every table, key, type, unit range and
contradiction is checked here, and what is wrong is named with the file, the key, the value and the way out. All values
are in SI units; a length in centimetres or a mass in grams falls outside its range.
"""

from __future__ import annotations

import difflib
import os
import tomllib
from dataclasses import dataclass, field, replace
from typing import Any

from .errors import SetupError
from .io import one_line, read_file
from .parameters import DEFAULT_LAW, FELT_LAWS, FIT_NAMES, MEMORY_NAMES, PARAMETERS

__all__ = ["PICKUPS", "Setup", "Take", "load_setup", "setup_from_dict", "with_law"]

PICKUPS = ("velocity", "displacement", "bridge-force", "pressure")
ON_THE_STRING = ("velocity", "displacement")  # pickups that need a position
MAX_BYTES = 2**20

# Lower, upper, unit. A piano's strings are 0.05 to 2.3 m long and weigh 0.1 to 300 g.
RANGES: dict[str, tuple[float, float, str]] = {
    "length": (0.01, 5.0, "m"),
    "mass": (1e-6, 1.0, "kg"),
    "position": (1e-4, 5.0, "m"),
    "width": (1e-5, 1.0, "m"),
    "scale": (1e-12, 1e12, "units at digital full scale"),
}
KEYS: dict[str, tuple[str, ...]] = {
    "string": ("length", "mass"),
    "strike": ("position", "width"),
    "pickup": ("quantity", "position", "scale"),
    "felt": ("law",),
    "known": FIT_NAMES + MEMORY_NAMES,
    "initial": FIT_NAMES + MEMORY_NAMES,
    "bounds": FIT_NAMES + MEMORY_NAMES,
    "take": ("file", "v_H0", "group", "gain_group", "strike"),
}


@dataclass(frozen=True)
class Take:
    """One recording of the note."""

    file: str | None = None
    v_H0: float | None = None  # m/s, measured
    group: str | None = None  # takes of a group share one output path
    gain_group: str | None = None  # takes of a gain group share one gain
    strike: str | None = None  # takes of one strike are one blow, heard by several microphones


@dataclass(frozen=True)
class Setup:
    """What was known beforehand, SI units; None or empty where nothing was said."""

    length: float | None = None  # m
    mass: float | None = None  # kg
    strike_position: float | None = None  # m, from the agraffe
    strike_width: float | None = None  # m, full width of the contact window
    pickup_quantity: str = "pressure"  # one of PICKUPS
    pickup_position: float | None = None  # m, from the agraffe
    pickup_scale: float | None = None  # units (m/s, m or N) at digital full scale; None = uncalibrated
    known: dict[str, float] = field(default_factory=dict)  # measured, held fixed
    initial: dict[str, float] = field(default_factory=dict)  # starting values
    bounds: dict[str, tuple[float, float]] = field(default_factory=dict)
    takes: tuple[Take, ...] = ()
    felt: str | None = None  # one of FELT_LAWS


def load_setup(path: str | os.PathLike[str]) -> Setup:
    """Read a `setup.toml`.

    Raises
    ------
    SetupError
        Naming the file, the key, the value, and the way out.
    """
    name = one_line(os.fspath(path))
    data = read_file(path, MAX_BYTES, SetupError)
    try:
        table = tomllib.loads(data.decode("utf-8-sig"))
    except UnicodeDecodeError as problem:
        line = data.count(b"\n", 0, problem.start) + 1
        raise SetupError(
            f"{name}: byte 0x{data[problem.start]:02x} on line {line} is not UTF-8; save as UTF-8"
        ) from None
    except (ValueError, RecursionError) as problem:  # RecursionError: brackets nested without end
        raise SetupError(f"{name}: not valid TOML: {one_line(problem)[:200]}; correct that place") from None
    return setup_from_dict(table, name)


def setup_from_dict(data: dict[str, Any], where: str) -> Setup:
    """Make a setup of nested dicts with the tables and keys of a `setup.toml`; `where` opens every error.

    Raises
    ------
    SetupError
        As `load_setup`.
    """
    _check_names(data, where)
    known, initial = (_parameters(data.get(name, {}), f"{where}: [{name}]") for name in ("known", "initial"))
    length, mass = _quantities(data, "string", ("length", "mass"), where)
    strike, width = _quantities(data, "strike", ("position", "width"), where)
    pickup, scale = _quantities(data, "pickup", ("position", "scale"), where)
    setup = Setup(
        length=length,
        mass=mass,
        strike_position=strike,
        strike_width=width,
        pickup_quantity=_quantity(data, where),
        pickup_position=pickup,
        pickup_scale=scale,
        known=known,
        initial=initial,
        bounds={key: _pair(pair, key, f"{where}: [bounds]") for key, pair in data.get("bounds", {}).items()},
        felt=_felt(data, where),
        takes=tuple(_take(entry, f"{where}: [[take]] {n}") for n, entry in enumerate(data.get("take", []), 1)),
    )
    _check_strike(setup, where)
    _check_pickup(setup, where)
    _check_parameters(setup, where)
    _check_takes(setup, where)
    return setup


def with_law(setup: Setup, felt: str | None, where: str) -> Setup:
    """`setup` with another law of the felt, if one is named; `where` opens an error.

    Raises
    ------
    SetupError
        If the setup speaks of parameters that this law does not have.
    """
    if felt is None:
        return setup
    setup = replace(setup, felt=felt)
    _check_law(setup, where)
    return setup


def _check_names(data: dict[str, Any], where: str) -> None:
    """Refuse a table or key that has no meaning, and what is not the table it should be."""
    for name, content in data.items():
        if name not in KEYS:
            raise SetupError(f"{where}: {_show(name)} is not known; {_suggest(name, tuple(KEYS))}")
        tables = content if name == "take" and isinstance(content, list) else [content]
        for table in tables:
            if not isinstance(table, dict) or (name == "take" and tables[0] is content):
                header = "[[take]]" if name == "take" else f"[{name}]"
                raise SetupError(f"{where}: {name} = {_show(content)} must be a table; begin it with a line {header}")
            for key in table:
                if key not in KEYS[name]:
                    raise SetupError(f"{where}: [{name}] {_show(key)} is not known; {_suggest(key, KEYS[name])}")


def _suggest(key: str, allowed: tuple[str, ...]) -> str:
    """Name the nearest allowed key, the table the key belongs to, or all that is allowed."""
    lower = {name.lower(): name for name in allowed}
    near = difflib.get_close_matches(key.lower(), lower, 1, 0.7)
    if near:
        return f"did you mean {lower[near[0]]}?"
    homes = [f"[{table}]" for table, keys in KEYS.items() if key in keys]
    return f"it belongs in {' or '.join(homes)}" if homes else f"known here: {', '.join(allowed)}"


def _show(value: object) -> str:
    """Return a value as one short line."""
    text = one_line(value if isinstance(value, str) else repr(value))
    text = text if len(text) <= 60 else text[:57] + "..."
    return f'"{text}"' if isinstance(value, str) else text


def _number(value: object, key: str, lower: float, upper: float, unit: str, where: str) -> float:
    """Return a number within its range; comparing first keeps integers too large for a float out."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not lower <= value <= upper:
        unit = "" if unit == "1" else f" {unit}"
        raise SetupError(
            f"{where} {key} = {_show(value)} must be a number from {lower:g} to {upper:g}{unit} (no quotes)"
        )
    return float(value)


def _quantities(data: dict[str, Any], table: str, keys: tuple[str, str], where: str) -> tuple[float | None, ...]:
    given = data.get(table, {})
    return tuple(
        _number(given[key], key, *RANGES[key], f"{where}: [{table}]") if key in given else None for key in keys
    )


def _quantity(data: dict[str, Any], where: str) -> str:
    quantity = data.get("pickup", {}).get("quantity", "pressure")
    if not isinstance(quantity, str) or quantity not in PICKUPS:
        raise SetupError(f"{where}: [pickup] quantity = {_show(quantity)} must be one of {', '.join(PICKUPS)}")
    return quantity


def _felt(data: dict[str, Any], where: str) -> str | None:
    law = data.get("felt", {}).get("law")
    if law is not None and (not isinstance(law, str) or law not in FELT_LAWS):
        raise SetupError(f"{where}: [felt] law = {_show(law)} must be one of {', '.join(FELT_LAWS)}")
    return law


def _parameter(value: object, key: str, where: str) -> float:
    box = PARAMETERS[key]
    return _number(value, key, box.lower, box.upper, box.unit, where)


def _parameters(table: dict[str, Any], where: str) -> dict[str, float]:
    return {key: _parameter(value, key, where) for key, value in table.items()}


def _pair(pair: object, key: str, where: str) -> tuple[float, float]:
    if not isinstance(pair, list | tuple) or len(pair) != 2:
        raise SetupError(f"{where} {key} = {_show(pair)} must be two numbers, [lower, upper]")
    lower, upper = (_parameter(value, key, where) for value in pair)
    if lower >= upper:
        raise SetupError(f"{where} {key} = {_show(pair)}: lower must be below upper; to hold a value, use [known]")
    return lower, upper


def _take(entry: dict[str, Any], where: str) -> Take:
    for key in ("file", "group", "gain_group", "strike"):
        if key in entry and not (isinstance(entry[key], str) and entry[key].strip()):
            raise SetupError(f"{where} {key} = {_show(entry[key])} must be a text in quotes, not empty")
    velocity = _parameter(entry["v_H0"], "v_H0", where) if "v_H0" in entry else None
    return Take(entry.get("file"), velocity, entry.get("group"), entry.get("gain_group"), entry.get("strike"))


def _check_strike(setup: Setup, where: str) -> None:
    """Refuse a contact window that does not lie on the string."""
    position, length = setup.strike_position, setup.length
    half = (setup.strike_width or 0.0) / 2
    if position is not None and position < half:
        raise SetupError(
            f"{where}: [strike] width = {2 * half:g} m reaches past the agraffe from position = {position:g} m; "
            "narrow it or correct the position"
        )
    if length is not None and (position or half) + half > length:
        raise SetupError(
            f"{where}: [strike] reaches {(position or half) + half:g} m from the agraffe, past the string's "
            f"length = {length:g} m; correct position, width or [string] length"
        )


def _check_pickup(setup: Setup, where: str) -> None:
    """Refuse a position or a scale that means nothing with the quantity."""
    quantity, position = setup.pickup_quantity, setup.pickup_position
    if quantity in ON_THE_STRING and position is None:
        raise SetupError(f'{where}: [pickup] quantity = "{quantity}" needs a position in m from the agraffe; add it')
    if quantity not in ON_THE_STRING and position is not None:
        raise SetupError(
            f'{where}: [pickup] position = {position:g} has no meaning with quantity = "{quantity}"; '
            "say velocity or displacement, or remove the position"
        )
    if quantity == "pressure" and setup.pickup_scale is not None:
        raise SetupError(
            f'{where}: [pickup] scale = {setup.pickup_scale:g} has no meaning with quantity = "pressure", which comes '
            "through an unknown path; say velocity, displacement or bridge-force, or remove the scale"
        )
    if position is not None and setup.length is not None and position >= setup.length:
        raise SetupError(
            f"{where}: [pickup] position = {position:g} m is not on the string of length = {setup.length:g} m; "
            "correct one of them"
        )


def _check_parameters(setup: Setup, where: str) -> None:
    """Refuse a value both known and free, or a start outside its bounds."""
    for name in setup.known:
        for table, given in (("initial", setup.initial), ("bounds", setup.bounds)):
            if name in given:
                raise SetupError(f"{where}: {name} is in [known], held fixed, and in [{table}]; remove one of them")
    _check_law(setup, where)
    for name, (lower, upper) in setup.bounds.items():
        value = setup.initial.get(name, lower)
        if not lower <= value <= upper:
            raise SetupError(
                f"{where}: [initial] {name} = {value:g} is outside its [bounds] {lower:g} to {upper:g}; correct one"
            )


def _check_law(setup: Setup, where: str) -> None:
    """Refuse parameters that the felt's law does not have."""
    law = setup.felt or DEFAULT_LAW
    for name in (*setup.known, *setup.initial, *setup.bounds):
        if name in ("mu", *MEMORY_NAMES) and name not in FELT_LAWS[law]:
            has = ", ".join(FELT_LAWS[law])
            raise SetupError(f"{where}: {name} is no parameter of the felt's law, {law}, which has {has}; remove it")


def _check_takes(setup: Setup, where: str) -> None:
    """Refuse a second velocity for a take, or a file named twice."""
    lower, upper = setup.bounds.get("v_H0", (0.0, float("inf")))
    files: set[str] = set()
    for number, take in enumerate(setup.takes, 1):
        entry = f"{where}: [[take]] {number}"
        if take == Take():
            raise SetupError(f"{entry} is empty; give its file or v_H0, or remove it")
        if take.file in files:
            raise SetupError(f'{entry} file = "{one_line(take.file)}" is there twice; remove one')
        if take.v_H0 is not None and "v_H0" in setup.known:
            raise SetupError(f"{entry} v_H0 = {take.v_H0:g} is also in [known]; remove one of them")
        if take.v_H0 is not None and not lower <= take.v_H0 <= upper:
            raise SetupError(
                f"{entry} v_H0 = {take.v_H0:g} is outside its [bounds] {lower:g} to {upper:g}; correct one"
            )
        files |= {take.file} if take.file else set()
    _check_strikes(setup, where)


def _check_strikes(setup: Setup, where: str) -> None:
    """Refuse one blow with two velocities, or heard twice by one microphone."""
    heard: dict[tuple[str, str | None], int] = {}
    struck: dict[str, float] = {}
    for number, take in enumerate(setup.takes, 1):
        if take.strike is None:
            continue
        entry = f'{where}: [[take]] {number} strike = "{one_line(take.strike)}"'
        other = heard.setdefault((take.strike, take.group), number)
        if other != number:
            group = "neither has a group" if take.group is None else f'both have group = "{one_line(take.group)}"'
            raise SetupError(
                f"{entry} is that of [[take]] {other}, and {group}; a microphone hears a blow once: give each its own "
                "group, or another strike"
            )
        if take.v_H0 is not None and struck.setdefault(take.strike, take.v_H0) != take.v_H0:
            raise SetupError(
                f"{entry} has v_H0 = {take.v_H0:g} and {struck[take.strike]:g}; one blow has one velocity: correct one"
            )
