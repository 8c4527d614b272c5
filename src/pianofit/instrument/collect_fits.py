"""Fits of single keys from a folder, on one velocity scale.

An uncalibrated fit determines its velocities up to a factor: (K_H, μ, d, v_H0, gain) → (K_H s^(1-p), μ/s, s d, s v_H0,
gain/s) does not change the sound. The loudest recording of every such key is set to `LOUDEST_VELOCITY`, which puts all
keys on one scale. Where the MIDI velocities of the recordings are known, this holds for the largest one. The loudest
recordings of other keys are set to the velocities that their own MIDI velocities have.
"""

import math
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..analysis.note_names import midi_to_note, note_to_midi
from ..conversions import HIGHEST_KEY, LOWEST_KEY, midi_of
from ..errors import FitError
from ..excitation import Excitation
from ..felt import SoftHammer, law_of
from ..felt.law import scale_velocity
from ..felt.soft_skin import SOFT_SKIN
from ..io.files import as_paths, printable
from ..model.modal_response import ModalResponse, decays_and_beats
from ..model.note import Note
from ..parameters import PARAMETERS, Hammer
from ..schema.extras import EXTRAS_FILE, KeyExtras, read_extras
from ..schema.fit import HINT, Fit, key_files, read_fit
from ..schema.instrument import SMALLEST_GAIN, FitSummary, Layer, PartialEntry
from ..schema.notes import note_of
from ..threads import numerical_settings
from .key_measurements import fitted_values, measurements_of, needed
from .key_quantities import soft_hammer, stroke_level, within_ranges
from .keyboard_posterior import KeyMeasurements, Measurement
from .velocity_curve import loudest_velocities

# Number of lowest partials whose beating and decays are listed.
LOWEST_PARTIALS = 4
# Largest value of a minimum over the upper end of its range: the mean of a Gaussian may lie a little beyond.
BEYOND = 10.0
# Largest distance of a pitch from the key in the folder's name, semitones. Pianos may be out of tune.
LARGEST_MISTUNING = 1.5
# Name of an instrument and of a key, with a separator or with a capital letter: "take2" does not contain the key E2.
_KEY = re.compile(r"(.*?)(?:(?:^|[-_ ])(?=[a-g])|[-_ ]?(?=[A-G]))([A-Ga-g][#sb♯♭]?(?:-1|\d))")


@dataclass(frozen=True, eq=False)
class KeyFit:
    """The fit of one key."""

    midi: int
    note: Note  # with gain and velocity of the loudest recording
    measured: KeyMeasurements  # of the `LAW_QUANTITIES`, without the prior of the fit
    fitted: Measurement  # of the `LAW_QUANTITIES`, as the fit reports them
    summary: FitSummary
    velocity: float | None  # of the loudest recording by its own fit, m/s; None if the scale of velocities is given

    @property
    def law(self) -> Excitation:
        """Excitation of the string; all keys of an instrument have the same kind."""
        return law_of(self.note.hammer)


def find_fits(paths: Sequence[str | os.PathLike[str]], prefix: str | None = None) -> list[Path]:
    """Find the `fit.json` files among paths.

    Parameters
    ----------
    paths : files themselves, or folders with `keys/KEY/fit.json`, as `pianofit batch` writes them.
    prefix : name of the instrument, if the folders hold several.

    Returns
    -------
    The files of one instrument.

    Raises
    ------
    FitError
        Without any fit, or if the folders hold several instruments and `prefix` names none of them.

    Examples
    --------
    >>> from pathlib import Path
    >>> import pianofit
    >>> [file.parent.name for file in pianofit.find_fits([Path("batch")], "cp80")]
    ['cp80-C4', 'cp80-E4']
    """
    found: list[Path] = []
    paths = as_paths("paths", paths)
    for path in paths:
        if path.is_file():
            found.append(path)
            continue
        if not path.is_dir():
            raise FitError(f"{printable(path)}: no such file or folder; give what pianofit batch or pianofit fit wrote")
        if not (in_folder := key_files(path)):
            raise FitError(f"{printable(path)}: holds no keys/KEY/fit.json; give the folder that pianofit batch wrote")
        found += in_folder
    owners = {file: instrument_name(file) for file in found}
    if prefix is not None:
        chosen = [file for file in found if owners[file] == prefix]
        if not chosen:
            names = ", ".join(sorted(repr(printable(name)) for name in set(owners.values())))
            raise FitError(f"--prefix {prefix!r}: no key has this prefix; available: {names}")
        return chosen
    several = sorted({name for name in owners.values() if name})
    if len(several) > 1:
        named = ", ".join(map(printable, several))
        folders = ", ".join(map(printable, paths))
        raise FitError(f"{folders}: these fits are of several instruments, {named}; choose one by --prefix")
    return found


def load_extras(paths: Sequence[str | os.PathLike[str]], instrument: str) -> list[KeyExtras]:
    """Read what a batch measured of dampers, release noise and noise floors.

    Parameters
    ----------
    paths : as for `find_fits`; next to a single fit.json its own `extras.json` is read.
    instrument : name of the instrument in the names of the folders, empty if they have none. Other instruments are left
        out.

    Returns
    -------
    The records of the keys, which may have no fit. Empty if there are none.

    Raises
    ------
    FitError
        For a file of another kind or schema.

    Examples
    --------
    >>> from pathlib import Path
    >>> import pianofit
    >>> pianofit.load_extras([Path("batch")], "cp80")
    []
    """
    files: list[Path] = []
    for path in as_paths("paths", paths):
        files += path.parent.glob(EXTRAS_FILE) if path.is_file() else key_files(path, EXTRAS_FILE)
    return [read_extras(file) for file in files if instrument_name(file) == instrument]


def instrument_name(file: Path) -> str:
    """Return the instrument in the name of a fit's folder, such as cp80 in cp80-Fs2; empty if there is none."""
    return _names_of(file)[0]


def instrument_title(paths: Sequence[Path], files: Sequence[Path], prefix: str | None) -> str:
    """Return the name of an instrument: the `prefix`, the name in the folders of its fits, or the first folder's."""
    first = paths[0].resolve()
    folder = first if first.is_dir() else first.parent
    return printable(prefix or instrument_name(files[0]) or folder.name)


def _names_of(file: Path) -> tuple[str, int | None]:
    """Return the instrument and the key in the folder's name, such as cp80-Fs2."""
    match = _KEY.fullmatch(file.resolve().parent.name)
    return (match[1], note_to_midi(match[2])) if match else ("", None)


@numerical_settings()
def load_keys(files: Sequence[str | os.PathLike[str]]) -> list[KeyFit]:
    """Read the fit of one key from every file.

    Parameters
    ----------
    files : `fit.json` files, as `find_fits` returns them.

    Returns
    -------
    The fits in ascending order of keys.

    Raises
    ------
    FitError
        For a file that is not a `fit.json`, for two fits of one key, for a key beyond the keyboard, for a relaxing
        felt, and for recordings of different quantities.

    Examples
    --------
    >>> from pathlib import Path
    >>> import pianofit
    >>> [key.midi for key in pianofit.load_keys(pianofit.find_fits([Path("batch")], "cp80"))]
    [60, 64]
    """
    found: dict[int, _CheckedFit] = {}
    for file in as_paths("files", files):
        key = _checked_fit(file)
        if (other := found.get(key.midi)) is not None:
            raise FitError(
                f"{key.name}: is {midi_to_note(key.midi)}, and so is {other.name}; leave one out, or choose an "
                "instrument by --prefix"
            )
        found[key.midi] = key
    _check_one_excitation(found.values())
    kinds = sorted({key.note.quantity for key in found.values()})
    if len(kinds) > 1:
        raise FitError(
            f"{printable(files[0])}: the keys were recorded as {' and '.join(kinds)}; an instrument needs one quantity"
        )
    keys = [found[midi] for midi in sorted(found)]
    velocities = loudest_velocities([_layers(key.fit, key.sizes) for key in keys])
    return [_key_fit(key, velocity) for key, velocity in zip(keys, velocities, strict=True)]


class _CheckedFit(NamedTuple):
    """The content of a `fit.json` that an instrument can use."""

    name: str  # of the file
    fit: Fit
    note: Note
    midi: int
    sizes: dict[int, float]  # of the strokes, by recording


def _check_one_excitation(keys: Iterable[_CheckedFit]) -> None:
    """Raise a `FitError` that names two files with different excitations."""
    found = {(law := law_of(key.note.hammer)).kind: (key.name, law.words.verb) for key in keys}
    if len(found) > 1:
        (a, how_a), (b, how_b), *_ = found.values()
        raise FitError(
            f"{a} is {how_a} and {b} is {how_b}; an instrument needs one excitation, so give the fits of one"
        )


def _checked_fit(file: Path) -> _CheckedFit:
    fit, name = read_fit(file), printable(file)
    note = note_of(fit, file.parent, name)
    midi = _midi(note, file)
    law = law_of(note.hammer)
    if law.key_quantities and not isinstance(note.hammer, Hammer | SoftHammer):
        raise FitError(f"{name}: an instrument cannot use a relaxing felt; fit with --felt {SOFT_SKIN.name}")
    _check_values(fit, name, note)
    return _CheckedFit(name, fit, note, midi, _sizes(fit, law))


def _key_fit(key: _CheckedFit, velocity: float) -> KeyFit:
    """The fit of a key whose loudest recording is set to `velocity`, m/s, if its own scale of velocities is open."""
    name, fit, note, midi, sizes = key
    law = law_of(note.hammer)
    loudest = max(sizes, key=lambda recording: sizes[recording])
    # The note has the output path of the reference recording, and a gain belongs to a path.
    same_path = [i for i in fit.path_groups[fit.reference.path_group] if i in sizes]
    gain = note.gain if law.size_is_gain else fit.recordings[max(same_path, key=lambda i: sizes[i])].gain
    note = note.with_size(sizes[loudest])
    path = None if note.path is None else note.path._replace(velocity_discrepancy=None)  # only predictions use it
    summary = FitSummary(
        file=name,
        recordings=len(fit.recordings),
        levels_db=fit.levels.fitted_db,
        converged=fit.converged,
        velocities=tuple(np.unique([*sizes.values()]).tolist()),
        layers=_layers(fit, sizes),
        partials=() if note.modal_response is None else partial_decays(note.modal_response),
    )
    own_velocity = sizes[loudest] if fit.velocity_scale_open else None
    scale = velocity / sizes[loudest] if own_velocity or law.size_is_gain else 1.0
    note, summary = _scaled(note._replace(gain=gain, path=path), summary, scale)
    own = fit, note, midi, stroke_level(note)
    return KeyFit(midi, note, measurements_of(*own), fitted_values(*own), summary, own_velocity)


def _sizes(fit: Fit, law: Excitation) -> dict[int, float]:
    """Return the size of the stroke by recording: its velocity, m/s, or the force of a pluck over the reference's, N.

    The force of a pluck follows from its gain, which other paths do not share. Their recordings are left out.
    """
    if not law.size_is_gain:
        return {i: float(recording.stroke_value) for i, recording in enumerate(fit.recordings)}
    group = fit.path_groups[fit.reference.path_group]
    return {i: abs(fit.recordings[i].gain / fit.reference.gain) for i in group}


def _check_values(fit: Fit, name: str, note: Note) -> None:
    """Raise a `FitError` for values that an instrument cannot use."""
    law = law_of(note.hammer)
    stroke = law.stroke
    for i, recording in enumerate(fit.recordings):
        if not (recording.stroke_value > 0 and abs(recording.gain) >= SMALLEST_GAIN):
            raise FitError(
                f"{name}: recordings[{i}] has {stroke.name} = {recording.stroke_value:g} {stroke.unit} and gain = "
                f"{recording.gain:g}, but a {law.words.order} must be above 0, and a gain at least "
                f"{SMALLEST_GAIN:g} of either sign; {HINT}"
            )
    for i, minimum in enumerate(fit.minima):
        values = minimum.values(fit)
        # A felt may have no loss: `note_at` gives it the smallest one.
        names = needed(law) | {x for x in law.parameters if x in fit.parameters}
        missing = {x for x in names if not (values.get(x, -1.0) > 0 or (x == "mu" and values.get(x) == 0))}
        if missing or len(minimum.stroke_values) == 0 or not (minimum.stroke_values > 0).all():
            raise FitError(
                f"{name}: minima[{i}] must have {law.words.strokes} above 0, {stroke.unit}, and values above 0 of "
                f"{', '.join(sorted(missing)) or 'its parameters'}; {HINT}"
            )
        boxes = PARAMETERS | law.hammer_parameters
        far = {x: value for x, value in values.items() if x in boxes and value > BEYOND * boxes[x].upper}
        if far or (minimum.stroke_values > BEYOND * stroke.bounds(note.geometry)[1]).any():
            raise FitError(f"{name}: minima[{i}] is far beyond the ranges of {', '.join(far) or stroke.name}; {HINT}")
        if minimum.covariance is not None and not minimum.covariance.is_valid:
            raise FitError(
                f"{name}: minima[{i}].covariance must be a finite symmetric matrix without negative eigenvalues; {HINT}"
            )


def scale_key(key: KeyFit, scale: float) -> KeyFit:
    """Return the fit of a key with all sizes of strokes times `scale`. The sound of its recordings stays the same."""
    note, summary = _scaled(key.note, key.summary, scale)
    return replace(key, note=note, summary=summary)


def _scaled(note: Note, summary: FitSummary, scale: float) -> tuple[Note, FitSummary]:
    response, hammer = note.modal_response, _scaled_hammer(note, scale)
    response = None if response is None else response.scale_velocity(scale)
    layers = tuple(replace(layer, velocity=layer.velocity * scale) for layer in summary.layers)
    velocities = tuple(velocity * scale for velocity in summary.velocities)
    return (
        note._replace(hammer=hammer, gain=note.gain / scale, modal_response=response),
        replace(summary, velocities=velocities, layers=layers),
    )


def _scaled_hammer(note: Note, scale: float) -> Any:
    if not law_of(note.hammer).key_quantities:
        return note.with_size(note.size * scale).hammer
    return SoftHammer(**within_ranges(scale_velocity(soft_hammer(note.hammer)._asdict(), SOFT_SKIN, scale)))


def _midi(note: Note, file: Path) -> int:
    """Return the key in the folder's name if it is near the pitch, otherwise the nearest key."""
    pitch = midi_of(note.f0)
    _, named = _names_of(file)
    midi = named if named is not None and abs(named - pitch) < LARGEST_MISTUNING else round(pitch)
    if not LOWEST_KEY <= midi <= HIGHEST_KEY:
        raise FitError(f"{printable(file)}: f0 is {pitch - 69:+z.1f} semitones from A4, beyond a piano's A0 to C8")
    return midi


def _layers(fit: Fit, sizes: Mapping[int, float]) -> tuple[Layer, ...]:
    """Return the recordings of a fit whose strokes have `sizes`, soft to loud."""
    entries = () if fit.modal_response is None else fit.modal_response.layers
    delay = {entry.file: entry.contact_s for entry in entries}
    layers = [
        Layer(r.file, r.sha256, r.onset_s + delay.get(r.file, 0.0), sizes[i], r.midi_velocity)
        for i, r in enumerate(fit.recordings)
        if i in sizes
    ]
    return tuple(sorted(layers, key=lambda layer: layer.velocity))


def partial_decays(response: ModalResponse) -> tuple[PartialEntry, ...]:
    """Return the split of the two beating modes, cents, and the ratio of late to early T60 of the lowest partials."""
    return tuple(
        PartialEntry(
            partial.number,
            _finite(partial.late / partial.early),
            _finite(1200 * math.log2(1 + partial.beat_frequency / partial.frequency)),
        )
        for partial in decays_and_beats(response)
        if partial.number <= LOWEST_PARTIALS
    )


def _finite(value: float) -> float | None:
    """Return None instead of NaN, which JSON does not have."""
    return None if math.isnan(value) else value
