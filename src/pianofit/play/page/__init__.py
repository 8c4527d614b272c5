"""An instrument as one HTML file that plays.

`prepare.js` makes tables of a key's numbers, `contact.js` solves strokes, `engine.js` plays them, `output.js` keeps
them within full scale, `change.js` changes a key, `note.js` makes a file of one; none of these knows of a page.
`worklet.js` runs the engine in the audio thread; `player.js`, `workbench.js` and `keyboard.js` are what a user sees of
it. `payload` makes the numbers, `write` the file.
"""

from .write import Page, write_page

__all__ = ["Page", "write_page"]
