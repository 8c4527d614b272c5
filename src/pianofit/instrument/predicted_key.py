"""The prior of a key's fit, from the fits of all other keys of its keyboard.

A second pass over a keyboard fits each key again with this prior in place of the literature's. The key's own first fit
takes no part in it, so no recording counts twice.

An instrument sets the loudest recordings of uncalibrated keys to velocities on one scale (`collect_fits`). The scale of
all velocities together is unknown. The first fits placed it where the literature has it, in the mean of their own
velocities, and the prior is stated on that scale. Only the deviation of single keys from the common scale is left open.
"""

import math
from collections.abc import Sequence

import numpy as np

from ..analysis.note_names import midi_to_note
from ..complex_step import slope_by_entry
from ..conversions import CENTS, hertz_of
from ..errors import ParameterError
from ..felt import FeltLaw
from ..key_prior import PRIOR_QUANTITIES, KeyPrior
from .build import reference_values
from .collect_fits import KeyFit
from .key_quantities import LAW_QUANTITIES, LOUDEST_VELOCITY, at_scale, law_compression
from .keyboard_posterior import VELOCITY_SCALE_SD, joint_laws

NAMES = tuple(LAW_QUANTITIES)


def prior_of_key(keys: Sequence[KeyFit], midi: int) -> KeyPrior:
    """Predict one key from the fits of all others.

    Parameters
    ----------
    keys : fits of an instrument, as `load_keys` returns them. The fit of the key itself is left out.
    midi : MIDI number of the key.

    Returns
    -------
    A `KeyPrior` for `Setup.prior`: logarithms of invariants, with their joint covariance.

    Raises
    ------
    ParameterError
        Without a fit of another key, and for plucked strings.

    Examples
    --------
    >>> from pathlib import Path
    >>> import pianofit
    >>> keys = pianofit.load_keys(pianofit.find_fits([Path("batch")], "cp80"))
    >>> pianofit.prior_of_key(keys, 62).names[:2]
    ('f0', 'B')
    """
    others = [key for key in keys if key.midi != midi]
    if not others:
        raise ParameterError(f"keys= has no fit of another key than {midi_to_note(midi)}; give at least one")
    if (law := others[0].law).key_quantities != FeltLaw.key_quantities:
        raise ParameterError(f"keys= are {law.words.verb}; a prior from other keys needs struck strings")
    at = sorted([*(key.midi for key in others), midi])
    priors = [quantity.prior for quantity in LAW_QUANTITIES.values()]
    measured, reference = [key.measured for key in others], reference_values(others, at)
    laws = joint_laws(measured, reference, priors, at, range(len(priors)), [at.index(midi)])
    mean, covariance = laws.value_of(0)
    ratios = [key.velocity / float(key.note.size) for key in others if key.velocity is not None]
    # A given velocity sets the scale of all.
    scale = math.exp(np.log(ratios).mean()) if len(ratios) == len(others) else 1.0
    loudest = [float(key.note.size) for key in keys if key.midi == midi and key.velocity is not None]
    velocity = scale * (loudest[0] if loudest else LOUDEST_VELOCITY)
    return _record(*_with_scale(mean, covariance, midi, scale), midi, velocity)


def _with_scale(mean: np.ndarray, covariance: np.ndarray, midi: int, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """A prediction if all velocities are multiplied by `scale`."""
    slopes = [slope_by_entry(lambda at: at_scale(at, midi, scale), mean, i) for i in range(len(mean))]
    jacobian = np.transpose(slopes)
    return at_scale(mean, midi, scale), jacobian @ covariance @ jacobian.T


def _record(mean: np.ndarray, covariance: np.ndarray, midi: int, velocity: float) -> KeyPrior:
    """The record of a prediction. The pitch relative to equal temperament becomes log f0, Hz."""
    slope = np.array([1 / CENTS if name == "cents" else 1.0 for name in NAMES])
    offset = np.array([math.log(hertz_of(midi)) if name == "cents" else 0.0 for name in NAMES])
    places = [NAMES.index("cents" if name == "f0" else name) for name in PRIOR_QUANTITIES]
    logs, matrix = offset + slope * mean, covariance * np.outer(slope, slope)
    return KeyPrior(
        PRIOR_QUANTITIES,
        tuple(logs[places].tolist()),
        tuple(map(tuple, matrix[np.ix_(places, places)].tolist())),
        law_compression(midi),
        velocity,
        VELOCITY_SCALE_SD,
    )
