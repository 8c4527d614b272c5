"""A recording of one note: read, checked, and its onset found."""

from .onset import find_onset
from .recording import Recording, Source, load_recording, recording_from_samples

__all__ = ["Recording", "Source", "find_onset", "load_recording", "recording_from_samples"]
