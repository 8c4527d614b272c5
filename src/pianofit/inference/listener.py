"""A fit heard beside its recording: on the paper's criterion, and in the levels of its partials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..analysis import Analysis, Partials
from ..criterion import (
    BANDS,
    band_of,
    band_values,
    borders,
    closed_form_gain,
    level_error_db,
    line_sigma,
    measure,
)
from ..model.note import Note
from ..recording import Recording
from .align import touched
from .result import Sound

__all__ = ["Listener", "level_errors", "scored", "together", "worse_bands"]

# Levels are compared over partials to this, Hz: few hammers reach beyond,
LEVEL_TOP = 6000.0
# within so many dB of the strongest: other sounds lie there.
LEVEL_RANGE = 60.0


def worse_bands(criterion: dict) -> list[str]:
    """Occupied bands, and `global`, in which the criterion ended no lower than it started."""
    names = [n for n in ("global", *BANDS) if n in criterion]
    return [n for n in names if criterion[n]["final"] >= criterion[n]["initial"]]


def scored(frequency: np.ndarray, level: np.ndarray) -> np.ndarray:
    """The partials on which levels are compared [partials], bool."""
    return (frequency <= LEVEL_TOP) & (level >= level.max() - LEVEL_RANGE)


@dataclass(frozen=True)
class Listener:
    """A recording on the paper's criterion: cells, and what any other sound of the same length gives on them."""

    recording: Recording
    analysis: Analysis
    sigma: float
    spacing: np.ndarray
    energy: np.ndarray

    @classmethod
    def of(cls, recording: Recording, analysis: Analysis) -> Listener:
        """The listener to one recording."""
        sigma = line_sigma(analysis.f0)
        last = int(analysis.partials.number.max())
        cells, energy = measure(
            recording.samples[recording.onset :], recording.rate, analysis.f0, analysis.B, last, sigma
        )
        return cls(recording, analysis, sigma, cells.spacing, energy)

    @property
    def last(self) -> int:
        """Number of the highest partial found."""
        return int(self.analysis.partials.number.max())

    @property
    def occupied(self) -> tuple[str, ...]:
        """Bands with a partial above the noise."""
        return tuple(BANDS[b] for b in np.unique(band_of(self.analysis.partials.number)))

    def hear(self, samples: np.ndarray) -> np.ndarray:
        """|Y|² [partials, nodes] of a sound aligned to the recording."""
        a, r = self.analysis, self.recording
        return measure(samples[r.onset :], r.rate, a.f0, a.B, self.last, self.sigma)[1]

    def play(self, note: Note, gain: float | None, begins: int | None, level: np.ndarray) -> Sound:
        """A note laid on the recording, with the gain that the criterion likes best if none is given.

        Parameters
        ----------
        begins : the sample at which the hammer touches; where its sound would be seen at the onset if None.
        level : dB, [partials], through a gain of 1.
        """
        strike = note.strike(self.recording.rate)
        begins = touched(note, strike, self.recording) if begins is None else begins
        samples = note.heard(strike, self.recording.rate, len(self.recording.samples), begins)
        if gain is None:
            gain = float(np.sqrt(closed_form_gain(self.hear(samples), self.energy, self.spacing[:, None])))
            level = level + 20 * np.log10(max(gain, 1e-15))
        return Sound(note._replace(gain=gain), samples * gain, strike, level)

    def criterion(self, initial: Sound, fitted: Sound, calibrated: bool) -> dict:
        """Eq. 19 per band on the sounds themselves, from the onset on; bands without a partial are dropped.

        Unless their levels are known, `calibrated`, each has the gain that the criterion likes best.
        """

        def of(sound: Sound) -> dict[str, float]:
            heard, weight = self.hear(sound.samples), self.spacing[:, None]
            square = 1.0 if calibrated else closed_form_gain(heard, self.energy, weight)
            return band_values(square * heard, self.energy, self.spacing)

        before, after = of(initial), of(fitted)
        kept = {"global", *self.occupied}
        values = {name: {"initial": before[name], "final": after[name]} for name in before if name in kept}
        return values | {
            "dropped": [name for name in BANDS if name not in kept],
            "sigma": self.sigma,
            "borders": list(borders(self.analysis.f0, self.analysis.B, self.last)),
        }


def level_errors(levels: dict[str, np.ndarray | None], p: Partials, measured: np.ndarray) -> dict:
    """Rms errors, dB, of levels [partials] by name, one gain removed, and how many partials were compared."""
    chosen = scored(p.frequency, measured)
    of = {n: None if x is None else level_error_db(x[chosen], measured[chosen]) for n, x in levels.items()}
    return of | {"partials": int(chosen.sum())}


def together(levels: Sequence[dict]) -> dict:
    """Level errors over all recordings, dB rms, and the partials counted."""
    count = np.array([x["partials"] for x in levels])

    def rms(name: str) -> float | None:
        values = [x[name] for x in levels]
        return None if None in values else float(np.sqrt((np.square(values) * count).sum() / count.sum()))

    return {name: rms(name) for name in ("initial_db", "fitted_db", "path_only_db")} | {"partials": int(count.sum())}
