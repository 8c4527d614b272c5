"""`Result`: a finished fit, with quantities by name, the identifiability statement, and notes to render."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .. import deferred
from ..analysis import Analysis
from ..errors import FitError
from ..felt import FeltLaw
from ..io.files import as_path, printable
from ..io.number_format import counted
from ..model.note import Note
from ..recording.recording import Recording, Source
from ..schema.decode import builtins_of
from ..schema.fit import Fit, fit_path, read_fit
from ..schema.notes import notes_of_fit
from ..schema.quantities import Covariance, Quantities
from .derived import DerivedQuantity, DrawSet, ModelDraw
from .draws import DRAWS_FILE, Draws, read_draws
from .fitted_recording import FittedRecording, RenderedFit
from .prediction import Prediction, predict_recording
from .reload import reload_recordings

if TYPE_CHECKING:
    from .cross_validation import CrossValidation

# Characters of the identifiability statement in a `repr`.
STATEMENT_LENGTH = 300


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """A finished fit, or one that was loaded from its `fit.json`.

    `fit` has all that the fit reports, as in `fit.json`. `recordings` are in the order in which they were given. A
    loaded result has none until `with_recordings` reads them; plots, `save` and `report` do this when needed.
    `minima_notes` has a note for each [minima, recordings]. `draws` are posterior draws [chains, draws] by name, if the
    fit computed them. `folder` is the folder that the result was loaded from.
    """

    fit: Fit
    recordings: tuple[FittedRecording, ...]
    minima_notes: tuple[tuple[Note, ...], ...]
    draws: Draws | None = None
    folder: Path | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {own.name: getattr(self, own.name) for own in fields(self)}  # without functions, which cannot be pickled

    @property
    def identifiability_statement(self) -> str:
        """The kind of measurement, and which parameters it determines."""
        return self.fit.identifiability_statement

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings, the most important first."""
        return self.fit.warnings

    @property
    def parameters(self) -> Quantities:
        """Every parameter by name, with value, unit, 95 % interval, status and meaning."""
        return self.fit.parameters

    @property
    def invariants(self) -> Quantities:
        """Quantities that do not depend on an assumed length, mass or (except F/M_S) velocity."""
        return self.fit.invariants

    @property
    def reference_index(self) -> int:
        """Index of the reference recording."""
        return self.fit.reference_index

    @property
    def weights(self) -> tuple[float, ...]:
        """Posterior weights of the minima, the best first."""
        return tuple(minimum.weight for minimum in self.fit.minima) or (1.0,)

    @property
    def note(self) -> Note:
        """The note of the best minimum at the velocity of the reference recording. It renders and predicts."""
        return self.minima_notes[0][self.reference_index]

    @property
    def mixture(self) -> list[tuple[float, Note]]:
        """Pairs of posterior weight and note for all minima, the best first, as `predict_recording` takes them."""
        return [*zip(self.weights, (notes[self.reference_index] for notes in self.minima_notes), strict=True)]

    @property
    def gains(self) -> tuple[float, ...]:
        """Gains of the recordings in the path group of the reference recording, dB relative to it."""
        return self.fit.relative_gains()

    @property
    def covariance(self) -> Covariance:
        """Covariance of log(value) at the best minimum, by name.

        Raises
        ------
        FitError
            If the fit was loaded from a file without a covariance.
        """
        if self.fit.covariance is None:
            raise FitError("covariance: this fit.json has none; fit the recordings again")
        return self.fit.covariance

    @property
    def correlation(self) -> Covariance | None:
        """Correlations of log(value) of all parameters but velocities, at the reference velocity if none is known."""
        intervals, scale_open = self.fit.has_intervals, self.fit.velocity_scale_open
        return self.covariance.of_shared(scale_open).normalised if intervals else None

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
            return replace(self, recordings=reload_recordings(self.fit, self.minima_notes[0], recordings))
        return self if self.recordings else self._reloaded

    @cached_property
    def _reloaded(self) -> Result:
        return replace(self, recordings=reload_recordings(self.fit, self.minima_notes[0]))

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

    @property
    def derived_quantities(self) -> Quantities:
        """Contact time, forces, energy lost in the felt and T60, with intervals from draws of the posterior."""
        return self.fit.derived.quantities

    def derived(self, function: Callable[[ModelDraw], float], *, at_reference_velocity: bool = True) -> DerivedQuantity:
        """Compute any quantity with its 95 % interval, from joint draws of the posterior over all minima.

        Parameters
        ----------
        function : takes a `ModelDraw` and returns one number. A draw has `values` by name, the `note`, its simulated
            `stroke`, `felt_force(u)`, N, and `local_exponent(u)` at any compression u, m, and `t60(k)`, s, of any
            partial k.
        at_reference_velocity : without a measured velocity, draws hold at the reference velocity shown, as F/M_S does.
            False includes the unknown common scale of the velocities, as the interval of K_H does.

        Returns
        -------
        A `DerivedQuantity`: value at the best minimum, interval, status, draws [draws]; the same after loading.

        Raises
        ------
        ParameterError
            If the function does not return one number.
        FitError
            If a value is not finite.

        Examples
        --------
        With the folder that the example of `fit` saves:

        >>> import pianofit
        >>> contact = pianofit.Result.load("fit").derived(lambda draw: 1e3 * draw.stroke.contact_time)  # ms
        >>> contact.interval[0] < contact.value < contact.interval[1], contact.draws.shape
        (True, (256,))
        """
        found = self.draw_set.evaluate(function)
        if at_reference_velocity:
            return found
        return replace(replace(self.draw_set, at_reference_velocity=False).evaluate(function), status=found.status)

    @cached_property
    def draw_set(self) -> DrawSet:
        """Draws of the posterior for `derived`."""
        stroke = self.recordings[self.reference_index].fitted.simulation if self.recordings else None
        return DrawSet(self.fit, self.note, stroke, self.draws)

    def predict(self, recording: Analysis | Source, gains: Sequence[float] | None = None) -> Prediction:
        """Predict a recording that took no part in the fit. Only its velocity, gain and pitch are fitted.

        Parameters
        ----------
        recording : the recording in any form that `fit` takes, or its analysis.
        gains : as for `predict_recording`; `gains` of this result if None.

        Returns
        -------
        A `Prediction`: velocity in m/s, predicted levels [partials] and their rms error in dB.

        Raises
        ------
        FitError
            If too few partials are above the noise, or no velocity gives a finite sound.
        RecordingError, AnalysisError
            If the recording cannot be used, is too short, or is of another key.

        Examples
        --------
        With the folder that the example of `fit` saves:

        >>> import pianofit
        >>> it = pianofit.preset("chabassier-F3")
        >>> sound = pianofit.simulate(it.string, it.hammer, it.geometry, quantity="bridge-force")
        >>> samples = sound.waveform(44_100, 44_100)
        >>> prediction = pianofit.Result.load("fit").predict((0.5 * samples / abs(samples).max(), 44_100))
        >>> prediction.error_db < 1.0
        True
        """
        return predict_recording(self.mixture, recording, gains=self.gains if gains is None else gains)

    # --- display ------------------------------------------------------------------------------------------------------

    def __repr__(self) -> str:
        count, statement = len(self.fit.recordings), self.identifiability_statement
        short = statement if len(statement) <= STATEMENT_LENGTH else statement[: STATEMENT_LENGTH - 3] + "..."
        state = "converged" if self.fit.converged else "NOT CONVERGED"
        lines = [f"Result of {counted(count, 'recording')}, {self.fit.recipe} recipe, {state}", short]
        lines += [", ".join(f"{q.name} {q.value:.5g}" for q in table.values()) for table in self._tables]
        return "\n".join(line for line in lines if line)

    def __str__(self) -> str:
        return "\n\n".join(filter(None, [self.identifiability_statement, *map(str, self._tables)]))

    def _repr_html_(self) -> str:
        notes = "".join(f"<li>{escape(warning)}</li>" for warning in self.warnings)
        return (
            f"<p><strong>{escape(self.identifiability_statement)}</strong></p>"
            f"{''.join(table._repr_html_() for table in self._tables)}<ul>{notes}</ul>"
        )

    @property
    def _tables(self) -> tuple[Quantities, ...]:
        return self.invariants, self.parameters, self.derived_quantities

    def summary(self) -> str:
        """Statement, quantities with intervals, errors and warnings, as `pianofit fit` prints them."""
        return deferred.call("report.summary", "fit_summary", self)

    @property
    def plot(self) -> Any:
        """Figures: `plot.spectrum()`, `force()`, `felt()`, `levels()`, `envelopes()`, `correlations()`.

        Each takes Axes and a `label`, so that two results can share a figure, and returns the Axes.
        """
        return deferred.call("report.plots", "Plots", self)

    # --- export -------------------------------------------------------------------------------------------------------

    def to_dict(self) -> dict[str, Any]:
        """The content of `fit.json` as dicts, lists, numbers and texts (docs/files.md)."""
        return builtins_of(self.fit)

    def to_dataframe(self) -> Any:
        """The parameters as a pandas data frame, one row each. For the invariants use `invariants.to_dataframe()`.

        Raises
        ------
        OutputError
            If pandas is not installed.
        """
        return self.parameters.to_dataframe()

    def to_arviz(self) -> Any:
        """The posterior draws as a tree of ArviZ 1.x (an `xarray.DataTree`).

        "posterior" has the parameters, the velocities of all strokes and the invariants, "M_H over M_S" for M_H/M_S.
        "observed_data" has levels and bounds of censored partials, dB, frequencies (cents) and decay rates (logarithms)
        relative to the string model, "constant_data" the recording and partial of each observation. "log_likelihood"
        has the log density of each observation given all others, for ArviZ's `loo` and `compare`.

        Raises
        ------
        FitError
            If the fit has no draws.
        OutputError
            If ArviZ is not installed.
        """
        if self.draws is None:
            if any(q.interval_method == "posterior" for q in self.parameters.values()):
                raise FitError(f"the draws, {DRAWS_FILE}, are missing next to fit.json; copy the file, or fit again")
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
        return deferred.call("report.save", "save", self, as_path(folder), force=force, page=page)

    def report(
        self, path: str | os.PathLike[str], *, title: str | None = None, held_out: CrossValidation | None = None
    ) -> Path:
        """Write the page to `path`, a file, or a folder for `report.html`, and return its path.

        Parameters
        ----------
        title : title of the page; names of recordings and note if None.
        held_out : cross-validation of the same recordings, to be shown too.

        Raises
        ------
        OutputError
            If the page cannot be written.
        FitError
            If the fit was loaded, and a recording was moved or changed.
        """
        return deferred.call("report.save", "write_page", self, as_path(path), title, held_out)

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
        fit = read_fit(path)
        notes = notes_of_fit(fit, path.parent, printable(path), felt)
        return cls(fit, (), notes, read_draws(fit.draws, path.parent), path.parent)
