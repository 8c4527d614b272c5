"""Time steps of a felt. Felt laws are data (`pianofit.felt`), and three of them share a special solver (`relaxing`)."""

from .contact_step import compression, felt_force, force, memory_weights, update_relaxation
from .passivity import static_force

__all__ = ["compression", "felt_force", "force", "memory_weights", "update_relaxation", "static_force"]
