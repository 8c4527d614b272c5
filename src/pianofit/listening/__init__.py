"""A blind listening test as a page, of any two sets of sounds: what is asked, what may be heard, and what came of it.

`page` is the test itself, of sounds in memory. `sounds` makes one of two folders of files, whose sounds pass the gates
of `gates`; `mushra` writes the same sounds as a webMUSHRA experiment; `result` counts answers.
"""
