"""How a key rings: the modes of its partials, and its knock, driven by the hammer's force.

    sound_l(t) = g_l F_l(t) ∗ (Re Σ_m P_m e^{p_m t} + knock(t))

`modes` finds the poles that all layers of a key share, with `subspace` in `bands` about each partial; `key` finds what
stands between the fitted forces and the recordings. `fit_modal_response` does all of it for a finished fit, and keeps what
brings layers nearer that took no part.
"""

from .aligned_layers import AlignedLayers, align_layers
from .bands import band, kernel_seconds
from .distance import HEARD, log_mel_distances, mel_edges, mel_power
from .model_selection import fit_modal_response, modal_response_of
from .modes import PartialModes, modes_of
from .shared_response import SharedResponse, estimate_shared_response

__all__ = [
    "HEARD",
    "AlignedLayers",
    "SharedResponse",
    "PartialModes",
    "band",
    "align_layers",
    "kernel_seconds",
    "estimate_shared_response",
    "log_mel_distances",
    "fit_modal_response",
    "mel_edges",
    "mel_power",
    "modes_of",
    "modal_response_of",
]
