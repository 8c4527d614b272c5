"""The damper law of an instrument, from the keys whose dampers were measured and from the literature."""

import math
from collections.abc import Sequence

import numpy as np

from ..conversions import hertz_of
from ..schema.dampers import LAST_DAMPER, LITERATURE_SD, Dampers, design_rows
from ..schema.extras import KeyExtras

# Standard deviations of single keys about the law: of the logarithm of the rate, and of the slope. Chosen: dampers are
# regulated by hand, so the rates of neighbours differ by some 15 %.
KEY_SD = (0.15, 0.1)


def damper_law(extras: Sequence[KeyExtras]) -> Dampers:
    """Return the law of greatest posterior density: weighted least squares with the literature as prior."""
    measured = [key for key in extras if key.dampers and key.midi <= LAST_DAMPER]
    if not measured:
        return Dampers()
    prior = Dampers()
    precision = np.diag(1 / np.square(LITERATURE_SD))
    weighted = precision @ [math.log(prior.bass), math.log(prior.treble), prior.slope]
    for key in measured:
        value, covariance = _key_mean(key)
        rows = np.concatenate([design_rows(key.midi, np.array([hertz_of(key.midi)])), [[0.0, 0.0, 1.0]]])
        weight = np.linalg.inv(covariance + np.diag(np.square(KEY_SD)))
        precision = precision + rows.T @ weight @ rows
        weighted = weighted + rows.T @ weight @ value
    covariance = np.linalg.inv(precision)
    bass, treble, slope = covariance @ weighted
    a, b, c = ((float(x), float(y), float(z)) for x, y, z in covariance)
    keys = tuple(sorted(key.midi for key in measured))
    return Dampers(math.exp(bass), math.exp(treble), float(slope), (a, b, c), "recordings", keys)


def _key_mean(key: KeyExtras) -> tuple[np.ndarray, np.ndarray]:
    """Mean of log rate and slope over the recordings of a key, weighted by their precision, and its covariance."""
    precisions = [np.linalg.inv(entry.covariance) for entry in key.dampers]
    values = [np.array([entry.log_rate, entry.slope]) for entry in key.dampers]
    covariance = np.linalg.inv(np.sum(precisions, axis=0))
    return covariance @ np.sum([p @ v for p, v in zip(precisions, values, strict=True)], axis=0), covariance
