"""Single figures of the page, for a notebook. Several results can be drawn into the same axes.

Each label then has its own hue, and its legend entries contain the label.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ..errors import FitError, ParameterError
from ..result import Result
from .drawing import FITTED, GROUP, INITIAL, LAW, MEASURED, STYLE
from .figures import contact_of, draw_force, draw_levels, draw_spectrum, spectra_of
from .identifiability import draw_correlations
from .modal_response import draw_envelope, envelopes_of
from .static_law import draw_static_law, static_law

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Colours of Okabe and Ito, which colour-blind readers can distinguish, in the order of the drawings.
HUES = (FITTED, INITIAL, LAW, GROUP, "#56b4e9", "#e69f00")
FAINT_ALPHA = 0.45  # of measured curves, to distinguish them from fitted curves of the same hue
GROUP_ID = "pianofit:"  # prefix of the group id of labelled artists


@dataclass(frozen=True)
class Plots:
    """Figures of one fit. Each method draws into `ax`, or into new axes, and returns the axes.

    To compare results in one figure, draw them into the same axes with a `label` each: `a.plot.felt(label="soft")`
    returns axes, and `b.plot.felt(axes, label="loud")` adds to them. Each label has its own hue.

    A fit that was loaded from a file draws force, felt, levels and correlations without its recordings. `spectrum` and
    `envelopes` read the reference recording again, and raise `FitError` if it is missing or was changed.
    """

    result: Result

    def spectrum(self, ax: Axes | None = None, *, label: str | None = None) -> Axes:
        """Draw measured, initial and fitted spectrum, dB over Hz, with the bands of the criterion."""
        return drawn_on(ax, draw_spectrum, spectra_of(self.result.with_recordings()), label)

    def force(self, ax: Axes | None = None, *, label: str | None = None) -> Axes:
        """Draw the force of the hammer on the string, N over ms from the first contact, before and after the fit."""
        self._check_figure("force")
        return drawn_on(ax, draw_force, (contact_of(self.result),), label)

    def _check_figure(self, name: str) -> None:
        """Raise a `FitError` if the excitation of the fit does not have a figure."""
        law = self.result.draw_set.law
        if name not in law.figures:
            raise FitError(f"plot.{name}: the string is {law.words.verb}, so the fit has no such figure")

    def felt(self, ax: Axes | None = None, *, label: str | None = None) -> Axes:
        """Draw the static force of the felt, N over mm of compression, with its 95 % band.

        The curve ends at the largest compression of all strokes. Without a measured velocity the band holds at the
        reference velocity shown.

        Raises `FitError` if the fit was loaded from a file without a covariance.
        """
        self._check_figure("felt")
        return drawn_on(ax, draw_static_law, (static_law(self.result),), label)

    def levels(self, ax: Axes | None = None, *, label: str | None = None) -> Axes:
        """Draw the levels of the partials, dB over the partial number, measured with 95 % bars, initial and fitted."""
        return drawn_on(ax, draw_levels, (self.result.fit.reference.partials,), label)

    def envelopes(self, ax: Axes | None = None, *, number: int | None = None, label: str | None = None) -> Axes:
        """Draw the level of one partial, dB over s: measured, with the string model, and with the modes of the key.

        `number` is the partial, the strongest if None. Raises `ParameterError` if it was not measured.
        """
        reference = self.result.reference
        measured = reference.partials.number
        chosen = int(measured[reference.partials.level.argmax()]) if number is None else number
        if chosen not in measured:
            raise ParameterError(
                f"number={number} is not a partial of this recording; choose one of {measured.tolist()}"
            )
        return drawn_on(ax, draw_envelope, envelopes_of(self.result, [chosen]), label)

    def correlations(self, ax: Axes | None = None, *, label: str | None = None) -> Axes:
        """Draw the correlations of the estimates, %; without a measured velocity, at the reference velocity shown.

        `label` goes into the title. Raises `FitError` if the fit has no intervals, like those of the paper's recipes.
        """
        correlation = self.result.correlation
        if correlation is None or not correlation.names:
            raise FitError("this fit has no intervals and therefore no correlations; use the default recipe")
        axes = drawn_on(ax, draw_correlations, (correlation,), size=(6.4, 5.6))
        axes.set(xlabel="logarithm of the parameter", ylabel="logarithm of the parameter")
        if label is not None:
            axes.set_title(f"{axes.get_title(loc='left')}: {label}", loc="left")
        return axes


def drawn_on(
    ax: Axes | None,
    draw: Callable[..., None],
    values: Sequence[Any],
    label: str | None = None,
    size: tuple[float, float] = (8.0, 4.4),
) -> Axes:
    """Draw values into `ax` or new axes, with a legend. If `ax` contains a drawing, the limits then include both.

    With a label, line style still distinguishes measured, initial and fitted, and the hue distinguishes the results.
    """
    import matplotlib.pyplot as plt

    with plt.rc_context(STYLE):
        axes = plt.subplots(figsize=size, layout="constrained")[1] if ax is None else ax
        limits = (axes.get_xlim(), axes.get_ylim()) if axes.has_data() else None
        title, before = axes.get_title(loc="left"), {*axes.get_children(), *axes.containers}
        draw(axes, *values)
        if label is not None:
            ids = {str(artist.get_gid()) for artist in axes.get_children()}
            earlier = {one for one in ids if one.startswith(GROUP_ID)} - {GROUP_ID + label}
            _apply_label(axes, before, label, HUES[len(earlier) % len(HUES)])
        if limits is not None:
            _widen_limits(axes, before, limits, title)
        if axes.get_legend_handles_labels()[0]:
            axes.legend()
    return axes


def _apply_label(axes: Axes, before: set[Any], label: str, hue: str) -> None:
    """Give the artists that are not in `before` the hue and the label."""
    from matplotlib.collections import Collection
    from matplotlib.lines import Line2D

    for artist in [*axes.lines, *axes.collections, *axes.containers]:
        if artist in before:
            continue
        name = str(artist.get_label())
        if name and not name.startswith("_"):
            artist.set_label(f"{label}: {name}")
        if isinstance(artist, Line2D | Collection):
            artist.set_gid(GROUP_ID + label)
            if isinstance(artist, Line2D) and artist.get_color() == MEASURED:
                artist.set_alpha(FAINT_ALPHA)
            artist.set_color(hue)


def _widen_limits(axes: Axes, before: set[Any], limits: tuple[Any, Any], title: str) -> None:
    """Widen the limits to those of both drawings, and remove texts and shades that would overlap the first."""
    for artist in [*axes.texts, *axes.patches]:
        if artist not in before:
            artist.remove()
    for get, set_to, old in zip((axes.get_xlim, axes.get_ylim), (axes.set_xlim, axes.set_ylim), limits, strict=True):
        set_to(min(get()[0], old[0]), max(get()[1], old[1]))
    if title:
        axes.set_title(title, loc="left")
