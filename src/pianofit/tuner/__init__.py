"""The tuning of a piano for its tuner, from the fits of some of its keys.

`curves` solves for octaves without beats. `tuning` applies it to draws from the joint posterior of the keyboard.
`page`, `table` and `entropy_piano_tuner` write the result.
"""
