"""Means and joint covariances of the quantities that have keyboard laws, from the fit of a key.

The covariance of a fit is that of logarithms of parameters and velocities. All law quantities but the level are
logarithms of products of powers of these, so their covariance is J C Jᵀ with a matrix J of exponents. The keyboard
has its own prior, so that of the fit is removed before (`fit_prior`): the literature's, or that of the other keys in a
second pass.
"""

import math
from collections.abc import Mapping

import numpy as np

from ..complex_step import slope_by_entry
from ..conversions import CENTS
from ..errors import FitError
from ..excitation import Excitation
from ..felt import ALL_PARAMETERS, SoftHammer, law_of
from ..felt.law import scale_velocity
from ..felt.soft_skin import SOFT_SKIN
from ..key_prior import INVARIANTS, KeyPrior
from ..model.note import Note
from ..parameters import STRING_NAMES
from ..schema.fit import Fit, Minimum
from ..schema.quantities import Covariance
from .fit_prior import FitPrior, prior_of, remove_prior
from .key_quantities import (
    LAW_QUANTITIES,
    LOUDEST_VELOCITY,
    at_scale,
    key_quantities,
    law_compression,
    law_quantities,
    skin_share,
    soft_hammer,
    stroke_level,
)
from .keyboard_posterior import KeyMeasurements, Measurement

# Parameters of a hammer that every minimum must have.
NEEDED_OF_HAMMER = frozenset(("K_H", "mu", "p", "M_H"))
# Factor on the standard deviations of a fit that did not converge.
NONCONVERGED_FACTOR = 2.0
# Exponents of uncertain sizes. The values of a fit scale with them, and so no quantity but L and M_S/L does.
SIZE_EXPONENTS = {
    "cents": {"L": -CENTS},
    "B": {"L": -2.0},
    "d2": {"L": -2.0},
    "M_H/M_S": {"M_S": -1.0},
    "F/M_S": {"M_S": -1.0},
    "x0/L": {"L": -1.0},
    "width/L": {"L": -1.0},
    "pickup/L": {"L": -1.0},
    "L": {"L": 1.0},
    "M_S/L": {"M_S": 1.0, "L": -1.0},
}
# Change of log velocity over which the slope of the level is taken.
LEVEL_STEP = 0.1
# A variance below this is that of a given value.
GIVEN = 1e-12
# Relative difference of a compression that is rounding.
ROUNDED = 1e-6


def needed(law: Excitation) -> frozenset[str]:
    """Return the parameters that every minimum of a fit must have."""
    return frozenset((*STRING_NAMES, "x0", "width")) | (NEEDED_OF_HAMMER if law.key_quantities else frozenset())


def measurements_of(fit: Fit, note: Note, midi: int, level: float) -> KeyMeasurements:
    """Return the measurements of a key.

    Parameters
    ----------
    fit : content of its `fit.json`.
    note : its note on the velocity scale of the instrument.
    midi : number of the key.
    level : its `stroke_level`, dB.
    """
    minima = tuple(_measurement(fit, note, midi, minimum, level, without_prior=True) for minimum in fit.minima)
    minima = minima or (_without_intervals(note, midi, level),)
    none = np.zeros(len(law_quantities(law_of(note.hammer))))
    direction = _scale_direction(note, midi, level) if fit.velocity_scale_open else none
    return KeyMeasurements(midi, minima, direction)


def fitted_values(fit: Fit, note: Note, midi: int, level: float) -> Measurement:
    """Return the best minimum of a key as its fit reports it, with its prior; arguments as of `measurements_of`."""
    if not fit.minima:
        return _without_intervals(note, midi, level)
    return _measurement(fit, note, midi, fit.minima[0], level, without_prior=False)


def _without_intervals(note: Note, midi: int, level: float) -> Measurement:
    return Measurement(1.0, _scaled(note, midi, level), np.diag(_default_variances(note)))


def _scaled(note: Note, midi: int, level: float) -> np.ndarray:
    """Quantities of a note on the scales of their laws [quantities]."""
    values = key_quantities(note, midi) | {"level": level}
    quantities = law_quantities(law_of(note.hammer))
    return np.array([quantity.scaled(values[name]) for name, quantity in quantities.items()], float)


def _default_variances(note: Note) -> np.ndarray:
    return np.array([quantity.default_sd**2 for quantity in law_quantities(law_of(note.hammer)).values()])


def note_at(fit: Fit, note: Note, minimum: Minimum) -> Note:
    """Return the `note` of a key, on the velocity scale of the instrument, with the parameters of one minimum."""
    if not law_of(note.hammer).key_quantities:
        return _on_string(note, minimum.values(fit))
    velocity = float(np.max(minimum.stroke_values))
    return _scaled_note(note, minimum, float(note.size) / velocity if fit.velocity_scale_open else 1.0)


def _scaled_note(note: Note, minimum: Minimum, scale: float) -> Note:
    """The note of one minimum, with the velocities of the fit times `scale`."""
    velocity, at = float(np.max(minimum.stroke_values)), minimum.parameters
    hammer = soft_hammer(note.hammer)
    own = {name: at[name] for name in (*NEEDED_OF_HAMMER, "skin") if name in at}
    scaled = scale_velocity({**hammer._asdict(), **own, "v_H0": velocity}, SOFT_SKIN, scale)
    # A felt without a skin keeps the smallest one.
    skin = scaled["skin"] if "skin" in at else hammer.skin
    hammer = SoftHammer(**scaled | {"mu": max(scaled["mu"], ALL_PARAMETERS["mu"].lower), "skin": skin})
    return _on_string(note._replace(hammer=hammer), at)


def _on_string(note: Note, at: Mapping[str, float]) -> Note:
    """Return the note with the string and the place of the stroke of one minimum."""
    geometry = note.geometry._replace(strike_position=at["x0"], width=at["width"])
    geometry = geometry._replace(pickup=at.get("pickup", geometry.pickup))
    return note._replace(string=note.string._replace(**{name: at[name] for name in STRING_NAMES}), geometry=geometry)


def _measurement(fit: Fit, note: Note, midi: int, minimum: Minimum, level: float, without_prior: bool) -> Measurement:
    own = note_at(fit, note, minimum)
    mean = _scaled(own, midi, level)
    variance, weight = _default_variances(own), minimum.weight
    if minimum.covariance is None:
        return Measurement(weight, mean, np.diag(variance))
    names, matrix = minimum.covariance.names, _conditional(fit, minimum, minimum.covariance)
    exponents = _exponents(names, own, midi, float(own.size) / float(np.max(minimum.stroke_values)))
    if without_prior:
        of_keys = fit.prior and _joint_prior(fit, fit.prior, _scaled_note(note, minimum, 1.0), midi, minimum, names)
        removal = remove_prior(of_keys or prior_of(fit, minimum, names), matrix)
        weight *= math.exp(removal.log_weight)
        mean, matrix = mean + exponents @ removal.shift, removal.covariance
    covariance = exponents @ matrix @ exponents.T * (1.0 if fit.converged else NONCONVERGED_FACTOR**2)
    given = np.diag(covariance) < GIVEN
    return Measurement(weight, mean, covariance + np.diag(np.where(given, variance, 0.0)))


def _joint_prior(fit: Fit, prior: KeyPrior, own: Note, midi: int, minimum: Minimum, names: tuple[str, ...]) -> FitPrior:
    """The prior that other keys gave to a fit, without quantities that the fit does not have or assumes.

    Parameters
    ----------
    own : note of the minimum, on the velocity scale of the fit.
    names : of the logarithms of the fit.
    """
    if not math.isclose(prior.compression, law_compression(midi), rel_tol=ROUNDED):
        raise FitError(
            f"prior.compression = {prior.compression:g} m must be {law_compression(midi):g} m for this key; fit again "
            "with a prior that pianofit batch --joint wrote"
        )
    values = {**key_quantities(own, midi), "f0": float(own.f0)}
    rows = _exponents(names, own, midi, 1.0)
    kept = [i for i, name in enumerate(prior.names) if _is_fitted(fit, minimum, next(iter(INVARIANTS[name])))]
    laws = [list(LAW_QUANTITIES).index("cents" if prior.names[i] == "f0" else prior.names[i]) for i in kept]
    unit = np.array([1 / CENTS if prior.names[i] == "f0" else 1.0 for i in kept])
    away = np.array([math.log(values[prior.names[i]]) - prior.mean[i] for i in kept])
    root = np.linalg.inv(np.linalg.cholesky(np.array(prior.covariance)[np.ix_(kept, kept)]))
    return FitPrior(root @ (unit[:, None] * rows[laws]), root @ away)


def _is_fitted(fit: Fit, minimum: Minimum, name: str) -> bool:
    return name in minimum.parameters and fit.parameters[name].status != "assumed"


def _conditional(fit: Fit, minimum: Minimum, covariance: Covariance) -> np.ndarray:
    """Covariance of a fit; given the velocity of the loudest stroke if the scale of the velocities is unknown."""
    matrix, loudest = covariance.matrix, int(np.argmax(minimum.stroke_values))
    name = "v_H0" if loudest == fit.reference.stroke else f"v_H0 {loudest + 1}"
    if fit.velocity_scale_open and name in covariance.names:
        fixed = covariance.names.index(name)
        if matrix[fixed, fixed] > 0:
            matrix = matrix - np.outer(matrix[fixed], matrix[fixed]) / matrix[fixed, fixed]
    return matrix


def _exponents(names: tuple[str, ...], note: Note, midi: int, scale: float) -> np.ndarray:
    """Derivatives of the quantities by the logarithms of a fit's values [quantities, names]."""
    rows = INVARIANTS | {"cents": {"c": CENTS}, "pickup/L": {"pickup": 1.0}}
    quantities = law_quantities(law_of(note.hammer))
    if law_of(note.hammer).key_quantities:
        rows |= _felt_exponents(note, midi, scale)
    rows = {quantity: {**rows.get(quantity, {}), **SIZE_EXPONENTS.get(quantity, {})} for quantity in quantities}
    return np.array([[own.get(name, 0.0) for name in names] for own in rows.values()])


def _felt_exponents(note: Note, midi: int, scale: float) -> dict[str, dict[str, float]]:
    """Those of the quantities of a felt at a compression, by quantity and name."""
    hammer, u = soft_hammer(note.hammer), law_compression(midi)
    p, skin = float(hammer.p), float(hammer.skin)
    share = skin_share(u, skin)
    power = float(SOFT_SKIN.log_power(u, {"p": p, "skin": skin}))
    return {
        # F = K s^(1-p) g^p, with the base g = u²/(u + skin)
        "F/M_S": {"K_H": 1.0, "p": power - p * math.log(scale), "skin": -p * share},
        "local_exponent": {"p": 1.0, "skin": share * (1 - share) / (1 + share)},
    }


def _scale_direction(note: Note, midi: int, level: float) -> np.ndarray:
    """Change of the quantities with the logarithm of the scale of the velocities [quantities]."""
    slope = (level - stroke_level(note, LOUDEST_VELOCITY * math.exp(-LEVEL_STEP))) / LEVEL_STEP
    own = _scaled(note, midi, level)
    change = slope_by_entry(lambda log: at_scale(own, midi, np.exp(log[0])), np.zeros(1), 0)
    return change - slope * np.array([name == "level" for name in LAW_QUANTITIES])
