"""Text of a Decent Sampler preset, as https://decentsampler-developers-guide.readthedocs.io documents the format.

The format has no crossfades, but a table can modulate the volume of a group by velocity, so every sample is a group.

A sample has one release time, so the slope of a damper over frequency is lost. Half pedal and sostenuto are not
documented. Groups are chosen by a pedal at the stroke (`loCC67`, `loCC64`), so a pedal that
is pressed later adds no resonance. A release group (`trigger`) plays the noise of a key that is let go. Release
velocity is not documented, and `releaseTriggerDecay` can only reduce a level with the sounding time.

Three knobs on screen change the sound: attack, release and tone. As loaded they change nothing. The release of a group
is that of its damper times the value of its knob.
"""

from collections.abc import Iterator
from xml.etree import ElementTree

from ..conversions import T60_NEPERS
from ..playback.midi import SWITCH
from .layers import LOUDEST, Sample, SampledKey, SamplerContent, Zone

# The first version that documents velocity as a modulator.
VERSION = "1.15.0"
# Size of the window, and place and width of the first knob and of the next ones, pixels.
WINDOW, KNOB, KNOB_STEP = (812, 375), (180, 130, 110), 170
# Largest attack, s, and smallest and largest release relative to that of the damper.
LONGEST_ATTACK, RELEASES = 2.0, (0.25, 4.0)
# Cutoff of the low-pass filter over the knob of the tone, Hz: two octaves each quarter. At its end it passes all.
TONES = ((0.0, 340.0), (0.25, 960.0), (0.5, 2_700.0), (0.75, 7_700.0), (1.0, 22_000.0))


def dspreset_text(content: SamplerContent) -> str:
    """Return the text of a preset."""
    root = ElementTree.Element("DecentSampler", minVersion=VERSION)
    root.append(ElementTree.Comment(f" {content.title}: strings and hammers, computed by pianofit "))
    knobs = _add_knobs(root)
    groups = ElementTree.SubElement(root, "groups", attack="0", decay="0", sustain="1")
    modulators = ElementTree.SubElement(root, "modulators")
    velocity = ElementTree.SubElement(modulators, "midiVelocity", scope="voice", modAmount="1.0")
    for i, (key, sample, pedals, follows_velocity) in enumerate(_samples(content)):
        _add_group(groups, key, sample, pedals)
        if key.damper:
            low, high = (f"{x * _release(key):.4f}" for x in RELEASES)
            binding = {"type": "amp", "level": "group", "groupIndex": str(i), "parameter": "ENV_RELEASE"}
            binding |= {"translation": "linear", "translationOutputMin": low, "translationOutputMax": high}
            ElementTree.SubElement(knobs["Release"], "binding", binding)
        if follows_velocity:
            binding = {"type": "amp", "level": "group", "groupIndex": str(i), "parameter": "AMP_VOLUME"}
            binding |= {"modBehavior": "set", "translation": "table", "translationTable": _table(sample.zone)}
            ElementTree.SubElement(velocity, "binding", binding)
    if content.releases:
        _add_releases(groups, content)
    ElementTree.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ElementTree.tostring(root, encoding="unicode")}\n'


def _samples(content: SamplerContent) -> Iterator[tuple[SampledKey, Sample, dict[str, str], bool]]:
    """All samples, each with its key, the pedals at which it sounds, and whether its volume follows the velocity."""
    curves = content.blend == "curves"
    for key in content.keys:
        for sample in key.strokes:
            yield key, sample, _range(67, 0, SWITCH - 1) if key.soft else {}, curves
        for sample in key.soft:
            yield key, sample, _range(67, SWITCH, LOUDEST), curves
        if key.resonance:
            yield key, key.resonance, _range(64, SWITCH, LOUDEST), True


def _range(controller: int, low: int, high: int) -> dict[str, str]:
    """Attributes that choose a group by the value of a controller at the stroke."""
    return {f"loCC{controller}": str(low), f"hiCC{controller}": str(high)}


def _add_group(groups: ElementTree.Element, key: SampledKey, sample: Sample, pedals: dict[str, str]) -> None:
    zone, file = sample
    element = ElementTree.SubElement(groups, "group", {"ampVelTrack": "0"} | pedals)
    attributes = {"path": file, "rootNote": key.midi, "loNote": key.low, "hiNote": key.high}
    attributes |= {"loVel": zone.low, "hiVel": zone.high}
    # The damper is the release; without a damper the note rings on. The format does not define the fall of an envelope
    # during the release; 60 dB is usual.
    if key.damper:
        element.set("release", f"{_release(key):.4f}")  # of the group, which its knob can change
    else:
        attributes |= {"ampEnvEnabled": "false"}
    ElementTree.SubElement(element, "sample", {name: str(value) for name, value in attributes.items()})


def _release(key: SampledKey) -> float:
    """Time in which the damper of a key lowers the sound by 60 dB, s."""
    return T60_NEPERS / key.damper


def _add_knobs(root: ElementTree.Element) -> dict[str, ElementTree.Element]:
    """Add the window with its knobs, by label, and the filter of the tone."""
    width, height = map(str, WINDOW)
    tab = ElementTree.SubElement(ElementTree.SubElement(root, "ui", width=width, height=height), "tab", name="main")
    ranges = {"Attack": (0.0, LONGEST_ATTACK, 0.0), "Release": (*RELEASES, 1.0), "Tone": (0.0, 1.0, 1.0)}
    knobs, (x, y, size) = {}, KNOB
    for i, (label, (low, high, value)) in enumerate(ranges.items()):
        place = {"x": x + i * KNOB_STEP, "y": y, "width": size, "textSize": 18}
        values = {"label": label, "type": "float", "minValue": low, "maxValue": high, "value": value}
        attributes = {
            name: f"{given:g}" if isinstance(given, float) else str(given) for name, given in (place | values).items()
        }
        knobs[label] = ElementTree.SubElement(tab, "labeled-knob", attributes)
    attack = {"type": "amp", "level": "instrument", "position": "0", "parameter": "ENV_ATTACK"}
    ElementTree.SubElement(knobs["Attack"], "binding", attack)
    tone = {"type": "effect", "level": "instrument", "position": "0", "parameter": "FX_FILTER_FREQUENCY"}
    table = ";".join(f"{at:g},{hz:g}" for at, hz in TONES)
    ElementTree.SubElement(knobs["Tone"], "binding", tone | {"translation": "table", "translationTable": table})
    effects = ElementTree.SubElement(root, "effects")
    ElementTree.SubElement(effects, "effect", type="lowpass", frequency=f"{TONES[-1][1]:g}")
    return knobs


def _add_releases(groups: ElementTree.Element, content: SamplerContent) -> None:
    """Add the group of noises of keys that are let go, at their own pitch and level."""
    own = {"trigger": "release", "ampVelTrack": "0", "pitchKeyTrack": "0"}
    element = ElementTree.SubElement(groups, "group", own)
    for release in content.releases:
        midi = str(release.midi)
        attributes = {"path": release.file, "rootNote": midi, "loNote": midi, "hiNote": midi}
        attributes |= {"volume": f"{release.gain_db:.2f}dB", "ampEnvEnabled": "false"}
        ElementTree.SubElement(element, "sample", attributes)


def _table(zone: Zone) -> str:
    """Pairs of modulator value, 0 to 1, and volume. A table needs two."""
    velocities = range(zone.low, zone.high + 1)
    pairs = [f"{v / LOUDEST:.6f},{gain:.5g}" for v, gain in zip(velocities, zone.gain, strict=True)]
    return ";".join(pairs if len(pairs) > 1 else ["0,0", *pairs])
