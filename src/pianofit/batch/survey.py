"""The files of a library before a fit: their layouts, and the files that were not read."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ..io.files import printable
from ..io.number_format import counted
from ..recording.recording import is_sound, readable_formats
from .job import Job, Source
from .manifest import NAMED, files_in

__all__ = ["Unread", "listing", "mixtures", "unread"]


class Unread(NamedTuple):
    """A file of the folder that does not belong to a key."""

    file: str  # from the folder
    reason: str


def mixtures(units: Sequence[Job]) -> list[str]:
    """Remarks on recordings whose channels or rates differ within a key, and on keys that differ from others."""
    found = [*_within(units, "channels", _mono), *_within(units, "rate", _resampled)]
    for what, words in (("channels", "{} channel(s)"), ("rate", "{} Hz")):
        keys: dict[tuple[int, ...], list[str]] = {}
        for unit in units:
            if layouts := _layouts(unit, what):
                keys.setdefault(tuple(sorted(layouts)), []).append(unit.key)
        if len(keys) > 1:
            ordered = sorted(keys.items(), key=lambda entry: -len(entry[1]))
            each = [f"{_words(layout, words)}: {_some(names, 'key')}" for layout, names in ordered]
            found.append(f"the keys differ in their {'channels' if what == 'channels' else 'sample rates'}: "
                         f"{'; '.join(each)}")  # fmt: skip
    return found


def _words(layout: tuple[int, ...], words: str) -> str:
    text = words.format(" and ".join(map(str, layout)))
    return text.replace("(s)", "" if layout == (1,) else "s")


def _layouts(unit: Job, what: str) -> dict[int, list[str]]:
    """Names of the readable recordings by their channels or rate; one channel is chosen where the settings say so."""
    found: dict[int, list[str]] = {}
    if what == "channels" and unit.settings.channel != "average":
        return found
    for source in unit.sources:
        if not source.wrong:
            found.setdefault(getattr(source, what), []).append(Path(source.path).name)
    return found


def _within(units: Sequence[Job], what: str, words: Any) -> Iterator[str]:
    """One remark for all keys that mix layouts in the same way."""
    mixed = [(unit.key, layouts) for unit in units if len(layouts := _layouts(unit, what)) > 1]
    by_kind: dict[tuple[int, ...], list[tuple[str, dict[int, list[str]]]]] = {}
    for key, layouts in mixed:
        by_kind.setdefault(tuple(sorted(layouts)), []).append((key, layouts))
    for values, keys in by_kind.items():
        rare = min(values, key=lambda value: sum(len(layouts[value]) for _, layouts in keys))
        names = [printable(name) for _, layouts in keys for name in layouts[rare]]
        yield words(values, _some([key for key, _ in keys], "key"), rare, _some(names, "recording"))


def _mono(values: Sequence[int], keys: str, rare: int, names: str) -> str:
    return (f"{keys}: recordings with {' and '.join(map(str, values))} channels are mixed, so the sound of the key is "
            f"mono; {counted(rare, 'channel')}: {names}. Leave these out, or choose one --channel for all")  # fmt: skip


def _resampled(values: Sequence[int], keys: str, rare: int, names: str) -> str:
    return (f"{keys}: recordings with {' and '.join(map(str, values))} Hz are mixed, and are resampled to "
            f"{max(values)} Hz; {rare} Hz: {names}")  # fmt: skip


def _some(names: Sequence[str], noun: str) -> str:
    """Names, or the first of many with how many there are."""
    if len(names) <= NAMED:
        return ", ".join(names)
    return f"{', '.join(names[:NAMED])} ... ({counted(len(names), noun)})"


def unread(source: Path, units: Sequence[Job]) -> list[Unread]:
    """Files in the folder of a manifest that no key uses, and why not."""
    folder = source if source.is_dir() else source.parent
    used = {file.path for unit in units for file in unit.sources}
    found = []
    for name in files_in(folder):
        if str((folder / name).resolve()) in used:
            continue
        if is_sound(name):
            why = "does not fit the pattern" if source.is_dir() else f"is not used by {printable(source.name)}"
            found.append(Unread(printable(name), why))
        elif source.is_dir():
            found.append(Unread(printable(name), f"is none of {readable_formats()}"))
    return found


def listing(unit: Job, folder: Path) -> list[list[str]]:
    """A row of text for every recording of a key: the file, what it was read as, and its layout."""
    return [
        [_seen_from(folder, source.path), _read_as(source), source.wrong or
         f"{counted(source.channels, 'channel')}, {source.rate} Hz"] for source in unit.sources
    ]  # fmt: skip


def _seen_from(folder: Path, path: str) -> str:
    """A path from the folder where it lies in it, and else its name."""
    file = Path(path)
    inside = file.is_relative_to(base := folder.resolve())
    return printable(file.relative_to(base).as_posix() if inside else file.name)


def _read_as(source: Source) -> str:
    """Layer, velocity and group of a recording, as they are known."""
    velocity = f"{source.velocity:g} m/s" if source.velocity is not None else ""
    given = {"layer": source.layer, "velocity": velocity, "group": source.group}
    return ", ".join(f"{name} {printable(value)}" for name, value in given.items() if value) or "no layer"
