"""A stroke in the laboratory as a fit meets it: measured, fitted by recipes, and how near each sound comes to it.

The setup holds what the laboratory knew, and as initial values the paper's (Tables II and III), with the hammer's
velocity as the sensor read it, which the paper's recipes fit like the rest. Sounds go by the names of `SOUNDS`.

What the ear calls attack and brightness are two numbers measured on the sounds themselves. The paper says that the
global criterion made the attack "too smooth" and the sound less bright (IV.B), and gives no measure for either. A
struck string's attack is over within a part of the first period, so its time is taken from the first wave that passes
the pickup, not from an envelope smoothed over periods. Brightness is the spectral centroid, of the partials'
amplitudes: of the whole spectrum's it would depend on how the window leaks.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ...analysis import Analysis, analyse, law_frequency
from ...criterion import BANDS, Cells, band_of, band_values, line_sigma, measure
from ...errors import ParameterError
from ...inference import run_inference
from ...inference.initial_values import starting_values
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

# recipe -> what it is called on the page. `read` is the paper's third step on a string that was read off the partials.
RECIPES = {
    "global": "global criterion", "paper": "three bands", "read": "three bands, string read",
    "default": "default recipe",
}  # fmt: skip
# The same of every sound.
SOUNDS = {"measured": "measured", "initial": "initial"} | RECIPES
# From the seed of one annealing to that of the next; measurements have the seeds in between.
NEXT_TRY = 10_000
# The attack runs from the first to the second of these shares of the first wave's height.
FOOT = 0.1
TOP = 0.9
SPAN = 0.35  # s under a Hann window, whose skirts hide no partial
HIGHEST = 6000.0  # Hz: above, the noise of a measurement begins to count


class Closeness(NamedTuple):
    """A sound beside a measurement."""

    criterion: dict[str, float]  # eq. 19, `global` and band by band
    level_db: float  # rms of the partials' differences in level, dB
    attack: float  # s
    centroid: float  # Hz


@dataclass(frozen=True)
class Stroke:
    """A measurement as a fit meets it, its fits by recipe, and its sounds by name, m/s [samples] from the onset on."""

    measurement: Measurement
    recording: Recording
    analysis: Analysis
    setup: Setup
    sounds: dict[str, np.ndarray]
    results: dict[str, Result] = field(default_factory=dict)

    def with_sounds(self, sounds: dict[str, np.ndarray], **results: Result) -> Stroke:
        """The same measurement with these fits, and with these sounds beside its own."""
        return replace(self, sounds={"measured": self.sounds["measured"]} | sounds, results=results)

    @cached_property
    def spectrum(self) -> tuple[Cells, np.ndarray]:
        """The criterion's cells, and |S|² [partials, nodes] there."""
        return self._spectrum(self.sounds["measured"])

    def _spectrum(self, sound: np.ndarray) -> tuple[Cells, np.ndarray]:
        a = self.analysis
        return measure(sound, self.recording.rate, a.f0, a.B, int(a.partials.number.max()), line_sigma(a.f0))

    def played(self, note: Note) -> np.ndarray:
        """A note, laid over the measurement's onset."""
        samples, _ = note.render_stroke(self.recording.rate, len(self.recording.samples), self.measurement.onset)
        return samples[self.recording.onset :] / note.gain

    @cached_property
    def closeness(self) -> dict[str, Closeness]:
        """Every sound beside the measured one."""
        (cells, energy), at, found = self.spectrum, (self.recording.rate, self.analysis.f0), {}
        for name, sound in self.sounds.items():
            criterion, (_, off) = band_values(self._spectrum(sound)[1], energy, cells.spacing), self.levels_off(sound)
            found[name] = Closeness(criterion, rms(off), attack_time(sound, *at), centroid(sound, *at))
        return found

    def levels_off(self, sound: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Numbers of the partials to 6 kHz within 60 dB of the strongest, and how far `sound` is above them, dB."""
        measured, own = (
            10 * np.log10((energy * cells.spacing[:, None]).sum(axis=1))
            for cells, energy in (self.spectrum, self._spectrum(sound))
        )
        number = np.arange(1, len(measured) + 1)
        compared = audible_partials(law_frequency(self.analysis.f0, self.analysis.B, number), measured)
        return number[compared], (own - measured)[compared]

    def shares(self) -> dict[str, dict[int, float]]:
        """Share of each partial in its band's ∫ |S|⁴, by which eq. 19 weighs: band -> partial -> share."""
        cells, energy = self.spectrum
        weight = (cells.spacing[:, None] * energy**2).sum(axis=1)
        band = band_of(np.arange(1, len(weight) + 1))
        return {
            name: {int(k) + 1: float(weight[k] / weight[band == n].sum()) for k in np.flatnonzero(band == n)}
            for n, name in enumerate(BANDS)
        }


def measured(lab: SyntheticMeasurement, velocity: float, seed: int, start: float | None = None) -> Stroke:
    """A stroke of `velocity`, m/s, analysed; a fit starts at what the sensor read, or at `start`, m/s."""
    found = record(lab, velocity, seed)
    recording = recording_from_samples(found.samples, found.rate, name=f"{velocity:g} m/s")
    setup = setup_from_dict(tomllib.loads(setup_text(found.scale, found.nominal_velocity)), "laboratory")
    if start is not None:
        setup = replace(setup, initial=setup.initial | {"v_H0": start})
    heard = recording.samples[recording.onset :] * found.scale
    return Stroke(found, recording, analyse(recording), setup, {"measured": heard})


def fitted(stroke: Stroke, recipe: str, seed: int, annealing: int | None = None, tries: int = 1) -> Result:
    """Fit by one of `RECIPES`.

    Parameters
    ----------
    annealing : evaluations for each annealing, the recipe's own number if None.
    tries : annealings, each with a seed of its own; the one with the lowest criterion in band 3 counts.
    """
    heard, setup = (stroke.recording, stroke.analysis), stroke.setup
    if recipe == "default":
        return build_result(run_inference([stroke.recording], [stroke.analysis], setup, seed=seed))
    if recipe == "global":
        return fit_bensa2005(*heard, setup, recipe, seed=seed)
    if recipe == "read":
        # The string is held at what the frequencies and decays of the partials say.
        values = starting_values(stroke.analysis, setup).values
        left = {name: value for name, value in setup.initial.items() if name not in STRING_NAMES}
        setup = replace(setup, fixed={name: values[name] for name in STRING_NAMES}, initial=left)
    results = [
        fit_bensa2005(*heard, setup, "paper", evaluations=annealing, seed=seed + NEXT_TRY * n) for n in range(tries)
    ]
    return min(results, key=lambda result: result.document["criterion"]["band3"]["final"])


def values_of(result: Result) -> dict[str, float]:
    """The nine parameters that were found."""
    return {name: float(result.document["parameters"][name]["value"]) for name in FIT_NAMES}


def rms(values: np.ndarray) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def attack_time(samples: np.ndarray, rate: float, f0: float) -> float:
    """Time in which the first wave rises from 10 to 90 % of its height, s.

    `samples` [samples] are from the onset on; the first half period of `f0`, Hz, is looked at. A `ParameterError`
    if there is none, or nothing in it.
    """
    head = np.abs(np.asarray(samples, float)[: int(0.5 * rate / f0) + 1])
    if head.size < 2 or head.max() == 0:
        raise ParameterError(f"samples={head.size} at {rate:g} Hz hold no attack within half a period of {f0:g} Hz")
    first, last = (_crossing(head, share * head.max()) for share in (FOOT, TOP))
    return (last - first) / rate


def centroid(samples: np.ndarray, rate: float, f0: float) -> float:
    """Σ f A / Σ A of the partials to 6 kHz over the first 0.35 s, Hz.

    A partial is the highest line of an interval as wide as `f0`, Hz, so that none counts twice. `samples` [samples]
    are from the onset on; a `ParameterError` if they are silent.
    """
    samples = np.asarray(samples, float)[: int(SPAN * rate)]
    size = 2 ** int(np.ceil(np.log2(max(len(samples), 2))) + 2)
    level = np.abs(np.fft.rfft(samples * np.hanning(len(samples)), size))
    edges = (np.arange(0.5, HIGHEST / f0) * f0 * size / rate).astype(int)
    peak = np.array([low + np.argmax(level[low:high]) for low, high in pairwise(edges)])
    amplitude = level[peak]
    if not amplitude.any():
        raise ParameterError(f"samples={len(samples)} are silent: they have no centroid")
    return float(peak @ amplitude / amplitude.sum() * rate / size)


def _crossing(rising: np.ndarray, height: float) -> float:
    """Where `rising` [samples] first comes to `height`, in samples, on the straight line between two of them."""
    after = int(np.argmax(rising >= height))
    low, high = rising[max(after - 1, 0)], rising[after]
    return after - 1 + float((height - low) / (high - low)) if after else 0.0
