"""Setups: every key is read, and everything else is rejected."""

import math
from pathlib import Path

import numpy as np
import pytest
from bad_inputs import BAD_INPUTS, BadInput
from hypothesis import given, settings
from hypothesis import strategies as st

from pianofit.errors import SetupError
from pianofit.felt import ALL_PARAMETERS, LAWS
from pianofit.io.files import printable
from pianofit.setup import KEYS, RANGES, RecordingInfo, Setup, recording_info_for
from pianofit.transducer import QUANTITIES, TRANSDUCERS

FULL = """
# The experiment of the paper.
[string]
length = 1.0
mass = 0.00618
[strike]
position = 0.12
width = 0.02
[pickup]
quantity = "velocity"
position = 0.30
scale = 2.0
[fixed]
v_H0 = 0.84
[initial]
c = 310.6
b1 = 0.5
[bounds]
K_H = [1e8, 1e12]
c = [300, 320]
[[recording]]
file = "a.flac"
group = "close"
gain_group = "close"
stroke = "L4"
midi_velocity = 112.5
[[recording]]
file = "b.flac"
"""


def test_every_key_is_read(tmp_path):
    (tmp_path / "setup.toml").write_text(FULL)
    assert Setup.from_toml(tmp_path / "setup.toml") == Setup(
        length=1.0,
        mass=0.00618,
        strike_position=0.12,
        strike_width=0.02,
        pickup_quantity="velocity",
        pickup_position=0.30,
        pickup_scale=2.0,
        fixed={"v_H0": 0.84},
        initial={"c": 310.6, "b1": 0.5},
        bounds={"K_H": (1e8, 1e12), "c": (300.0, 320.0)},
        recordings=(RecordingInfo("a.flac", None, "close", "close", "L4", 112.5), RecordingInfo("b.flac")),
    )


@pytest.mark.parametrize("text", ["# nothing is given\n", "[string]\n[strike]\n[fixed]\n[bounds]\n"])
def test_all_of_it_is_optional(tmp_path, text):
    (tmp_path / "setup.toml").write_text(text)
    setup = Setup.from_toml(str(tmp_path / "setup.toml"))
    assert setup == Setup()
    assert (setup.pickup_quantity, setup.fixed, setup.recordings) == ("pressure", {}, ())


def test_windows_line_ends_and_byte_order_mark(tmp_path):
    (tmp_path / "setup.toml").write_bytes(b"\xef\xbb\xbf" + FULL.strip().replace("\n", "\r\n").encode())
    assert Setup.from_toml(tmp_path / "setup.toml").length == 1.0


def test_numbers_may_be_integers_and_become_floats():
    setup = Setup.from_dict({"string": {"length": 1}, "fixed": {"p": 3}, "bounds": {"c": [300, 310]}}, "here")
    assert [type(value) for value in (setup.length, setup.fixed["p"], *setup.bounds["c"])] == [float] * 4


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_every_pickup_has_one_complete_form(quantity):
    pickup = {"quantity": quantity}
    pickup |= {"position": 0.3} if TRANSDUCERS[quantity].on_string else {}
    pickup |= {} if TRANSDUCERS[quantity].unknown_path else {"scale": 0.5}
    setup = Setup.from_dict({"pickup": pickup}, "here")
    assert (setup.pickup_quantity, setup.pickup_position, setup.pickup_scale) == (
        quantity,
        pickup.get("position"),
        pickup.get("scale"),
    )


def test_recordings_may_have_velocities_of_their_own():
    setup = Setup.from_dict(
        {"recording": [{"file": "a.wav", "v_H0": 1}, {"file": "b.wav", "v_H0": 2.5}, {"v_H0": 1}]}, "here"
    )
    assert [recording.v_H0 for recording in setup.recordings] == [1.0, 2.5, 1.0]


@pytest.mark.parametrize("bad", [b for b in BAD_INPUTS if b.gate == "setup"], ids=lambda b: b.id)
def test_every_bad_setup_is_refused_in_one_line(tmp_path, bad: BadInput):
    bad.build(tmp_path)
    with pytest.raises(SetupError) as caught:
        Setup.from_toml(bad.bad_file(tmp_path))
    message = str(caught.value)
    assert bad.is_explained_by(message)
    assert message.startswith(printable(bad.bad_file(tmp_path)) + ": ")
    assert message.isprintable()
    assert len(message) < 300 + len(bad.bad_file(tmp_path))


@pytest.mark.parametrize("name", ALL_PARAMETERS)
@pytest.mark.parametrize("table", ["fixed", "initial"])
def test_parameters_stay_in_their_box(name, table):
    box = ALL_PARAMETERS[name]
    law = next(
        n for n, law in LAWS.items() if name in law.parameters or not any(name in x.parameters for x in LAWS.values())
    )
    for value in (box.lower, box.upper, math.sqrt(box.lower * box.upper)):
        setup = Setup.from_dict({"felt": {"law": law}, table: {name: value}}, "here")
        assert getattr(setup, table) == {name: value}
    for value in (box.lower * 0.999, box.upper * 1.001, -box.lower, 0.0, math.inf, math.nan, "1", None, True, [1.0]):
        with pytest.raises(SetupError, match=rf"here: \[{table}\] {name} = "):
            Setup.from_dict({table: {name: value}}, "here")


@pytest.mark.parametrize(("table", "key"), [(t, k) for t in ("string", "strike") for k in KEYS[t]])
def test_sizes_stay_in_their_range(table, key):
    lower, upper, unit = RANGES[key]
    for value in (lower * 0.999, upper * 1.001):
        with pytest.raises(SetupError, match=rf"here: \[{table}\] {key} = .* {unit}"):
            Setup.from_dict({table: {key: value}}, "here")


@pytest.mark.parametrize(
    ("position", "width", "length", "fits"),
    [
        (0.01, 0.02, 1.0, True),  # ends at the agraffe
        (0.0099, 0.02, 1.0, False),
        (0.99, 0.02, 1.0, True),  # ends at the bridge
        (0.9901, 0.02, 1.0, False),
        (0.5, 1.0, 1.0, True),
        (0.5, None, 0.5, True),
        (0.51, None, 0.5, False),
        (None, 0.02, 0.015, False),
        (0.99, 0.02, None, True),
    ],
)
def test_the_contact_window_lies_on_the_string(position, width, length, fits):
    strike = {key: value for key, value in (("position", position), ("width", width)) if value is not None}
    data = {"strike": strike, "string": {} if length is None else {"length": length}}
    if fits:
        assert Setup.from_dict(data, "here").strike_position == position
    else:
        with pytest.raises(SetupError, match="past the"):
            Setup.from_dict(data, "here")


def test_an_entry_is_of_the_recording_that_it_names():
    """Entries of other files are not used. An entry without a file applies to a single recording."""
    key = Setup(recordings=(RecordingInfo("far/soft.wav", 0.8), RecordingInfo("loud.wav", 3.0)))
    assert (
        recording_info_for(key, "near/loud.wav", alone=True).v_H0
        == recording_info_for(key, "loud.wav", alone=False).v_H0
        == 3.0
    )
    assert (
        recording_info_for(key, "other.wav", alone=True)
        == recording_info_for(key, "other.wav", alone=False)
        == RecordingInfo()
    )
    nameless = Setup(recordings=(RecordingInfo("soft.wav", 0.8), RecordingInfo(v_H0=2.0), RecordingInfo(v_H0=9.0)))
    assert recording_info_for(nameless, "soft.wav", alone=True).v_H0 == 0.8
    assert recording_info_for(nameless, "other.wav", alone=True).v_H0 == 2.0
    assert recording_info_for(nameless, "other.wav", alone=False) == RecordingInfo()


IN_PYTHON = [
    ({"fixed": {"KH": 1e9}}, "[fixed]\nKH = 1e9\n", "did you mean K_H?"),
    ({"bounds": {"p": (4, 2)}}, "[bounds]\np = [4, 2]\n", "lower must be below upper"),
    ({"felt": "foam"}, '[felt]\nlaw = "foam"\n', "must be one of hunt-crossley, power"),
    ({"length": "1.37 m"}, '[string]\nlength = "1.37 m"\n', "must be a number from 0.01 to 5 m"),
    ({"mass": 6.18}, "[string]\nmass = 6.18\n", "mass = 6.18"),
    ({"initial": {"p": True}}, "[initial]\np = true\n", "p = True"),
    ({"fixed": 3}, "fixed = 3\n", "must be a table"),
    ({"pickup_quantity": "light"}, '[pickup]\nquantity = "light"\n', "must be one of velocity"),
    ({"pickup_position": 0.3}, "[pickup]\nposition = 0.3\n", "has no meaning"),
    ({"strike_position": 0.01, "strike_width": 0.03}, "[strike]\nposition = 0.01\nwidth = 0.03\n", "past the agraffe"),
    ({"fixed": {"epsilon": 0.1}}, "[fixed]\nepsilon = 0.1\n", "not a parameter of the felt law"),
    ({"fixed": {"p": 2}, "initial": {"p": 3}}, "[fixed]\np = 2\n[initial]\np = 3\n", "remove one of them"),
    ({"recordings": [RecordingInfo()]}, "[[recording]]\n", "[[recording]] 1 is empty"),
    ({"recordings": [RecordingInfo(v_H0=100)]}, "[[recording]]\nv_H0 = 100\n", "[[recording]] 1 v_H0 = 100"),
    (
        {"recordings": [RecordingInfo("a"), {"file": 3}]},
        '[[recording]]\nfile = "a"\n[[recording]]\nfile = 3\n',
        "2 file = 3",
    ),
    ({"recordings": [{"fil": "a"}]}, '[[recording]]\nfil = "a"\n', "did you mean file?"),
    ({"recordings": [RecordingInfo("a"), RecordingInfo("a")]}, '[[recording]]\nfile = "a"\n' * 2, "given twice"),
]


@pytest.mark.parametrize(("arguments", "text", "message"), IN_PYTHON, ids=[message for *_, message in IN_PYTHON])
def test_python_is_checked_in_the_words_of_the_file(tmp_path, arguments, text, message):
    path = tmp_path / "setup.toml"
    path.write_text(text)
    with pytest.raises(SetupError) as from_file:
        Setup.from_toml(path)
    with pytest.raises(SetupError) as from_python:
        Setup(**arguments)
    assert message in str(from_python.value)
    assert str(from_file.value) == f"{path}: {from_python.value}"


def test_a_setup_is_plain_numbers_and_stays_as_it_was_checked():
    given = {"p": 3}
    setup = Setup(length=1, fixed=given, recordings=[{"v_H0": 2}])
    given["p"] = 99
    assert (setup.length, setup.fixed, setup.recordings) == (1.0, {"p": 3.0}, (RecordingInfo(v_H0=2.0),))
    assert type(setup.fixed["p"]) is type(setup.recordings[0].v_H0) is float
    assert Setup(length=np.float32(1.5), fixed={"p": np.int64(3)}) == Setup(length=1.5, fixed={"p": 3.0})


SCALAR = st.one_of(st.booleans(), st.integers(), st.floats(), st.text(max_size=5), st.none())
VALUE = st.one_of(SCALAR, st.lists(SCALAR, max_size=3), st.dictionaries(st.text(max_size=5), SCALAR, max_size=2))
NAME = st.one_of(st.sampled_from([*KEYS, *{key for keys in KEYS.values() for key in keys}]), st.text(max_size=8))
TABLE = st.one_of(VALUE, st.dictionaries(NAME, VALUE, max_size=3))


@settings(max_examples=300, deadline=None)
@given(st.dictionaries(NAME, st.one_of(TABLE, st.lists(TABLE, max_size=2)), max_size=3))
def test_anything_at_all_is_a_setup_or_a_setup_error(data):
    try:
        setup = Setup.from_dict(data, "here")
    except SetupError as error:
        message = str(error)
    else:
        message = f"here: {setup.pickup_quantity}"
    assert message.startswith("here: ")
    assert message.isprintable()


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=60))
def test_any_bytes_at_all_are_a_setup_or_a_setup_error(tmp_path_factory, data):
    path: Path = tmp_path_factory.mktemp("setup") / "setup.toml"
    path.write_bytes(data)
    try:
        message = f"{path}: {Setup.from_toml(path).pickup_quantity}"
    except SetupError as error:
        message = str(error)
    assert message.startswith(f"{path}: ")
    assert message.isprintable()


def test_the_corpus_of_bad_inputs_is_large_and_its_names_differ():
    assert len(BAD_INPUTS) >= 60
    assert len({bad.id for bad in BAD_INPUTS}) == len(BAD_INPUTS)
    for command in ("fit", "analyse", "simulate", "render", "demo"):
        assert any(bad.args[0] == command for bad in BAD_INPUTS)
