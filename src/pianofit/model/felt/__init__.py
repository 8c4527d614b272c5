"""Laws of the felt: the three that a fit knows (`relaxing`), and any other as one object (`own`)."""

from .own import FeltLaw, own_law
from .step import compression, felt_force, force, memory_weights, remember

__all__ = ["FeltLaw", "compression", "felt_force", "force", "memory_weights", "own_law", "remember"]
