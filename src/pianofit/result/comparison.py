"""Comparison of a fit with its recordings: the paper's criterion, and the levels of the partials."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..analysis import Analysis
from ..conversions import DB
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
from ..inference import STRING_SIZE, InferenceResult, select_partials
from ..model.note import Note
from ..parameters import STRING_NAMES
from ..recording.recording import Recording
from ..schema.fit import LEVEL_RANGE, LEVEL_TOP, BandValue, Criterion, LevelErrors, PartialLevels
from .alignment import align_attack, estimate_contact_onset
from .fitted_recording import FittedRecording, RenderedFit
from .minima import note_at


def worse_bands(criterion: Criterion) -> list[str]:
    """Occupied bands, and `global`, in which the criterion did not decrease."""
    return [name for name, band in criterion.bands.items() if band.final >= band.initial]


def audible_partials(frequency: np.ndarray, level: np.ndarray) -> np.ndarray:
    """True for partials whose levels are compared [partials]."""
    return (frequency <= LEVEL_TOP) & (level >= level.max() - LEVEL_RANGE)


@dataclass(frozen=True)
class RecordingComparison:
    """A recording, and the comparison of other sounds of its length with it."""

    recording: Recording
    analysis: Analysis
    scale: float | None  # pickup unit at full scale; None if unknown

    @cached_property
    def _recorded(self) -> tuple[SpectralCells, np.ndarray]:
        return self._measure(self.recording.samples)

    def _measure(self, samples: np.ndarray) -> tuple[SpectralCells, np.ndarray]:
        """Cells of the recording, and |Y|² on them of a sound aligned with it [partials, nodes]."""
        onset, rate, a = self.recording.onset, self.recording.rate, self.analysis
        return measure(samples[onset:], rate, a.f0, a.B, int(a.partials.number.max()), damping_for(a.f0))

    @property
    def level(self) -> np.ndarray:
        """Measured levels, dB in the pickup unit [partials]."""
        return self.analysis.partials.level + (0.0 if self.scale is None else 20 * np.log10(self.scale))

    @property
    def gain(self) -> float | None:
        """Full scale over the pickup unit; None if unknown."""
        return None if self.scale is None else 1.0 / self.scale

    def levels_at_partials(self, level: np.ndarray, number: np.ndarray) -> np.ndarray:
        """Levels of partials `number`, dB, at the recording's [partials]; NaN where there are none."""
        return select_partials(level, number, self.analysis.partials.number, np.nan)

    def add_noise_floor(self, level: np.ndarray) -> np.ndarray:
        """Levels, dB [partials], plus the noise energy of the recording, since a partial at a node is not silent."""
        noise = self.level - self.analysis.partials.snr
        with np.errstate(invalid="ignore"):  # NaN where a level is not known
            return DB / 2 * np.logaddexp(2 / DB * level, 2 / DB * noise)

    def energy_and_gain(self, samples: np.ndarray) -> tuple[np.ndarray, float]:
        """|Y|² of a sound on the cells [partials, nodes], and the square of its best gain by eq. 19."""
        (cells, recorded), (_, energy) = self._recorded, self._measure(samples)
        return energy, closed_form_gain(energy, recorded, cells.spacing[:, None])

    def contact(self, note: Note) -> int | None:
        """Sample index of the first contact, by alignment of the attack; None if the onset determines it."""
        return None if self.gain is None else round(align_attack(note._replace(gain=self.gain), self.recording))

    def render(self, note: Note, gain: float | None, begins: int | None) -> RenderedFit:
        """Render a note aligned with the recording.

        Parameters
        ----------
        gain : gain of the sound; the best one by the criterion if None.
        begins : sample index of the first contact; estimated from the onset if None.
        """
        strike = note.strike(self.recording.rate)
        begins = estimate_contact_onset(note, strike, self.recording) if begins is None else begins
        samples = note.render_mono(strike, self.recording.rate, len(self.recording.samples), begins)
        if gain is None:
            gain = float(np.sqrt(self.energy_and_gain(samples)[1]))
        return RenderedFit(note._replace(gain=gain), samples * gain, strike)

    def at_best_gain(self, sound: RenderedFit, level: np.ndarray) -> np.ndarray:
        """Levels of a sound at a gain of 1, dB [partials], with the gain that the criterion gave it, if it did."""
        return level if self.gain is not None else level + 20 * np.log10(max(float(sound.note.gain), 1e-15))

    def level_errors(
        self, initial: np.ndarray, fitted: np.ndarray, initial_hammer: np.ndarray | None = None
    ) -> LevelErrors:
        """Rms errors of levels, dB [partials], with one gain removed from each."""
        chosen = audible_partials(self.analysis.partials.frequency, self.level) & np.isfinite(fitted)

        def error(level: np.ndarray) -> float:
            return level_error_db(level[chosen], self.level[chosen])

        hammer = None if initial_hammer is None else error(initial_hammer)
        return LevelErrors(error(initial), error(fitted), hammer, int(chosen.sum()))

    def compare(
        self, initial: RenderedFit, fitted: RenderedFit, levels: Sequence[np.ndarray], errors: LevelErrors
    ) -> FittedRecording:
        """The recording with two sounds, their `levels`, dB [partials], and the criterion of both."""
        table, criterion = self.analysis.partials, self._criterion(initial, fitted)
        columns = np.array([table.number, self.level, table.level_error, levels[0], levels[1]])
        compared = PartialLevels(*columns[:, np.isfinite(columns).all(axis=0)])  # F has no partials above 10 kHz
        return FittedRecording(initial, fitted, self.recording, self.analysis, compared, criterion, errors)

    def _criterion(self, initial: RenderedFit, fitted: RenderedFit) -> Criterion:
        """Eq. 19 for each band, computed on the sounds from the onset on; bands without a partial are excluded.

        In an uncalibrated recording each sound has its best gain by the criterion.
        """
        cells, recorded = self._recorded

        def values_of(sound: RenderedFit) -> dict[str, float]:
            energy, gain_squared = self.energy_and_gain(sound.samples)
            return band_values((gain_squared if self.scale is None else 1.0) * energy, recorded, cells.spacing)

        before, after, number = values_of(initial), values_of(fitted), self.analysis.partials.number
        occupied = {"global", *(BANDS[b] for b in band_of(number))}
        return Criterion(
            bands={name: BandValue(before[name], after[name]) for name in before if name in occupied},
            excluded_bands=tuple(name for name in BANDS if name not in occupied),
            sigma=cells.sigma,
            borders=band_borders(self.analysis.f0, self.analysis.B, int(number.max())),
        )


def pool_level_errors(levels: Sequence[LevelErrors]) -> LevelErrors:
    """Rms level errors over all recordings, dB, and the number of partials."""
    count = np.array([own.partials for own in levels])

    def rms(values: Sequence[float]) -> float:
        return float(np.sqrt((np.square(values) * count).sum() / count.sum()))

    initial, fitted = rms([own.initial_db for own in levels]), rms([own.fitted_db for own in levels])
    hammer = [own.initial_hammer_db for own in levels if own.initial_hammer_db is not None]
    return LevelErrors(initial, fitted, rms(hammer) if len(hammer) == len(levels) else None, int(count.sum()))


def compare_recordings(fit: InferenceResult, notes: Sequence[Note]) -> tuple[FittedRecording, ...]:
    """Compare every recording with the initial values and with its note at the best minimum."""
    problem, columns, integrated = fit.problem, fit.problem.observed.number, fit.latent(0)
    start = fit.initial_theta.copy()
    start[:STRING_SIZE] = np.log([problem.initial_values.initial[name] for name in STRING_NAMES])
    initial = fit.level(start)
    fitted = np.asarray(problem.observed.level.value) - integrated.residual - integrated.discrepancy
    has_hammer = problem.parametrisation.law.has_contact and not problem.calibrated
    initial_hammer = fit.initial_hammer_level if has_hammer else None
    compared = []
    for i, note in enumerate(notes):
        comparison = RecordingComparison(problem.recordings[i], problem.analyses[i], problem.initial_values.scale)
        begins = comparison.contact(note)
        # The uncertainty of the onset affects the lowest partial least.
        gain = 10 ** (integrated.columns[i][0] / 20) if comparison.gain is None else comparison.gain
        after = comparison.render(note, float(gain), begins)
        # The initial sound has its best gain by the criterion, since its overall level is not compared.
        before = comparison.render(note_at(problem, start, problem.structure.stroke[i]), comparison.gain, begins)
        rows = [initial[i], fitted[i]] + ([] if initial_hammer is None else [initial_hammer[i]])
        first, *others = (comparison.levels_at_partials(row, columns) for row in rows)
        levels = [comparison.at_best_gain(before, first), *others]
        errors = comparison.level_errors(*map(comparison.add_noise_floor, levels))
        compared.append(comparison.compare(before, after, levels, errors))
    return tuple(compared)
