"""The direct model: parameters in, force pulse, spectrum and waveform out.

A string is a table of modes (`modes`), contact is one scalar equation per step (`contact`), and the rest is closed form
(`response`). Importing this package switches JAX to float64, in which everything here is computed.
"""

import jax

jax.config.update("jax_enable_x64", True)

from .contact import Pulse, kernel, strike  # noqa: E402
from .felt import felt_force  # noqa: E402
from .modes import Modes, mode_frequencies, mode_table, project, window_weights  # noqa: E402
from .response import level_db, mobility, pulse_transform, ringing, spectrum, string_energy, waveform  # noqa: E402
from .simulate import Simulation, contact_rate, simulate  # noqa: E402

__all__ = [
    "Modes",
    "Pulse",
    "Simulation",
    "contact_rate",
    "felt_force",
    "kernel",
    "level_db",
    "mobility",
    "mode_frequencies",
    "mode_table",
    "project",
    "pulse_transform",
    "ringing",
    "simulate",
    "spectrum",
    "strike",
    "string_energy",
    "waveform",
    "window_weights",
]
