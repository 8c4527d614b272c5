"""How a key rings: the modes of its partials, and its knock, driven by the hammer's force.

    sound_l(t) = g_l F_l(t) ∗ (Re Σ_m P_m e^{p_m t} + knock(t))

`modes` finds the poles that all layers of a key share, with `subspace` in `bands` about each partial; `key` finds what
stands between the fitted forces and the recordings. `make_ring` does all of it for a finished fit, and keeps what
brings layers nearer that took no part.
"""

from .bands import band, kernel_seconds
from .distance import HEARD, log_mel_distances, mel_edges, mel_power
from .fitted import make_ring, ringing_of
from .heard import Heard, hear
from .key import Key, key_of
from .modes import PartialModes, modes_of

__all__ = [
    "HEARD", "Heard", "Key", "PartialModes", "band", "hear", "kernel_seconds", "key_of", "log_mel_distances",
    "make_ring", "mel_edges", "mel_power", "modes_of", "ringing_of",
]  # fmt: skip
