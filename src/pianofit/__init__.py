"""From recordings of struck strings to the physical parameters behind them, and back to sound."""

__version__ = "0.1.0"
