"""A sampler's text for Decent Sampler: a group for each sample, whose volume a curve over velocity sets.

It has no crossfades, but a voice's velocity may modulate the volume of a group, by a table. The format is documented at
https://decentsampler-developers-guide.readthedocs.io.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from xml.etree import ElementTree

from .layers import LOUDEST, SampledKey, Zone

__all__ = ["dspreset_text"]

# The first version whose documentation has velocity as a modulator.
VERSION = "1.15.0"
# How far an envelope falls in the time of its release; the format does not say, 60 dB is usual.
RELEASED = math.log(1000)


def dspreset_text(title: str, keys: Sequence[SampledKey]) -> str:
    """The `.dspreset`, as XML."""
    root = ElementTree.Element("DecentSampler", minVersion=VERSION)
    root.append(ElementTree.Comment(f" {title}: strings and hammers, played by pianofit "))
    groups = ElementTree.SubElement(root, "groups", attack="0", decay="0", sustain="1")
    modulators = ElementTree.SubElement(root, "modulators")
    velocity = ElementTree.SubElement(modulators, "midiVelocity", scope="voice", modAmount="1.0")
    zones = [(key, zone, file) for key in keys for zone, file in zip(key.zones, key.files, strict=True)]
    for i, (key, zone, file) in enumerate(zones):
        group = ElementTree.SubElement(groups, "group", ampVelTrack="0")
        heard = {"path": file, "rootNote": key.midi, "loNote": key.low, "hiNote": key.high}
        heard |= {"loVel": zone.low, "hiVel": zone.high} | _end(key)
        ElementTree.SubElement(group, "sample", {name: str(value) for name, value in heard.items()})
        ElementTree.SubElement(
            velocity, "binding", type="amp", level="group", groupIndex=str(i), parameter="AMP_VOLUME",
            modBehavior="set", translation="table", translationTable=_table(zone),
        )  # fmt: skip
    ElementTree.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ElementTree.tostring(root, encoding="unicode")}\n'


def _end(key: SampledKey) -> dict[str, str]:
    """The damper's decay; without one a note rings on."""
    return {"release": f"{RELEASED / key.damper:.4f}"} if key.damper else {"ampEnvEnabled": "false"}


def _table(zone: Zone) -> str:
    """Pairs of a modulator's value, 0 to 1, and a volume."""
    velocities = range(zone.low, zone.high + 1)
    pairs = [f"{v / LOUDEST:.6f},{gain:.5g}" for v, gain in zip(velocities, zone.gain, strict=True)]
    # A table needs two points.
    return ";".join(pairs if len(pairs) > 1 else ["0,0", *pairs])
