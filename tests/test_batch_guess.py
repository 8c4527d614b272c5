"""The pattern of file names is guessed from the names alone, and every name that it matches has the correct note."""

from __future__ import annotations

import itertools

import pytest

from pianofit.analysis.note_names import midi_to_note, note_to_midi
from pianofit.batch import read_keys
from pianofit.batch.name_pattern import MIN_VALUE_RATIO, expression_of, guess_pattern, midi_number_offset
from pianofit.errors import SetupError

NOTES = ("A0", "C2", "F#2", "Bb3", "C4", "D#5")


def names(form: str, notes=NOTES, **values: tuple) -> list[str]:
    """File names from a template with {n} for the note, {m} for its MIDI number, and other fields."""
    rows = itertools.product(notes, *values.values())
    return [form.format(n=n, m=note_to_midi(n), **dict(zip(values, rest, strict=True))) for n, *rest in rows]


LIBRARIES = {
    "words": (names("grand-{n}-{v}", v=("soft", "loud")), "{instrument}-{note}-{layer}"),
    "one file": (["grand-F#2-soft"], "{instrument}-{note}-{layer}"),
    "note first": (names("{n}_{v}", v=("pp", "mf")), "{note}_{layer}"),
    "dynamics before the note": (names("Piano.{v}.{n}", v=("pp", "ff")), "{instrument}.{layer}.{note}"),
    "MIDI number and name": (names("{m:03d}-{n}-v{v}", v=(64, 100)), "{*}-{note}-{layer}"),
    "no separator": ([*names("{n}v{v}", v=range(1, 17)), "rel1", "rel30", "pedalD1", "harmLA0"], "{note}{layer}"),
    "MIDI number": (names("{m}_{v}", v=(30, 127)), "{note}_{layer}"),
    "microphones": (names("Grand D-{n}-{v}-{k}", v="pf", k=("close", "room")), "{instrument}-{note}-{layer}-{mic}"),
    "microphones by letters": (names("{n}_{v}_{k}", v="pf", k="LR"), "{note}_{layer}_{mic}"),
    "numbered layers": (names("{n}-L{v}", v=(1, 2, 3)), "{note}-{layer}"),  # as `pianofit cut` names them
    "round robins": (names("{n}_{v}_R{r}", v="pf", r=(1, 2)), "{note}_{layer}_{take}"),
    "folders of layers": (names("{v}/{n}", v=("p", "f")), "{layer}/{note}"),
    "two instruments": (names("{i}-{n}-{v}", i=("cp80", "grand"), v="pf"), "{instrument}-{note}-{layer}"),
    "capital letter": (names("Piano{n}"), "{instrument}{note}"),
    "layers and takes": (names("{n}_{v}_rr{r}", v="pf", r=(1, 2)), "{note}_{layer}_{take}"),
    "brackets": (names("{n} [{v}]", v=("mp", "ff")), "{note} [[{layer}]]"),
    "optional brackets": (names("{n}[{v}]", v=("mp", "ff")) + names("{n}", NOTES[:2]), "{note}[[[{layer}]]]"),
    "a layer that may be missing": (names("a-{n}") + names("a-{n}-soft", NOTES[:4]), "{instrument}-{note}[-{layer}]"),
    "a folder of the note": (names("{n}/{n}-{v}", v="pf"), "{note}/{*}-{layer}"),
    "note alone": (["C4"], "{note}"),
}


@pytest.mark.parametrize("library", LIBRARIES)
def test_the_pattern_of_a_library_is_guessed(library):
    listed, expected = LIBRARIES[library]
    assert guess_pattern(listed) == expected
    assert guess_pattern(listed[::-1]) == expected  # in any order


@pytest.mark.parametrize("library", [name for name in LIBRARIES if name != "MIDI number"])
def test_every_name_that_is_read_has_its_note(library):
    listed, _ = LIBRARIES[library]
    expression = expression_of(guess_pattern(listed))
    read = {name: note_to_midi(match["note"]) for name in listed if (match := expression.fullmatch(name))}
    assert len(read) >= len(listed) - 4
    assert all(any(note in name for note in NOTES if note_to_midi(note) == midi) for name, midi in read.items())


@pytest.mark.parametrize("listed", [["take1", "take2", "strange"], names("{m}_{v}", NOTES[:3], v=(30, 60, 90))])
def test_nothing_is_guessed_where_the_note_is_not_clear(listed):
    assert guess_pattern(listed) is None


def test_a_number_is_the_note_where_it_has_clearly_more_values():
    def library(keys: int) -> list[str]:
        return names("{m}_{v}", [midi_to_note(36 + i) for i in range(keys)], v=(30, 60, 90))

    assert guess_pattern(library(3 * MIN_VALUE_RATIO)) == "{note}_{layer}"
    assert guess_pattern(library(3 * MIN_VALUE_RATIO - 1)) is None


def test_numbers_that_count_octaves_otherwise_are_found():
    assert midi_number_offset(names("{m:03d}-{n}-v{v}", v=(64, 100))) == 0
    assert midi_number_offset([f"{note_to_midi(n) + 12}-{n}-v{v}" for n in NOTES for v in (64, 100)]) == 12
    assert midi_number_offset(names("{n}-v{v}", v=(64, 100))) == 0


def test_a_folder_is_read_by_the_guess_and_the_guess_is_said(tmp_path):
    for name in ["Piano.pp.C4.aiff", "Piano.ff.C4.aiff", "Piano.pp.Db4.aiff", "notes.txt", "noise.wav"]:
        (tmp_path / name).write_bytes(name.encode())
    keys, remarks = read_keys(tmp_path)
    assert [(key.name, [sample.layer for sample in key.samples]) for key in keys] == [
        ("Piano-C4", ["ff", "pp"]), ("Piano-Cs4", ["pp"]),
    ]  # fmt: skip
    assert any("--pattern" in remark and "{instrument}.{layer}.{note}" in remark for remark in remarks)
    assert any("noise.wav" in remark for remark in remarks)


@pytest.mark.parametrize(
    ("files", "named"), [(["C4.m4a", "D4.m4a"], ".m4a (2)"), (["a.txt"], ".txt"), ([], "no files")]
)
def test_a_folder_without_recordings_says_what_it_holds(tmp_path, files, named):
    for name in files:
        (tmp_path / name).write_bytes(b"x")
    with pytest.raises(SetupError) as error:
        read_keys(tmp_path)
    assert named in str(error.value)
    assert "AIFF" in str(error.value)


def test_what_fits_have_written_is_not_a_recording(tmp_path):
    for name in ["C4-p.wav", "fits/ledger/lock", "fits/keys/C4/fitted.wav", "one/fit.json", "one/fitted-C4-p.wav"]:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"x")
    (key,), _ = read_keys(tmp_path)
    assert [sample.file.name for sample in key.samples] == ["C4-p.wav"]


def test_neighbouring_free_fields_are_matched_in_linear_time():
    """Each is as short as possible, as if all divisions of the text were tried."""
    assert expression_of("{note}" + "{*}" * 30 + "x").fullmatch("C4" + "y" * 60) is None
    match = expression_of("{instrument}{*}{layer}-{note}").fullmatch("piano-C4")
    assert match is not None
    assert (match["instrument"], match["layer"]) == ("p", "iano")
