"""Text of an SFZ file. A key is a group, and a layer is a region with its own gain over velocity.

Dampers and pedals use these opcodes, documented at https://sfzformat.com and checked in the source of sfizz:

- `ampeg_release` is one time for all partials, so the slope of a damper over frequency is lost.
- `sustain_lo` makes the right pedal a switch where the dampers no longer touch the strings. Below it, `ampeg_release`
  follows controller 64 (`ampeg_release_oncc64`, `ampeg_dynamic`), which gives half pedal in players that know both.
- `trigger=release_key` plays the noise of a key that is let go, whatever the pedals do. Its level is that of release
  velocity 64 and of a long note: sfizz replaces the release velocity (extended controller 132) by that of the stroke,
  and `rt_decay` can only reduce a level with the sounding time.
- A resonance region sounds with every stroke. Its gain follows the right pedal (`xfin_locc64`), so that a pedal that is
  pressed after the stroke finds the strings in motion.
"""

from collections.abc import Iterable, Iterator

from ..analysis.note_names import midi_to_note
from ..conversions import T60_NEPERS
from ..playback.midi import SWITCH
from ..playback.pedals import PedalRange
from .layers import LOUDEST, Sample, SampledKey, SamplerContent, Zone

# Fall of an SFZ envelope during `ampeg_release`, nepers. The format does not define it; this is the value of sfizz.
RELEASED = 9.0
# Longest release in the format, s. It stands for a damper that does not touch the string.
LONGEST_RELEASE = 100.0
# Number of the curve of the release time over controller 64. ARIA and sfizz have their own curves below 7.
PEDAL_CURVE = 10


def sfz_text(content: SamplerContent) -> str:
    """Return the text of an SFZ file."""
    return "\n".join([*_head(content), *(line for key in content.keys for line in _key(key, content)), ""])


def _head(content: SamplerContent) -> Iterator[str]:
    """Comments, curves, what all regions share, and the noises of keys that are let go."""
    yield f"// {content.title}: strings and hammers, computed by pianofit"
    yield "// The damper of a key acts on all partials alike, because the format has one release time."
    yield "// Half pedal needs a player with ampeg_dynamic, such as sfizz. In others the right pedal is a switch."
    yield "// A group is one sampled key, pitch_keycenter. It plays the keys from lokey to hikey."
    yield "// A region is one layer, or the free strings. Its gain follows the velocity."
    pedals = {64: "right pedal", 66: "middle pedal"} | ({67: "left pedal"} if content.keys[0].soft else {})
    yield f"<control> {' '.join(f'label_cc{number}={name}' for number, name in pedals.items())}"
    least = _least_contact(content)
    contacts = map(PedalRange().contact, range(LOUDEST + 1))  # at each value of controller 64
    times = [(1 / max(contact, least) - 1) / (1 / least - 1) for contact in contacts]
    yield f"<curve> curve_index={PEDAL_CURVE} {_points(enumerate(times))}"
    blend = "100" if content.blend == "curves" else "0 xf_velcurve=gain"
    switches = f"sustain_lo={PedalRange().high:g} sostenuto_lo={SWITCH}"
    yield f"<global> ampeg_attack=0 ampeg_dynamic=1 {switches} amp_veltrack={blend}"
    yield from _releases(content)
    yield ""


def _least_contact(content: SamplerContent) -> float:
    """Contact of a damper whose release lasts at most `LONGEST_RELEASE` at every key."""
    slowest = min((key.damper for key in content.keys if key.damper), default=1.0)
    return min(RELEASED / slowest / LONGEST_RELEASE, 0.5)


def _points(points: Iterable[tuple[int, float]]) -> str:
    """Points of a curve, without those on a constant part."""
    listed = list(points)
    inner = [
        point
        for before, point, after in zip(listed, listed[1:], listed[2:], strict=False)
        if not before[1] == point[1] == after[1]
    ]
    return " ".join(f"v{at:03}={value:.6g}" for at, value in [listed[0], *inner, listed[-1]])


def _releases(content: SamplerContent) -> Iterator[str]:
    if not content.releases:
        return
    yield "// keys that are let go"
    yield "<group> group_label=release trigger=release_key pitch_keytrack=0 amp_veltrack=0"
    for release in content.releases:
        yield f"<region> key={release.midi} sample={release.file} volume={release.gain_db:.2f}"


def _key(key: SampledKey, content: SamplerContent) -> Iterator[str]:
    end = "loop_mode=one_shot"
    if key.damper:
        shortest = RELEASED / key.damper
        longer = shortest / _least_contact(content) - shortest
        end = f"ampeg_release={shortest:.4f} ampeg_release_oncc64={longer:.4f} ampeg_release_curvecc64={PEDAL_CURVE}"
    span = midi_to_note(key.low) + (f" to {midi_to_note(key.high)}" if key.high > key.low else "")
    velocities = ", ".join(str(sample.zone.velocity) for sample in key.strokes)
    damper = f"the damper takes {T60_NEPERS / key.damper:.2f} s for 60 dB" if key.damper else "no damper"
    yield f"// {midi_to_note(key.midi)}: plays {span}; layers struck at {velocities}; {damper}"
    label = midi_to_note(key.midi).replace("#", "s")  # SFZ reads "#" as the start of a directive
    yield f"<group> group_label={label} lokey={key.low} hikey={key.high} pitch_keycenter={key.midi} {end}"
    for sample in key.strokes:
        yield _stroke(sample, content.blend) + (f" hicc67={SWITCH - 1}" if key.soft else "")
    for sample in key.soft:
        yield f"{_stroke(sample, content.blend)} locc67={SWITCH}"
    if key.resonance:
        low, high = PedalRange()
        gate = f"xfin_locc64={low:g} xfin_hicc64={high:g}"
        gain = f"{gate} amp_veltrack=100 {_curve(key.resonance.zone)}"
        yield f"<region> region_label=resonance sample={key.resonance.file} {gain}"


def _stroke(sample: Sample, blend: str) -> str:
    """Region of one layer of a key."""
    zone = sample.zone
    text = f"<region> region_label=v{zone.velocity} lovel={zone.low} hivel={zone.high} sample={sample.file}"
    if blend == "curves":
        return f"{text} {_curve(zone)}"
    if blend == "xfade" and zone.low < zone.velocity:
        text += f" xfin_lovel={zone.low - 1} xfin_hivel={zone.velocity}"
    if blend == "xfade" and zone.velocity < zone.high:
        text += f" xfout_lovel={zone.velocity} xfout_hivel={zone.high + 1}"
    return text


def _curve(zone: Zone) -> str:
    """Gain at every velocity, because players interpolate differently."""
    return " ".join(f"amp_velcurve_{zone.low + i}={gain:.5g}" for i, gain in enumerate(zone.gain))
