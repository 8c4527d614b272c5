"""The prior of a key's fit that the other keys of a keyboard give: one Gaussian over the logarithms of quantities.

Without it, the prior of a fit is the literature's (`inference.priors`). `instrument.predicted_key` makes this record
from the fits of all other keys, `Setup.prior` hands it to a fit, and `fit.json` keeps it. All quantities are
invariants, so they do not depend on an assumed length or mass.
"""

import json
from dataclasses import asdict, dataclass

import numpy as np

from .errors import ParameterError, check_range, check_type

# Quantities that a prior can have, as exponents of the parameters of a fit; F/M_S is in N/kg, d2 is b2 π²/L², 1/s. The
# two of the felt also depend on its other parameters.
INVARIANTS: dict[str, dict[str, float]] = {
    "f0": {"c": 1.0},
    "B": {"kappa": 2.0, "c": -2.0},
    "b1": {"b1": 1.0},
    "d2": {"b2": 1.0},
    "M_H/M_S": {"M_H": 1.0},
    "F/M_S": {"K_H": 1.0},
    "local_exponent": {"p": 1.0},
    "mu": {"mu": 1.0},
    "skin": {"skin": 1.0},
    "x0/L": {"x0": 1.0},
    "width/L": {"width": 1.0},
}
PRIOR_QUANTITIES = tuple(INVARIANTS)
# Range of the compression, m, and of the velocity, m/s.
COMPRESSIONS = (1e-7, 1e-1)
VELOCITIES = (1e-2, 20.0)
# Range of the standard deviation of a logarithm: wider priors contain no information, and narrower ones fix a value.
NARROWEST, WIDEST = 1e-6, 30.0
# Largest mean of a logarithm, either sign: a factor of 5e21 in SI units, beyond all strings and hammers.
LARGEST_MEAN = 50.0
# Smallest eigenvalue of the correlations: the inverse of a matrix near a singular one has no correct digits.
SMALLEST_EIGENVALUE = 1e-12
# Largest difference of two correlations that must be equal: numbers in files are rounded.
ROUNDING = 1e-9


@dataclass(frozen=True)
class KeyPrior:
    """Means and joint covariance of the logarithms of some quantities of a key, in SI units.

    Parameters
    ----------
    names : some of `PRIOR_QUANTITIES`.
    mean : logarithms [quantities].
    covariance : of the logarithms [quantities, quantities].
    compression : compression, m, at which `F/M_S` and `local_exponent` are stated.
    velocity, velocity_sd : velocity of the loudest stroke, m/s, and standard deviation of its logarithm. A fit uses
        them if neither a velocity nor the scale of its levels was given.

    Raises
    ------
    ParameterError
        If a name is unknown or given twice, if sizes differ, if the covariance is not positive definite or nearly
        singular, and for a mean, standard deviation, compression or velocity out of range.

    Examples
    --------
    >>> from pianofit.key_prior import KeyPrior
    >>> KeyPrior(("M_H/M_S",), (-0.7,), ((0.04,),), 4e-4, 4.0, 0.25).names
    ('M_H/M_S',)
    """

    names: tuple[str, ...]
    mean: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]
    compression: float
    velocity: float
    velocity_sd: float

    def __post_init__(self) -> None:
        check_type("prior names=", self.names, list | tuple, "a list of names")
        unknown = [name for name in self.names if name not in PRIOR_QUANTITIES]
        if unknown or not self.names or len({*self.names}) < len(self.names):
            raise ParameterError(f"prior names={self.names!r} must be different ones of {', '.join(PRIOR_QUANTITIES)}")
        size = len(self.names)
        mean, covariance = _numbers("mean", self.mean, (size,)), _numbers("covariance", self.covariance, (size, size))
        for value in mean:
            check_range("prior mean=", value, -LARGEST_MEAN, LARGEST_MEAN, ", the logarithm of a value in SI units")
        if not _positive_definite(covariance):
            raise ParameterError(
                "prior covariance= must be symmetric, positive definite and not nearly singular, with standard "
                f"deviations from {NARROWEST:g} to {WIDEST:g}; correct it"
            )
        check_range("prior compression=", self.compression, *COMPRESSIONS, " m")
        check_range("prior velocity=", self.velocity, *VELOCITIES, " m/s")
        check_range("prior velocity_sd=", self.velocity_sd, NARROWEST, WIDEST)
        object.__setattr__(self, "names", tuple(self.names))
        object.__setattr__(self, "mean", tuple(mean.tolist()))
        object.__setattr__(self, "covariance", tuple(map(tuple, covariance.tolist())))

    def to_toml(self) -> str:
        """Return the table `[prior]` of a `setup.toml`."""
        return "\n[prior]\n" + "".join(f"{name} = {json.dumps(value)}\n" for name, value in asdict(self).items())


def _numbers(name: str, values: object, shape: tuple[int, ...]) -> np.ndarray:
    """Return finite numbers as an array of this shape."""
    try:
        array = np.array(values, float)
    except (TypeError, ValueError):
        array = np.array(np.nan)
    if array.shape != shape or not np.isfinite(array).all():
        raise ParameterError(f"prior {name}= must be {' by '.join(map(str, shape))} finite numbers, one for each name")
    return array


def _positive_definite(matrix: np.ndarray) -> bool:
    variance = np.diag(matrix)
    if not ((variance >= NARROWEST**2) & (variance <= WIDEST**2)).all():
        return False
    correlation = matrix / np.sqrt(np.outer(variance, variance))
    symmetric = np.abs(correlation - correlation.T).max() <= ROUNDING
    return bool(symmetric and np.linalg.eigvalsh(correlation)[0] >= SMALLEST_EIGENVALUE)
