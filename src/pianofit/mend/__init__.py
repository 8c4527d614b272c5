"""Recordings of a library, mended: longer tails, even levels and onsets, and sounds where none was recorded."""

from .library import Change, MendOptions, mend_library
