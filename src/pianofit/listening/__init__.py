"""Blind listening tests of two sets of sounds.

`page` writes the test of sounds in memory as an HTML page. `sounds` makes a test of two folders, `pairs` finds their
pairs, and `artefact_checks` rejects faulty sounds. `mushra` writes the same sounds as a webMUSHRA experiment. `result`
counts answers.
"""
