"""The modal response of a key: modes of its partials and knock, driven by the hammer's force.

    sound_l(t) = g_l F_l(t) ∗ (Re Σ_m P_m e^{p_m t} + knock(t))

`modes` estimates the poles that all layers of a key share, by ESPRIT in a band about each partial (`dsp`).
`shared_response` estimates patterns, knock and contact times from the fitted forces and the recordings.
`model_selection` does both for a finished fit. It keeps the modal response only if that improves the prediction of
layers that are left out.
"""

from .aligned_layers import partial_band
from .model_selection import fit_modal_response
from .modes import fastest_beat
