"""What lies between a fitted string and a file, partial by partial: level and decay.

A soundboard and a microphone give every partial its own level, and what the string loses to the bridge is no smooth
law. Both are shared by all takes of a group, and both are shrunk: what is measured counts by how well it is known
against how far partials are seen to scatter about the smooth path and the law b1 + b2 β².
"""

from __future__ import annotations

import numpy as np

from ..criterion import OutputPath
from ..initial import Start
from .joint import Fit
from .state import predicted

__all__ = ["path_document", "path_of", "roughness"]


def roughness(fit: Fit, take: int) -> np.ndarray:
    """What takes of a group share beyond hammer and smooth path, dB [rows], shrunk by how well it is known."""
    data = fit.data
    if fit.spread.rough == 0:
        return np.zeros(data.rows)
    mine = data.found & _group(fit, take)
    miss = data.level - predicted(fit.target, fit.cfg, fit.z[0])[:, 2]
    weight = mine / (data.level_error**2 + (fit.spread.level * data.buried) ** 2 + ~mine)
    return (weight * miss).sum(axis=0) / (weight.sum(axis=0) + fit.spread.rough**-2)


def path_of(fit: Fit, take: int, start: Start) -> OutputPath | None:
    """The fitted path of one take, smooth part and roughness, and the decays, where it has partials."""
    if start.quantity != "pressure":
        return None
    data, columns = fit.data, fit.data.layout.path[take]
    mine = data.found & _group(fit, take)
    rows, loudest = np.flatnonzero(mine.any(axis=0)), (mine.argmax(axis=0), np.arange(data.rows))
    smooth = np.asarray(fit.target.basis)[loudest][:, columns] @ fit.values[columns]
    db = (smooth + roughness(fit, take))[rows]
    return OutputPath(data.frequency[loudest][rows], db, _decays(fit, mine)[rows], data.way[loudest][rows])


def path_document(path: OutputPath | None) -> dict | None:
    """As `fit.json` holds it."""
    if path is None:
        return None
    return {name: column.tolist() for name, column in path._asdict().items() if column is not None}


def _group(fit: Fit, take: int) -> np.ndarray:
    """Which takes [takes, 1] share this one's path."""
    groups = np.array(fit.data.layout.groups)
    return (groups == groups[take])[:, None]


def _decays(fit: Fit, mine: np.ndarray) -> np.ndarray:
    """Each partial's decay rate over the law's [rows], of the takes of a path [takes, rows], shrunk to 1.

    Another microphone hears a string's polarisations in other proportions, and so another decay.
    """
    data = fit.data
    law = predicted(fit.target, fit.cfg, fit.z[0])[:, 1]
    there = ~data.found  # lest what is not there be divided by its 0
    miss = np.where(data.found, np.log(np.maximum(data.decay + there, 1e-3) / law), 0.0)
    # Takes of one path decay alike: their differences are errors of measurement.
    error = np.hypot(data.decay_error / (data.decay + there), 0.1)
    weight = mine / error**2
    return np.exp((weight * miss).sum(axis=0) / (weight.sum(axis=0) + max(fit.spread.decay, 1e-3) ** -2))
