"""Measurements of the laboratory as a fit meets them, their fits, and how near a sound comes to one.

A `Case` is a measurement as a fit meets it. Its setup holds what the laboratory knew, and as initial values the paper's
(Tables II and III), with the hammer's velocity as the sensor read it, which the paper's recipes fit like the rest.
"""

from __future__ import annotations

import tomllib
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ...analysis import Analysis, analyse, law_frequency
from ...criterion import BANDS, band_of, band_values, line_sigma, measure
from ...inference import Result
from ...inference.fit import fit_takes
from ...inference.start import starting_values
from ...model.note import Note
from ...parameters import FIT_NAMES, STRING_NAMES
from ...recording import Recording, recording_from_samples
from ...setup import Setup, setup_from_dict
from ..laboratory import Laboratory, Measurement, setup_text
from ..laboratory import measure as record
from ..recipes import fit_by_recipe
from .descriptors import attack_time, centroid

__all__ = [
    "RECIPES", "Case", "Closeness", "closeness", "fitted", "level_differences", "make_case", "played", "rms", "shares",
    "values_of",
]  # fmt: skip

# recipe -> what it is called on the page. `read` is the paper's third step on a string that was read off the partials.
RECIPES = {
    "global": "global criterion", "paper": "three bands", "read": "three bands, string read",
    "default": "default recipe",
}  # fmt: skip
# Levels are compared over partials to 6 kHz within 60 dB of the strongest.
LEVEL_TOP, LEVEL_RANGE = 6000.0, 60.0
# From the seed of one annealing to that of the next; measurements have the seeds in between.
NEXT_TRY = 10_000


class Case(NamedTuple):
    """One measurement as a fit meets it."""

    velocity: float  # true, m/s
    measurement: Measurement
    recording: Recording
    analysis: Analysis
    setup: Setup

    @property
    def heard(self) -> np.ndarray:
        """The recording from its onset on, m/s [samples]."""
        return self.recording.samples[self.recording.onset :] * self.measurement.scale


class Closeness(NamedTuple):
    """A sound beside a measurement."""

    criterion: dict[str, float]  # eq. 19, `global` and band by band
    level_db: float  # rms of the partials' differences in level, dB
    attack: float  # s
    centroid: float  # Hz


def make_case(lab: Laboratory, velocity: float, seed: int, *, start: float | None = None) -> Case:
    """Measure a stroke of `velocity`, m/s, and analyse it.

    Parameters
    ----------
    start : the hammer velocity at which a fit starts, m/s; what the sensor read if None.
    """
    measured = record(lab, velocity, seed)
    recording = recording_from_samples(measured.samples, measured.rate, name=f"{velocity:g} m/s")
    setup = setup_from_dict(tomllib.loads(setup_text(measured, hold_velocity=False)), "laboratory")
    if start is not None:
        setup = replace(setup, initial=setup.initial | {"v_H0": start})
    return Case(velocity, measured, recording, analyse(recording), setup)


def fitted(case: Case, recipe: str, seed: int, annealing: int | None = None, tries: int = 1) -> Result:
    """Fit by one of `RECIPES`.

    Parameters
    ----------
    annealing : evaluations for each annealing, the recipe's own number if None.
    tries : annealings, each with a seed of its own; the one with the lowest criterion in band 3 counts.
    """
    heard = case.recording, case.analysis
    if recipe == "default":
        return fit_takes([case.recording], [case.analysis], case.setup, seed=seed)
    if recipe == "global":
        return fit_by_recipe(*heard, case.setup, recipe, seed=seed)
    setup = case.setup if recipe == "paper" else _with_string_read(case)
    results = [
        fit_by_recipe(*heard, setup, "paper", evaluations=annealing, seed=seed + NEXT_TRY * n) for n in range(tries)
    ]
    return min(results, key=lambda result: result.document["criterion"]["band3"]["final"])


def _with_string_read(case: Case) -> Setup:
    """A setup in which the string is held at what the frequencies and decays of the partials say."""
    values = starting_values(case.analysis, case.setup).values
    string = {name: values[name] for name in STRING_NAMES}
    left = {name: value for name, value in case.setup.initial.items() if name not in string}
    return replace(case.setup, known=string, initial=left)


def values_of(result: Result) -> dict[str, float]:
    """The nine parameters that were found."""
    return {name: float(result.document["parameters"][name]["value"]) for name in FIT_NAMES}


def played(note: Note, case: Case, velocity: float | None = None) -> np.ndarray:
    """A note, at another hammer velocity if one is given, laid over a measurement's onset: m/s [samples]."""
    if velocity is not None:
        note = note.struck(velocity)
    rate, onset = case.recording.rate, case.recording.onset
    samples, _ = note.play(rate, len(case.recording.samples), case.measurement.onset)
    return samples[onset:] / note.gain


def closeness(sound: np.ndarray, case: Case) -> Closeness:
    """Compare `sound`, m/s [samples] from the measurement's onset on, with the measurement."""
    cells, energy = _energies(case.heard, case)
    return Closeness(
        criterion=band_values(_energies(sound, case)[1], energy, cells.spacing),
        level_db=rms(level_differences(sound, case)[1]),
        attack=attack_time(sound, case.recording.rate, case.analysis.f0),
        centroid=centroid(sound, case.recording.rate, case.analysis.f0),
    )


def level_differences(sound: np.ndarray, case: Case) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of the partials to 6 kHz within 60 dB of the strongest, and how far `sound` is above them, dB."""
    cells, energy = _energies(case.heard, case)
    measured, own = (
        10 * np.log10((e * cells.spacing[:, None]).sum(axis=1)) for e in (energy, _energies(sound, case)[1])
    )
    number = np.arange(1, len(measured) + 1)
    frequency = law_frequency(case.analysis.f0, case.analysis.B, number)
    scored = (frequency <= LEVEL_TOP) & (measured >= measured.max() - LEVEL_RANGE)
    return number[scored], (own - measured)[scored]


def shares(case: Case) -> dict[str, dict[int, float]]:
    """Share of each partial in its band's ∫ |S|⁴, by which eq. 19 weighs: band -> partial -> share."""
    cells, energy = _energies(case.heard, case)
    weight = (cells.spacing[:, None] * energy**2).sum(axis=1)
    number = np.arange(1, len(weight) + 1)
    bands = {name: number[band_of(number) == n] for n, name in enumerate(BANDS)}
    return {
        name: {int(k): float(weight[k - 1] / weight[own - 1].sum()) for k in own} for name, own in bands.items()
    }  # fmt: skip


def rms(values: np.ndarray) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def _energies(sound: np.ndarray, case: Case):
    a = case.analysis
    last = int(a.partials.number.max())
    return measure(sound, case.recording.rate, a.f0, a.B, last, line_sigma(a.f0))
