"""An instrument played: `perform` plays a `midi` song on its `strings`, `export` writes a sampler's folder."""

from .export import Asked, Exported, export_sampler
from .formats import SAMPLERS
from .layers import parse_keys
from .midi import Song, load_song
from .perform import Performance, limit, perform

__all__ = [
    "SAMPLERS", "Asked", "Exported", "Performance", "Song", "export_sampler", "limit", "load_song", "parse_keys",
    "perform",
]  # fmt: skip
