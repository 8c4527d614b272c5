"""An instrument played: `perform` plays a `midi` song on its `strings`, `sfz` writes a sampler's folder."""

from .midi import Song, load_song
from .perform import Performance, limit, perform
from .sfz import export_sfz, parse_keys

__all__ = ["Performance", "Song", "export_sfz", "limit", "load_song", "parse_keys", "perform"]
