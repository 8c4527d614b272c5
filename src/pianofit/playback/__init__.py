"""Rendering of MIDI songs: `load_song` reads a file, `render_song` plays it under all pedals."""

from .midi import Song, load_song
from .pedals import PedalRange
from .song import Performance, PlayOptions, render_song

__all__ = ["PedalRange", "Performance", "PlayOptions", "Song", "load_song", "render_song"]
