"""The sounds that are compared: files of one name in all folders, or recordings with the sounds of their fits.

A fit names its recordings by the hash of their content, so that recordings and fits are paired wherever they lie and
whatever they are called.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from ..errors import RecordingError
from ..io.files import LARGEST_FIT, load_json, printable, read_file
from ..recording.recording import MAX_BYTES, Recording, is_sound, load_recording, readable_formats
from ..report.save import stroke_names

__all__ = ["Place", "load_pair", "pairs_of"]

# Names at the most: with 4 s in stereo at 48 kHz a page of 160 MB, which browsers still open.
MOST = 80
FITS = ("keys/*/fit.json", "*/fit.json", "fit.json")


class Place(NamedTuple):
    """A sound file, and the channel that is used."""

    path: Path
    channel: str = "average"
    fitted: bool = False


class Fit(NamedTuple):
    """The sound of one recording's fit."""

    name: str  # of the recording
    channel: str  # of the recording, that was fitted
    sound: Path


Fits = dict[str, Fit]  # by the hash of the recording
Group = list[Place]  # of one name, a sound of each side


def pairs_of(sides: Sequence[Path]) -> tuple[dict[str, Group], list[str]]:
    """The sounds of each name that all sides have, and the names that some lack.

    Raises `RecordingError` where no name is common, or a folder cannot be read; `FitError` for a damaged `fit.json`.
    """
    if not any(side.is_dir() for side in sides):
        return {printable(sides[0].stem): [Place(side) for side in sides]}, []
    fits = [_fits_in(side) for side in sides]
    found = [_by_name(side) for side in sides] if not any(fits) else _by_content(sides, fits)
    names = sorted(set.intersection(*map(set, found)))
    if not names:
        by_name = "no file name in common; pairs are by name"
        by_fit = "the fits are of other recordings; pairs are by the recordings' content"
        raise RecordingError(f"{printable(sides[0])} and {printable(sides[1])}: {by_fit if any(fits) else by_name}")
    if len(names) > MOST and not any(fits):
        raise RecordingError(f"{printable(sides[0])}: {len(names)} pairs are more than {MOST}; take fewer")
    alone = sorted(set.union(*map(set, found)) - {*names})
    return {printable(name): [side[name] for side in found] for name in names}, [printable(name) for name in alone]


def load_pair(group: Group) -> list[Recording]:
    """The sounds of a name; a recording whose fit is in mono is used in mono too."""
    loaded = [load_recording(place.path, channel=place.channel) for place in group]
    mono = any(place.fitted and len(one.frames) == 1 for place, one in zip(group, loaded, strict=True))
    return [replace(one, frames=one.samples[None]) if mono else one for one in loaded]


def _by_name(folder: Path) -> dict[str, Place]:
    """The sounds of a folder by name, without the ending."""
    if not folder.is_dir():
        raise RecordingError(f"{printable(folder)}: is no folder; give folders only, or files only")
    found: dict[str, Place] = {}
    try:
        for path in sorted(path for path in folder.iterdir() if is_sound(path.name)):
            if path.stem in found:
                raise RecordingError(
                    f"{printable(path)}: {printable(found[path.stem].path.name)} has this name too; remove one"
                )
            found[path.stem] = Place(path)
    except OSError as error:
        raise RecordingError(f"{printable(folder)}: cannot be read ({error.strerror}); check it") from None
    if not found:
        raise RecordingError(f"{printable(folder)}: holds no sound; the formats are {readable_formats()}")
    return found


def _by_content(sides: Sequence[Path], fits: Sequence[Fits]) -> list[dict[str, Place]]:
    """The sounds of every side by the name of the recording that they are, or that they were fitted to."""
    wanted = {digest: fit for fitted in fits for digest, fit in fitted.items()}
    stems = [fit.name for fit in wanted.values()]
    names = {digest: f.name if stems.count(f.name) == 1 else f"{f.name} {digest[:6]}" for digest, f in wanted.items()}
    found = []
    for side, fitted in zip(sides, fits, strict=True):
        places = {names[digest]: Place(fit.sound, fitted=True) for digest, fit in fitted.items()}
        for path in _files(side) if not fitted else ():
            digest = hashlib.sha256(read_file(path, MAX_BYTES, RecordingError)).hexdigest()
            channel = wanted[digest].channel if digest in wanted else "average"
            places[names.get(digest, path.stem)] = Place(path, channel)
        found.append(places)
    return found


def _files(side: Path) -> Iterator[Path]:
    """All sounds below a folder, without those that fits have written; or a file itself."""
    if not side.is_dir():
        yield side
        return
    for place, inner, files in os.walk(side):
        if "fit.json" in files:
            continue
        inner[:] = sorted(name for name in inner if not name.startswith("."))
        yield from (Path(place) / name for name in sorted(files) if is_sound(name) and not name.startswith("."))


def _fits_in(side: Path) -> Fits:
    """The sounds of all fits in a folder."""
    files = next((found for form in FITS if (found := sorted(side.glob(form)))), [])
    return {digest: fit for file in files for digest, fit in _sounds_of(file)}


def _sounds_of(file: Path) -> Iterator[tuple[str, Fit]]:
    """By the hash of each recording of a fit the sound that was fitted to it."""
    document = load_json(file, LARGEST_FIT, "a fit.json", "fit the recordings again")
    rows = document.get("recordings") if isinstance(document, dict) else None
    rows = [
        row
        for row in (rows if isinstance(rows, list) else ())
        if isinstance(row, dict) and isinstance(row.get("file"), str)
    ]
    stems = [Path(row["file"]).stem for row in rows]
    for row, stem, name in zip(rows, stems, stroke_names(stems) or ["fitted.wav"], strict=False):
        if (sound := file.parent / name).is_file():
            channel = str(row.get("channel", "average"))
            yield str(row.get("sha256")), Fit(stem, "average" if channel == "mono" else channel, sound)
