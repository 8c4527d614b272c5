"""Priors about published felts and hammers, which all laws of this package share."""

from functools import partial

from ..parameters import PARAMETERS, Parameter

# Prior standard deviations of log(value) around the published hammer for the key. Felts of similar instruments differ
# by factors (Chaigne and Askenfelt 1994; Chabassier). K_H stands for the force at a reference compression.
FELT_SPREAD = {"K_H": 1.5, "mu": 1.5, "p": 0.2}
# The same for hammer mass, strike position and contact window: hammer masses of neighbouring instruments differ by tens
# of percent (Chaigne and Askenfelt 1994; Chabassier).
HAMMER_SD = {"M_H": 0.4, "x0": 0.2, "width": 0.3}
# The parameters of a fit next to those of the string, for all laws of this package, including parameters that a law
# does not have. So a seed draws the same numbers for all laws.
COLUMNS = ("K_H", "p", "mu", "M_H", "x0", "width", "epsilon", "tau", "skin")


def published_parameter(name: str) -> Parameter:
    """Return K_H, p or μ with the bounds of the paper, and the published value for the key as prior median."""
    return PARAMETERS[name]._replace(median=partial(_published_value, name), spread=FELT_SPREAD[name])


def _published_value(name: str, midi: float) -> float:
    from ..literature import typical  # its curves need SciPy, which help texts must not import

    return getattr(typical(midi).hammer, name)
