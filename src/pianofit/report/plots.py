"""The figures of the page, one at a time, for a notebook."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ..errors import FitError, ParameterError
from ..result import Result
from .build import contact_curves, envelopes_of, felt_of, known_of, level_curves, reference_curves
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
    """Figures of one fit. Each goes to `ax`, or to new axes, and returns its axes.

    To compare results in one figure, draw them into the same axes with a `label` each: `a.plot.felt(label="soft")`
    returns axes, and `b.plot.felt(axes, label="loud")` adds to them. Every label has a hue of its own.

    A fit that was read back draws force, felt, levels and correlations without its recordings. `spectrum` and
    `envelopes` read the reference recording again, and raise `FitError` if it is missing or was changed.
    """

    result: Result

    def spectrum(self, ax: Axes | None = None, *, label: str | None = None) -> Axes:
        """Measured, initial and fitted spectrum, dB over Hz, with the bands of the paper's criterion."""
        curves, dropped = reference_curves(self.result), tuple(self.result.document["criterion"]["dropped"])
        return drawn_on(ax, lambda axes: draw_spectrum(axes, curves, dropped), label)

    def force(self, ax: Axes | None = None, *, label: str | None = None) -> Axes:
        """The hammer's force on the string, N over ms from the first touch, before and after the fit."""
        curves = contact_curves(self.result)
        return drawn_on(ax, lambda axes: draw_force(axes, curves), label)

    def felt(self, ax: Axes | None = None, *, label: str | None = None) -> Axes:
        """The felt's static force, N over mm of compression, with its 95 % band.

        The curve ends at the largest compression of the hardest stroke. Without a measured velocity the band holds at
        the reference velocity as shown.

        Raises `FitError` if the fit was read back from a file without a covariance.
        """
        felt = felt_of(self.result)
        return drawn_on(ax, lambda axes: draw_static_law(axes, felt), label)

    def levels(self, ax: Axes | None = None, *, label: str | None = None) -> Axes:
        """Levels of the partials, dB over the partial number, measured with 95 % bars, initial and fitted."""
        curves = level_curves(self.result)
        return drawn_on(ax, lambda axes: draw_levels(axes, curves), label)

    def envelopes(self, ax: Axes | None = None, *, number: int | None = None, label: str | None = None) -> Axes:
        """Level of one partial, dB over s: measured, by the string model, and with the modes that were measured.

        `number` is the partial, the strongest if None. Raises `ParameterError` if no such partial was found.
        """
        heard = self.result.reference
        known = heard.partials.number
        own = int(known[heard.level.argmax()]) if number is None else number
        if own not in known:
            raise ParameterError(f"number={number} is no partial of this recording; choose one of {known.tolist()}")
        (envelope,) = envelopes_of(self.result, [own])
        return drawn_on(ax, lambda axes: draw_envelope(axes, envelope), label)

    def correlations(self, ax: Axes | None = None, *, label: str | None = None) -> Axes:
        """Correlations of the estimates, %; without a measured velocity, those at the reference's velocity as shown.

        `label` goes into the title. Raises `FitError` if the fit has no intervals, as the paper's recipes have none.
        """
        _ = self.result.covariance
        known = known_of(self.result)
        if known is None:
            raise FitError("this fit has no intervals, so no correlations; fit with recipe='default'")
        axes = drawn_on(ax, lambda axes: draw_correlations(axes, known), None, (6.4, 5.6))
        axes.set(xlabel="logarithm of the parameter", ylabel="logarithm of the parameter")
        if label is not None:
            axes.set_title(f"{axes.get_title(loc='left')}: {label}", loc="left")
        return axes


def drawn_on(
    ax: Axes | None, draw: Callable[[Axes], None], label: str | None = None, size: tuple[float, float] = (8.0, 4.4)
) -> Axes:
    """Draw into `ax` or into new axes, and name in a legend what is drawn."""
    import matplotlib.pyplot as plt

    with plt.rc_context(STYLE):
        axes = plt.subplots(figsize=size, layout="constrained")[1] if ax is None else ax
        draw_labelled(axes, draw, label)
        if axes.get_legend_handles_labels()[0]:
            axes.legend()
    return axes
