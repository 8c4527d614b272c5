"""An instrument played: `perform` plays a `midi` song on its `strings`, `export` writes a sampler's folder."""

from ..export.formats import SAMPLERS
from ..export.layers import parse_keys
from ..export.sampler import ExportOptions, ExportSummary, export_sampler
from .midi import Song, load_song
from .song import Performance, limit, render_song

__all__ = [
    "SAMPLERS", "ExportOptions", "ExportSummary", "Performance", "Song", "export_sampler", "limit", "load_song", "parse_keys",
    "render_song",
]  # fmt: skip
