"""Pairs of sounds for a listening test: files of the same name, or recordings with the sounds of their fits.

A fit identifies its recordings by the hash of their content. Recordings and fits are therefore paired in any folder and
under any name.
"""

import hashlib
import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from ..errors import RecordingError
from ..io.containers import is_sound, readable_formats
from ..io.files import printable, read_file
from ..recording.recording import MAX_BYTES, Recording, load_recording
from ..report.save import stroke_names
from ..schema.fit import key_files, read_fit

# Maximum number of pairs. With 4 s in stereo at 48 kHz the page has 160 MB, which browsers still open.
MAX_PAIRS = 80


class Place(NamedTuple):
    """A sound file and the channel to use."""

    path: Path
    channel: str = "average"
    fitted: bool = False


class Fit(NamedTuple):
    """The sound of a fit to one recording."""

    name: str  # name of the recording
    channel: str  # channel of the recording that was fitted
    sound: Path


Fits = dict[str, Fit]  # by hash of the recording
Group = list[Place]  # sounds of one name, one from each side


def pairs_of(sides: Sequence[Path]) -> tuple[dict[str, Group], list[str]]:
    """Return the sounds by name, and the names that are missing on some side.

    Raises `RecordingError` if the sides have no common name or a folder cannot be read, `FitError` for an invalid
    `fit.json`.
    """
    if not any(side.is_dir() for side in sides):
        return {printable(sides[0].stem): [Place(side) for side in sides]}, []
    fits = [_fits_in(side) for side in sides]
    found = [_by_name(side) for side in sides] if not any(fits) else _by_content(sides, fits)
    names = sorted(set.intersection(*map(set, found)))
    if not names:
        by_name = "no file name in common; give the files of a pair the same name"
        by_fit = "the fits do not contain these recordings (compared by content); give the recordings that were fitted"
        raise RecordingError(f"{printable(sides[0])} and {printable(sides[1])}: {by_fit if any(fits) else by_name}")
    if len(names) > MAX_PAIRS and not any(fits):
        raise RecordingError(f"{printable(sides[0])}: {len(names)} pairs are more than {MAX_PAIRS}; give fewer files")
    alone = sorted(set.union(*map(set, found)) - {*names})
    return {printable(name): [side[name] for side in found] for name in names}, [printable(name) for name in alone]


def load_pair(group: Group) -> list[Recording]:
    """Load the sounds of a name. If a fit is mono, its recording is averaged to mono."""
    loaded = [load_recording(place.path, channel=place.channel) for place in group]
    mono = any(place.fitted and len(sound.frames) == 1 for place, sound in zip(group, loaded, strict=True))
    return [replace(sound, frames=sound.samples[None]) if mono else sound for sound in loaded]


def _by_name(folder: Path) -> dict[str, Place]:
    """Sounds of a folder by name, without extension."""
    if not folder.is_dir():
        raise RecordingError(f"{printable(folder)}: is not a folder; give folders only, or files only")
    found: dict[str, Place] = {}
    try:
        for path in sorted(path for path in folder.iterdir() if is_sound(path.name)):
            if path.stem in found:
                raise RecordingError(
                    f"{printable(path)}: {printable(found[path.stem].path.name)} has the same name; remove one"
                )
            found[path.stem] = Place(path)
    except OSError as error:
        raise RecordingError(f"{printable(folder)}: cannot be read ({error.strerror}); check it") from None
    if not found:
        raise RecordingError(f"{printable(folder)}: contains no sound file; readable formats: {readable_formats()}")
    return found


def _by_content(sides: Sequence[Path], fits: Sequence[Fits]) -> list[dict[str, Place]]:
    """Sounds of every side, by name of the recording that they are, or that they were fitted to."""
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
    """Yield all sounds below a folder, except those of fits; or the file itself."""
    if not side.is_dir():
        yield side
        return
    for place, inner, files in os.walk(side):
        if "fit.json" in files:
            continue
        inner[:] = sorted(name for name in inner if not name.startswith("."))
        yield from (Path(place) / name for name in sorted(files) if is_sound(name) and not name.startswith("."))


def _fits_in(side: Path) -> Fits:
    """Sounds of all fits in a folder, by hash of the recording."""
    fits = {}
    for file in key_files(side):
        recordings = read_fit(file).recordings
        stems = [Path(recording.file).stem for recording in recordings]
        for recording, stem, name in zip(recordings, stems, stroke_names(stems) or ["fitted.wav"], strict=False):
            if (sound := file.parent / name).is_file():
                channel = "average" if recording.channel == "mono" else recording.channel
                fits[recording.sha256] = Fit(stem, channel, sound)
    return fits
