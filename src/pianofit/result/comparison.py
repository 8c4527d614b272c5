"""A fit heard beside its recordings: on the paper's criterion, and in the levels of their partials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..analysis import Analysis
from ..criterion import (
    BANDS,
    Cells,
    band_of,
    band_values,
    borders,
    closed_form_gain,
    level_error_db,
    line_sigma,
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
from .minima_notes import latent_means
from .result import FittedRecording, RenderedFit

__all__ = ["RecordingComparison", "compare_recordings", "audible_partials", "pool_level_errors", "worse_bands"]

# Of which levels of partials errors are told: before and after, and of the first hammer as it suits.
LEVELS = ("initial_db", "fitted_db", "path_only_db")
# Levels are compared over partials to this, Hz: few hammers reach beyond,
LEVEL_TOP = 6000.0
# within so many dB of the strongest: other sounds lie there.
LEVEL_RANGE = 60.0
# Steps of the initial hammer's descent at the most, and the gain that ends it, F: a number to a tenth of a dB.
STEPS, GAIN = 25, 0.1
# dB, of a hammer whose contact does not end.
SILENT = -300.0


def worse_bands(criterion: dict) -> list[str]:
    """Occupied bands, and `global`, in which the criterion ended no lower than it started."""
    names = [n for n in ("global", *BANDS) if n in criterion]
    return [n for n in names if criterion[n]["final"] >= criterion[n]["initial"]]


def audible_partials(frequency: np.ndarray, level: np.ndarray) -> np.ndarray:
    """The partials on which levels are compared [partials], bool."""
    return (frequency <= LEVEL_TOP) & (level >= level.max() - LEVEL_RANGE)


@dataclass(frozen=True)
class RecordingComparison:
    """A recording on the paper's criterion: cells, and what any other sound of the same length gives on them."""

    recording: Recording
    analysis: Analysis
    scale: float | None  # the pickup's unit at full scale; None where that is not known
    cells: Cells
    energy: np.ndarray  # |S|² of the recording [partials, nodes]

    @classmethod
    def of(cls, recording: Recording, analysis: Analysis, scale: float | None) -> RecordingComparison:
        """The listener to one recording."""
        return cls(recording, analysis, scale, *_measured(recording.samples, recording, analysis))

    @property
    def level(self) -> np.ndarray:
        """Measured, dB [partials], in the pickup's unit."""
        return self.analysis.partials.level + (0.0 if self.scale is None else 20 * np.log10(self.scale))

    @property
    def gain(self) -> float | None:
        """Full scale over the pickup's unit; None where that is not known."""
        return None if self.scale is None else 1.0 / self.scale

    def begins(self, note: Note) -> int | None:
        """Where in a calibrated recording the hammer touched; None where the onset says it."""
        return None if self.gain is None else round(align_attack(note._replace(gain=self.gain), self.recording))

    def at(self, level: np.ndarray, number: np.ndarray) -> np.ndarray:
        """Levels, dB, of partials `number` at the recording's [partials]; as measured where there are none."""
        own = scatter_by_number(level, number, self.analysis.partials.number, np.nan)
        return np.where(np.isfinite(own), own, self.level)

    def add_noise_floor(self, level: np.ndarray) -> np.ndarray:
        """Levels, dB [partials], with the energy of the noise that the recording's have: a node is not silent."""
        noise = self.level - self.analysis.partials.snr
        return 10 / np.log(10) * np.logaddexp(level * np.log(10) / 10, noise * np.log(10) / 10)

    def best(self, samples: np.ndarray) -> tuple[np.ndarray, float]:
        """|Y|² [partials, nodes] of a sound on the recording's cells, and the square of its best gain by eq. 19."""
        heard = _measured(samples, self.recording, self.analysis)[1]
        return heard, closed_form_gain(heard, self.energy, self.cells.spacing[:, None])

    def play(self, note: Note, gain: float | None, begins: int | None, level: np.ndarray) -> RenderedFit:
        """A note laid on the recording, with the gain that the criterion likes best if none is given.

        Parameters
        ----------
        begins : the sample at which the hammer touches; where its sound would be seen at the onset if None.
        level : dB, [partials], through a gain of 1.
        """
        strike = note.strike(self.recording.rate)
        begins = estimate_contact_onset(note, strike, self.recording) if begins is None else begins
        samples = note.render_mono(strike, self.recording.rate, len(self.recording.samples), begins)
        if gain is None:
            gain = float(np.sqrt(self.best(samples)[1]))
            level = level + 20 * np.log10(max(gain, 1e-15))
        return RenderedFit(note._replace(gain=gain), samples * gain, strike, level)

    def compared(self, initial: RenderedFit, fitted: RenderedFit, levels: dict[str, np.ndarray]) -> FittedRecording:
        """The recording beside two sounds, on the criterion, and on some of `LEVELS`, dB [partials], less one gain."""
        chosen = audible_partials(self.analysis.partials.frequency, self.level)
        off = {name: level_error_db(level[chosen], self.level[chosen]) for name, level in levels.items()}
        return FittedRecording(
            initial, fitted, self.level, self.recording, self.analysis, self._criterion(initial, fitted),
            dict.fromkeys(LEVELS) | off | {"partials": int(chosen.sum())},
        )  # fmt: skip

    def _criterion(self, initial: RenderedFit, fitted: RenderedFit) -> dict:
        """Eq. 19 per band on the sounds themselves, from the onset on; bands without a partial are dropped.

        Unless their levels are known each has the gain that the criterion likes best.
        """

        def of(sound: RenderedFit) -> dict[str, float]:
            heard, square = self.best(sound.samples)
            return band_values((square if self.scale is None else 1.0) * heard, self.energy, self.cells.spacing)

        before, after, number = of(initial), of(fitted), self.analysis.partials.number
        kept = {"global", *(BANDS[b] for b in band_of(number))}
        values = {name: {"initial": before[name], "final": after[name]} for name in before if name in kept}
        return values | {
            "dropped": [name for name in BANDS if name not in kept],
            "sigma": self.cells.sigma,
            "borders": list(borders(self.analysis.f0, self.analysis.B, int(number.max()))),
        }


def _measured(samples: np.ndarray, r: Recording, a: Analysis) -> tuple[Cells, np.ndarray]:
    """Cells of a recording, and |Y|² on them [partials, nodes] of a sound that is aligned to it."""
    return measure(samples[r.onset :], r.rate, a.f0, a.B, int(a.partials.number.max()), line_sigma(a.f0))


def pool_level_errors(levels: Sequence[dict]) -> dict:
    """Level errors over all recordings, dB rms, and the partials counted."""
    count = np.array([x["partials"] for x in levels])

    def rms(name: str) -> float | None:
        values = [x[name] for x in levels]
        return None if None in values else float(np.sqrt((np.square(values) * count).sum() / count.sum()))

    return {name: rms(name) for name in LEVELS} | {"partials": int(count.sum())}


def compare_recordings(fit: InferenceResult, notes: Sequence[Note]) -> tuple[FittedRecording, ...]:
    """Every recording beside the starting values, and beside its note at the minimum that is shown.

    Raises
    ------
    FitError
        If an initial or a final contact does not end.
    """
    problem, descent, columns = fit.problem, fit.found.minima.descent, fit.problem.observed.number
    integrated = latent_means(fit.found.minima, 0)
    start = fit.begun.copy()
    start[:STRING_SIZE] = np.log([problem.start.initial[name] for name in STRING_NAMES])
    initial = descent.level(start[None])[0]
    fitted = np.asarray(descent.table.value) - integrated.own
    path_only = None if problem.calibrated else fit_reference_hammer(fit)
    heard = []
    for i, note in enumerate(notes):
        recording = problem.recordings[i]
        listener = RecordingComparison.of(recording, problem.analyses[i], problem.start.scale)
        begins = listener.begins(note)
        # The lowest partial has least of the onset's.
        gain = 10 ** (integrated.columns[i][0] / 20) if listener.gain is None else listener.gain
        after = listener.play(note, float(gain), begins, listener.at(fitted[i], columns))
        # The criterion's own gain on the initial sound: its level is not what is judged.
        before = listener.play(_played(fit, start, i), listener.gain, begins, listener.at(initial[i], columns))
        levels = {"initial_db": before.level, "fitted_db": after.level}
        levels |= {} if path_only is None else {"path_only_db": listener.at(path_only[i], columns)}
        heard.append(listener.compared(before, after, {n: listener.add_noise_floor(x) for n, x in levels.items()}))
    return tuple(heard)


def _played(fit: InferenceResult, z: np.ndarray, i: int) -> Note:
    """What values at `z` [size] give of a recording, without a path."""
    u, problem = fit.problem.unknowns, fit.problem
    hammer = u.hammer(z, problem.layout.stroke[i])
    return Note(u.string(z), hammer, u.geometry_at(z), problem.start.quantity, 1.0, None)


def fit_reference_hammer(fit: InferenceResult) -> np.ndarray:
    """Levels of the initial hammer at the velocities, and through the gain and path, that suit it, dB [R, K].

    Where its strike is free it is fitted too: what is left to the fitted hammer is what mass and felt explain.
    """
    problem, u, z = fit.problem, fit.problem.unknowns, fit.found.z
    felt = np.arange(u.size) < u.shared
    felt[:STRING_SIZE] = felt[[u.index_of("x0"), u.index_of("width")]] = False
    known = replace(u, mean=np.where(felt, fit.begun, u.mean), sd=np.where(felt, 0.0, u.sd))
    descent = descents.Optimiser(replace(problem, unknowns=known), z[:STRING_SIZE], descents.LEVELS)
    phi, offset = fit.found.minima.people.level.phi[:1], descent.discretisation_error_db(z[None])[0]
    parabolas = [QuadraticSurrogate.of(descent.table, phi[0], gains=node) for node in range(len(descent.table.scale))]
    begun = np.concatenate(rescan_velocities(descent, known.project(np.stack([fit.begun, z])), parabolas, offset))
    people = descent.minimise(descent.initialise(begun, [phi], offset=offset), 0.0, STEPS, GAIN)
    if not len(people):
        return np.full(descent.table.value.shape, SILENT)
    best = people.level
    return (
        np.asarray(descent.table.value) - latent_posterior(descent.table, best.residual[0], best.phi[0], best.w[0]).own
    )
