"""Damper, release noise and noise floor of a key: the measurements beyond its string and hammer."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ..analysis.damper import fit_damper
from ..analysis.noise import FREQUENCIES, noise_density
from ..analysis.note_names import note_to_midi
from ..analysis.release import release_sound
from ..errors import PianofitError
from ..recording.recording import load_recording
from ..schema.extras import DamperEntry, KeyExtras, NoiseFloor, SoundEntry
from .manifest import Role


def measure_extras(
    files: Mapping[Path, Role], paths: Mapping[str, str], note: str, channel: str
) -> tuple[KeyExtras, dict[Path, str]]:
    """Measure the files of one key; also return the recordings that cannot be used, with the reason.

    Parameters
    ----------
    files : recordings of the key and their roles.
    paths : original path of each.
    """
    dampers, releases, densities, unusable = [], [], [], {}
    for file, role in files.items():
        try:
            recording = load_recording(file, channel=channel)
            if role == "damped":
                fitted = {name: x for name, x in vars(fit_damper(recording, note)).items() if name != "f1"}
                dampers.append(DamperEntry(file=paths[str(file)], sha256=recording.sha256, **fitted))
            if role == "release":
                releases.append(SoundEntry.of(release_sound(recording), recording.rate, paths[str(file)]))
            else:
                densities.append(noise_density(recording))
        except PianofitError as error:
            unusable[file] = str(error)
    return KeyExtras(
        midi=note_to_midi(note), dampers=tuple(dampers), releases=tuple(releases), noise=_noise(densities)
    ), unusable


def _noise(densities: list[np.ndarray]) -> NoiseFloor | None:
    """The median over the recordings; of their mean channel if they differ in channels."""
    if not densities:
        return None
    same = len({len(density) for density in densities}) == 1
    rows = [density if same else density.mean(axis=0, keepdims=True) for density in densities]
    return NoiseFloor(FREQUENCIES, tuple(np.median(rows, axis=0)))
