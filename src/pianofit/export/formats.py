"""Formats of samplers, and the readme of an exported folder."""

from collections.abc import Callable, Iterable
from typing import NamedTuple

from ..analysis.note_names import midi_to_note
from ..instrument import Instrument
from ..io.files import printable
from ..schema.dampers import LAST_DAMPER
from .decent_sampler import dspreset_text
from .layers import BLENDS, SamplerContent, format_keys, played_keys, silent_keys
from .sfz import sfz_text

# A line that identifies a folder as an export, so that --force never deletes a folder of the user.
EXPORT_MARK = "Every sample is computed by pianofit"
NO_LICENCE = (
    "No licence was given when this folder was written (pianofit export --licence WORDS). The samples are\n"
    "computed from an instrument that was fitted to recordings. Check whether the licence of the\n"
    "recordings applies to them."
)


class Sampler(NamedTuple):
    """One sampler format."""

    ending: str  # file name suffix of the text
    kind: str  # audio format that all its players read
    blends: tuple[str, ...]  # of `BLENDS`, those that the format has
    text: Callable[[SamplerContent], str]


SAMPLERS = {
    "sfz": Sampler(".sfz", "flac", BLENDS, sfz_text),
    # FLAC only from version 1.19 on; the format has no crossfades
    "decent-sampler": Sampler(".dspreset", "wav", ("curves", "plain"), dspreset_text),
}


def readme_text(instrument: Instrument, file: str, content: SamplerContent, licence: str | None) -> str:
    """Text of README.txt. Names and words from the user are escaped, so that each stays on one line."""
    name, keys = printable(instrument.name) or "An instrument", content.keys
    sampled = [*dict.fromkeys(key.midi for key in keys)]
    unrecorded = instrument.unrecorded(sampled)
    transposed = played_keys(keys) - {*sampled}
    changed = {*instrument.changed} & {*sampled}
    by_hand = f"Sampled, changed by hand on the page to play: {_named(changed)}\n" if changed else ""
    return f"""{name}
{"=" * len(name)}

Load {file} in a sampler. {EXPORT_MARK} from the instrument's strings, hammers and modes. No sample
of a string is a recording. {_layers(content)}

Licence
-------
{printable(licence) if licence else NO_LICENCE}

Keys
----
{by_hand}Sampled, fitted to recordings of the key: {_named({*sampled} - {*unrecorded})}
Sampled, not recorded (guesses, interpolated by keyboard laws): {_named(unrecorded)}
Transposed from the nearest sampled key: {_named(transposed)}
Silent: {format_keys(silent_keys(keys))}

Pedals and release
------------------
{_pedals(instrument, content)}
"""


def _layers(content: SamplerContent) -> str:
    count = len(content.keys[0].strokes)
    if count == 1:
        return "A key has one layer, scaled to the level of each velocity."
    if content.blend == "plain":
        return f"A key has {count} layers. One of them sounds at each velocity."
    end = "crossfaded to the\nlevel of the velocity." if content.blend == "curves" else "crossfaded by the sampler."
    return f"A key has {count} layers. Between two layers both sound, {end}"


def _pedals(instrument: Instrument, content: SamplerContent) -> str:
    """Return what the folder holds of dampers, pedals and noises."""
    source = "recordings of damped notes" if instrument.dampers.source == "recordings" else "the literature"
    lines = [
        f"The damper is an additional decay rate of all partials, that of the fundamental. Its source: {source}.",
        f"Keys above {midi_to_note(LAST_DAMPER)} have no damper and ring on.",
        "Keys that are let go make the noise of their recordings."
        if content.releases
        else "A release triggers no sample, because the instrument has no recorded release noise.",
        "With the right pedal down, a sample of the free strings' resonance sounds with each stroke."
        if content.keys[0].resonance
        else "The resonance of free strings is not included.",
        "The left pedal chooses samples of its own." if content.keys[0].soft else "The left pedal has no effect.",
    ]
    return "\n".join(lines)


def _named(keys: Iterable[int]) -> str:
    return " ".join(map(midi_to_note, sorted(keys))) or "none"
