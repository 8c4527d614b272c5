"""SFZ libraries: the key of each sample, and the regions and files that are left out or rejected."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from pianofit.batch import read_keys
from pianofit.batch.sfz_text import MAX_DEPTH, SfzText, regions, unrecognised_opcodes
from pianofit.errors import SetupError
from pianofit.io.files import encode_wav


def library(folder: Path, text: str | bytes, *names: str) -> Path:
    """An SFZ file, and samples or other files whose content is their own name."""
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(name.encode())
    (folder / "p.sfz").write_bytes(text if isinstance(text, bytes) else text.encode())
    return folder / "p.sfz"


def keys_of(source: Path, **more) -> dict[str, list[str]]:
    return {key.name: [s.file.name for s in key.samples] for key in read_keys(source, **more)[0]}


def tone(hertz: float, rate: int = 22_050, seconds: float = 0.6) -> np.ndarray:
    """A decaying tone of 12 partials."""
    t = np.arange(round(seconds * rate)) / rate
    return sum(0.1 / k * np.sin(2 * np.pi * k * hertz * t) * np.exp(-2 * t) for k in range(1, 13))


SFZ = r"""// a piano, samples/*.wav
<control> default_path=..\samples\ #define $LOUD 90
<global> ampeg_release=1 /* over
two lines */
<group> lovel=1 hivel=89
<region> sample=soft one.wav lokey=59 hikey=61 pitch_keycenter=60
<region> key=c#4 sample=cs.wav
<group> lovel=$LOUD hivel=127
<region> sample=loud.wav pitch_keycenter=60
<region> sample=loud.wav lokey=62 hikey=63 pitch_keycenter=60
#include "more.sfz"
<group> trigger=release <region> sample=release.wav key=60
<region> sample=*sine key=60
"""


def test_an_sfz_file_names_keys_velocities_and_samples(tmp_path):
    library(tmp_path, "", *(f"samples/{n}.wav" for n in ("soft one", "cs", "loud", "release", "D4")))
    (tmp_path / "sfz").mkdir()
    (tmp_path / "sfz" / "more.sfz").write_text("<region> sample=D4.wav key=d4 // the end")
    keys, remarks = read_keys(library(tmp_path / "sfz", SFZ), root=tmp_path)
    assert {k.name: [s.file.name for s in k.samples] for k in keys} == {
        "C4": ["loud.wav", "soft one.wav"], "Cs4": ["cs.wav"], "D4": ["D4.wav"],
    }  # fmt: skip
    assert [s.layer for s in keys[0].samples] == ["v090-127", "v001-089"]
    assert [s.midi_velocity for s in keys[0].samples] == [108.5, 45.0]
    assert len(remarks) == 1
    assert "1 region without a recorded sample" in remarks[0]
    assert "1 region on release" in remarks[0]


def test_samples_of_one_range_of_velocities_are_numbered(tmp_path):
    library(tmp_path, "", *(f"samples/{n}.wav" for n in ("a", "b", "c")))
    text = "<region> sample=samples/{}.wav key=60 seq_position={}\n"
    keys, _ = read_keys(library(tmp_path, "".join(text.format(name, i) for i, name in enumerate("abc", 1))))
    assert {s.file.stem: s.layer for s in keys[0].samples} == {"a": "v001-127", "b": "v001-127 2", "c": "v001-127 3"}


def test_an_sfz_file_may_not_leave_its_folder(tmp_path):
    library(tmp_path, "", "samples/soft one.wav")
    (tmp_path / "sfz").mkdir()
    with pytest.raises(SetupError, match=r"region 1: .*leads out of .*--root"):
        read_keys(library(tmp_path / "sfz", SFZ.replace("#include", "//")))
    with pytest.raises(SetupError, match=r"includes \.\./p\.sfz leads out"):
        read_keys(library(tmp_path / "sfz", '#include "../p.sfz"'))


# --- the text ---------------------------------------------------------------------------------------------------------


def test_any_number_of_includes_is_read(tmp_path):
    """88 keys with five layers each include one template, with variables that are defined again each time."""
    lines = [f'<region> lovel={v} #define $KEY {k} #include "key.txt"' for k in range(21, 109) for v in range(1, 6)]
    source = library(tmp_path, "\n".join(lines), *(f"s{k}.wav" for k in range(21, 109)))
    (tmp_path / "key.txt").write_text("sample=s$KEY.wav\nkey=$KEY\n")
    keys = keys_of(source)
    assert len(keys) == 88
    assert keys["A0"] == ["s21.wav"]
    assert keys["C8"] == ["s108.wav"]


@pytest.mark.parametrize("files", [("p",), ("p", "a"), ("p", "a", "b")])
def test_a_file_that_includes_itself_is_refused(tmp_path, files):
    for name, other in zip(files, (*files[1:], files[0]), strict=True):
        (tmp_path / f"{name}.sfz").write_text(f'<region> key=60 sample=x.wav\n#include "{other}.sfz"\n')
    with pytest.raises(SetupError, match=r"#include") as caught:
        read_keys(tmp_path / "p.sfz")
    assert f"{files[-1]}.sfz" in str(caught.value)


def test_a_file_may_be_included_twice_by_others(tmp_path):
    source = library(tmp_path, '#include "a.sfz"\n#include "b.sfz"\n<region> key=60 sample=x.wav', "x.wav")
    (tmp_path / "a.sfz").write_text('#include "b.sfz"')
    (tmp_path / "b.sfz").write_text("<global> ampeg_release=1\n")
    assert keys_of(source) == {"C4": ["x.wav"]}


def test_includes_that_double_in_every_file_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("pianofit.batch.sfz_text.MAX_TEXT", 2**20)
    for i in range(40):
        (tmp_path / f"{i}.sfz").write_text(f'#include "{i + 1}.sfz"\n' * 2)
    (tmp_path / "40.sfz").write_text("<region> key=60 sample=x.wav\n" * 200)
    with pytest.raises(SetupError, match="more than 1 MiB"):
        read_keys(tmp_path / "0.sfz")


def test_many_includes_of_nothing_end(tmp_path, monkeypatch):
    """An include counts as 200 characters: 5,000 fit into 1 MiB, and 6,000 do not."""
    monkeypatch.setattr("pianofit.batch.sfz_text.MAX_TEXT", 2**20)
    (tmp_path / "a").write_text(" ")
    lines = "#include a\n"  # without quotation marks
    assert keys_of(library(tmp_path, lines * 4500 + "<region> key=53 sample=x.wav", "x.wav")) == {"F3": ["x.wav"]}
    with pytest.raises(SetupError, match="more than 1 MiB"):
        read_keys(library(tmp_path, lines * 6000))


def test_variables_that_double_are_refused(tmp_path):
    text = "#define $A xxxxxxxxxx\n" + "#define $A $A$A\n" * 60
    with pytest.raises(SetupError, match="more than 16 MiB"):
        read_keys(library(tmp_path, text))


def test_a_chain_of_includes_without_end_is_refused(tmp_path):
    for i in range(MAX_DEPTH + 1):
        (tmp_path / f"{i}.sfz").write_text(f'#include "{i + 1}.sfz"\n')
    with pytest.raises(SetupError, match=f"more than {MAX_DEPTH} files"):
        read_keys(tmp_path / "0.sfz")


def test_an_included_file_is_sought_at_the_library_and_then_at_the_file_that_names_it(tmp_path):
    source = library(tmp_path, r'#include "maps\one.sfz"', "x.wav", "maps/y.wav")
    (tmp_path / "maps" / "one.sfz").write_text('#include "two.sfz"\n')
    (tmp_path / "maps" / "two.sfz").write_text("<region> key=60 sample=x.wav")
    assert keys_of(source) == {"C4": ["x.wav"]}


def test_an_included_file_whose_case_differs_has_a_hint(tmp_path):
    source = library(tmp_path, '#include "Map.sfz"', "map.sfz")
    if (tmp_path / "Map.sfz").exists():
        pytest.skip("this disk finds the file by either name")
    with pytest.raises(SetupError, match=r"did you mean map\.sfz"):
        read_keys(source)


@pytest.mark.parametrize(
    "text",
    [
        "<region>key=53 sample=a b.wav// loud",
        "<region> sample=a b.wav /* key=60 */ key=53",
        "<region>\r\nsample=a b.wav\r\nkey=53\r\n",
        "// see samples/*.wav\n<region> sample=a b.wav key=53 // and more/*.wav\n// */",
        '<region> sample="a b.wav" key=53',
        "#define $N 5\n<region> sample=a b.wav key=$N3",
        "#define $NOTE 60\n#define $NOTE_LOW 53\n<region> sample=a b.wav key=$NOTE_LOW",
        "#define $SHARP #\n<region> sample=a b.wav key=e$SHARP3",
        "#define $EMPTY\n<region> sample=$EMPTYa b.wav key=53",
        "<REGION> Sample=a b.wav Key=53",
        "<master> key=60 <group> key=53 <region> sample=a b.wav",
        "<global> pitch_keycenter=60 hikey=-1 <region> sample=a b.wav key=53",
        "<global> sample=a b.wav <region> key=53 <curve> v000=0 <effect> bus=main",
        "<control> default_path=x/../ <region> sample=a b.wav key=53",
        "<region> sample=./x/../a b.wav key=f3",
        "<region> sample=/a b.wav key=F3",
        "<region> sample=a b.wav pitch_keycenter=53.0 lokey=50 hikey=54",
        "<region> sample=a b.wav lokey=53 hikey=53 pitch_keytrack=0",
        "<region> sample=a b.wav key=53 loop_mode=loop_continuous loop_start=100 loop_end=200",
        "<control> octave_offset=1 <region> sample=a b.wav key=41",
        "<control> octave_offset=-1 note_offset=2 <region> sample=a b.wav pitch_keycenter=d#4",
        "<control> note_offset=12 <region> sample=a b.wav lokey=38 hikey=43 pitch_keycenter=41",
    ],
)
def test_text_as_libraries_have_it(tmp_path, text):
    assert keys_of(library(tmp_path, text, "x/y.wav", "a b.wav")) == {"F3": ["a b.wav"]}


def test_text_that_is_not_utf_8_is_read_with_a_remark(tmp_path):
    source = library(tmp_path, "// \xa9 2004\n<region> sample=fl\xfcgel.wav key=53".encode("cp1252"), "flügel.wav")
    keys, remarks = read_keys(source)
    assert keys[0].samples[0].file.name == "flügel.wav"
    assert "p.sfz" in remarks[0]


@pytest.mark.parametrize("text", ["<region> key=53".encode("utf-16"), b"<region> key=53 sample=\0.wav"])
def test_what_is_not_text_is_refused(tmp_path, text):
    with pytest.raises(SetupError, match=r"p\.sfz: (is UTF-16|has a zero byte)"):
        read_keys(library(tmp_path, text))


def test_a_path_with_backslashes_at_both_ends_is_relative(tmp_path):
    text = "<control>\ndefault_path=\\samples\\\n<region> key=53 sample=a.wav"
    assert keys_of(library(tmp_path, text, "samples/a.wav")) == {"F3": ["a.wav"]}


# --- the regions ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("opcodes", "reason"),
    [
        ("lokey=-1 hikey=-1 on_locc64=64 on_hicc64=127", "controller"),
        ("key=-1", "controller"),
        ("hikey=-1", "controller"),
        ("start_locc64=126 start_hicc64=127 key=60", "controller"),
        ("on_lohdcc64=0.9 key=60", "controller"),
        ("key=60 trigger=release", "release"),
        ("key=60 trigger=release_key", "release"),
        ("key=60 locc64=64", "pedal"),
        ("key=60 locc67=1 hicc67=127", "pedal"),
        ("key=60 lovel=0 hivel=0", "empty"),
        ("key=60 lovel=100 hivel=90", "empty"),
        ("lokey=62 hikey=60", "empty"),
        ("key=60 end=-1", "sample"),
        ("key=60 sample=*silence", "sample"),
        ("key=3", "piano"),
        ("key=120", "piano"),
        ("key=x", "piano"),
        ("pitch_keycenter=200 lokey=60 hikey=61", "piano"),
    ],
)
def test_a_region_that_no_struck_key_starts_is_left_out_and_counted(tmp_path, opcodes, reason):
    """It neither becomes a key nor has the library refused."""
    text = f"<region> key=53 sample=a.wav <region> sample=other.wav {opcodes}"
    keys, remarks = read_keys(library(tmp_path, text, "a.wav", "other.wav"))
    assert [(k.name, len(k.samples)) for k in keys] == [("F3", 1)]
    assert len(remarks) == 1 + ("start_" in opcodes)  # an older name
    assert "1 region " in remarks[0]
    assert reason in remarks[0]


def test_a_library_without_any_key_says_why(tmp_path):
    with pytest.raises(SetupError, match="2 regions on release"):
        read_keys(library(tmp_path, "<global> trigger=release <region> sample=a.wav <region> sample=b.wav", "a.wav"))


def test_round_robins_and_microphones_of_one_file_name_are_recordings_of_one_key(tmp_path):
    names = [f"{folder}/F3.wav" for folder in ("rr1", "rr2", "far")]
    text = "<global> key=53 seq_length=2\n" + "".join(f"<region> sample={n} seq_position=1\n" for n in names)
    keys, remarks = read_keys(library(tmp_path, text, *names))
    assert [(k.name, len(k.samples), len({s.layer for s in k.samples})) for k in keys] == [("F3", 3, 3)]
    assert len(remarks) == 1  # all at the first position: one stroke starts them together
    assert "mic" in remarks[0]
    assert "F3" in remarks[0]


def test_microphones_with_a_volume_each_are_named(tmp_path):
    """Each master is silent when its controller is at 0, and both are up by default."""
    text = "".join(f"<master> locc2{n}=1 <region> key=53 sample={n}.wav\n" for n in (1, 2))
    _, remarks = read_keys(library(tmp_path, text, "1.wav", "2.wav"))
    assert any("mic" in remark and "F3" in remark for remark in remarks)


@pytest.mark.parametrize("opcodes", ["seq_position={}", "lorand=0.{} hirand=0.5", "lovel={}", "sw_last={}"])
def test_samples_that_a_player_chooses_among_are_different_strokes(tmp_path, opcodes):
    text = "".join(f"<region> key=53 sample={n}.wav {opcodes.format(n)}\n" for n in (1, 2))
    _, remarks = read_keys(library(tmp_path, text, "1.wav", "2.wav"))
    assert not any("mic" in remark for remark in remarks)


def test_a_copy_of_a_sample_is_left_out_of_its_key(tmp_path):
    """Round robins of some libraries are one file under several names. A joint fit must count each recording once."""
    names = ("a.wav", "b.wav", "c.wav", "d.wav")
    source = library(tmp_path, "".join(f"<region> key=53 sample={n}\n" for n in names), *names)
    (tmp_path / "c.wav").write_bytes(b"a.wav")
    keys, remarks = read_keys(source)
    assert [s.file.name for s in keys[0].samples] == ["a.wav", "b.wav", "d.wav"]
    assert any("copies" in remark and "c.wav" in remark for remark in remarks)


def test_a_missing_sample_is_named_with_its_region(tmp_path):
    text = "<region> key=53 sample=a.wav <region> key=53 sample=lost.wav <region> key=54 sample=gone.wav"
    with pytest.raises(SetupError, match=r"region 2: lost\.wav.*region 3: gone\.wav"):
        read_keys(library(tmp_path, text, "a.wav"))


def test_a_key_with_more_samples_than_a_fit_takes_keeps_all_its_velocities(tmp_path):
    names = [f"{v:03d}-{turn}.wav" for v in range(1, 128, 2) for turn in (1, 2)]
    text = "".join(f"<region> key=53 sample={n} lovel={int(n[:3])} hivel={int(n[:3]) + 1}\n" for n in names)
    keys, remarks = read_keys(library(tmp_path, text, *names))
    assert [s.layer[1:4] for s in keys[0].samples] == [f"{v:03d}" for v in range(1, 128, 2)]
    assert "F3" in remarks[0]


def test_a_library_can_be_transposed(tmp_path):
    text = "<region> key=96 sample=a.wav <region> key=107 sample=b.wav"
    assert keys_of(library(tmp_path, text, "a.wav", "b.wav"), transpose=12) == {"C8": ["a.wav"]}


@pytest.mark.parametrize(("midi", "note"), [(53, "F3"), (65, "F4")])
def test_a_sample_at_two_roots_is_of_the_key_that_it_detected_note(tmp_path, midi, note):
    text = "<region> lokey=50 hikey=55 pitch_keycenter=53 sample=a.wav\n" \
           "<region> lokey=62 hikey=67 pitch_keycenter=65 sample=./a.wav\n"  # fmt: skip
    source = library(tmp_path, text)
    (tmp_path / "a.wav").write_bytes(encode_wav(tone(440 * 2 ** ((midi - 69) / 12)), 22_050))
    keys, remarks = read_keys(source)
    assert [(k.name, len(k.samples)) for k in keys] == [(note, 1)]
    assert all(word in remarks[0] for word in ("a.wav", "F3", "F4"))


def test_a_sample_at_two_roots_without_a_pitch_is_of_the_first(tmp_path):
    text = "<region> pitch_keycenter=65 sample=a.wav <region> pitch_keycenter=53 sample=a.wav"
    assert keys_of(library(tmp_path, text, "a.wav")) == {"F4": ["a.wav"]}


# --- names of opcodes -------------------------------------------------------------------------------------------------


def test_opcodes_that_the_format_does_not_define_are_named(tmp_path):
    text = "<region> key=53 sample=a.wav pitch_keycentre=60 ampeg_release=1 frobnicate=2"
    _, remarks = read_keys(library(tmp_path, text, "a.wav"))
    assert len(remarks) == 1
    assert "frobnicate" in remarks[0]
    assert "did you mean pitch_keycenter" in remarks[0]
    assert "ampeg" not in remarks[0]


def test_opcodes_of_every_version_of_the_format_are_recognised():
    names = """sample default_path lokey hikey key lovel hivel trigger pitch_keycenter transpose tune volume pan width
    ampeg_attack ampeg_release ampeg_vel2decay ampeg_releasecc72 amp_veltrack amp_velcurve_64 amp_random rt_decay
    fil_type cutoff cutoff2 cutoff_cc74 cutoff_oncc74 cutoff2_curvecc74 resonance fil_veltrack fileg_depth
    eq1_freq eq3_gain_oncc20 eg06_time2 eg01_sustain lfo01_freq lfo01_volume lfo02_wave2 pitchlfo_depthcc1
    loop_mode loop_start offset offset_random end count delay delay_random group off_by off_mode
    off_time seq_length seq_position lorand hirand locc64 hicc64 on_locc1 xfin_lovel xf_velcurve
    xfin_locc1 sw_lokey sw_last sw_default sw_previous sw_label bend_up polyphony note_polyphony
    note_selfmask sustain_sw sustain_cc sostenuto_sw hint_ram_based set_cc1 label_cc1 label_key60 group_label
    region_label master_volume global_amplitude volume_oncc7 gain_oncc7 amplitude_oncc1 amplitude_curvecc1
    pitch_keytrack pitch_veltrack pitch_random tune_oncc1 effect1 effect2 fx1tomain bus oscillator
    oscillator_multi phase direction reverse_locc1 sample_quality image lochan hichan lobend lochanaft lopolyaft
    octave_offset note_offset curve_index varcc01 var01_mod amp_keytrack amp_keycenter noise_filter position
    position_oncc10 pan_oncc10 pitch_oncc1 pitcheg_depth fillfo_freq lotimer stop_locc64 load_mode md5 sync_beats"""
    assert unrecognised_opcodes(names.split()) == []
    assert len(unrecognised_opcodes(["smaple", "pitch_key_center", "zzz9", "lowvel"])) == 4


@pytest.mark.parametrize(
    ("older", "today"), [("loopmode", "loop_mode"), ("start_locc64", "on_locc64"), ("gain_cc7", "volume_oncc7")]
)
def test_older_names_are_named_with_todays(older, today):
    (found,) = unrecognised_opcodes([older])
    assert found.startswith(older)
    assert today in found


def test_articulations_by_key_switch_are_named(tmp_path):
    text = "".join(f"<region> key=53 sample={n}.wav sw_last={k}\n" for n, k in (("a", 24), ("b", 25)))
    _, remarks = read_keys(library(tmp_path, text, "a.wav", "b.wav"))
    assert any("key switch" in remark for remark in remarks)


def test_long_texts_take_linear_time(tmp_path):
    """Thousands of variables, each used before the next is defined, and comments that do not end."""
    text = "".join(f"#define $V{i} {i % 9}\n<region> key=$V{i}0 sample=$V{i}.wav\n" for i in range(20_000))
    source = library(tmp_path, text + "/*" * 200_000)
    begin = time.monotonic()
    found = [*regions(SfzText(source, tmp_path))]
    assert time.monotonic() - begin < 10
    assert found[19_998] == {"key": "00", "sample": "0.wav"}  # the longest name is replaced
