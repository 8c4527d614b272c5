"""An instrument as one HTML file that plays.

These scripts do not depend on a page: `prepare.js` computes tables of a key's numbers, `contact.js` solves strokes,
`engine.js` plays them, `output.js` limits the output to full scale, `change.js` changes a key, `note.js` and
`instrument.js` write documents of what was changed, `midi.js` reads and writes MIDI files, `record.js` records what is
played. `worklet.js` runs the engine in the audio thread. The user interface is in `player.js`, `workbench.js`,
`song.js` and `keyboard.js`, and in `compare.js` where there are recordings.

In Python, `payload` makes the numbers, `recordings` the sounds and `write` the file. `widget` makes a note to play in a
notebook from the same scripts.
"""

from .write import Page, write_page

__all__ = ["Page", "write_page"]
