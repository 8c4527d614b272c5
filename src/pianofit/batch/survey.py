"""Files of a library before a fit: their channels and sample rates, and the files that are not used."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from ..io.files import printable
from ..io.number_format import counted
from ..recording.recording import is_sound, readable_formats
from .job import Job, Source
from .manifest import MAX_LISTED, files_in

__all__ = ["UnusedFile", "recording_rows", "layout_remarks", "unused_files"]


class UnusedFile(NamedTuple):
    """A file of the folder that does not belong to a key."""

    file: str  # relative to the folder
    reason: str


def layout_remarks(jobs: Sequence[Job]) -> list[str]:
    """Remarks on recordings whose channels or rates differ within a key, and on keys that differ from others."""
    remarks = [*_within(jobs, "channels", _mono), *_within(jobs, "rate", _resampled)]
    for quantity, template in (("channels", "{} channel(s)"), ("rate", "{} Hz")):
        keys: dict[tuple[int, ...], list[str]] = {}
        for job in jobs:
            if layouts := _layouts(job, quantity):
                keys.setdefault(tuple(sorted(layouts)), []).append(job.key)
        if len(keys) > 1:
            ordered = sorted(keys.items(), key=lambda entry: -len(entry[1]))
            groups = [f"{_layout_text(layout, template)}: {_some(names, 'key')}" for layout, names in ordered]
            remarks.append(f"the keys differ in their {'channels' if quantity == 'channels' else 'sample rates'}: "
                           f"{'; '.join(groups)}")  # fmt: skip
    return remarks


def _layout_text(layout: tuple[int, ...], template: str) -> str:
    text = template.format(" and ".join(map(str, layout)))
    return text.replace("(s)", "" if layout == (1,) else "s")


def _layouts(job: Job, quantity: str) -> dict[int, list[str]]:
    """Names of the readable recordings by their channels or rate. Channels are ignored if the settings choose one."""
    layouts: dict[int, list[str]] = {}
    if quantity == "channels" and job.settings.channel != "average":
        return layouts
    for source in job.sources:
        if not source.error:
            layouts.setdefault(getattr(source, quantity), []).append(Path(source.path).name)
    return layouts


def _within(jobs: Sequence[Job], quantity: str, remark: Callable[..., str]) -> Iterator[str]:
    """One remark for all keys that mix layouts in the same way."""
    mixed = [(job.key, layouts) for job in jobs if len(layouts := _layouts(job, quantity)) > 1]
    by_kind: dict[tuple[int, ...], list[tuple[str, dict[int, list[str]]]]] = {}
    for key, layouts in mixed:
        by_kind.setdefault(tuple(sorted(layouts)), []).append((key, layouts))
    for values, keys in by_kind.items():
        rare = min(values, key=lambda value: sum(len(layouts[value]) for _, layouts in keys))
        names = [printable(name) for _, layouts in keys for name in layouts[rare]]
        yield remark(values, _some([key for key, _ in keys], "key"), rare, _some(names, "recording"))


def _mono(values: Sequence[int], keys: str, rare: int, names: str) -> str:
    return (f"{keys}: recordings with {' and '.join(map(str, values))} channels are mixed, so the sound of the key is "
            f"mono; {counted(rare, 'channel')}: {names}. Leave these out, or choose one --channel for all")  # fmt: skip


def _resampled(values: Sequence[int], keys: str, rare: int, names: str) -> str:
    return (f"{keys}: recordings with {' and '.join(map(str, values))} Hz are mixed, and are resampled to "
            f"{max(values)} Hz; {rare} Hz: {names}")  # fmt: skip


def _some(names: Sequence[str], noun: str) -> str:
    """All names, or the first names and the total number."""
    if len(names) <= MAX_LISTED:
        return ", ".join(names)
    return f"{', '.join(names[:MAX_LISTED])} ... ({counted(len(names), noun)})"


def unused_files(source: Path, jobs: Sequence[Job]) -> list[UnusedFile]:
    """Files in the folder of a manifest that no key uses, with the reason."""
    folder = source if source.is_dir() else source.parent
    used = {file.path for job in jobs for file in job.sources}
    unused = []
    for name in files_in(folder):
        if str((folder / name).resolve()) in used:
            continue
        if is_sound(name):
            reason = "does not fit the pattern" if source.is_dir() else f"is not used by {printable(source.name)}"
            unused.append(UnusedFile(printable(name), reason))
        elif source.is_dir():
            unused.append(UnusedFile(printable(name), f"is none of {readable_formats()}"))
    return unused


def recording_rows(job: Job, folder: Path) -> list[list[str]]:
    """A row of text for every recording of a key: its file, its layer, velocity and group, its channels and rate."""
    return [
        [_relative_to(folder, source.path), _description(source), source.error or
         f"{counted(source.channels, 'channel')}, {source.rate} Hz"] for source in job.sources
    ]  # fmt: skip


def _relative_to(folder: Path, path: str) -> str:
    """The path relative to a folder, or the name of a file outside it."""
    file = Path(path)
    inside = file.is_relative_to(base := folder.resolve())
    return printable(file.relative_to(base).as_posix() if inside else file.name)


def _description(source: Source) -> str:
    """Layer, velocity and group of a recording, if given."""
    velocity = f"{source.velocity:g} m/s" if source.velocity is not None else ""
    given = {"layer": source.layer, "velocity": velocity, "group": source.group}
    return ", ".join(f"{name} {printable(value)}" for name, value in given.items() if value) or "no layer"
