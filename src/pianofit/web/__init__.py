"""An instrument as one HTML file with a playable keyboard.

Some scripts do not depend on a page. `prepare.js` computes the tables of a key, `contact.js` solves strokes,
`engine.js` plays them, and `output.js` limits the output to full scale. `signal.js` has Fourier transforms and
resampling, and `loudness.js` matches loudness. `change.js` applies the sliders to a key. `note.js` and `instrument.js`
write documents of the changed keys. `midi.js` reads and writes MIDI files, and `record.js` stores events. `worklet.js`
runs the engine in the audio thread. The user interface is in `player.js`, `workbench.js`, `song.js`, `keyboard.js`, and
`compare.js` for pages with recordings.

In Python, `payload` encodes the tables, `recordings` encodes the sounds, and `write` writes the file. `widget` plays a
note in a notebook with the same scripts.
"""

from .write import PageSummary, write_playable_page
