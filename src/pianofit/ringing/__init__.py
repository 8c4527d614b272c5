"""How a key rings: the modes of its partials, and its knock, driven by the hammer's force.

    sound_l(t) = g_l F_l(t) ∗ (Re Σ_m P_m e^{p_m t} + knock(t))

`modes` finds the poles that all layers of a key share, with `subspace` in `bands` about each partial; `key` finds what
stands between the fitted forces and the recordings. `ringing_of` does all of it for a finished fit.
"""

from .fitted import ringing_of
from .heard import Heard, hear
from .key import key_of
from .modes import PartialModes, modes_of

__all__ = ["Heard", "PartialModes", "hear", "key_of", "modes_of", "ringing_of"]
