"""Data sets of synthetic notes with their parameters.

`source` reads the notes to draw around. `draw` draws the parameters of one note from its number and the seed.
`labelled_note` renders them in blocks. `table` describes each as a row of numbers, and makes notes from rows. `write`
keeps blocks as files.
"""

from ..schema.dataset import NoteOptions
from .labelled_note import LabelledNote, notes
from .table import note_from_labels
from .write import DatasetSummary, write_dataset
