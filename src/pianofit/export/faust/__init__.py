"""Export to one Faust program: `tables` computes the tables of a key, `write` writes the `.dsp`."""

from .write import FaustSummary, write_faust
