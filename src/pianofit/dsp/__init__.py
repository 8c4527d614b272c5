"""Signal processing that is independent of the string model. It uses NumPy and SciPy only."""
