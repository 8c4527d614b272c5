"""Signal processing without knowledge of strings: damped exponentials on an even grid and their sums."""
