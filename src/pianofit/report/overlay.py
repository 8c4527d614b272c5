"""Drawing several results into one axes: each label has its own hue, and its legend entries contain the label."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from .drawing import FITTED, INITIAL, LAW, MEASURED

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["HUES", "draw_labelled"]

# Colours of Okabe and Ito, which colour-blind readers can distinguish, in the order of the drawings.
HUES = (FITTED, INITIAL, LAW, "#cc79a7", "#56b4e9", "#e69f00")
FAINT_ALPHA = 0.45  # of measured curves, to distinguish them from fitted curves of the same hue
GROUP_ID = "pianofit:"  # prefix of the group id of labelled artists


def draw_labelled(axes: Axes, draw: Callable[[Axes], None], label: str | None) -> None:
    """Draw into axes that may contain another drawing. The limits then include both.

    With a label, line style still distinguishes measured, initial and fitted, and the hue distinguishes the results.
    """
    has_data = axes.has_data()
    limits, title = (axes.get_xlim(), axes.get_ylim()), axes.get_title(loc="left")
    before = {*axes.get_children(), *axes.containers}
    draw(axes)
    if label is not None:
        earlier = {artist.get_gid() for artist in axes.get_children() if str(artist.get_gid()).startswith(GROUP_ID)}
        _apply_label(axes, before, label, HUES[len(earlier - {GROUP_ID + label}) % len(HUES)])
    if has_data:
        _widen_limits(axes, before, limits, title)


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
        if isinstance(artist, Line2D):
            artist.set_gid(GROUP_ID + label)
            if artist.get_color() == MEASURED:
                artist.set_alpha(FAINT_ALPHA)
            artist.set_color(hue)
        elif isinstance(artist, Collection):
            artist.set_gid(GROUP_ID + label)
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
