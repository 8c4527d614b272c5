"""An instrument as one Faust program: `tables` makes the numbers of a key, `write` the `.dsp`."""

from .write import Program, write_faust

__all__ = ["Program", "write_faust"]
