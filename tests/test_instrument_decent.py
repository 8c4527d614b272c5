"""The folder for Decent Sampler: its text against the format's documentation, its gains against the SFZ's."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import soundfile
from instrument_cases import true_instrument

from pianofit.play import SAMPLERS, Asked, export_sampler
from pianofit.play.layers import spans_of
from pianofit.play.strings import damper_rate

KEYS = [55, 60, 100]
# From the developer's guide, version 1.22.2: elements, those they may stand in, and of their attributes those needed
# and those allowed, of the ones that can be set here.
ELEMENTS = {
    "DecentSampler": (None, set(), {"minVersion"}),
    "groups": ("DecentSampler", set(), {"attack", "decay", "sustain", "release"}),
    "group": ("groups", set(), {"ampVelTrack", "volume", "tags"}),
    "sample": ("group", {"path", "rootNote"},
               {"loNote", "hiNote", "loVel", "hiVel", "volume", "release", "ampEnvEnabled"}),
    "modulators": ("DecentSampler", set(), set()),
    "midiVelocity": ("modulators", set(), {"modAmount", "scope"}),
    "binding": ("midiVelocity", {"type", "level", "parameter"},
                {"groupIndex", "modBehavior", "translation", "translationTable"}),
}  # fmt: skip


@pytest.fixture(scope="module")
def folders(tmp_path_factory) -> dict[str, Path]:
    place = tmp_path_factory.mktemp("out")
    for to in SAMPLERS:
        asked = Asked(3, 0.3, kind=SAMPLERS[to].kind)
        export_sampler(true_instrument(), place / to, KEYS, asked, to=to, licence="<&>")
    return {to: place / to for to in SAMPLERS}


@pytest.fixture(scope="module")
def root(folders) -> ElementTree.Element:
    return ElementTree.parse(folders["decent-sampler"] / "twin.dspreset").getroot()  # noqa: S314


def test_the_text_is_what_the_format_documents(root):
    assert root.tag == "DecentSampler"
    for parent in root.iter():
        for child in parent:
            within, needed, allowed = ELEMENTS[str(child.tag)]
            assert parent.tag == within
            assert needed <= set(child.attrib) <= needed | allowed
    assert len(root.findall("groups")) == 1


def test_samples_are_there_as_wav(root, folders):
    names = [sample.attrib["path"] for sample in root.iter("sample")]
    assert len(set(names)) == len(names) == 9
    for name in names:
        info = soundfile.info(folders["decent-sampler"] / name)
        assert (info.format, info.subtype) == ("WAV", "PCM_24")
    assert "<&>" in (folders["decent-sampler"] / "README.txt").read_text()


def test_every_key_and_velocity_has_the_gains_of_the_sfz(root, folders):
    """Group by group, through the table as the format describes it: linear between its points, velocity from 0 to 1."""
    lines = (folders["sfz"] / "twin.sfz").read_text().splitlines()
    regions = [dict(word.split("=", 1) for word in line.split()[1:]) for line in lines if "<region>" in line]
    groups, bindings = root.findall("groups/group"), root.findall("modulators/midiVelocity/binding")
    assert len(regions) == len(groups) == len(bindings)
    covered = set()
    for i, (region, group, binding) in enumerate(zip(regions, groups, bindings, strict=True)):
        (sample,) = group
        assert (binding.attrib["groupIndex"], binding.attrib["parameter"]) == (str(i), "AMP_VOLUME")
        assert Path(region["sample"]).stem == Path(sample.attrib["path"]).stem
        table = np.array([pair.split(",") for pair in binding.attrib["translationTable"].split(";")], float)
        assert (np.diff(table[:, 0]) > 0).all()
        assert 0 <= table.min() <= table.max() <= 1
        assert (sample.attrib["loVel"], sample.attrib["hiVel"]) == (region["lovel"], region["hivel"])
        for velocity in range(int(region["lovel"]), int(region["hivel"]) + 1):
            expected = float(region[f"amp_velcurve_{velocity}"])
            assert np.interp(velocity / 127, *table.T) == pytest.approx(expected, rel=1e-3)
        covered |= {(k, v) for k in range(int(sample.attrib["loNote"]), int(sample.attrib["hiNote"]) + 1)
                    for v in range(int(sample.attrib["loVel"]), int(sample.attrib["hiVel"]) + 1)}  # fmt: skip
    keys = {key for low, high in spans_of(KEYS) for key in range(low, high + 1)}
    assert covered == {(k, v) for k in keys for v in range(1, 128)}


def test_dampers_are_releases_and_the_treble_rings_on(root):
    for sample in root.iter("sample"):
        rate = damper_rate(int(sample.attrib["rootNote"]))
        if rate:
            assert float(sample.attrib["release"]) == pytest.approx(np.log(1000) / rate, rel=1e-3)
        else:
            assert sample.attrib["ampEnvEnabled"] == "false"
            assert "release" not in sample.attrib
