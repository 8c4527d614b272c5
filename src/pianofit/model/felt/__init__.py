"""How a felt is stepped: its laws are data (`pianofit.felt`), three of them with a solver of their own (`relaxing`)."""

from .contact_step import compression, felt_force, force, memory_weights, update_relaxation
from .passivity import static_force

__all__ = ["compression", "felt_force", "force", "memory_weights", "update_relaxation", "static_force"]
