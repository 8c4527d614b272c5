"""A synthetic measurement of one stroke, its fits by several recipes, and the similarity of each sound to it.

The setup contains the given values of the laboratory, and the paper's initial values (Tables II and III). The initial
hammer velocity is the reading of the sensor; the paper's recipes fit it like the other parameters. Sounds have the
names of `SOUNDS`.

Attack and brightness are measured on the sounds. The paper says that the global criterion made the attack "too smooth"
and the sound less bright (IV.B), and gives no measure for either. The attack of a struck string is shorter than the
first period. The attack time is therefore the rise time of the first wave at the pickup, not that of an envelope
smoothed over periods. The measure of brightness is the spectral centroid of the partials' amplitudes. The centroid of
the whole spectrum would depend on the leakage of the window.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ...analysis import Analysis, analyse, law_frequency
from ...criterion import BANDS, SpectralCells, band_of, band_values, damping_for, measure
from ...errors import ParameterError
from ...inference import run_inference, starting_values
from ...model.note import Note
from ...parameters import FIT_NAMES, STRING_NAMES
from ...recording.recording import Recording, recording_from_samples
from ...result import Result, build_result
from ...result.comparison import audible_partials
from ...setup import Setup, setup_from_dict
from ..laboratory import Measurement, SyntheticMeasurement, setup_text
from ..laboratory import measure as record
from ..recipes import fit_bensa2005

__all__ = [
    "RECIPES", "SOUNDS", "Closeness", "Stroke", "attack_time", "centroid", "fitted", "measured", "rms", "values_of",
]  # fmt: skip

# recipe -> name on the page. `read` is the paper's third step on a string determined from the partials.
RECIPES = {
    "global": "global criterion", "paper": "three bands", "read": "three bands, string read",
    "default": "default recipe",
}  # fmt: skip
# sound -> name on the page.
SOUNDS = {"measured": "measured", "initial": "initial"} | RECIPES
# Difference between the seeds of two annealings; measurements have the seeds in between.
SEED_STEP = 10_000
# The attack time is measured between these shares of the height of the first wave.
FOOT = 0.1
TOP = 0.9
SPAN = 0.35  # length of the Hann window of the centroid, s; its sidelobes mask no partial
HIGHEST = 6000.0  # Hz; the noise of a measurement matters above


class Closeness(NamedTuple):
    """A sound compared with a measurement."""

    criterion: dict[str, float]  # eq. 19, `global` and band by band
    level_db: float  # rms of the partials' differences in level, dB
    attack: float  # s
    centroid: float  # Hz


@dataclass(frozen=True)
class Stroke:
    """A measurement with analysis and setup, fits by recipe, and sounds by name, m/s [samples] from the onset on."""

    measurement: Measurement
    recording: Recording
    analysis: Analysis
    setup: Setup
    sounds: dict[str, np.ndarray]
    results: dict[str, Result] = field(default_factory=dict)

    def with_sounds(self, sounds: dict[str, np.ndarray], **results: Result) -> Stroke:
        """Return the same measurement with these fits and sounds; the measured sound is kept."""
        return replace(self, sounds={"measured": self.sounds["measured"]} | sounds, results=results)

    @cached_property
    def spectrum(self) -> tuple[SpectralCells, np.ndarray]:
        """The criterion's cells, and |S|² [partials, nodes] there."""
        return self._spectrum(self.sounds["measured"])

    def _spectrum(self, sound: np.ndarray) -> tuple[SpectralCells, np.ndarray]:
        a = self.analysis
        return measure(sound, self.recording.rate, a.f0, a.B, int(a.partials.number.max()), damping_for(a.f0))

    def played(self, note: Note) -> np.ndarray:
        """Return the sound of a note, aligned with the onset of the measurement."""
        samples, _ = note.render_stroke(self.recording.rate, len(self.recording.samples), self.measurement.onset)
        return samples[self.recording.onset :] / note.gain

    @cached_property
    def closeness(self) -> dict[str, Closeness]:
        """Every sound compared with the measured one."""
        (cells, energy), at, closeness = self.spectrum, (self.recording.rate, self.analysis.f0), {}
        for name, sound in self.sounds.items():
            criterion = band_values(self._spectrum(sound)[1], energy, cells.spacing)
            _, off = self.level_differences(sound)
            closeness[name] = Closeness(criterion, rms(off), attack_time(sound, *at), centroid(sound, *at))
        return closeness

    def level_differences(self, sound: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Numbers of the partials to 6 kHz within 60 dB of the strongest, and the level differences of `sound`, dB."""
        measured, own = (
            10 * np.log10((energy * cells.spacing[:, None]).sum(axis=1))
            for cells, energy in (self.spectrum, self._spectrum(sound))
        )
        number = np.arange(1, len(measured) + 1)
        compared = audible_partials(law_frequency(self.analysis.f0, self.analysis.B, number), measured)
        return number[compared], (own - measured)[compared]

    def shares(self) -> dict[str, dict[int, float]]:
        """Share of each partial in ∫ |S|⁴ of its band, its weight in eq. 19: band -> partial -> share."""
        cells, energy = self.spectrum
        weight = (cells.spacing[:, None] * energy**2).sum(axis=1)
        band = band_of(np.arange(1, len(weight) + 1))
        return {
            name: {int(k) + 1: float(weight[k] / weight[band == n].sum()) for k in np.flatnonzero(band == n)}
            for n, name in enumerate(BANDS)
        }


def measured(lab: SyntheticMeasurement, velocity: float, seed: int, start: float | None = None) -> Stroke:
    """Measure and analyse a stroke of `velocity`, m/s. The initial velocity is the sensor's reading or `start`, m/s."""
    measurement = record(lab, velocity, seed)
    recording = recording_from_samples(measurement.samples, measurement.rate, name=f"{velocity:g} m/s")
    setup = setup_from_dict(tomllib.loads(setup_text(measurement.scale, measurement.nominal_velocity)), "laboratory")
    if start is not None:
        setup = replace(setup, initial=setup.initial | {"v_H0": start})
    sound = recording.samples[recording.onset :] * measurement.scale
    return Stroke(measurement, recording, analyse(recording), setup, {"measured": sound})


def fitted(stroke: Stroke, recipe: str, seed: int, annealing: int | None = None, tries: int = 1) -> Result:
    """Fit by one of `RECIPES`.

    Parameters
    ----------
    annealing : evaluations of each annealing; the default of the recipe if None.
    tries : number of annealings, each with its own seed. The one with the lowest criterion in band 3 is returned.
    """
    data, setup = (stroke.recording, stroke.analysis), stroke.setup
    if recipe == "default":
        return build_result(run_inference([stroke.recording], [stroke.analysis], setup, seed=seed))
    if recipe == "global":
        return fit_bensa2005(*data, setup, recipe, seed=seed)
    if recipe == "read":
        # The string is fixed at the values determined from the frequencies and decay rates of the partials.
        values = starting_values(stroke.analysis, setup).values
        initial = {name: value for name, value in setup.initial.items() if name not in STRING_NAMES}
        setup = replace(setup, fixed={name: values[name] for name in STRING_NAMES}, initial=initial)
    results = [
        fit_bensa2005(*data, setup, "paper", evaluations=annealing, seed=seed + SEED_STEP * n) for n in range(tries)
    ]
    return min(results, key=lambda result: result.fit.criterion.bands["band3"].final)


def values_of(result: Result) -> dict[str, float]:
    """Return the nine fitted parameters."""
    return {name: float(result.parameters[name].value) for name in FIT_NAMES}


def rms(values: np.ndarray) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def attack_time(samples: np.ndarray, rate: float, f0: float) -> float:
    """Return the time in which the first wave rises from 10 to 90 % of its height, s.

    `samples` [samples] begin at the onset. The wave is searched in the first half period of `f0`, Hz.

    Raises
    ------
    ParameterError
        If the samples are silent or shorter than two samples.
    """
    head = np.abs(np.asarray(samples, float)[: int(0.5 * rate / f0) + 1])
    if head.size < 2 or head.max() == 0:
        raise ParameterError(f"samples={head.size} at {rate:g} Hz contain no attack in half a period of {f0:g} Hz")
    first, last = (_crossing(head, share * head.max()) for share in (FOOT, TOP))
    return (last - first) / rate


def centroid(samples: np.ndarray, rate: float, f0: float) -> float:
    """Return Σ f A / Σ A of the partials to 6 kHz over the first 0.35 s, Hz.

    A partial is the highest line in an interval of width `f0`, Hz, so that none counts twice. `samples` [samples] begin
    at the onset.

    Raises
    ------
    ParameterError
        If the samples are silent.
    """
    samples = np.asarray(samples, float)[: int(SPAN * rate)]
    size = 2 ** int(np.ceil(np.log2(max(len(samples), 2))) + 2)
    level = np.abs(np.fft.rfft(samples * np.hanning(len(samples)), size))
    edges = (np.arange(0.5, HIGHEST / f0) * f0 * size / rate).astype(int)
    peak = np.array([low + np.argmax(level[low:high]) for low, high in pairwise(edges)])
    amplitude = level[peak]
    if not amplitude.any():
        raise ParameterError(f"samples={len(samples)} are silent and have no centroid")
    return float(peak @ amplitude / amplitude.sum() * rate / size)


def _crossing(rising: np.ndarray, height: float) -> float:
    """Return the position at which `rising` [samples] first reaches `height`, in samples, by linear interpolation."""
    after = int(np.argmax(rising >= height))
    low, high = rising[max(after - 1, 0)], rising[after]
    return after - 1 + float((height - low) / (high - low)) if after else 0.0
