"""Texts of an exported sampler: the map from keys and velocities to samples and gains, and the readme.

In SFZ, a key is a group and a layer is a region with its own gain curve over velocity. Decent Sampler has no
crossfades, but a table can modulate the volume of a group by velocity, so every sample is a group. Its format is
documented at https://decentsampler-developers-guide.readthedocs.io.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple
from xml.etree import ElementTree

from ..analysis.note_names import midi_to_note
from ..instrument import Instrument
from ..instrument.dampers import LAST_DAMPER
from ..io.files import printable
from .layers import LOUDEST, SampledKey, Zone, format_keys, silent_keys

# Fall of an SFZ envelope during `ampeg_release`, nepers. The format does not define it; this is the value of sfizz.
SFZ_RELEASED = 9.0
# Fall of Decent Sampler's envelope during the release, nepers. The format does not define it; 60 dB is usual.
DECENT_RELEASED = math.log(1000)
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
    text: Callable[[str, Sequence[SampledKey]], str]  # (title, keys) -> text


def _sfz(title: str, keys: Sequence[SampledKey]) -> str:
    """SFZ text. Gain curves list every velocity, because players interpolate them differently."""
    lines = [f"// {title}: strings and hammers, computed by pianofit", "<global> amp_veltrack=100 ampeg_attack=0", ""]
    for key in keys:
        # The damper adds the same decay rate to every mode, as an exponential envelope does.
        end = f"ampeg_release={SFZ_RELEASED / key.damper:.4f}" if key.damper else "loop_mode=one_shot"
        lines.append(f"<group> lokey={key.low} hikey={key.high} pitch_keycenter={key.midi} {end}")
        for zone, file in zip(key.zones, key.files, strict=True):
            curve = " ".join(f"amp_velcurve_{zone.low + i}={gain:.5g}" for i, gain in enumerate(zone.gain))
            lines.append(f"<region> lovel={zone.low} hivel={zone.high} sample={file} {curve}")
    return "\n".join(lines) + "\n"


def _dspreset(title: str, keys: Sequence[SampledKey]) -> str:
    # The first version that documents velocity as a modulator.
    root = ElementTree.Element("DecentSampler", minVersion="1.15.0")
    root.append(ElementTree.Comment(f" {title}: strings and hammers, computed by pianofit "))
    groups = ElementTree.SubElement(root, "groups", attack="0", decay="0", sustain="1")
    modulators = ElementTree.SubElement(root, "modulators")
    velocity = ElementTree.SubElement(modulators, "midiVelocity", scope="voice", modAmount="1.0")
    zones = [(key, zone, file) for key in keys for zone, file in zip(key.zones, key.files, strict=True)]
    for i, (key, zone, file) in enumerate(zones):
        group = ElementTree.SubElement(groups, "group", ampVelTrack="0")
        attributes = {"path": file, "rootNote": key.midi, "loNote": key.low, "hiNote": key.high}
        attributes |= {"loVel": zone.low, "hiVel": zone.high}
        # The damper is the release; without a damper the note rings on.
        attributes |= {"release": f"{DECENT_RELEASED / key.damper:.4f}"} if key.damper else {"ampEnvEnabled": "false"}
        ElementTree.SubElement(group, "sample", {name: str(value) for name, value in attributes.items()})
        binding = {"type": "amp", "level": "group", "groupIndex": str(i), "parameter": "AMP_VOLUME"}
        binding |= {"modBehavior": "set", "translation": "table", "translationTable": _table(zone)}
        ElementTree.SubElement(velocity, "binding", binding)
    ElementTree.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ElementTree.tostring(root, encoding="unicode")}\n'


def _table(zone: Zone) -> str:
    """Pairs of modulator value, 0 to 1, and volume. A table needs two."""
    velocities = range(zone.low, zone.high + 1)
    pairs = [f"{v / LOUDEST:.6f},{gain:.5g}" for v, gain in zip(velocities, zone.gain, strict=True)]
    return ";".join(pairs if len(pairs) > 1 else ["0,0", *pairs])


SAMPLERS = {
    "sfz": Sampler(".sfz", "flac", _sfz),
    "decent-sampler": Sampler(".dspreset", "wav", _dspreset),  # FLAC only from version 1.19 on
}


def readme_text(instrument: Instrument, file: str, keys: Sequence[SampledKey], licence: str | None) -> str:
    """Text of README.txt. Names and words from the user are escaped, so that each stays on one line."""
    name = printable(instrument.name) or "An instrument"
    sampled, count = [key.midi for key in keys], len(keys[0].zones)
    unrecorded = instrument.unrecorded(sampled)
    transposed = {midi for key in keys for midi in range(key.low, key.high + 1)} - {*sampled}
    layers = "A key has one layer, scaled to the level of each velocity."
    if count > 1:
        layers = f"A key has {count} layers. Between two layers both sound, crossfaded to the\nlevel of the velocity."
    changed = {*instrument.changed} & {*sampled}
    by_hand = f"Sampled, changed by hand on the page to play: {_named(changed)}\n" if changed else ""
    return f"""{name}
{"=" * len(name)}

Load {file} in a sampler. {EXPORT_MARK} from the instrument's strings, hammers and modes. No sample
is a recording. {layers}

Licence
-------
{printable(licence) if licence else NO_LICENCE}

Keys
----
{by_hand}Sampled, fitted to recordings of the key: {_named({*sampled} - {*unrecorded})}
Sampled, not recorded (guesses, interpolated by keyboard laws): {_named(unrecorded)}
Transposed from the nearest sampled key: {_named(transposed)}
Silent: {format_keys(silent_keys(keys))}

Release
-------
A release triggers no sample. The damper is modelled as an additional decay rate of all modes, with assumed values.
Keys above {midi_to_note(LAST_DAMPER)} have no damper and ring on.
"""


def _named(keys: Iterable[int]) -> str:
    return " ".join(map(midi_to_note, sorted(keys))) or "none"
