"""The folder for Decent Sampler: its text against the documented format, its gains against those of the SFZ.

Its sound is compared with the model through a reader of the documented format, because Decent Sampler cannot render
files.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import soundfile
from instrument_cases import true_instrument

from pianofit.conversions import hertz_of
from pianofit.dsp.filters import fractional_lag
from pianofit.errors import ParameterError
from pianofit.export import SAMPLERS, ExportOptions, export_sampler
from pianofit.export.layers import key_ranges, layer_velocities
from pianofit.instrument.release_noise import ReleaseNoise
from pianofit.playback.midi import Song
from pianofit.playback.song import render_song

KEYS = [55, 60, 100]
NOISE = np.random.default_rng(1).normal(size=(1, 500)) * np.exp(-np.arange(500) / 100)
NOISES = ReleaseNoise({58: 1e-3 * NOISE, 70: 2e-3 * NOISE}, 48_000)
PIANO = replace(true_instrument(), release=NOISES)
# From the developer's guide, version 1.22.2: element -> (parent, required attributes, other allowed attributes).
ELEMENTS = {
    "DecentSampler": (None, set(), {"minVersion"}),
    "groups": ("DecentSampler", set(), {"attack", "decay", "sustain", "release"}),
    "group": ("groups", set(), {"ampVelTrack", "volume", "tags", "trigger", "pitchKeyTrack",
                                "release", "loCC64", "hiCC64", "loCC67", "hiCC67"}),
    "sample": ("group", {"path", "rootNote"},
               {"loNote", "hiNote", "loVel", "hiVel", "volume", "release", "ampEnvEnabled"}),
    "modulators": ("DecentSampler", set(), set()),
    "midiVelocity": ("modulators", set(), {"modAmount", "scope"}),
    "binding": ("midiVelocity|labeled-knob", {"type", "level", "parameter"},
                {"groupIndex", "modBehavior", "position", "translation", "translationTable", "translationOutputMin",
                 "translationOutputMax"}),
    "ui": ("DecentSampler", set(), {"width", "height"}),
    "tab": ("ui", set(), {"name"}),
    "labeled-knob": ("tab", {"x", "y", "label", "type", "minValue", "maxValue", "value"}, {"width", "textSize"}),
    "effects": ("DecentSampler", set(), set()),
    "effect": ("effects", {"type"}, {"frequency"}),
}  # fmt: skip


@pytest.fixture(scope="module")
def folders(tmp_path_factory) -> dict[str, Path]:
    place = tmp_path_factory.mktemp("out")
    for to in SAMPLERS:
        asked = ExportOptions(3, 0.3, kind=SAMPLERS[to].kind, una_corda=True)
        export_sampler(PIANO, place / to, KEYS, asked, to=to, licence="<&>")
    return {to: place / to for to in SAMPLERS}


@pytest.fixture(scope="module")
def root(folders) -> ElementTree.Element:
    return ElementTree.parse(folders["decent-sampler"] / "twin.dspreset").getroot()  # noqa: S314


def strokes(root: ElementTree.Element) -> list[ElementTree.Element]:
    """Groups that a stroke triggers."""
    return [group for group in root.findall("groups/group") if "trigger" not in group.attrib]


def test_the_text_is_what_the_format_documents(root):
    assert root.tag == "DecentSampler"
    for parent in root.iter():
        for child in parent:
            within, needed, allowed = ELEMENTS[str(child.tag)]
            assert parent.tag in (within or "").split("|")
            assert needed <= set(child.attrib) <= needed | allowed
    assert len(root.findall("groups")) == 1


def test_samples_are_there_as_wav(root, folders):
    names = [sample.attrib["path"] for group in strokes(root) for sample in group]
    assert len(set(names)) == len(names) == 3 * (2 * 3 + 1)
    names += [sample.attrib["path"] for sample in root.iter("sample")]
    for name in names:
        info = soundfile.info(folders["decent-sampler"] / name)
        assert (info.format, info.subtype) == ("WAV", "PCM_24")
    assert "<&>" in (folders["decent-sampler"] / "README.txt").read_text()


def test_every_key_and_velocity_has_the_gains_of_the_sfz(root, folders):
    """Group by group, with linear interpolation of the table over velocity from 0 to 1, as the format documents."""
    lines = (folders["sfz"] / "twin.sfz").read_text().splitlines()
    regions = [dict(word.split("=", 1) for word in line.split()[1:]) for line in lines if "amp_velcurve" in line]
    groups, bindings = strokes(root), root.findall("modulators/midiVelocity/binding")
    assert len(regions) == len(groups) == len(bindings)
    covered = set()
    for i, (region, group, binding) in enumerate(zip(regions, groups, bindings, strict=True)):
        (sample,) = group
        assert (binding.attrib["groupIndex"], binding.attrib["parameter"]) == (str(i), "AMP_VOLUME")
        assert Path(region["sample"]).stem == Path(sample.attrib["path"]).stem
        table = np.array([pair.split(",") for pair in binding.attrib["translationTable"].split(";")], float)
        assert (np.diff(table[:, 0]) > 0).all()
        assert 0 <= table.min() <= table.max() <= 1
        velocities = int(region.get("lovel", 1)), int(region.get("hivel", 127))
        assert (int(sample.attrib["loVel"]), int(sample.attrib["hiVel"])) == velocities
        for velocity in range(velocities[0], velocities[1] + 1):
            expected = float(region[f"amp_velcurve_{velocity}"])
            assert np.interp(velocity / 127, *table.T) == pytest.approx(expected, rel=1e-3)
        covered |= {(k, v) for k in range(int(sample.attrib["loNote"]), int(sample.attrib["hiNote"]) + 1)
                    for v in range(int(sample.attrib["loVel"]), int(sample.attrib["hiVel"]) + 1)}  # fmt: skip
    keys = {key for low, high in key_ranges(KEYS) for key in range(low, high + 1)}
    assert covered == {(k, v) for k in keys for v in range(1, 128)}


def test_dampers_are_releases_and_the_treble_rings_on(root):
    for group in strokes(root):
        (sample,) = group
        midi = int(sample.attrib["rootNote"])
        rate = PIANO.dampers.rates(midi, np.array([hertz_of(midi)]))[0]
        if rate:
            assert float(group.attrib["release"]) == pytest.approx(np.log(1000) / rate, rel=1e-3)
        else:
            assert sample.attrib["ampEnvEnabled"] == "false"
            assert "release" not in group.attrib


def test_knobs_change_nothing_as_loaded(root):
    """A linear binding maps the range of its knob to its output; the table of the tone ends at the open filter."""
    knobs = {knob.attrib["label"]: knob for knob in root.iter("labeled-knob")}
    groups = root.findall("groups/group")
    low, high, value = (float(knobs["Release"].attrib[name]) for name in ("minValue", "maxValue", "value"))
    bound = {}
    for binding in knobs["Release"]:
        ends = [float(binding.attrib[f"translationOutput{end}"]) for end in ("Min", "Max")]
        bound[int(binding.attrib["groupIndex"])] = ends[0] + (value - low) / (high - low) * (ends[1] - ends[0])
    released = {i: float(group.attrib["release"]) for i, group in enumerate(groups) if "release" in group.attrib}
    assert bound == pytest.approx(released, abs=2e-4)
    assert float(knobs["Attack"].attrib["value"]) == 0
    (tone,) = knobs["Tone"]
    last = tone.attrib["translationTable"].split(";")[-1].split(",")
    assert [float(x) for x in last] == [float(knobs["Tone"].attrib["value"]), 22_000]
    assert root.findall("effects/effect")[0].attrib["frequency"] == "22000"


def test_groups_are_chosen_by_the_pedals(root):
    """Strokes without and with the left pedal exclude each other, and the resonance needs the right one."""
    found: dict[str, set[tuple[str, ...]]] = {}
    for group in strokes(root):
        ending = group[0].attrib["path"].partition("-v")[2].partition("-")[2] or group[0].attrib["path"].split("-")[-1]
        kind = {"soft.wav": "soft", "resonance.wav": "resonance"}.get(ending, "stroke")
        pedals = tuple(f"{name}={value}" for name, value in sorted(group.attrib.items()) if "CC" in name)
        found.setdefault(kind, set()).add(pedals)
    assert found == {
        "stroke": {("hiCC67=63", "loCC67=0")},
        "soft": {("hiCC67=127", "loCC67=64")},
        "resonance": {("hiCC64=127", "loCC64=64")},
    }


def test_keys_that_are_let_go_have_the_noise_of_the_engine(root, folders):
    """One release group plays every key that sounds, at its own pitch, with the engine's level."""
    (group,) = [group for group in root.findall("groups/group") if group.attrib.get("trigger") == "release"]
    assert (group.attrib["ampVelTrack"], group.attrib["pitchKeyTrack"]) == ("0", "0")
    keys = [int(sample.attrib["loNote"]) for sample in group]
    assert keys == sorted({key for low, high in key_ranges(KEYS) for key in range(low, high + 1)})
    ratios = []
    for sample in group:
        data, rate = soundfile.read(folders["decent-sampler"] / sample.attrib["path"])
        gain = 10 ** (float(sample.attrib["volume"].removesuffix("dB")) / 20)
        expected = NOISES.sound(int(sample.attrib["loNote"]), 64, 9.0, rate)
        ratios.append(gain * np.linalg.norm(data) / np.linalg.norm(expected))
    assert ratios == pytest.approx([ratios[0]] * len(ratios), rel=2e-3)


def test_layers_are_blended_as_the_format_can(tmp_path):
    options = ExportOptions(3, 0.2, kind="wav", resonance=False)
    export_sampler(PIANO, tmp_path / "plain", [60], options._replace(blend="plain"), to="decent-sampler")
    root = ElementTree.parse(tmp_path / "plain" / "twin.dspreset").getroot()  # noqa: S314
    velocities = [range(int(group[0].attrib["loVel"]), int(group[0].attrib["hiVel"]) + 1) for group in strokes(root)]
    assert [v for own in velocities for v in own] == list(range(1, 128))
    assert not root.findall("modulators/midiVelocity/binding")
    for blend, layers, name in (("xfade", 3, "blend"), ("plain", 1, "layers"), ("none", 3, "blend")):
        with pytest.raises(ParameterError, match=name):
            export_sampler(PIANO, tmp_path / "x", [60], ExportOptions(layers, blend=blend), to="decent-sampler")


# --- sound ---

PLAYED = [28, 55, 100]
LAYERS = 8
RATE = 48_000


@pytest.fixture(scope="module")
def player(tmp_path_factory) -> Callable[..., np.ndarray]:
    """(key, MIDI velocity, s until release, right pedal) -> 1.5 s of sound by the preset, without release noise."""
    out = tmp_path_factory.mktemp("played") / "sampler"
    options = ExportOptions(LAYERS, 1.5, kind="wav")
    export_sampler(PIANO, out, PLAYED, options, to="decent-sampler")
    tree = ElementTree.parse(out / "twin.dspreset").getroot()  # noqa: S314
    tables = {}
    for binding in tree.findall("modulators/midiVelocity/binding"):
        points = [pair.split(",") for pair in binding.attrib["translationTable"].split(";")]
        tables[int(binding.attrib["groupIndex"])] = np.array(points, float).T
    groups = strokes(tree)

    def play(key: int, velocity: int, held: float = 1.5, pedal: int = 0) -> np.ndarray:
        sound, t = np.zeros(round(1.5 * RATE)), np.arange(round(1.5 * RATE)) / RATE
        for i, group in enumerate(groups):
            if not int(group.attrib.get("loCC64", 0)) <= pedal <= int(group.attrib.get("hiCC64", 127)):
                continue
            for sample in group:
                attributes = sample.attrib
                if not int(attributes["loNote"]) <= key <= int(attributes["hiNote"]):
                    continue
                if not int(attributes["loVel"]) <= velocity <= int(attributes["hiVel"]):
                    continue
                assert group.attrib["ampVelTrack"] == "0"  # otherwise the velocity would count twice
                data, rate = soundfile.read(out / attributes["path"])
                place = t * rate * 2 ** ((key - int(attributes["rootNote"])) / 12)
                sampled = np.interp(place, np.arange(len(data)), data, right=0.0)
                if attributes.get("ampEnvEnabled") != "false":  # 60 dB in the time of the release
                    sampled *= 10 ** (-3 * np.maximum(t - held, 0) / float(group.attrib["release"]))
                sound += np.interp(velocity / 127, *tables[i]) * sampled
        return sound

    return play


def level(sound: np.ndarray) -> float:
    """Level of the first second, dB."""
    return 10 * np.log10(np.mean(sound[:RATE] ** 2))


def test_loudness_follows_velocity_as_renders_does(player):
    """Within 0.15 dB at all velocities, with one gain for all keys. No step of one velocity exceeds 0.6 dB."""
    off = []
    for midi in PLAYED:
        loud = np.array([level(player(midi, v)) for v in range(1, 128, 3)])
        assert np.diff(loud).min() > 0
        assert np.diff(loud).max() < 3 * 0.6
        for velocity in range(1, 128, 9):
            rendered = PIANO.note(midi, velocity).render(seconds=1.0, rate=RATE)
            off.append(loud[(velocity - 1) // 3] - level(rendered))
    assert np.ptp(off) < 0.15


def test_onsets_are_renders(player):
    """At the velocities of layers except the softest. Soft layers are shifted to align with the next louder one."""
    for midi in PLAYED:
        late = []
        for velocity in layer_velocities(LAYERS)[1:]:
            rendered = PIANO.note(midi, velocity).render(seconds=1.0, rate=RATE)
            late.append(fractional_lag(rendered, player(midi, velocity)[:RATE]) / RATE)
        assert np.ptp(late) < 2e-3
        assert abs(late[-1]) < 5e-3  # a sample begins just before it becomes audible


def test_a_release_is_the_dampers(player):
    held, released = player(55, 100), player(55, 100, 0.5)
    at = (np.array([0.52, 0.56]) * RATE).astype(int)
    ratio = [np.sqrt(np.mean(released[i:][:960] ** 2) / np.mean(held[i:][:960] ** 2)) for i in at]
    assert np.log(ratio[0] / ratio[1]) / 0.04 == pytest.approx(PIANO.dampers.rates(55, np.array([196.0]))[0], rel=0.03)
    assert player(100, 100, 0.5) == pytest.approx(player(100, 100), abs=0)


def test_free_strings_sound_under_the_right_pedal(player):
    """At the velocity of the sampled stroke, the sound is that of `render_song` with the pedal down."""
    velocity = layer_velocities(LAYERS)[LAYERS // 2]
    song = Song({55: [(0.0, velocity), (9.0, 0)]}, [(0.0, 127)], 9.0, 1)
    expected, found = render_song(PIANO, song).samples[0][: round(1.3 * RATE)], player(55, velocity, pedal=127)
    late = round(fractional_lag(expected, found[: len(expected)]))
    a, b = expected[max(-late, 0) :][: RATE + 9_600], found[max(late, 0) :][: RATE + 9_600]
    gain = (a @ b) / (a @ a)
    assert np.mean((b - gain * a)[2_400:] ** 2) < 1e-3 * np.mean((gain * a)[2_400:] ** 2)
    dry = player(55, velocity)[max(late, 0) :][: RATE + 9_600]
    assert np.mean((b - dry) ** 2) > 1e-2 * np.mean(dry**2)
