"""A stand-in for the laboratory: measurements that contain what the paper's own model leaves out.

The signals of Bensa et al. (2005) are not public, and a fit of one's own model always looks perfect. Here the paper's
string and hammer, with the final values of its Tables II and III, meet in a laboratory that has, each switchable:

- a second polarisation, 2 cents sharp and slower to decay, coupled because the supports' axes are turned by 20° against
  the hammer: beating, and decay in two stages (`polarisation`);
- a support that gives way at the string's end, five damped resonators in both directions: some partials decay faster
  and shift by fractions of a cent (`bridge`);
- a relaxing felt (Stulov) in place of the paper's Hunt-Crossley law (`felt`);
- noise of the vibrometer, white with some 1/f below 100 Hz (`noise_db`);
- a sensor that reads the hammer's velocity a few per cent wrong (`velocity_error`).

All values that the paper does not give are in `chosen`, each with its reason, or in `published`. They are invented:
what is found on these measurements says how far a fit can be trusted when the model is wrong in such ways, not how
wrong the model is about a real string.

How it is computed: `body` writes string, polarisations and bridge as one linear system with symmetric matrices and
turns it into damped exponentials; `strike` steps hammer and felt against it at 1.4 MHz or more; then the exponentials
ring. No line is shared with `pianofit.model`, which has another scheme, so that with every switch off the two are
witnesses of each other. No energy is made, at any step.
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
