"""Time step, modes and steps that the contact of a set of parameters needs.

`simulate` chooses them by itself. Programs that call `mode_table` and `strike`, under `jit` or `vmap`, have to give
them.
"""

from typing import Any, NamedTuple

import numpy as np

from ..felt import law_of
from ..io.number_format import summary
from ..parameters import Geometry, String
from ..x64 import float64
from .contact import Pulse
from .simulate import MAX_STEPS, StrikeConfig, check_stroke, contact_rate, count_modes, endless_contact
from .strokes import strokes


class ContactGrid(NamedTuple):
    """The discretisation of a contact, from `contact_grid`."""

    rate: float  # of the contact, Hz, a whole multiple of the sample rate
    n_modes: int  # rows of the table of modes
    steps: int  # until the contact is proven to be over, a multiple of 32

    def __repr__(self) -> str:
        return summary(self)


@float64
def contact_grid(string: String, hammer: Any, geometry: Geometry, *, rate: float = 44_100.0) -> ContactGrid:
    """Return the contact rate, the number of modes, and the number of steps that a stroke needs.

    Rate and modes are those of `simulate`: at least 88 kHz, and high enough for 30 modes, or for all modes above -60 dB
    at the strike position. The steps are those of the stroke itself, which is simulated. For a batch, take the largest
    numbers of modes and steps. A batch with one rate needs the largest rate, and more steps in proportion.

    Parameters
    ----------
    string, geometry : in SI units; see `String` and `Geometry`.
    hammer : a `Hammer`, a `SoftHammer`, a `RelaxingHammer`, or a hammer of a `FeltLaw`. Slow, heavy and soft hammers
        need the most steps.
    rate : sample rate of the signal, Hz.

    Returns
    -------
    A `ContactGrid`: `rate`, Hz, `n_modes` and `steps`, for `mode_table` and `strike`.

    Raises
    ------
    ParameterError
        For values out of range, and if the string needs a rate above 6 MHz.
    FitError
        If the contact does not end within 65,536 steps.

    Examples
    --------
    >>> import pianofit
    >>> it = pianofit.typical("C4")
    >>> grid = pianofit.contact_grid(it.string, it.hammer, it.geometry)
    >>> grid.rate, grid.n_modes
    (88200.0, 128)
    >>> modes = pianofit.mode_table(it.string, it.geometry, rate=grid.rate, n_modes=grid.n_modes)
    >>> bool(pianofit.strike(modes, it.hammer, steps=grid.steps).contact_ended)
    True
    """
    check_stroke(string, hammer, geometry, "bridge-force", rate)
    step_rate = float(contact_rate(string, geometry, rate))
    n_modes = count_modes(string, geometry, step_rate)
    arrays = (np.array([[*map(float, part)]]) for part in (string, hammer, geometry))
    cfg = StrikeConfig(n_modes, MAX_STEPS, "bridge-force", law_of(hammer))
    _, pulse, _, steps = strokes(*arrays, np.float64(step_rate), cfg)
    if not Pulse(*pulse).contact_ended[0]:
        raise endless_contact(hammer, step_rate)
    return ContactGrid(step_rate, n_modes, int(steps[0]))
