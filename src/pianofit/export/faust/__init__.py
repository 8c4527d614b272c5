"""Export to one Faust program: `tables` computes the tables of a key, `write` writes the `.dsp`."""

from .write import Program, write_faust

__all__ = ["Program", "write_faust"]
