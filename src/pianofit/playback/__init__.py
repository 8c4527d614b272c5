"""An instrument played: `render_song` plays a MIDI song with one voice per key."""

from .midi import Song, load_song
from .song import Performance, limit, render_song

__all__ = ["Performance", "Song", "limit", "load_song", "render_song"]
