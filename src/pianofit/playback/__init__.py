"""Rendering of MIDI songs: `load_song` reads a file, `render_song` plays it with one voice per key."""

from .midi import Song, load_song
from .song import Performance, limit, render_song

__all__ = ["Performance", "Song", "limit", "load_song", "render_song"]
