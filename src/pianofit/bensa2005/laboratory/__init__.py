"""Synthetic measurements with effects that the paper's model does not describe.

The recordings of Bensa et al. (2005) are not public. A fit of synthetic recordings of the same model always looks
perfect. This laboratory therefore adds effects to the paper's string and hammer, which have the final values of its
Tables II and III. Each effect can be switched off:

- `polarisation`: a second polarisation, 2 cents sharp and with a slower decay. The axes of the supports are turned by
  20° against the hammer, which couples the polarisations. This causes beating and decay in two stages.
- `bridge`: a compliant support at the end of the string, made of five damped resonators in both directions. Some
  partials decay faster and shift by fractions of a cent.
- `felt`: a relaxing felt (Stulov) in place of the paper's Hunt-Crossley law.
- `noise_db`: noise of the vibrometer, white with some 1/f below 100 Hz.
- `velocity_error`: a sensor that reads the hammer velocity with an error of a few per cent.

All values that the paper does not give are in `chosen`, each with its reason, or in `pianofit.literature`. They are
invented. Fits of these measurements show the errors that such effects cause. They do not show how accurate the model
is for a real string.

Method: `body` writes string, polarisations and bridge as one linear system with symmetric matrices and transforms it
into damped exponentials. `strike` steps hammer and felt against it at 1.4 MHz or more. Afterwards the exponentials
decay freely. The laboratory shares no code with `pianofit.model`, which has another scheme: with all effects off, each
is an independent check of the other. No step creates energy.
"""

from .chosen import FINAL, INITIAL
from .measurement import Measurement, SyntheticMeasurement, make_synthetic_recording, measure, setup_text

__all__ = [
    "FINAL",
    "INITIAL",
    "SyntheticMeasurement",
    "Measurement",
    "make_synthetic_recording",
    "measure",
    "setup_text",
]
