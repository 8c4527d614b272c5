"""The identifiability statement: the kind of measurement, and which parameters it determines."""

import math
from collections.abc import Sequence

from ..inference import InferenceResult
from ..schema.dependencies import MAX_LOG_SD
from ..schema.fit import LevelErrors
from ..transducer import TRANSDUCERS
from .correlations import StrongCorrelation
from .statuses import FELT_EXCESS_DB, HAMMER_EXCESS_DB, PIANIST_VELOCITY_RATIO, Statuses, force_direction

KEYBOARD_PRIOR = " The prior of hammer and felt is the prediction from the other keys of the keyboard."


def identifiability_statement(
    fit: InferenceResult, states: Statuses, levels: LevelErrors, correlated: Sequence[StrongCorrelation]
) -> str:
    """The opening sentences of a result."""
    keyboard = KEYBOARD_PRIOR if fit.problem.key_prior is not None else ""
    if fit.problem.calibrated:
        return _calibrated(fit, states, correlated) + keyboard
    problem, law = fit.problem, fit.problem.parametrisation.law
    if not law.has_contact:
        return _released(fit, states, levels)
    start = problem.initial_values
    source = "" if start.user_given or start.law.hammers is None else " (those of the literature)"
    text = (
        f"{_uncalibrated(fit, states.compared)} The rms error of the partial levels is {levels.initial_db:.1f} dB "
        f"before the fit, {levels.fitted_db:.1f} dB after it. It is {levels.initial_hammer_db:.1f} dB if felt and "
        f"hammer mass keep their initial values{source} and everything else is fitted.{keyboard}"
    )
    if not states.compared:
        u = problem.parametrisation
        felt = any(u.free[u.index_of(name)] for name in law.parameters)
        prior = "the prior of the output path" if problem.has_unknown_path else "the prior"
        return text + f" The felt parameters shown depend on {prior}. Do not interpret them." * felt
    if states.exceeds_pianist:
        low, ratio, high = states.velocity_range
        return (
            f"{text} The fitted velocities differ by a factor of {ratio:.3g} ({low:.3g} to {high:.3g}), those of a "
            f"pianist by at most {PIANIST_VELOCITY_RATIO:.0f}. The layers differ in a way that the model does not "
            "describe. Do not interpret the felt parameters, the velocities and the hammer mass."
        )
    if states.unidentifiable:
        text += (
            f" The recordings leave the force of the felt open by more than a factor of {math.exp(MAX_LOG_SD):.0f}. Do "
            "not interpret the felt parameters and the hammer mass."
        )
    if problem.velocity_scale_open:
        return f"{text} {_scale_open(fit)}"
    return text


def _scale_open(fit: InferenceResult) -> str:
    """Sentences on the common scale of velocities that were not measured."""
    law = fit.problem.parametrisation.law
    scaled = (name.replace("mu", "μ") for name in law.parameters_with_unit("N m"))
    text = (
        "No hammer velocity was measured, so one common scale of the velocities is unknown. "
        f"{_listed('Velocities', *scaled)} change with this scale, and their intervals come from its prior."
    )
    if force_direction(fit) is None:
        return f"{text} Invariants do not depend on it."
    return (
        f"{text} F/M_S changes with it too, and is given at the reference velocity shown. None of the other invariants "
        "depends on it."
    )


def _uncalibrated(fit: InferenceResult, compared: bool) -> str:
    """Sentences on uncalibrated recordings, by their number and velocities."""
    count = len(fit.problem.recordings)
    if count == 1 and fit.problem.has_unknown_path:
        return (
            "One uncalibrated recording does not determine the hammer felt. A different felt gives the same sound "
            "through a different output path (soundboard, room, microphone). A softer felt struck faster also gives "
            "the same sound at another gain."
        )
    if count == 1:
        return (
            "One recording of unknown scale does not determine the hammer felt. A softer felt struck faster gives the "
            "same sound at another gain."
        )
    if compared:
        return (
            f"{count} uncalibrated recordings of one key were compared. Differences between strokes are attributed to "
            "the hammer. Everything common to all strokes is attributed to the output path (soundboard, room, "
            "microphone)."
        )
    return (
        f"{count} uncalibrated recordings do not determine the hammer felt. This needs strokes of clearly different "
        "velocities through one output path (soundboard, room, microphone). Without them, a different felt gives the "
        "same sound through a different output path."
    )


def _calibrated(fit: InferenceResult, states: Statuses, correlated: Sequence[StrongCorrelation]) -> str:
    """The statement of calibrated recordings."""
    several = len(fit.problem.recordings) > 1
    opening = "The recordings are calibrated" if several else "The recording is calibrated"
    if fit.excess > FELT_EXCESS_DB:
        advice = "An effect outside the model is present. Do not interpret the felt parameters."
        if fit.excess > HAMMER_EXCESS_DB:
            advice = (
                "Another hammer may explain them better, or the setup does not describe this string. Do not interpret "
                "the hammer parameters."
            )
        return f"{opening}, but the model misses the partial levels by {fit.excess:.2f} dB beyond the noise. {advice}"
    unidentifiable = [
        name for name, state in states.parameters.items() if state == "not-identifiable" and name != "width"
    ]
    if unidentifiable:
        return f"{opening}, but {'do' if several else 'does'} not determine {_listed(*unidentifiable)}."
    pairs = (
        f" {pair.first} and {pair.second} are determined mainly in one combination: {pair.best_combination}."
        for pair in correlated
    )
    return f"{opening} and {'determine' if several else 'determines'} all free parameters." + "".join(pairs)


def _released(fit: InferenceResult, states: Statuses, levels: LevelErrors) -> str:
    """The statement of a string that is released, as a plucked one is."""
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
    """A sentence on the symmetry of pickup and plucking position, if the position of the pickup is not given."""
    u = fit.problem.parametrisation
    if "pickup" not in u.reported or not u.free[at := u.index_of("pickup")] or u.given[at]:
        return []
    if u.strokes == 1:
        return [
            "One pluck does not distinguish the plucking position from the position of the pickup: exchanging them "
            "changes no level. Give the position of the pickup, or record plucks at several positions."
        ]
    return ["The position of the pickup is fitted, as the position that all plucks share."]


def _listed(*names: str) -> str:
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))
