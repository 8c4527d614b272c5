"""Reads and checks the recording of one note, and detects its onset."""
