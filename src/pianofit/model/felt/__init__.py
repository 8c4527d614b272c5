"""How a felt is stepped: its laws are data (`pianofit.felt`), three of them with a solver of their own (`relaxing`)."""

from .passive import static_force
from .step import compression, felt_force, force, memory_weights, remember

__all__ = ["compression", "felt_force", "force", "memory_weights", "remember", "static_force"]
