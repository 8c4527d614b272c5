"""The README.txt of an exported sampler."""

from __future__ import annotations

from collections.abc import Sequence

from ..analysis.note_names import midi_to_note
from ..instrument import Instrument
from ..io.files import printable
from ..playback.voice import LAST_DAMPER
from .layers import SampledKey, format_keys, silent_keys

__all__ = ["EXPORT_MARK", "readme_text"]

# A line that identifies a folder as an export, so that --force never deletes a folder of the user.
EXPORT_MARK = "Every sample is computed by pianofit"
NO_LICENCE = (
    "No licence was given when this folder was written (pianofit export --licence WORDS). The samples are\n"
    "computed from an instrument that was fitted to recordings. Check whether the licence of the\n"
    "recordings applies to them."
)


def readme_text(instrument: Instrument, file: str, keys: Sequence[SampledKey], licence: str | None) -> str:
    """Text of README.txt. Names and words from the user are escaped, so that each stays on one line."""
    sampled = [key.midi for key in keys]
    unrecorded = instrument.unrecorded(sampled)
    recorded = [midi for midi in sampled if midi not in unrecorded]
    transposed = sorted({midi for key in keys for midi in range(key.low, key.high + 1)} - set(sampled))
    return f"""{printable(instrument.name) or "An instrument"}
{"=" * (len(printable(instrument.name)) or 13)}

Load {file} in a sampler. {EXPORT_MARK} from the instrument's strings, hammers and modes. No sample
is a recording. {_layers(len(keys[0].zones))}

Licence
-------
{printable(licence) if licence else NO_LICENCE}

Keys
----
{_changed(instrument, sampled)}Sampled, fitted to recordings of the key: {_named(recorded)}
Sampled, not recorded (guesses, interpolated by keyboard laws): {_named(unrecorded)}
Transposed from the nearest sampled key: {_named(transposed)}
Silent: {format_keys(silent_keys(keys))}

Release
-------
A release triggers no sample. The damper is modelled as an additional decay rate of all modes, with assumed values.
Keys above {midi_to_note(LAST_DAMPER)} have no damper and ring on.
"""


def _layers(count: int) -> str:
    if count == 1:
        return "A key has one layer, scaled to the level of each velocity."
    return f"A key has {count} layers. Between two layers both sound, crossfade_layers to the\nlevel of the velocity."


def _changed(instrument: Instrument, sampled: Sequence[int]) -> str:
    changed = [midi for midi in instrument.changed if midi in sampled]
    return f"Sampled, changed by hand on the page to play: {_named(changed)}\n" if changed else ""


def _named(keys: Sequence[int]) -> str:
    return " ".join(midi_to_note(key) for key in keys) if keys else "none"
