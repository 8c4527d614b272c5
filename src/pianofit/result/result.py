"""A finished fit as a program and a notebook hold it: numbers by name, what is claimed, and the note that plays."""

from __future__ import annotations

import copy
import os
from dataclasses import dataclass, replace
from functools import cached_property
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from ..analysis import Analysis, Partials
from ..errors import FitError
from ..felt import FeltLaw
from ..fit_file import fit_path, gains_of, mixture_of, read_fit
from ..io.files import printable, reference_of
from ..io.number_format import counted
from ..model import Simulation
from ..model.modal_response import ModalResponse
from ..model.note import Note
from ..recording.recording import Recording, Source
from .draws import DRAWS_FILE, Draws, read_draws
from .quantities import Covariance, Quantities

__all__ = ["FittedRecording", "Result", "RenderedFit"]

# Of the identifiability statement, in characters, that a `repr` shows.
STATEMENT = 300


@dataclass(frozen=True, eq=False, repr=False)
class RenderedFit:
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

    initial: RenderedFit
    fitted: RenderedFit
    level: np.ndarray  # dB, [partials], measured, in the pickup's unit
    recording: Recording
    analysis: Analysis
    criterion: dict
    levels: dict
    ringing: RenderedFit | None = None  # `fitted` as the key rings; itself is by the string's law

    def __repr__(self) -> str:
        return f"FittedRecording: {self.recording!r}, levels {self.levels['fitted_db']:.2f} dB off after the fit"

    @property
    def as_played(self) -> RenderedFit:
        """The fit as it plays this recording: as the key rings, or by the string's law."""
        return self.ringing or self.fitted

    def ringing_by(self, ringing: ModalResponse, late: float) -> FittedRecording:
        """The same with the fit as the key rings; the contact lies `late` seconds after the onset."""
        law, recording = self.fitted, self.recording
        note = law.note._replace(ringing=ringing)
        touch = recording.onset + round(late * recording.rate)
        frames = note.render_channels(law.simulation, recording.rate, len(recording.samples), touch)
        return replace(self, ringing=RenderedFit(note, frames.mean(axis=0), law.simulation, law.level, frames))

    @property
    def sound(self) -> np.ndarray:
        """`played` as a file has it [samples], or [channels, samples]."""
        frames = self.as_played.frames
        return self.as_played.samples if frames is None or len(frames) == 1 else frames

    @property
    def partials(self) -> Partials:
        """The table of partials."""
        return self.analysis.partials


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """A finished fit, or one that was read back from its `fit.json`.

    `document` is what `fit.json` holds. `recordings` are in the order in which they were given; a result that was read
    back has none until `with_recordings` reads them, which plots, `save` and `report` do by themselves. One recording,
    the `first`, is the reference. `notes` play each minimum, for every recording [minima][recordings], and `shares` are
    the minima's weights. `draws` are the posterior's, where it was asked for: values [chains, draws] by name. `folder`
    is where the result was read from.
    """

    document: dict
    recordings: tuple[FittedRecording, ...]
    reference_index: int
    minima_notes: tuple[tuple[Note, ...], ...]
    weights: tuple[float, ...]
    draws: Draws | None = None
    folder: Path | None = None

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
        return self.minima_notes[0][self.reference_index]

    @property
    def mixture(self) -> list[tuple[float, Note]]:
        """The notes of all minima with their shares, the best first: what `predict_recording` takes."""
        return [
            (share, notes[self.reference_index]) for share, notes in zip(self.weights, self.minima_notes, strict=True)
        ]

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
            If the fit was read back, and its recording is not at its place or was changed.
        """
        return self.with_recordings().recordings[self.reference_index]

    def with_recordings(self, *recordings: Source) -> Result:
        """The result with its recordings: itself, or one that was read back with the recordings read again.

        Parameters
        ----------
        recordings : in the order of the fit; those at their recorded paths if none is given.

        Raises
        ------
        FitError
            Naming the recording that is missing, or whose SHA-256 is not that of the one that was fitted.

        Examples
        --------
        With the folder that the example of `fit` saves, and the samples that were fitted there:

        >>> import pianofit
        >>> it = pianofit.preset("chabassier-F3")
        >>> sound = pianofit.simulate(it.string, it.hammer, it.geometry, quantity="bridge-force")
        >>> samples = sound.waveform(44_100, 88_200)
        >>> result = pianofit.Result.load("fit").with_recordings((0.5 * samples / abs(samples).max(), 44_100))
        >>> result.reference.recording.seconds
        2.0
        """
        if recordings:
            from .reload import recalled

            return recalled(self, recordings)
        return self if self.recordings else self._recalled

    @cached_property
    def _recalled(self) -> Result:
        from .reload import recalled

        return recalled(self)

    @property
    def initial(self) -> RenderedFit:
        """Before the fit, reference recording."""
        return self.reference.initial

    @property
    def fitted(self) -> RenderedFit:
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
        """Figures: `plot.spectrum()`, `force()`, `felt()`, `levels()`, `envelopes()`, `correlations()`.

        Each returns its Axes, and takes Axes and a `label`, so that two results share a figure.
        """
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
        """The posterior's draws as ArviZ knows them.

        The group "posterior" has parameters, the velocities of all strokes and invariants. "observed_data" has what was
        compared: levels and bounds of absent partials, dB, and frequencies, cents, and decays, logarithms, over their
        laws. "constant_data" names the recording and the partial of each observation. "log_likelihood" has the log
        density of each observation given all others, for ArviZ's `loo` and `compare`.

        Raises
        ------
        FitError
            If the fit has no draws.
        OutputError
            If ArviZ is not installed.
        """
        if self.draws is None:
            if any(q.interval_by == "posterior" for q in self.parameters.values()):
                raise FitError(f"the draws, {DRAWS_FILE}, are not next to fit.json; copy them there, or fit again")
            raise FitError("there are no draws; fit with intervals='posterior'")
        return self.draws.to_arviz()

    def save(self, folder: str | os.PathLike[str], *, force: bool = False, page: bool = True) -> Path:
        """Write `fit.json`, the draws, the sounds and the page to a folder, which is returned.

        A result that was read back reads its recordings again for that. Without a `page` it needs none: its files are
        copied.

        Raises
        ------
        OutputError
            If it cannot be written, or holds something and `force` is not given.
        FitError
            If the fit was read back, and a recording is not at its place or was changed.
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
            If the fit was read back, and a recording is not at its place or was changed.
        """
        from ..report.save import write_page

        return write_page(self, Path(path), title, held_out)

    @classmethod
    def load(cls, folder: str | os.PathLike[str], felt: FeltLaw | None = None) -> Result:
        """A fit read back from the folder it was saved to, or its `fit.json`, with its draws.

        Numbers, tables, notes and the figures of force, levels and correlations are there at once. What needs the
        recordings reads them from their recorded paths; see `with_recordings`.

        Parameters
        ----------
        folder : that `save` or `pianofit fit` wrote, or the file in it.
        felt : the felt's law, where the fit was by one of your own.

        Raises
        ------
        FitError
            Naming the file and what is wrong with it.

        Examples
        --------
        With the folder that the example of `fit` saves:

        >>> import pianofit
        >>> result = pianofit.Result.load("fit")
        >>> f"{result.invariants.f0:.1f}", result.parameters.c.sd > 0
        ('175.0+/-0.0', True)
        """
        path = fit_path(folder)
        document, name = read_fit(path), printable(path)
        shares, mixture = zip(*mixture_of(document, path, felt), strict=True)
        from .reload import every_note

        notes, (first, _) = every_note(document, mixture, name), reference_of(document["recordings"])
        invariants = document.get("invariants")
        draws = read_draws(document.get("draws"), path.parent, invariants if isinstance(invariants, dict) else {})
        result = cls(document, (), first, notes, shares, draws, path.parent)
        try:
            _ = repr(result), result._repr_html_()
        except (AttributeError, IndexError, KeyError, TypeError, ValueError) as missing:
            raise FitError(
                f"{name}: is not whole ({printable(repr(missing))}); give the file that pianofit fit wrote"
            ) from None
        return result
