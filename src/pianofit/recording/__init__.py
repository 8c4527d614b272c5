"""Reads and checks the recording of one note, and detects its onset."""

from .onset import find_onset
from .recording import Recording, Source, load_recording, recording_from_samples

__all__ = ["Recording", "Source", "find_onset", "load_recording", "recording_from_samples"]
