"""A finished fit as a program and a notebook hold it: numbers by name, what is claimed, and the note that plays."""

from __future__ import annotations

import copy
import os
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from ..analysis import Analysis, Partials
from ..errors import FitError
from ..felt import FeltLaw
from ..fit_file import fit_path, gains_of, mixture_of, read_fit
from ..io import one_line
from ..model import Simulation
from ..model.note import Note
from ..numbers import counted
from ..recording import Recording
from ..tables import optional
from .quantities import Covariance, Quantities

__all__ = ["FittedRecording", "Result", "Sound"]

# Of the identifiability statement, in characters, that a `repr` shows.
STATEMENT = 300


@dataclass(frozen=True, eq=False, repr=False)
class Sound:
    """One set of parameters, as it sounds."""

    note: Note
    samples: np.ndarray  # file units, as long as the recording
    simulation: Simulation
    level: np.ndarray  # dB, [partials], gain and path included; of a calibrated recording in its pickup's unit
    frames: np.ndarray | None = None  # `samples` is their mean [channels, samples]; None for one channel

    def __repr__(self) -> str:
        return f"Sound of {len(self.samples)} samples, {self.note.hammer.v_H0:.3g} m/s"


@dataclass(frozen=True, eq=False, repr=False)
class FittedRecording:
    """One recording beside what the model makes of it."""

    initial: Sound
    fitted: Sound
    level: np.ndarray  # dB, [partials], measured, in the pickup's unit
    recording: Recording
    analysis: Analysis
    criterion: dict
    levels: dict
    ringing: Sound | None = None  # `fitted` as the key rings; itself is by the string's law

    def __repr__(self) -> str:
        return f"FittedRecording: {self.recording!r}, levels {self.levels['fitted_db']:.2f} dB off after the fit"

    @property
    def played(self) -> Sound:
        """The fit as it plays this recording: as the key rings, or by the string's law."""
        return self.ringing or self.fitted

    @property
    def sound(self) -> np.ndarray:
        """`played` as a file has it [samples], or [channels, samples]."""
        frames = self.played.frames
        return self.played.samples if frames is None or len(frames) == 1 else frames

    @property
    def partials(self) -> Partials:
        """The table of partials."""
        return self.analysis.partials


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """A finished fit, or one that was read back from its `fit.json`.

    `document` is what `fit.json` holds, `recordings` are in the order in which they were given, none for one that was
    read back. What is shown of one recording is that of the `first`, the reference. `notes` are what plays each
    minimum, for every recording, and `shares` their weights. `draws` are the posterior's, where it was asked for:
    values [chains, draws] by name.
    """

    document: dict
    recordings: tuple[FittedRecording, ...]
    first: int
    notes: tuple[tuple[Note, ...], ...]
    shares: tuple[float, ...]
    draws: dict[str, np.ndarray] | None = None

    @property
    def claims(self) -> str:
        """The identifiability statement: what kind of measurement this is, and what of it is identified."""
        return self.document["claims"]

    @property
    def messages(self) -> tuple[str, ...]:
        """What to beware of, the weightiest first."""
        return tuple(self.document["messages"])

    @property
    def parameters(self) -> Quantities:
        """Every parameter by name, with value, unit, 95 % interval, status and meaning."""
        return Quantities.of(self.document["parameters"])

    @property
    def invariants(self) -> Quantities:
        """What needs no assumed length or mass and, but for F/M_S, no velocity: f0, B, ratios, the felt's force."""
        return Quantities.of(self.document["invariants"])

    @property
    def note(self) -> Note:
        """What renders and predicts: the best minimum's string, hammer and path, at the reference's velocity."""
        return self.notes[0][self.first]

    @property
    def mixture(self) -> list[tuple[float, Note]]:
        """The notes of all minima with their shares, the best first: what `predict_recording` takes."""
        return [(share, notes[self.first]) for share, notes in zip(self.shares, self.notes, strict=True)]

    @property
    def gains(self) -> tuple[float, ...]:
        """Of the recordings through the reference's path, dB over the reference's."""
        return gains_of(self.document)

    @property
    def covariance(self) -> Covariance:
        """Covariance of log(value) at the best minimum, by name.

        Raises
        ------
        FitError
            If the fit was read back from a file that holds none.
        """
        covariance = Covariance.of(self.document.get("covariance"))
        if covariance is None:
            raise FitError("covariance: this fit.json does not hold it; fit the recordings again")
        return covariance

    @property
    def reference(self) -> FittedRecording:
        """The reference recording beside what the model makes of it.

        Raises
        ------
        FitError
            If the fit was read back: a file holds no recordings.
        """
        if not self.recordings:
            raise FitError("this result was read from fit.json, which holds no recordings; fit them again")
        return self.recordings[self.first]

    @property
    def initial(self) -> Sound:
        """Before the fit, reference recording."""
        return self.reference.initial

    @property
    def fitted(self) -> Sound:
        """After the fit, reference recording."""
        return self.reference.fitted

    @property
    def recording(self) -> Recording:
        """As it was read, reference recording."""
        return self.reference.recording

    @property
    def analysis(self) -> Analysis:
        """Of the reference recording."""
        return self.reference.analysis

    # --- to look at ---------------------------------------------------------------------------------------------------

    def __repr__(self) -> str:
        count, statement = len(self.document["recordings"]), self.claims
        state = "converged" if self.document["converged"] else "NOT CONVERGED"
        short = statement if len(statement) <= STATEMENT else statement[: STATEMENT - 3] + "..."
        lines = [f"Result of {counted(count, 'recording')}, {self.document['recipe']} recipe, {state}", short]
        lines += [", ".join(f"{q.name} {q.value:.5g}" for q in table.values()) for table in
                  (self.invariants, self.parameters)]  # fmt: skip
        return "\n".join(line for line in lines if line)

    def __str__(self) -> str:
        return "\n\n".join(filter(None, [self.claims, str(self.invariants), str(self.parameters)]))

    def _repr_html_(self) -> str:
        notes = "".join(f"<li>{escape(message)}</li>" for message in self.messages)
        return (
            f"<p><strong>{escape(self.claims)}</strong></p>{self.invariants._repr_html_()}"
            f"{self.parameters._repr_html_()}<ul>{notes}</ul>"
        )

    @property
    def plot(self) -> Any:
        """Figures: `plot.spectrum()`, `force()`, `levels()`, `envelopes()`, `correlations()`; each returns its Axes."""
        from ..report.plots import Plots

        return Plots(self)

    # --- to take elsewhere --------------------------------------------------------------------------------------------

    def to_dict(self) -> dict[str, Any]:
        """A copy of what `fit.json` holds (docs/files.md)."""
        return copy.deepcopy(self.document)

    def to_dataframe(self) -> Any:
        """The parameters as a pandas data frame, a row each; `invariants.to_dataframe()` gives the others.

        Raises
        ------
        OutputError
            If pandas is not installed.
        """
        return self.parameters.to_dataframe()

    def to_arviz(self) -> Any:
        """The posterior's draws as ArviZ knows them, by name.

        Raises
        ------
        FitError
            If the fit has no draws, or was read back: a file does not hold them.
        OutputError
            If ArviZ is not installed.
        """
        if self.draws is None:
            if any(q.interval_by == "posterior" for q in self.parameters.values()):
                raise FitError("fit.json does not hold the draws; fit the recordings again, and take that result's")
            raise FitError("there are no draws; fit with intervals='posterior'")
        return optional("arviz", "draws for ArviZ").from_dict(posterior=self.draws)

    def save(self, folder: str | os.PathLike[str], *, force: bool = False, page: bool = True) -> Path:
        """Write `fit.json`, the sounds and the page to a folder, which is returned.

        Raises
        ------
        OutputError
            If it cannot be written, or holds something and `force` is not given.
        FitError
            If the fit was read back.
        """
        from ..report.save import save

        return save(self, Path(folder), force=force, page=page)

    def report(self, path: str | os.PathLike[str], *, title: str | None = None, held_out: dict | None = None) -> Path:
        """Write the page to `path`, a file or a folder for `report.html`, and return where it is.

        Parameters
        ----------
        title : the names of the recordings and the note, if None.
        held_out : what `cross_validate` returned of the same recordings, to be shown beside their fit.

        Raises
        ------
        OutputError
            If it cannot be written.
        FitError
            If the fit was read back.
        """
        from ..report.save import write_page

        return write_page(self, Path(path), title, held_out)

    @classmethod
    def load(cls, folder: str | os.PathLike[str], felt: FeltLaw | None = None) -> Result:
        """A fit read back from the folder it was saved to, or its `fit.json`, which holds no recordings and no draws.

        `felt` is the felt's law, where the fit was by one of your own.

        Raises
        ------
        FitError
            Naming the file and what is wrong with it.
        """
        path = fit_path(folder)
        document, name = read_fit(path), one_line(path)
        mixture = mixture_of(document, path, felt)
        shares, notes = zip(*mixture, strict=True)
        result = cls(document, (), 0, tuple((note,) for note in notes), shares)
        try:
            _ = repr(result), result._repr_html_()
        except (AttributeError, IndexError, KeyError, TypeError, ValueError) as missing:
            raise FitError(
                f"{name}: is not whole ({one_line(repr(missing))}); give the file that pianofit fit wrote"
            ) from None
        return result
