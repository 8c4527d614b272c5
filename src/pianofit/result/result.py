"""`Result`: a finished fit, with quantities by name, the identifiability statement, and notes to render."""

from __future__ import annotations

import copy
import os
from dataclasses import dataclass
from functools import cached_property
from html import escape
from pathlib import Path
from typing import Any

from .. import deferred
from ..analysis import Analysis
from ..errors import FitError
from ..felt import FeltLaw
from ..fit_file import fit_path, notes_of_minima, read_fit, relative_gains
from ..io.files import printable, reference_row
from ..io.number_format import counted
from ..model.note import Note
from ..recording.recording import Recording, Source
from .draws import DRAWS_FILE, Draws, read_draws
from .fitted_recording import FittedRecording, RenderedFit
from .quantities import Covariance, Quantities

__all__ = ["Result"]

# Characters of the identifiability statement in a `repr`.
STATEMENT_LENGTH = 300


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """A finished fit, or one that was loaded from its `fit.json`.

    `document` is the content of `fit.json`. `recordings` are in the order in which they were given. A loaded result has
    none until `with_recordings` reads them; plots, `save` and `report` do this when needed. `reference_index` is the
    index of the reference recording. `minima_notes` has a note for each minimum and recording [minima][recordings], and
    `weights` the posterior weights of the minima. `draws` are posterior draws [chains, draws] by name, if the fit
    computed them. `folder` is the folder that the result was loaded from.
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
        """The identifiability statement: the kind of measurement, and which parameters it determines."""
        return self.document["claims"]

    @property
    def messages(self) -> tuple[str, ...]:
        """Warnings, the most important first."""
        return tuple(self.document["messages"])

    @property
    def parameters(self) -> Quantities:
        """Every parameter by name, with value, unit, 95 % interval, status and meaning."""
        return Quantities.of(self.document["parameters"])

    @property
    def invariants(self) -> Quantities:
        """Quantities that do not depend on an assumed length, mass or (except F/M_S) velocity."""
        return Quantities.of(self.document["invariants"])

    @property
    def note(self) -> Note:
        """The note of the best minimum at the velocity of the reference recording. It renders and predicts."""
        return self.minima_notes[0][self.reference_index]

    @property
    def mixture(self) -> list[tuple[float, Note]]:
        """Pairs of posterior weight and note for all minima, the best first, as `predict_recording` takes them."""
        return [
            (weight, notes[self.reference_index]) for weight, notes in zip(self.weights, self.minima_notes, strict=True)
        ]

    @property
    def gains(self) -> tuple[float, ...]:
        """Gains of the recordings in the path group of the reference recording, dB relative to it."""
        return relative_gains(self.document)

    @property
    def covariance(self) -> Covariance:
        """Covariance of log(value) at the best minimum, by name.

        Raises
        ------
        FitError
            If the fit was loaded from a file without a covariance.
        """
        covariance = Covariance.of(self.document.get("covariance"))
        if covariance is None:
            raise FitError("covariance: this fit.json has none; fit the recordings again")
        return covariance

    @property
    def reference(self) -> FittedRecording:
        """The reference recording and the model's sounds for it.

        Raises
        ------
        FitError
            If the fit was loaded, and its recording was moved or changed.
        """
        return self.with_recordings().recordings[self.reference_index]

    def with_recordings(self, *recordings: Source) -> Result:
        """The result with its recordings, which are read again if the result was loaded.

        Parameters
        ----------
        recordings : the recordings in the order of the fit; read from their stored paths if none is given.

        Raises
        ------
        FitError
            If a recording is missing, or its SHA-256 is not that of the fitted one; the message names it.

        Examples
        --------
        With the folder that the example of `fit` saves, and the samples fitted there:

        >>> import pianofit
        >>> it = pianofit.preset("chabassier-F3")
        >>> sound = pianofit.simulate(it.string, it.hammer, it.geometry, quantity="bridge-force")
        >>> samples = sound.waveform(44_100, 88_200)
        >>> result = pianofit.Result.load("fit").with_recordings((0.5 * samples / abs(samples).max(), 44_100))
        >>> result.reference.recording.seconds
        2.0
        """
        if recordings:
            from .reload import reload_recordings

            return reload_recordings(self, recordings)
        return self if self.recordings else self._reloaded

    @cached_property
    def _reloaded(self) -> Result:
        from .reload import reload_recordings

        return reload_recordings(self)

    @property
    def initial(self) -> RenderedFit:
        """Sound of the initial values for the reference recording."""
        return self.reference.initial

    @property
    def fitted(self) -> RenderedFit:
        """Sound of the fit for the reference recording."""
        return self.reference.fitted

    @property
    def recording(self) -> Recording:
        """The reference recording."""
        return self.reference.recording

    @property
    def analysis(self) -> Analysis:
        """Analysis of the reference recording."""
        return self.reference.analysis

    # --- display ------------------------------------------------------------------------------------------------------

    def __repr__(self) -> str:
        count, statement = len(self.document["recordings"]), self.claims
        state = "converged" if self.document["converged"] else "NOT CONVERGED"
        short = statement if len(statement) <= STATEMENT_LENGTH else statement[: STATEMENT_LENGTH - 3] + "..."
        lines = [f"Result of {counted(count, 'recording')}, {self.document['recipe']} recipe, {state}", short]
        tables = (self.invariants, self.parameters)
        lines += [", ".join(f"{q.name} {q.value:.5g}" for q in table.values()) for table in tables]
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

        Each takes Axes and a `label`, so that two results can share a figure, and returns the Axes.
        """
        return deferred.call("report.plots", "Plots", self)

    # --- export -------------------------------------------------------------------------------------------------------

    def to_dict(self) -> dict[str, Any]:
        """A copy of the content of `fit.json` (docs/files.md)."""
        return copy.deepcopy(self.document)

    def to_dataframe(self) -> Any:
        """The parameters as a pandas data frame, one row each. For the invariants use `invariants.to_dataframe()`.

        Raises
        ------
        OutputError
            If pandas is not installed.
        """
        return self.parameters.to_dataframe()

    def to_arviz(self) -> Any:
        """The posterior draws as ArviZ inference data.

        The group "posterior" has the parameters, the velocities of all strokes and the invariants. "observed_data" has
        levels and bounds of censored partials, dB, and frequencies (cents) and decay rates (logarithms) relative to the
        string model. "constant_data" has the recording and the partial of each observation. "log_likelihood" has the
        log density of each observation given all others, for ArviZ's `loo` and `compare`.

        Raises
        ------
        FitError
            If the fit has no draws.
        OutputError
            If ArviZ is not installed.
        """
        if self.draws is None:
            if any(q.interval_by == "posterior" for q in self.parameters.values()):
                raise FitError(
                    f"the file of the draws, {DRAWS_FILE}, is missing next to fit.json; copy it there, or fit again"
                )
            raise FitError("the fit has no draws; fit with intervals='posterior'")
        return self.draws.to_arviz()

    def save(self, folder: str | os.PathLike[str], *, force: bool = False, page: bool = True) -> Path:
        """Write `fit.json`, the draws, the sounds and the page to a folder, and return the folder.

        A loaded result reads its recordings again for this. With `page=False` it copies its files instead.

        Raises
        ------
        OutputError
            If the folder cannot be written, or is not empty and `force` is not given.
        FitError
            If the fit was loaded, and a recording was moved or changed.
        """
        return deferred.call("report.save", "save", self, Path(folder), force=force, page=page)

    def report(self, path: str | os.PathLike[str], *, title: str | None = None, held_out: dict | None = None) -> Path:
        """Write the page to `path`, a file, or a folder for `report.html`, and return its path.

        Parameters
        ----------
        title : title of the page; the names of the recordings and the note if None.
        held_out : cross-validation of the same recordings, from `cross_validate`, to be shown with the fit.

        Raises
        ------
        OutputError
            If the page cannot be written.
        FitError
            If the fit was loaded, and a recording was moved or changed.
        """
        return deferred.call("report.save", "write_page", self, Path(path), title, held_out)

    @classmethod
    def load(cls, folder: str | os.PathLike[str], felt: FeltLaw | None = None) -> Result:
        """Load a fit from the folder that it was saved to, or from its `fit.json`, with its draws.

        Quantities, notes and the figures of force, levels and correlations are available at once. Everything else needs
        the recordings and reads them from their stored paths; see `with_recordings`.

        Parameters
        ----------
        folder : folder that `save` or `pianofit fit` wrote, or the file in it.
        felt : the felt law of the fit, if it is your own.

        Raises
        ------
        FitError
            If the file is invalid; the message names it and the reason.

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
        weights, mixture = zip(*notes_of_minima(document, path, felt), strict=True)
        from .reload import every_note

        notes, (first, _) = every_note(document, mixture, name), reference_row(document["recordings"])
        invariants = document.get("invariants")
        draws = read_draws(document.get("draws"), path.parent, invariants if isinstance(invariants, dict) else {})
        result = cls(document, (), first, notes, weights, draws, path.parent)
        try:
            _ = repr(result), result._repr_html_()
        except (AttributeError, IndexError, KeyError, TypeError, ValueError) as missing:
            raise FitError(
                f"{name}: is incomplete ({printable(repr(missing))}); give the file that pianofit fit wrote"
            ) from None
        return result
