"""From a finished fit to how its key rings."""

from __future__ import annotations

import numpy as np

from ..errors import FitError
from ..inference import Result
from ..model.modal import Ringing, force_of
from .heard import hear
from .key import key_of
from .modes import modes_of

__all__ = ["ringing_of"]


def ringing_of(result: Result) -> Ringing:
    """The modes and the knock of a fitted key, from the recordings that share the reference's path.

    With one recording nothing says which of its modes another stroke would excite alike: all that it shows is taken.

    Raises
    ------
    FitError
        If the fit was read back without its recordings, or no partial stands above the noise.
    """
    group = result.reference and result.document["takes"][result.first]["group"]
    rows = zip(result.takes, result.document["takes"], strict=True)
    layers = [layer for layer, row in rows if row["group"] == group]
    layers.sort(key=lambda layer: layer.fitted.note.hammer.v_H0)  # the loudest last: it says where partials are
    analyses = [layer.analysis for layer in layers]
    heard = hear([layer.recording for layer in layers], analyses)
    modes = modes_of(heard, analyses)
    if not modes:
        raise FitError(f"{result.recording.path}: no partial stands above the noise long enough to show its modes")
    return key_of(heard, modes, [force_of(layer.fitted.simulation) for layer in layers])
