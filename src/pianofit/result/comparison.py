"""Comparison of a fit with its recordings: the paper's criterion, and the levels of the partials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..analysis import Analysis
from ..criterion import (
    BANDS,
    SpectralCells,
    band_borders,
    band_of,
    band_values,
    closed_form_gain,
    damping_for,
    level_error_db,
    measure,
)
from ..inference import optimiser as descents
from ..inference.derivatives import latent_posterior
from ..inference.observation_tables import scatter_by_number
from ..inference.parametrisation import STRING_SIZE
from ..inference.pipeline import InferenceResult
from ..inference.prescreen import rescan_velocities
from ..inference.quadratic_surrogate import QuadraticSurrogate
from ..model.note import Note
from ..parameters import STRING_NAMES
from ..recording.recording import Recording
from .alignment import align_attack, estimate_contact_onset
from .fitted_recording import FittedRecording, RenderedFit
from .minima_notes import latent_means

__all__ = ["RecordingComparison", "compare_recordings", "audible_partials", "pool_level_errors", "worse_bands"]

# Level errors that are reported: before the fit, after it, and of the initial hammer at its best path and velocities.
LEVELS = ("initial_db", "fitted_db", "path_only_db")
# Levels are compared up to this frequency, Hz, since few hammers reach beyond it,
LEVEL_TOP = 6000.0
# and within this range of the strongest partial, dB, since other sounds lie below it.
LEVEL_RANGE = 60.0
# At most this many steps of the initial hammer's descent. It stops when F gains less than this, a tenth of a dB.
DESCENT_STEPS, DESCENT_GAIN = 25, 0.1
# Level of a hammer whose contact does not end, dB.
SILENT_DB = -300.0


def worse_bands(criterion: dict) -> list[str]:
    """Occupied bands, and `global`, in which the criterion did not decrease."""
    names = [n for n in ("global", *BANDS) if n in criterion]
    return [n for n in names if criterion[n]["final"] >= criterion[n]["initial"]]


def audible_partials(frequency: np.ndarray, level: np.ndarray) -> np.ndarray:
    """True for partials whose levels are compared [partials]."""
    return (frequency <= LEVEL_TOP) & (level >= level.max() - LEVEL_RANGE)


@dataclass(frozen=True)
class RecordingComparison:
    """A recording with the cells of the paper's criterion, on which other sounds of its length are compared with it."""

    recording: Recording
    analysis: Analysis
    scale: float | None  # pickup unit at full scale; None if unknown
    cells: SpectralCells
    energy: np.ndarray  # |S|² of the recording [partials, nodes]

    @classmethod
    def of(cls, recording: Recording, analysis: Analysis, scale: float | None) -> RecordingComparison:
        """The comparison with one recording."""
        return cls(recording, analysis, scale, *_measured(recording.samples, recording, analysis))

    @property
    def level(self) -> np.ndarray:
        """Measured levels, dB in the pickup unit [partials]."""
        return self.analysis.partials.level + (0.0 if self.scale is None else 20 * np.log10(self.scale))

    @property
    def gain(self) -> float | None:
        """Full scale over the pickup unit; None if unknown."""
        return None if self.scale is None else 1.0 / self.scale

    def contact_onset(self, note: Note) -> int | None:
        """Sample index of the first contact in a calibrated recording; None if the onset determines it."""
        return None if self.gain is None else round(align_attack(note._replace(gain=self.gain), self.recording))

    def levels_at_partials(self, level: np.ndarray, number: np.ndarray) -> np.ndarray:
        """Levels of partials `number`, dB, at the recording's [partials]; measured levels where there are none."""
        scattered = scatter_by_number(level, number, self.analysis.partials.number, np.nan)
        return np.where(np.isfinite(scattered), scattered, self.level)

    def add_noise_floor(self, level: np.ndarray) -> np.ndarray:
        """Levels, dB [partials], plus the noise energy of the recording, since a partial at a node is not silent."""
        noise = self.level - self.analysis.partials.snr
        return 10 / np.log(10) * np.logaddexp(level * np.log(10) / 10, noise * np.log(10) / 10)

    def energy_and_gain(self, samples: np.ndarray) -> tuple[np.ndarray, float]:
        """|Y|² of a sound on the cells [partials, nodes], and the square of its best gain by eq. 19."""
        energy = _measured(samples, self.recording, self.analysis)[1]
        return energy, closed_form_gain(energy, self.energy, self.cells.spacing[:, None])

    def render(self, note: Note, gain: float | None, begins: int | None, level: np.ndarray) -> RenderedFit:
        """Render a note aligned with the recording.

        Parameters
        ----------
        gain : gain of the sound; the best one by the criterion if None.
        begins : sample index of the first contact; estimated from the onset if None.
        level : levels at a gain of 1, dB [partials].
        """
        strike = note.strike(self.recording.rate)
        begins = estimate_contact_onset(note, strike, self.recording) if begins is None else begins
        samples = note.render_mono(strike, self.recording.rate, len(self.recording.samples), begins)
        if gain is None:
            gain = float(np.sqrt(self.energy_and_gain(samples)[1]))
            level = level + 20 * np.log10(max(gain, 1e-15))
        return RenderedFit(note._replace(gain=gain), samples * gain, strike, level)

    def compare(self, initial: RenderedFit, fitted: RenderedFit, levels: dict[str, np.ndarray]) -> FittedRecording:
        """The recording with two sounds, the criterion, and level errors by name of `LEVELS`, one gain removed."""
        chosen = audible_partials(self.analysis.partials.frequency, self.level)
        errors = {name: level_error_db(level[chosen], self.level[chosen]) for name, level in levels.items()}
        return FittedRecording(
            initial, fitted, self.level, self.recording, self.analysis, self._criterion(initial, fitted),
            dict.fromkeys(LEVELS) | errors | {"partials": int(chosen.sum())},
        )  # fmt: skip

    def _criterion(self, initial: RenderedFit, fitted: RenderedFit) -> dict:
        """Eq. 19 for each band, computed on the sounds from the onset on; bands without a partial are dropped.

        In an uncalibrated recording each sound has its best gain by the criterion.
        """

        def values_of(sound: RenderedFit) -> dict[str, float]:
            energy, gain_squared = self.energy_and_gain(sound.samples)
            return band_values((gain_squared if self.scale is None else 1.0) * energy, self.energy, self.cells.spacing)

        before, after, number = values_of(initial), values_of(fitted), self.analysis.partials.number
        occupied = {"global", *(BANDS[b] for b in band_of(number))}
        values = {name: {"initial": before[name], "final": after[name]} for name in before if name in occupied}
        return values | {
            "dropped": [name for name in BANDS if name not in occupied],
            "sigma": self.cells.sigma,
            "borders": list(band_borders(self.analysis.f0, self.analysis.B, int(number.max()))),
        }


def _measured(samples: np.ndarray, r: Recording, a: Analysis) -> tuple[SpectralCells, np.ndarray]:
    """Cells of a recording, and |Y|² on them of a sound aligned with it [partials, nodes]."""
    return measure(samples[r.onset :], r.rate, a.f0, a.B, int(a.partials.number.max()), damping_for(a.f0))


def pool_level_errors(levels: Sequence[dict]) -> dict:
    """Rms level errors over all recordings, dB, and the number of partials."""
    count = np.array([x["partials"] for x in levels])

    def rms(name: str) -> float | None:
        values = [x[name] for x in levels]
        return None if None in values else float(np.sqrt((np.square(values) * count).sum() / count.sum()))

    return {name: rms(name) for name in LEVELS} | {"partials": int(count.sum())}


def compare_recordings(fit: InferenceResult, notes: Sequence[Note]) -> tuple[FittedRecording, ...]:
    """Compare every recording with the initial values and with its note at the best minimum.

    Raises
    ------
    FitError
        If an initial or a final contact does not end.
    """
    problem, descent, columns = fit.problem, fit.estimate.minima.optimiser, fit.problem.observed.number
    integrated = latent_means(fit.estimate.minima, 0)
    start = fit.initial_theta.copy()
    start[:STRING_SIZE] = np.log([problem.initial_values.initial[name] for name in STRING_NAMES])
    initial = descent.level(start[None])[0]
    fitted = np.asarray(descent.table.value) - integrated.residual
    path_only = None if problem.calibrated else fit_reference_hammer(fit)
    compared = []
    for i, note in enumerate(notes):
        recording = problem.recordings[i]
        comparison = RecordingComparison.of(recording, problem.analyses[i], problem.initial_values.scale)
        begins = comparison.contact_onset(note)
        # The uncertainty of the onset affects the lowest partial least.
        gain = 10 ** (integrated.columns[i][0] / 20) if comparison.gain is None else comparison.gain
        after = comparison.render(note, float(gain), begins, comparison.levels_at_partials(fitted[i], columns))
        # The initial sound has its best gain by the criterion, since its overall level is not compared.
        before = comparison.render(
            _note_at(fit, start, i), comparison.gain, begins, comparison.levels_at_partials(initial[i], columns)
        )
        levels = {"initial_db": before.level, "fitted_db": after.level}
        levels |= {} if path_only is None else {"path_only_db": comparison.levels_at_partials(path_only[i], columns)}
        compared.append(
            comparison.compare(before, after, {n: comparison.add_noise_floor(x) for n, x in levels.items()})
        )
    return tuple(compared)


def _note_at(fit: InferenceResult, z: np.ndarray, i: int) -> Note:
    """The note of recording `i` at parameters `z` [size], without an output path."""
    u, problem = fit.problem.parametrisation, fit.problem
    hammer = u.hammer(z, problem.structure.stroke[i])
    return Note(u.string(z), hammer, u.geometry_at(z), problem.initial_values.quantity, 1.0, None)


def fit_reference_hammer(fit: InferenceResult) -> np.ndarray:
    """Levels of the initial hammer at its best velocities, gain and output path, dB [R, K].

    A free strike position is fitted too. So the remaining difference to the fitted hammer is due to mass and felt.
    """
    problem, u, z = fit.problem, fit.problem.parametrisation, fit.estimate.theta
    hammer = np.arange(u.size) < u.shared
    hammer[:STRING_SIZE] = hammer[[u.index_of("x0"), u.index_of("width")]] = False
    with_hammer = replace(u, mean=np.where(hammer, fit.initial_theta, u.mean), sd=np.where(hammer, 0.0, u.sd))
    descent = descents.Optimiser(replace(problem, parametrisation=with_hammer), z[:STRING_SIZE], descents.LEVELS)
    phi, offset = fit.estimate.minima.candidates.level.phi[:1], descent.discretisation_error_db(z[None])[0]
    surrogates = [QuadraticSurrogate.of(descent.table, phi[0], gains=node) for node in range(len(descent.table.scale))]
    starts = np.concatenate(
        rescan_velocities(descent, with_hammer.project(np.stack([fit.initial_theta, z])), surrogates, offset)
    )
    candidates = descent.minimise(descent.initialise(starts, [phi], offset=offset), 0.0, DESCENT_STEPS, DESCENT_GAIN)
    if not len(candidates):
        return np.full(descent.table.value.shape, SILENT_DB)
    best = candidates.level
    return (
        np.asarray(descent.table.value)
        - latent_posterior(descent.table, best.residual[0], best.phi[0], best.w[0]).residual
    )
