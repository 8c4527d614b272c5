"""Single figures of the page, for a notebook."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ..errors import FitError, ParameterError
from ..result import Result
from .build import contact_curves, envelopes_of, felt_of, identifiability_of, level_curves, reference_curves
from .drawing import STYLE
from .figures import draw_force, draw_levels, draw_spectrum
from .figures_identifiability import draw_correlations, draw_static_law
from .figures_modal_response import draw_envelope
from .overlay import draw_labelled

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["Plots", "drawn_on"]


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
        curves, dropped = reference_curves(self.result), tuple(self.result.document["criterion"]["dropped"])
        return drawn_on(ax, lambda axes: draw_spectrum(axes, curves, dropped), label)

    def force(self, ax: Axes | None = None, *, label: str | None = None) -> Axes:
        """Draw the force of the hammer on the string, N over ms from the first contact, before and after the fit."""
        curves = contact_curves(self.result)
        return drawn_on(ax, lambda axes: draw_force(axes, curves), label)

    def felt(self, ax: Axes | None = None, *, label: str | None = None) -> Axes:
        """Draw the static force of the felt, N over mm of compression, with its 95 % band.

        The curve ends at the largest compression of all strokes. Without a measured velocity the band holds at the
        reference velocity shown.

        Raises `FitError` if the fit was loaded from a file without a covariance.
        """
        felt = felt_of(self.result)
        return drawn_on(ax, lambda axes: draw_static_law(axes, felt), label)

    def levels(self, ax: Axes | None = None, *, label: str | None = None) -> Axes:
        """Draw the levels of the partials, dB over the partial number, measured with 95 % bars, initial and fitted."""
        curves = level_curves(self.result)
        return drawn_on(ax, lambda axes: draw_levels(axes, curves), label)

    def envelopes(self, ax: Axes | None = None, *, number: int | None = None, label: str | None = None) -> Axes:
        """Draw the level of one partial, dB over s: measured, with the string model, and with the modes of the key.

        `number` is the partial, the strongest if None. Raises `ParameterError` if it was not measured.
        """
        reference = self.result.reference
        measured = reference.partials.number
        chosen = int(measured[reference.level.argmax()]) if number is None else number
        if chosen not in measured:
            raise ParameterError(
                f"number={number} is not a partial of this recording; choose one of {measured.tolist()}"
            )
        (envelope,) = envelopes_of(self.result, [chosen])
        return drawn_on(ax, lambda axes: draw_envelope(axes, envelope), label)

    def correlations(self, ax: Axes | None = None, *, label: str | None = None) -> Axes:
        """Draw the correlations of the estimates, %; without a measured velocity, at the reference velocity shown.

        `label` goes into the title. Raises `FitError` if the fit has no intervals, like those of the paper's recipes.
        """
        _ = self.result.covariance
        data = identifiability_of(self.result)
        if data is None:
            raise FitError("this fit has no intervals and therefore no correlations; use the default recipe")
        axes = drawn_on(ax, lambda axes: draw_correlations(axes, data), None, (6.4, 5.6))
        axes.set(xlabel="logarithm of the parameter", ylabel="logarithm of the parameter")
        if label is not None:
            axes.set_title(f"{axes.get_title(loc='left')}: {label}", loc="left")
        return axes


def drawn_on(
    ax: Axes | None, draw: Callable[[Axes], None], label: str | None = None, size: tuple[float, float] = (8.0, 4.4)
) -> Axes:
    """Draw into `ax` or into new axes, with a legend."""
    import matplotlib.pyplot as plt

    with plt.rc_context(STYLE):
        axes = plt.subplots(figsize=size, layout="constrained")[1] if ax is None else ax
        draw_labelled(axes, draw, label)
        if axes.get_legend_handles_labels()[0]:
            axes.legend()
    return axes
