"""The identifiability statement of a string that is released, as a plucked one is."""

from __future__ import annotations

from ..inference import InferenceResult
from ..schema.fit import LevelErrors
from ..transducer import TRANSDUCERS
from .statuses import Statuses


def released_statement(fit: InferenceResult, states: Statuses, levels: LevelErrors) -> str:
    """The opening sentences of a fit without a hammer: what the recordings determine, and what they cannot."""
    problem, count = fit.problem, len(fit.problem.recordings)
    recorded = "One recording" if count == 1 else f"{count} recordings"
    verb = "determines" if count == 1 else "determine"
    player = problem.parametrisation.law.words.player
    parts = [
        f"{recorded} of unknown gain {verb} the string and the place of the {player}, not its size. The gain of a "
        "recording contains the size."
    ]
    if states.parameters.get("width") == "not-identifiable":
        parts.append(
            "The width is not identifiable, because a smooth output path changes the levels as the width does. Do not "
            "interpret it."
        )
    if problem.has_unknown_path and not TRANSDUCERS[problem.initial_values.quantity].on_string:
        parts.append("A notch in the output path (body, room, microphone) looks like a node at the plucking position.")
    parts += _exchange(fit)
    parts.append(
        f"The rms error of the partial levels is {levels.initial_db:.1f} dB before the fit, {levels.fitted_db:.1f} dB "
        "after it."
    )
    return " ".join(parts)


def _exchange(fit: InferenceResult) -> list[str]:
    """A sentence on the symmetry of pickup and plucking position, if the position of the pickup is searched."""
    u = fit.problem.parametrisation
    if "pickup" not in u.reported or not u.free[u.index_of("pickup")]:
        return []
    if u.strokes == 1:
        return [
            "One pluck does not distinguish the plucking position from the position of the pickup: exchanging them "
            "changes no level. Give the position of the pickup, or record plucks at several positions."
        ]
    return ["The position of the pickup is fitted, as the position that all plucks share."]
