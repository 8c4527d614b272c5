"""One recording of a fit, and the model's sounds for it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..analysis import Analysis, Partials
from ..model import Simulation
from ..model.modal_response import ModalResponse
from ..model.note import Note
from ..recording.recording import Recording
from ..schema.fit import Criterion, LevelErrors, PartialLevels


@dataclass(frozen=True, eq=False, repr=False)
class RenderedFit:
    """The sound of one set of parameters."""

    note: Note
    samples: np.ndarray  # file units, as long as the recording
    simulation: Simulation
    frames: np.ndarray | None = None  # [channels, samples], of which `samples` is the mean; None for one channel

    def __repr__(self) -> str:
        return f"Sound of {len(self.samples)} samples, stroke {self.note.stroke_value:.3g}"


@dataclass(frozen=True, eq=False, repr=False)
class FittedRecording:
    """One recording and the model's sounds for it."""

    initial: RenderedFit
    fitted: RenderedFit
    recording: Recording
    analysis: Analysis
    compared: PartialLevels
    criterion: Criterion
    levels: LevelErrors
    with_modes: RenderedFit | None = None  # `fitted` with the modal response; `fitted` uses the string model only

    def __repr__(self) -> str:
        return f"FittedRecording: {self.recording!r}, level error {self.levels.fitted_db:.2f} dB after the fit"

    @property
    def final(self) -> RenderedFit:
        """The fitted sound: with the modal response if the fit has one, else with the string model only."""
        return self.with_modes or self.fitted

    def add_modal_response(self, modal_response: ModalResponse, contact_delay: float, gain: float) -> FittedRecording:
        """A copy with a modal response, whose contact is `contact_delay` seconds after the onset.

        `gain` is that of the reference recording, which plucks through one path share.
        """
        fitted, recording = self.fitted, self.recording
        note = fitted.note.with_gain(gain)._replace(modal_response=modal_response)
        contact = recording.onset + round(contact_delay * recording.rate)
        frames = note.render_channels(fitted.simulation, recording.rate, len(recording.samples), contact)
        return replace(self, with_modes=RenderedFit(note, frames.mean(axis=0), fitted.simulation, frames))

    @property
    def sound(self) -> np.ndarray:
        """Samples of `final` for a file [samples] or [channels, samples]."""
        frames = self.final.frames
        return self.final.samples if frames is None or len(frames) == 1 else frames

    @property
    def partials(self) -> Partials:
        """The table of partials."""
        return self.analysis.partials
