"""Facts that follow from the parameters of a fit and from the stroke of its reference recording."""

from __future__ import annotations

from dataclasses import dataclass, field

from ..model.simulate import Contact
from .decode import Number
from .quantities import Quantities


@dataclass(frozen=True)
class Recontact:
    """A contact of hammer and string after the first."""

    start_ms: Number  # after the first contact
    duration_ms: Number
    max_force_N: Number

    @classmethod
    def of(cls, contact: Contact) -> Recontact:
        """Return the entry of a contact of a simulation."""
        return cls(1e3 * contact.start, 1e3 * (contact.stop - contact.start), contact.force)


@dataclass(frozen=True)
class GlideWindow:
    """Pitch in a window of time."""

    start_s: Number
    stop_s: Number
    f0: Number  # Hz


@dataclass(frozen=True)
class Derived:
    """Facts that follow from the parameters and the stroke of the reference recording."""

    f0: Number  # Hz
    B: Number
    f1: Number  # first partial, Hz
    reference_compression_mm: Number  # of the key: the felt forces of the fit hold there
    recontacts: tuple[Recontact, ...]
    glide_cents: Number
    glide: tuple[GlideWindow, ...]
    quantities: Quantities = field(default_factory=lambda: Quantities({}))  # with intervals from posterior draws
