"""An instrument as one HTML file that plays.

`prepare.js` makes tables of a key's numbers, `contact.js` solves strokes, `engine.js` plays them, `output.js` keeps
them within full scale, `change.js` changes a key, `note.js` makes a file of one; none of these knows of a page.
`worklet.js` runs the engine in the audio thread; `player.js`, `workbench.js` and `keyboard.js` are what a user sees of
it, and `compare.js` where there are recordings. `payload` makes the numbers, `recordings` the sounds, `write` the file;
`widget` makes of the same scripts a note to play in a notebook.
"""

from .write import Page, write_page

__all__ = ["Page", "write_page"]
