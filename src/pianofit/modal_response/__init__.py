"""The modal response of a key: modes of its partials and knock, driven by the hammer's force.

    sound_l(t) = g_l F_l(t) ∗ (Re Σ_m P_m e^{p_m t} + knock(t))

`modes` estimates the poles that all layers of a key share, by ESPRIT (`esprit`) in a band about each partial (`bands`).
`shared_response` estimates patterns, knock and contact times from the fitted forces and the recordings.
`model_selection` does both for a finished fit. It keeps the modal response only if that improves the prediction of
layers that are left out.
"""

from .aligned_layers import AlignedLayers, align_layers
from .bands import band, kernel_seconds
from .distance import AUDIBLE_RANGE_DB, log_mel_distances, mel_edges, mel_power
from .model_selection import fit_modal_response, modal_response_of
from .modes import PartialModes, modes_of
from .shared_response import SharedResponse, estimate_shared_response

__all__ = [
    "AUDIBLE_RANGE_DB",
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
