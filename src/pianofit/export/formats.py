"""Sampler formats: a text that maps keys and velocities to samples and gains.

In SFZ, a key is a group and a layer is a region with its own gain curve over velocity. Decent Sampler has no
crossfades, but a table can modulate the volume of a group by velocity, so every sample is a group. Its format is
documented at https://decentsampler-developers-guide.readthedocs.io.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple
from xml.etree import ElementTree

from .layers import LOUDEST, SampledKey, Zone

__all__ = ["SAMPLERS"]

# Fall of an SFZ envelope during `ampeg_release`, nepers. The format does not define it; this is the value of sfizz.
SFZ_RELEASED = 9.0
# First version of Decent Sampler that documents velocity as a modulator.
DECENT_VERSION = "1.15.0"
# Fall of its envelope during the release, nepers. The format does not define it; 60 dB is usual.
DECENT_RELEASED = math.log(1000)


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
    root = ElementTree.Element("DecentSampler", minVersion=DECENT_VERSION)
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
        ElementTree.SubElement(
            velocity, "binding", type="amp", level="group", groupIndex=str(i), parameter="AMP_VOLUME",
            modBehavior="set", translation="table", translationTable=_table(zone),
        )  # fmt: skip
    ElementTree.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ElementTree.tostring(root, encoding="unicode")}\n'


def _table(zone: Zone) -> str:
    """Pairs of modulator value, 0 to 1, and volume."""
    velocities = range(zone.low, zone.high + 1)
    pairs = [f"{v / LOUDEST:.6f},{gain:.5g}" for v, gain in zip(velocities, zone.gain, strict=True)]
    # A table needs two points.
    return ";".join(pairs if len(pairs) > 1 else ["0,0", *pairs])


SAMPLERS = {
    "sfz": Sampler(".sfz", "flac", _sfz),
    "decent-sampler": Sampler(".dspreset", "wav", _dspreset),  # FLAC only from version 1.19 on
}
