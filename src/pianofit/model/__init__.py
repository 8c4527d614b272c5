"""The direct model: parameters in, force pulse, spectrum and waveform out.

A string is a table of modes (`modes`). Contact is one scalar equation per step (`contact`). The response after it is
in closed form (`free_response`). All is computed in float64 (`pianofit.x64`).
"""

from .contact import kernel, strike
from .free_motion import pluck, project
from .free_response import level_db, levels, mobility, modal_amplitudes, spectrum, waveform
from .modes import Modes, mode_frequencies, mode_table, window_weights
from .note import Note
from .simulate import Simulation, contact_rate, simulate
