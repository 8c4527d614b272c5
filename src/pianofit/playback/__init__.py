"""Rendering of MIDI songs: `load_song` reads a file, `render_song` plays it under all pedals."""

from .midi import Song, load_song
from .pedals import PedalRange
from .song import Performance, PlayOptions, render_song
