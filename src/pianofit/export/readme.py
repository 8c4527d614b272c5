"""What a sampler's folder says of itself to a reader."""

from __future__ import annotations

from collections.abc import Sequence

from ..analysis.note_names import midi_to_note
from ..instrument.document import Instrument
from ..io.files import printable
from ..playback.voice import LAST_DAMPER
from .layers import SampledKey, format_keys, silent_keys

__all__ = ["MARK", "readme_text"]

# What tells an export from a folder of the user's.
MARK = "Every sample is computed by pianofit"
NO_LICENCE = (
    "None was given when this folder was written (pianofit export --licence WORDS). The samples are computed from an\n"
    "instrument that was fitted to recordings; whether the recordings' licence binds them is for you to find out."
)


def readme_text(instrument: Instrument, file: str, keys: Sequence[SampledKey], licence: str | None) -> str:
    """README.txt; what comes from the user is on one line."""
    own = [key.midi for key in keys]
    guesses = instrument.unrecorded_keys(own)
    recorded = [midi for midi in own if midi not in guesses]
    moved = sorted({midi for key in keys for midi in range(key.low, key.high + 1)} - set(own))
    return f"""{printable(instrument.name) or "An instrument"}
{"=" * (len(printable(instrument.name)) or 13)}

Load {file} in a sampler. {MARK} from the instrument's strings, hammers and modes; none is
a recording. {_layers(len(keys[0].zones))}

Licence
-------
{printable(licence) if licence else NO_LICENCE}

Keys
----
{_changed(instrument, own)}Sampled, and fitted to recordings of the key: {_named(recorded)}
Sampled, but guesses (never recorded; laws over the keyboard): {_named(guesses)}
Played from the nearest sampled key, transposed: {_named(moved)}
Silent: {format_keys(silent_keys(keys))}

Release
-------
No sample is triggered by a release: a damper is a faster decay of all modes, and no more is known of it. It was chosen,
not fitted. Keys above {midi_to_note(LAST_DAMPER)} have none and ring on.
"""


def _layers(count: int) -> str:
    if count == 1:
        return "A key has one layer, as loud as the velocity asks."
    return f"A key has {count} layers. Between two of them both are heard, together as loud\nas the velocity asks."


def _changed(instrument: Instrument, own: Sequence[int]) -> str:
    changed = [midi for midi in instrument.changed if midi in own]
    return f"Sampled, and changed by hand on the page to play: {_named(changed)}\n" if changed else ""


def _named(keys: Sequence[int]) -> str:
    return " ".join(midi_to_note(key) for key in keys) if keys else "none"
