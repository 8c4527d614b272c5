"""The values that a user gives: `values` has the setup and checks each value, `contradictions` checks them together."""

from .measured import Measured, relative_sd
from .values import KEYS, RANGES, SETUP_KEYS, RecordingInfo, Setup, recording_info_for, to_setup
