"""What a sampler's folder says of itself to a reader."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from ..analysis.notes import midi_to_note
from ..io import one_line
from ..keyboard.document import Instrument
from .layers import SampledKey

__all__ = ["readme_text", "unrecorded"]

NO_LICENCE = (
    "None was given when this folder was written (pianofit export --licence WORDS). The samples are computed from an\n"
    "instrument that was fitted to recordings; whether the recordings' licence binds them is for you to find out."
)


def unrecorded(instrument: Instrument, keys: Collection[int]) -> list[int]:
    """Which of these keys were never recorded: they are the laws' guess."""
    return sorted(set(keys) - instrument.recorded)


def readme_text(instrument: Instrument, file: str, keys: Sequence[SampledKey], licence: str | None) -> str:
    """README.txt; what comes from the user is on one line."""
    own = [key.midi for key in keys]
    guesses = unrecorded(instrument, own)
    recorded = [midi for midi in own if midi not in guesses]
    moved = sorted({midi for key in keys for midi in range(key.low, key.high + 1)} - set(own))
    return f"""{one_line(instrument.name) or "An instrument"}
{"=" * (len(one_line(instrument.name)) or 13)}

Load {file} in a sampler. Every sample is computed by pianofit from the instrument's strings, hammers and modes; none is
a recording. A key has {len(keys[0].zones)} layers. Between two of them both are heard, together as loud
as the velocity asks.

Licence
-------
{one_line(licence) if licence else NO_LICENCE}

Keys
----
Sampled, and fitted to recordings of the key: {_named(recorded)}
Sampled, but guesses (never recorded; laws over the keyboard): {_named(guesses)}
Played from the nearest sampled key, transposed: {_named(moved)}

Release
-------
No sample is triggered by a release: a damper is a faster decay of all modes, and no more is known of it. It was chosen,
not fitted. Keys above F#6 have none and ring on.
"""


def _named(keys: Sequence[int]) -> str:
    return " ".join(midi_to_note(key) for key in keys) if keys else "none"
