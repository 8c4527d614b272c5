"""A measurement of the laboratory as a fit meets it, its fits, and how near a sound comes to it.

The setup holds what the laboratory knew, and as initial values the paper's (Tables II and III), with the hammer's
velocity as the sensor read it, which the paper's recipes fit like the rest. Sounds go by `measured`, `initial` and the
names of `RECIPES`.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ...analysis import Analysis, analyse, law_frequency
from ...criterion import BANDS, Cells, band_of, band_values, line_sigma, measure
from ...inference import Result
from ...inference.fit import fit_recordings
from ...inference.listener import scored
from ...inference.start import starting_values
from ...model.note import Note
from ...parameters import FIT_NAMES, STRING_NAMES
from ...recording import Recording, recording_from_samples
from ...setup import Setup, setup_from_dict
from ..laboratory import Laboratory, Measurement, setup_text
from ..laboratory import measure as record
from ..recipes import fit_by_recipe
from .descriptors import attack_time, centroid

__all__ = ["RECIPES", "Case", "Closeness", "fitted", "make_case", "rms", "values_of"]

# recipe -> what it is called on the page. `read` is the paper's third step on a string that was read off the partials.
RECIPES = {
    "global": "global criterion", "paper": "three bands", "read": "three bands, string read",
    "default": "default recipe",
}  # fmt: skip
# From the seed of one annealing to that of the next; measurements have the seeds in between.
NEXT_TRY = 10_000


class Closeness(NamedTuple):
    """A sound beside a measurement."""

    criterion: dict[str, float]  # eq. 19, `global` and band by band
    level_db: float  # rms of the partials' differences in level, dB
    attack: float  # s
    centroid: float  # Hz


@dataclass(frozen=True)
class Case:
    """One measurement as a fit meets it. Sounds are m/s [samples] from the onset on."""

    measurement: Measurement
    recording: Recording
    analysis: Analysis
    setup: Setup

    @cached_property
    def heard(self) -> np.ndarray:
        """What was measured."""
        return self.recording.samples[self.recording.onset :] * self.measurement.scale

    @cached_property
    def measured(self) -> tuple[Cells, np.ndarray]:
        """The criterion's cells, and |S|² [partials, nodes] there."""
        return self.energies(self.heard)

    def energies(self, sound: np.ndarray) -> tuple[Cells, np.ndarray]:
        """The same of another sound."""
        a = self.analysis
        return measure(sound, self.recording.rate, a.f0, a.B, int(a.partials.number.max()), line_sigma(a.f0))

    def played(self, note: Note) -> np.ndarray:
        """A note, laid over the measurement's onset."""
        samples, _ = note.stroke(self.recording.rate, len(self.recording.samples), self.measurement.onset)
        return samples[self.recording.onset :] / note.gain

    def closeness(self, sound: np.ndarray) -> Closeness:
        """Compare a sound with the measurement."""
        (cells, energy), at = self.measured, (self.recording.rate, self.analysis.f0)
        criterion, (_, off) = band_values(self.energies(sound)[1], energy, cells.spacing), self.level_differences(sound)
        return Closeness(criterion, rms(off), attack_time(sound, *at), centroid(sound, *at))

    def level_differences(self, sound: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Numbers of the partials to 6 kHz within 60 dB of the strongest, and how far `sound` is above them, dB."""
        measured, own = (
            10 * np.log10((energy * cells.spacing[:, None]).sum(axis=1))
            for cells, energy in (self.measured, self.energies(sound))
        )
        number = np.arange(1, len(measured) + 1)
        frequency = law_frequency(self.analysis.f0, self.analysis.B, number)
        compared = scored(frequency, measured)
        return number[compared], (own - measured)[compared]

    def shares(self) -> dict[str, dict[int, float]]:
        """Share of each partial in its band's ∫ |S|⁴, by which eq. 19 weighs: band -> partial -> share."""
        cells, energy = self.measured
        weight = (cells.spacing[:, None] * energy**2).sum(axis=1)
        band = band_of(np.arange(1, len(weight) + 1))
        return {
            name: {int(k) + 1: float(weight[k] / weight[band == n].sum()) for k in np.flatnonzero(band == n)}
            for n, name in enumerate(BANDS)
        }


def make_case(lab: Laboratory, velocity: float, seed: int, start: float | None = None) -> Case:
    """Measure a stroke of `velocity`, m/s, and analyse it; a fit starts at what the sensor read, or at `start`, m/s."""
    measured = record(lab, velocity, seed)
    recording = recording_from_samples(measured.samples, measured.rate, name=f"{velocity:g} m/s")
    setup = setup_from_dict(tomllib.loads(setup_text(measured, hold_velocity=False)), "laboratory")
    if start is not None:
        setup = replace(setup, initial=setup.initial | {"v_H0": start})
    return Case(measured, recording, analyse(recording), setup)


def fitted(case: Case, recipe: str, seed: int, annealing: int | None = None, tries: int = 1) -> Result:
    """Fit by one of `RECIPES`.

    Parameters
    ----------
    annealing : evaluations for each annealing, the recipe's own number if None.
    tries : annealings, each with a seed of its own; the one with the lowest criterion in band 3 counts.
    """
    heard, setup = (case.recording, case.analysis), case.setup
    if recipe == "default":
        return fit_recordings([case.recording], [case.analysis], setup, seed=seed)
    if recipe == "global":
        return fit_by_recipe(*heard, setup, recipe, seed=seed)
    if recipe == "read":
        # The string is held at what the frequencies and decays of the partials say.
        values = starting_values(case.analysis, setup).values
        left = {name: value for name, value in setup.initial.items() if name not in STRING_NAMES}
        setup = replace(setup, known={name: values[name] for name in STRING_NAMES}, initial=left)
    results = [
        fit_by_recipe(*heard, setup, "paper", evaluations=annealing, seed=seed + NEXT_TRY * n) for n in range(tries)
    ]
    return min(results, key=lambda result: result.document["criterion"]["band3"]["final"])


def values_of(result: Result) -> dict[str, float]:
    """The nine parameters that were found."""
    return {name: float(result.document["parameters"][name]["value"]) for name in FIT_NAMES}


def rms(values: np.ndarray) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))
