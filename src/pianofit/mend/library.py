"""The recordings of a library, mended by the fits of its keys, and a list of every change.

Originals are only read. A recording that nothing changes is copied byte for byte.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..analysis.note_names import midi_to_note, note_to_midi
from ..batch import Key, Sample, read_keys
from ..errors import FitError, RecordingError, SetupError, check_range
from ..instrument import Instrument, load_instrument
from ..instrument.key_quantities import stroke_level
from ..io.audio import decode_file
from ..io.files import (
    PEAK_LIMIT,
    encode_pcm,
    encode_wav,
    limit_peak,
    output_folder,
    printable,
    read_file,
    replace_file,
    safe_name,
    write_error,
)
from ..io.table_output import write_csv
from ..model.modal_response import PRE_ONSET_S
from ..recording.recording import MAX_BYTES, load_recording
from .layers import LayerLaw, even_level, layer_laws, missing_sounds, recorded_level
from .tail import Continuation, continue_by_modes, end_in_silence, lengthen, modes_of_key

LIST = "changes.csv"
# Folder, in the output, of sounds that were never recorded.
ADDED = "added"
# Bits of changed files: 24, which hold a tail down to its end without dither, or 32 for floats.
BITS, FLOAT_BITS, FLOATS = 24, 32, ("FLOAT", "DOUBLE")
# Smallest change of level, dB, and of the onset, s, that is made.
LEAST_GAIN_DB, LEAST_SHIFT = 0.05, 1e-4


@dataclass(frozen=True)
class Change:
    """One change of one file, or the reason why there is none."""

    file: str  # in the output folder
    note: str
    layer: str
    change: str  # "tail", "level", "onset", "added" or "unchanged"
    before: float | None
    after: float | None
    unit: str
    detail: str


class MendOptions(NamedTuple):
    """The kinds of changes, and their amounts.

    Parameters
    ----------
    tails : length after the onset to which recordings are lengthened, s; 0 leaves all as they are.
    even_levels : how far levels are moved to an even keyboard, from 0 (not at all) to 1.
    onsets : how far surplus silence before an onset is removed, from 0 (not at all) to 1.
    fill : whether to add the layers and keys that were not recorded.
    keys : MIDI numbers of the keys to fill; None for all from the lowest recorded one to the highest.
    """

    tails: float = 10.0
    even_levels: float = 0.0
    onsets: float = 0.0
    fill: bool = True
    keys: tuple[int, ...] | None = None


class _Library(NamedTuple):
    """Recordings of a library and what their fits say."""

    root: Path
    notes: list[tuple[Key, Sample]]
    instrument: Instrument
    laws: dict[str, LayerLaw]
    recorded: dict[str, dict[int, float]]  # velocities, m/s, by layer and key


class _Sound(NamedTuple):
    """A sound to write."""

    file: str
    content: np.ndarray | Path  # [channels, samples], or the file to copy
    rate: int
    bits: int
    changes: list[Change]


def mend_library(
    library: Path,
    fits: Path,
    out: Path | None,
    options: MendOptions,
    *,
    pattern: str | None = None,
    root: Path | None = None,
    transpose: int = 0,
    prefix: str | None = None,
    force: bool = False,
    progress: Callable[[str, float], None] = lambda *_: None,
) -> tuple[list[Change], list[str]]:
    """Mend the recordings of a library.

    Parameters
    ----------
    library : manifest or folder, as for `read_keys`.
    fits : folder of its fits, as `pianofit batch` wrote it.
    out : folder for the mended recordings and `changes.csv`; None only lists the changes.
    options : what is mended.
    pattern, root, transpose : as for `read_keys`.
    prefix : name of the instrument, if the library has several.
    force : replace a result in the folder.
    progress : called with the name of the step and the finished fraction.

    Returns
    -------
    All changes, and remarks on the library.

    Raises
    ------
    SetupError
        If the library cannot be used, or the output folder lies in it.
    FitError
        If the fits cannot be used.
    """
    check_range("tails=", options.tails, 0.0, 120.0, " s")
    check_range("even_levels=", options.even_levels, 0.0, 1.0)
    check_range("onsets=", options.onsets, 0.0, 1.0)
    keys, remarks = read_keys(library, pattern=pattern, root=root, transpose=transpose)
    names = sorted({key.instrument for key in keys})
    if len(names) > 1 if prefix is None else prefix not in names:
        which = "several instruments" if prefix is None else f"no instrument {printable(prefix)!r}"
        raise SetupError(
            f"{printable(library)}: has {which}; choose one of {', '.join(map(printable, names))} by --prefix"
        )
    keys = [key for key in keys if prefix is None or key.instrument == prefix]
    root = (root or (library if library.is_dir() else library.parent)).resolve()
    # The strokes of all keys; recordings of other roles are left out.
    notes = [(key, sample) for key in keys for sample in key.samples if sample.role == "note"]
    files = [sample.file for _, sample in notes]
    _check_places(library, root, files)
    if out is not None:
        _check_out(out, root, files)
    digests = {file: hashlib.sha256(read_file(file, MAX_BYTES, RecordingError)).hexdigest() for file in files}
    sounds = _mended(_read(notes, root, load_instrument(fits, prefix), digests), options, remarks, progress)
    if out is None:
        return [change for sound in sounds for change in sound.changes], remarks
    changes: list[Change] = []
    with output_folder(out, force, LIST) as folder:
        for sound in sounds:
            _write(folder, sound)
            changes += sound.changes
        write_csv(folder / LIST, [field.name for field in fields(Change)], [astuple(change) for change in changes])
    return changes, remarks


def _read(notes: list[tuple[Key, Sample]], root: Path, instrument: Instrument, digests: dict[Path, str]) -> _Library:
    """Find the velocities of all recordings."""
    fitted = {midi: key.fit for midi, key in instrument.keys.items() if key.fit is not None}
    strokes = {layer.sha256: (midi, layer.velocity) for midi, fit in fitted.items() for layer in fit.layers}
    recorded: dict[str, dict[int, float]] = {}
    for key, sample in notes:
        midi, velocity = strokes.get(digests[sample.file], (None, 0.0))
        if midi is None:
            continue
        if midi != note_to_midi(key.note):
            raise SetupError(
                f"{printable(sample.file)}: is {key.note} here and {midi_to_note(midi)} in --fits; give the "
                "--transpose of pianofit batch"
            )
        recorded.setdefault(sample.layer, {})[midi] = velocity
    if not recorded:
        raise FitError(f"--fits: holds no fit of the recordings in {printable(root)}; give that of pianofit batch")
    return _Library(root, notes, instrument, layer_laws(recorded), recorded)


def _check_places(library: Path, root: Path, files: Sequence[Path]) -> None:
    """Raise a `SetupError` if two recordings would be written to one file."""
    places = Counter(_written(root, file) for file in files)
    twice = [place for place, count in places.items() if count > 1]
    if twice:
        raise SetupError(
            f"{printable(library)}: several recordings would be written to {printable(twice[0])}; rename one"
        )


def _check_out(out: Path, root: Path, files: Sequence[Path]) -> None:
    """Raise a `SetupError` if the output folder and the recordings could mix."""
    place = out.resolve()
    if place.is_relative_to(root) or any(file.is_relative_to(place) for file in files):
        raise SetupError(f"--out {printable(out)}: lies in the library or contains it; give a folder next to it")


def _mended(
    library: _Library, options: MendOptions, remarks: list[str], progress: Callable[[str, float], None]
) -> Iterator[_Sound]:
    """Yield all sounds of the mended library."""
    layouts = Counter[tuple[int, int, int, str]]()  # channels, rate, bits and kind
    several = any(sample.group for _, sample in library.notes)
    if several and (options.fill or options.even_levels):
        remarks.append("the library has several microphones; sounds are not added and levels stay as they are")
    missing = _missing(library, options) if options.fill and not several else {}
    gains, common = _gains(library, options.even_levels) if options.even_levels and not several else ({}, 0.0)
    if common < 0:
        remarks.append(f"all levels are lowered by {-common:.1f} dB, so that the loudest stays below full scale")
    for i, (key, sample) in enumerate(library.notes):
        try:
            original = _Original.read(sample.file)
        except RecordingError as error:
            yield _copied(library, key, sample, str(error))
            continue
        gain = gains.get(sample.file, 0.0) + common
        yield _mend(library, options, key, sample, original, gain)
        layouts[len(original.sound), original.rate, original.bits, _kind(sample.file)] += 1
        progress("mending", (i + 1) / len(library.notes))
    if missing:
        yield from _filled(library, options, missing, layouts.most_common(1)[0][0], common, progress)


def _gains(library: _Library, even: float) -> tuple[dict[Path, float], float]:
    """Gains of recordings towards an even keyboard, and the common one that keeps all below full scale, dB."""
    gains, highest = dict[Path, float](), -np.inf
    for key, sample in library.notes:
        midi = note_to_midi(key.note)
        if midi not in library.recorded.get(sample.layer, {}):
            continue
        original = _Original.read(sample.file)
        wanted = even_level(library.instrument, midi, library.laws[sample.layer])
        gains[sample.file] = even * (wanted - recorded_level(original.sound, original.rate, original.onset))
        highest = max(highest, 20 * np.log10(np.abs(original.sound).max()) + gains[sample.file])
    return gains, float(min(20 * np.log10(PEAK_LIMIT) - highest, 0.0))


class _Original(NamedTuple):
    """A recording as its file holds it."""

    sound: np.ndarray  # [channels, samples]
    rate: int  # Hz
    onset: int  # sample
    bits: int

    @classmethod
    def read(cls, file: Path) -> _Original:
        """Read a file of a library."""
        frames, rate, subtype = decode_file(file, MAX_BYTES)
        return cls(frames.T, rate, load_recording(file).onset, FLOAT_BITS if subtype in FLOATS else BITS)


def _mend(
    library: _Library, options: MendOptions, key: Key, sample: Sample, original: _Original, gain: float
) -> _Sound:
    """Mend one recording."""
    sound, rate, onset, bits = original
    written = _written(library.root, sample.file)
    changes, reason = list[Change](), "no change was asked for"

    def add(change: str, before: float, after: float, unit: str, detail: str) -> None:
        numbers = round(before, 4), round(after, 4)
        changes.append(Change(written, key.note, sample.layer, change, *numbers, unit, detail))

    if options.tails:
        have = (sound.shape[-1] - onset) / rate
        found = _continuation(library.instrument, note_to_midi(key.note), original, options.tails)
        if isinstance(found, str):
            reason = found
        else:
            sound = lengthen(sound, rate, onset, options.tails, found)
            joint, over = (found.joint - onset) / rate, f"{found.step_db:+z.2f} dB, {found.slope_db:+z.2f} dB/s"
            after = (sound.shape[-1] - onset) / rate
            add("tail", have, after, "s", f"joint at {joint:.2f} s, recording over modes {over}")
    if abs(gain) >= LEAST_GAIN_DB:
        level = recorded_level(sound, rate, onset)
        sound = sound * 10 ** (gain / 20)
        add("level", level, level + gain, "dB", "towards an even keyboard")
    surplus = options.onsets * (onset / rate - PRE_ONSET_S)
    if surplus > LEAST_SHIFT:
        sound = sound[:, round(surplus * rate) :]
        add("onset", onset / rate, onset / rate - surplus, "s", "silence before it removed")
    if changes:
        return _Sound(written, sound, rate, bits, changes)
    return _copied(library, key, sample, reason)


def _copied(library: _Library, key: Key, sample: Sample, reason: str) -> _Sound:
    """Return a file that is copied as it is."""
    place = _place(library.root, sample.file)
    unchanged = Change(place, key.note, sample.layer, "unchanged", None, None, "", reason)
    return _Sound(place, sample.file, 0, 0, [unchanged])


def _continuation(instrument: Instrument, midi: int, original: _Original, seconds: float) -> Continuation | str:
    """How a recording goes on up to `seconds` after its onset, or why it is left as it is."""
    sound, rate, onset, *_ = original
    have, key = (sound.shape[-1] - onset) / rate, instrument.keys.get(midi)
    if have >= seconds:
        return f"it rings for {have:.2f} s already"
    if key is None or key.fit is None:
        return "its key has no fit"
    return continue_by_modes(sound, rate, onset, modes_of_key(key.note))


def _place(root: Path, file: Path) -> str:
    """Place of a file in the output folder."""
    return file.relative_to(root).as_posix() if file.is_relative_to(root) else file.name


def _written(root: Path, file: Path) -> str:
    """Place of a changed recording, a FLAC or a WAV file."""
    place = Path(_place(root, file))
    return place.as_posix() if _kind(place) == "flac" else place.with_suffix(".wav").as_posix()


def _kind(file: Path) -> str:
    """Kind of the file to write for a recording."""
    return "flac" if file.suffix.lower() == ".flac" else "wav"


def _missing(library: _Library, options: MendOptions) -> dict[str, tuple[int, str]]:
    """Return the keys and layers that were not recorded, by the name of their file without its ending.

    Raises a `SetupError` if two have one name.
    """
    recorded = sorted(set().union(*library.recorded.values()))
    present = {(note_to_midi(key.note), sample.layer) for key, sample in library.notes}
    wanted = missing_sounds(library.recorded, options.keys or range(recorded[0], recorded[-1] + 1))
    found: dict[str, tuple[int, str]] = {}
    for midi, layer in wanted:
        if (midi, layer) in present:  # also a recording without a fit is there
            continue
        parts = library.notes[0][0].instrument, midi_to_note(midi).replace("#", "s"), layer
        name = "-".join(filter(None, map(safe_name, parts)))
        if name in found:
            layers = " and ".join(printable(repr(one)) for one in (found[name][1], layer))
            raise SetupError(f"layers {layers}: their added sounds would both be {name}; rename one, or add none")
        found[name] = midi, layer
    return found


def _filled(
    library: _Library,
    options: MendOptions,
    missing: Mapping[str, tuple[int, str]],
    layout: tuple[int, int, int, str],
    common: float,
    progress: Callable[[str, float], None],
) -> Iterator[_Sound]:
    """Yield the sounds that were not recorded, as the instrument plays them, with a `common` gain, dB."""
    channels, rate, bits, kind = layout
    for i, (name, (midi, layer)) in enumerate(missing.items()):
        key, velocity = library.instrument.keys[midi], library.laws[layer].velocity(midi)
        seconds = options.tails or MendOptions().tails
        sound = np.atleast_2d(key.note.render(velocity, seconds=seconds, rate=rate, mono=channels == 1))
        if len(sound) not in (1, channels):
            sound = sound.mean(axis=0, keepdims=True)
        amount = options.even_levels
        level = even_level(library.instrument, midi, library.laws[layer]) if amount else 0.0
        gain = common + amount * (level - stroke_level(key.note, velocity) if amount else 0.0)
        sound, limited = limit_peak(10 ** (gain / 20) * end_in_silence(sound, round(PRE_ONSET_S * rate)))
        detail = "computed from the fit of this key" if key.fit is not None else "computed from the keyboard laws"
        detail += f", lowered by {-20 * np.log10(limited):.2f} dB to stay below full scale" * (limited < 1)
        place = f"{ADDED}/{name}.{kind}"
        change = Change(place, midi_to_note(midi), layer, "added", None, round(velocity, 3), "m/s", detail)
        yield _Sound(place, np.broadcast_to(sound, (channels, sound.shape[-1])), rate, bits, [change])
        progress("adding", (i + 1) / len(missing))


def _write(folder: Path, sound: _Sound) -> None:
    file = folder / sound.file
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(file.parent, error, "choose another --out") from None
    if isinstance(sound.content, Path):
        replace_file(file, read_file(sound.content, MAX_BYTES, RecordingError))
    elif sound.bits == FLOAT_BITS and _kind(file) == "wav":
        replace_file(file, encode_wav(sound.content, sound.rate))
    else:
        replace_file(file, encode_pcm(sound.content, sound.rate, _kind(file), BITS))
