"""Every recording before and after a fit: two sounds, and three sets of its partials' levels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..model.note import Note
from ..parameters import STRING_NAMES
from .align import laid
from .infer import Inferred
from .listener import Listener
from .notes import latents
from .reports import latent
from .result import FittedRecording

__all__ = ["heard_beside"]

# dB, of a hammer whose contact does not end.
SILENT = -300.0


def heard_beside(fit: Inferred, notes: Sequence[Note]) -> tuple[FittedRecording, ...]:
    """Every recording beside the starting values, and beside its note at the minimum that is shown.

    Raises
    ------
    FitError
        If an initial or a final contact does not end.
    """
    problem, descent, columns = fit.problem, fit.found.minima.descent, fit.problem.observed.number
    integrated = latents(fit.found.minima, 0)
    model = descent.level(fit.begun)[descent.stroke]
    fitted = np.asarray(descent.table.value) - integrated.own
    path_only = None if problem.calibrated else _path_only(fit)
    heard = []
    for i, note in enumerate(notes):
        recording, number = problem.recordings[i], problem.analyses[i].partials.number
        listener = Listener.of(recording, problem.analyses[i], problem.start.scale)
        if listener.gain is None:
            gain, begins = 10 ** (integrated.columns[i][0] / 20), None  # the lowest partial has least of the onset's
        else:
            gain, begins = listener.gain, round(laid(note._replace(gain=listener.gain), recording))
        after = listener.play(note, float(gain), begins, listener.at(fitted[i], columns))
        # The criterion's own gain on the initial sound: its level is not what is judged.
        own = model[i, number.clip(max=problem.cfg.rows) - 1]
        before = listener.play(_initial(fit, i), listener.gain, begins, own)
        levels = {"initial_db": before.level, "fitted_db": after.level}
        levels |= {} if path_only is None else {"path_only_db": listener.at(path_only[i], columns)}
        heard.append(listener.compared(before, after, {n: listener.in_noise(x) for n, x in levels.items()}))
    return tuple(heard)


def _initial(fit: Inferred, i: int) -> Note:
    """What the starting values give, before any fit."""
    u, start = fit.problem.unknowns, fit.problem.start
    given = {n: start.initial[n] for n in STRING_NAMES if n in start.initial}
    hammer = u.hammer(fit.begun, fit.problem.layout.stroke[i])
    return Note(u.string(fit.begun)._replace(**given), hammer, u.struck(fit.begun), start.quantity, 1.0, None)


def _path_only(fit: Inferred) -> np.ndarray:
    """Levels that the initial hammer gives at the fitted velocities, through gain and path that suit it, dB [R, K]."""
    descent, people = fit.found.minima.descent, fit.found.minima.people
    shared = fit.problem.unknowns.shared
    z = np.append(fit.begun[:shared], fit.found.z[shared:])
    residual, _, good = descent.model(z[None])
    if not good[0]:
        return np.full(descent.table.value.shape, SILENT)
    return np.asarray(descent.table.value) - latent(descent.table, residual[0], people.phi[0], people.w[0]).own
