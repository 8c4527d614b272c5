"""Literature values: each preset is compared with its note, and typical notes are tested over the whole keyboard."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import PchipInterpolator

from pianofit.errors import ParameterError
from pianofit.literature import CHAIGNE_HAMMERS, HAMMERS, LOSSES, PRESETS, STRINGS, TABLES, preset, typical
from pianofit.parameters import FIT_NAMES, PARAMETERS, check

KEYBOARD = range(21, 109)
SEMITONES = {"C": -9, "C#": -8, "D#": -6, "F": -4, "F#": -3, "G": -2, "A": 0}


def hertz(note: str) -> float:
    """Equal temperament, A4 = 440 Hz."""
    return 440.0 * 2 ** (SEMITONES[note[:-1]] / 12 + int(note[-1]) - 4)


def cents(frequency: float, reference: float) -> float:
    return 1200 * math.log2(frequency / reference)


# --- presets -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("entry", [p for p in PRESETS.values() if p.note], ids=lambda p: p.name)
def test_a_preset_sounds_at_its_note(entry):
    f0 = entry.string.c / (2 * entry.geometry.length)
    assert entry.f0 == pytest.approx(f0, rel=1e-15)
    assert abs(cents(f0, hertz(entry.note))) < 5


@pytest.mark.parametrize("row", STRINGS, ids=lambda row: row.note)
def test_a_published_string_sounds_at_its_printed_frequency(row):
    assert abs(cents(row.c / (2 * row.length), row.f0)) < 9
    assert abs(cents(row.f0, hertz(row.note) * 441 / 440)) < 0.6  # as the docstring states


def test_the_chaigne_askenfelt_string():
    entry = preset("chaigne-askenfelt-C4")
    assert entry.f0 == pytest.approx(262.0, abs=0.3)  # Hz, as their table has it
    assert 670.0 / (entry.geometry.mass / entry.geometry.length) == pytest.approx(entry.string.c**2)
    assert entry.string.kappa**2 / (entry.string.c * entry.geometry.length) ** 2 == pytest.approx(3.82e-5)


def test_the_papers_values_are_as_printed():
    first, last = preset("bensa-initial"), preset("bensa-final")
    assert (first.string.c, first.string.b1, first.string.b2) == (310.6, 0.500, 1.004e-10)
    assert tuple(last.string) == (304.101, 1.737, 0.568, 1.628e-6)
    assert tuple(first.hammer) == (1.51647e9, 0.1000, 2.55, 6.790e-3, 0.74078)
    assert tuple(last.hammer) == (1.09949e10, 0.1998, 2.56, 5.687e-3, 0.79993)
    assert first.geometry == last.geometry
    assert first.geometry.length == 1.0
    assert first.note is last.note is None
    assert cents(last.f0, hertz("D#3")) == pytest.approx(-40, abs=0.6)  # as the docstring states


@pytest.mark.parametrize("entry", PRESETS.values(), ids=lambda p: p.name)
def test_a_preset_is_complete_possible_and_says_where_it_is_from(entry):
    check({**entry.string._asdict(), **entry.hammer._asdict()})
    length, mass, strike, width, pickup = entry.geometry
    assert width / 2 <= strike <= length - width / 2
    assert 0 < pickup < length
    assert mass > 0
    tension = entry.string.c**2 * mass / length
    assert 500 < tension < 2000  # N, usual for piano strings
    assert entry.source
    assert entry.derivation in ("read in the paper", "second-hand")
    assert entry.completed
    assert PRESETS[entry.name] is entry


def test_presets_cannot_be_changed():
    with pytest.raises(dataclasses.FrozenInstanceError):
        preset("bensa-final").note = "C4"
    with pytest.raises(AttributeError):
        preset("bensa-final").string.c = 1.0


def test_stiffness_of_the_table_is_that_of_its_core():
    for row in STRINGS:  # κ² = E I/(ρ A), the core being a round wire of steel
        area, moment = math.pi * row.diameter**2 / 4, math.pi * row.diameter**4 / 64
        assert row.kappa**2 == pytest.approx(2.0e11 * moment / (row.density * area), rel=1e-12)
        assert row.mass == pytest.approx(row.density * area * row.length, rel=1e-12)
        assert row.tension == pytest.approx(row.c**2 * row.mass / row.length, rel=1e-12)


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("bensa-finl", "did you mean bensa-final?"),
        ("CHABASSIER-c2", "did you mean chabassier-C2?"),
        ("\n", "presets: "),
    ],
)
def test_an_unknown_preset_is_named_with_the_nearest(name, hint):
    with pytest.raises(ParameterError) as caught:
        preset(name)
    message = str(caught.value)
    assert hint in message
    assert all(known in message for known in PRESETS)
    assert message.isprintable()


# --- the typical note ----------------------------------------------------------------------------------------------


def curve(of) -> np.ndarray:
    return np.array([of(typical(midi)) for midi in KEYBOARD])


def test_every_key_is_possible():
    for midi in KEYBOARD:
        entry = typical(midi)
        check({**entry.string._asdict(), **entry.hammer._asdict()}, f"midi {midi}")
        length, mass, strike, width, pickup = entry.geometry
        assert entry.f0 == pytest.approx(440 * 2 ** ((midi - 69) / 12))
        assert entry.string.c == pytest.approx(2 * length * entry.f0, rel=1e-14)
        assert strike == pytest.approx(0.12 * length)
        assert 0 < width <= 0.02
        assert width / 2 < strike
        assert 0 < pickup < length
        assert mass > 0


@pytest.mark.parametrize(
    ("name", "of", "sign", "lowest", "highest"),
    [
        ("length", lambda t: t.geometry.length, -1, 0.045, 2.4),
        ("mass", lambda t: t.geometry.mass, -1, 1e-4, 0.4),
        ("b1", lambda t: t.string.b1, 1, 0.05, 30),
        ("b2", lambda t: t.string.b2, 1, 1e-5, 1e-2),
        ("K_H", lambda t: t.hammer.K_H, 1, 1e7, 1e13),
        ("p", lambda t: t.hammer.p, 1, 2.0, 3.5),
        ("M_H", lambda t: t.hammer.M_H, -1, 1.9e-3, 13e-3),
        ("M_H/M_S", lambda t: t.hammer.M_H / t.geometry.mass, 1, 0.02, 40),
    ],
)
def test_the_keyboard_goes_one_way(name, of, sign, lowest, highest):
    values = curve(of)
    assert np.all(sign * np.diff(values) > 0), name
    assert lowest < values.min() < values.max() < highest


def test_inharmonicity_falls_to_the_wound_strings_and_rises_again():
    inharmonicity = curve(lambda t: (t.string.kappa * math.pi / (t.string.c * t.geometry.length)) ** 2)
    turns = np.flatnonzero(np.diff(np.sign(np.diff(inharmonicity))))
    assert len(turns) == 1
    assert 3e-5 < inharmonicity.min() < 1e-4
    assert 1e-2 < inharmonicity[-1] < 4e-2


def test_no_key_jumps():
    for of in (lambda t: t.geometry.length, lambda t: t.hammer.K_H, lambda t: t.string.b2, lambda t: t.string.kappa):
        steps = np.diff(np.log(curve(of)))
        assert np.abs(np.diff(steps)).max() < 0.04  # most where one string becomes two


def test_the_tables_are_met_where_they_have_rows():
    for row in STRINGS:
        entry = typical(row.midi)
        assert entry.geometry.length == pytest.approx(row.length, rel=1e-12)
        assert entry.string.c == pytest.approx(row.c, rel=0.003)  # their tuning is not quite 440 Hz
        assert entry.string.kappa == pytest.approx(row.kappa, rel=0.003)
        assert entry.geometry.mass == pytest.approx(row.mass, rel=0.006)
    for hammer in HAMMERS:
        felt = typical(hammer.midi).hammer
        whole = hammer.M_H / felt.M_H
        assert (felt.p, whole * felt.K_H) == pytest.approx((hammer.p, hammer.K_H), rel=1e-12)
        assert 2 - 1e-12 <= whole <= 3 + 1e-12
    for loss in LOSSES:
        string = typical(loss.midi).string
        assert (string.b1, string.b2) == pytest.approx((loss.b1, loss.b2), rel=1e-12)


def test_a_string_is_struck_by_its_share_of_the_hammer():
    """One source has whole hammers, the other the shares of one string: half at C2, a third at C4 and C7."""
    for share in CHAIGNE_HAMMERS:
        found = typical(share.midi).hammer.M_H
        assert found == pytest.approx(share.M_H, rel=0.05)
    found = typical(24).hammer.M_H  # one string per key
    assert found == pytest.approx(0.0110, rel=0.02)


def test_the_interpolation_is_the_usual_monotone_cubic():
    midi, length = np.array(TABLES["length"]).T
    witness = PchipInterpolator(midi, np.log(length))  # the same slopes except at the ends
    inside = np.linspace(36, 91, 111)
    ours = [math.log(typical(x).geometry.length) for x in inside]
    np.testing.assert_allclose(ours, witness(inside), rtol=0, atol=1e-12)


@settings(max_examples=50, deadline=None)
@given(st.floats(15, 113.99))
def test_between_keys_it_is_smooth(midi):
    low, high = typical(midi), typical(midi + 0.01)
    for name in FIT_NAMES:
        here, there = (getattr(t.string if name in t.string._fields else t.hammer, name) for t in (low, high))
        assert here == pytest.approx(there, rel=0.003)
        assert PARAMETERS[name].lower <= here <= PARAMETERS[name].upper


@pytest.mark.parametrize("midi", [14.9, 114.1, -1, 440, math.nan, math.inf, None, True, "C9"])
def test_a_note_beyond_any_piano_is_refused(midi):
    with pytest.raises(ParameterError, match="must be from 15 to 114"):
        typical(midi)


def test_a_note_is_named_or_numbered():
    assert typical("C4") == typical(" c4") == typical(60) == typical("60")
    assert typical("Gb2") == typical("F#2") == typical(42.0)
    assert (typical("C4").note, typical("Gb2").note, typical(60.25).note) == ("C4", "F#2", "60.25")
    with pytest.raises(ParameterError, match="H9"):
        typical("H9")


@pytest.mark.parametrize(
    ("note", "name", "place"),
    [
        ("C4", "M_H", "between A3 and A4"), ("C4", "length", "between F3 and C#5"), ("C4", "b1", None),
        ("A4", "K_H", None), ("F3", "c", None), ("C7", "b2", None), ("C7", "kappa", None),
        ("C7", "p", "extrapolated beyond A5"), ("A0", "mass", "extrapolated beyond D#1"),
        (60.5, "b1", "between C4 and C7"),
        ("C4", "mu", None), ("C4", "v_H0", None),
    ],
)  # fmt: skip
def test_what_is_interpolated_is_named_with_the_rows_next_to_it(note, name, place):
    entry = typical(note)
    assert entry.interpolated.get(name) == place
    fields = {*entry.string._fields, *entry.hammer._fields, *entry.geometry._fields}
    assert {*entry.interpolated} <= fields
    for chosen in ("mu", "v_H0", "width", "pickup", "strike_position"):
        assert chosen in entry.completed
    for source in ("Chabassier", "Bensa"):
        assert source in entry.source


def test_a_preset_names_what_is_interpolated_in_it():
    assert "K_H" in preset("chabassier-F3").interpolated
    assert "c" not in preset("chabassier-F3").interpolated
    assert preset("chabassier-C2").interpolated == {}  # strings, hammers and losses have a row at C2
    assert preset("bensa-final").interpolated == preset("chaigne-askenfelt-C4").interpolated == {}
