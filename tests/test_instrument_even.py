"""Evening out: recorded keys move towards what the other keys predict, by a chosen amount."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from instrument_cases import ERRORS, fit_document, rung, true_note, write_fit
from typer.testing import CliRunner

from pianofit.cli import app
from pianofit.errors import ParameterError
from pianofit.instrument import build_instrument, find_fits, load_instrument, load_keys, write_instrument
from pianofit.instrument.evened_keys import brightness_slope, decay_factor, predict_key, with_decay, with_knock
from pianofit.instrument.guessed_knocks import static_part
from pianofit.instrument.guessed_responses import recorded_keys
from pianofit.instrument.key_quantities import stroke_level
from pianofit.instrument.measured_fields import TIMES, RecordedKey, StringLaw, early_ratio, measure_fields
from pianofit.schema.decode import builtins_of
from pianofit.schema.modal_response import FittedModalResponse, ModalResponseEntry, encode_knock

KEYS = (44, 48, 52, 56, 60)
UNEVEN, PLAIN = 52, 70
# The uneven key: its decay rates over those of its neighbours, its slope, dB per octave, and its gain.
FASTER, SLOPE, GAIN = 1.7, -4.0, 3.0


def uneven(midi: int):
    """A key whose decay, brightness and level differ from those of its neighbours if it is `UNEVEN`."""
    note = rung(midi)
    response = note.modal_response
    if midi != UNEVEN:
        return note
    octave = np.log2(response.partial)
    pole = FASTER * response.pole.real + 1j * response.pole.imag
    response = response._replace(pole=pole, pattern=response.pattern * 10 ** (SLOPE * octave / 20))
    return note._replace(modal_response=response, gain=GAIN * note.gain)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("fits")
    for midi in KEYS:
        note = uneven(midi)
        fitted = builtins_of(FittedModalResponse(response=ModalResponseEntry.of(note.modal_response)))
        file = write_fit(place, midi, fit_document(note, ERRORS) | {"modal_response": fitted})
        (file.parent / "knock.flac").write_bytes(encode_knock(note.modal_response))
    write_fit(place, PLAIN, fit_document(true_note(PLAIN)._replace(gain=0.1), ERRORS))
    return place


@pytest.fixture(scope="module")
def pianos(folder):
    """The instrument by amount."""
    fits = load_keys(find_fits([folder]))
    return {even: build_instrument(fits, "twin", even) for even in (0.5, 1.0)} | {0.0: build_instrument(fits, "twin")}


def test_nothing_changes_at_0(folder, pianos):
    """Without an amount, recorded keys have the string, modes and level of their fits."""
    for fit in load_keys(find_fits([folder])):
        own, key = fit.note, pianos[0.0].keys[fit.midi]
        assert key.note.string == own.string
        # The keyboard has its own scale of velocities.
        level = own.gain * fit.summary.velocities[0]
        assert key.note.gain * key.fit.velocities[0] == pytest.approx(level, rel=1e-12)
        if fit.midi != PLAIN:
            for name in ("pole", "pattern", "knock"):
                assert np.array_equal(getattr(key.note.modal_response, name), getattr(own.modal_response, name))


def test_the_level_moves_to_the_law(pianos):
    for midi in (*KEYS, PLAIN):
        law = pianos[0.0].laws["level"].value[midi - 21]
        none, half, whole = (stroke_level(pianos[even].keys[midi].note) for even in (0.0, 0.5, 1.0))
        assert whole == pytest.approx(law, abs=0.01)
        assert half == pytest.approx((none + law) / 2, abs=0.01)
        assert all(pianos[even].keys[midi].state == "recorded" for even in (0.0, 0.5, 1.0))
    assert abs(stroke_level(pianos[0.0].keys[UNEVEN].note) - pianos[0.0].laws["level"].value[UNEVEN - 21]) > 1.0


def test_decay_and_brightness_are_predicted_at_1(pianos):
    """The key, measured again, has a mean log decay ratio and a slope of 0 over the prediction."""
    before = recorded_keys({midi: pianos[0.0].keys[midi] for midi in KEYS}, pianos[0.0].laws)
    fields = measure_fields(before)
    for key in before:
        own, curve, level = predict_key(fields, key.midi)
        found = measure_fields([replace(key, note=pianos[1.0].keys[key.midi].note)]).cells
        ratio = np.log(early_ratio(curve) / early_ratio(found.curve))
        assert np.average(ratio, weights=own.points.size) == pytest.approx(0.0, abs=0.02)
        assert brightness_slope(found, level)[0] == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize("even", [0.5, 1.0])
def test_an_uneven_key_becomes_as_its_neighbours(pianos, even):
    """Against the factors by which it was made uneven."""
    recorded, evened = (pianos[amount].keys[UNEVEN].note.modal_response for amount in (0.0, even))
    ratio = evened.pole.real / recorded.pole.real
    assert ratio == pytest.approx(np.full(len(ratio), FASTER**-even), rel=0.05)
    assert np.array_equal(evened.pole.imag, recorded.pole.imag)
    k, change = recorded.partial, 20 * np.log10(np.abs(evened.pattern / recorded.pattern))
    slopes = [np.polyfit(np.log2(k), row, 1)[0] for row in change]
    # The guess in place of the key has a part of its slope.
    assert all(0.5 < slope / (-even * SLOPE) < 1.1 for slope in slopes)


def test_a_key_without_modes_changes_its_level_alone(pianos):
    recorded, evened = (pianos[even].keys[PLAIN].note for even in (0.0, 1.0))
    assert evened._replace(gain=recorded.gain) == recorded
    assert evened.gain != recorded.gain


def test_one_key_has_no_neighbours(folder):
    (key,) = [key for key in load_keys(find_fits([folder])) if key.midi == UNEVEN]
    recorded, evened = key.note, build_instrument([key], even=1.0).keys[UNEVEN].note
    assert np.array_equal(evened.modal_response.pattern, recorded.modal_response.pattern)
    assert np.array_equal(evened.modal_response.pole, recorded.modal_response.pole)


def test_a_partial_keeps_its_level_with_another_decay():
    """Against the integral of its energy over the first 0.35 s."""
    note = rung(UNEVEN)
    key = RecordedKey(UNEVEN, note, note, StringLaw(0.5, 1e-3, 0.01), (0.5,))  # where the velocity gain is 1
    other = with_decay(key, note.modal_response, 2.0)
    assert other.pole.real == pytest.approx(2.0 * note.modal_response.pole.real)
    time = np.linspace(0.0, 0.35, 20_001)

    def level(response, k):
        mode = response.partial == k
        turned = 1j * (response.pole.imag[mode] - response.pole.imag[mode].min())
        sound = np.exp(np.outer(time, response.pole.real[mode] + turned - 8)) @ response.pattern.mean(axis=0)[mode]
        return 10 * np.log10(np.trapezoid(np.abs(sound) ** 2, time))

    for k in np.unique(other.partial):
        assert level(other, k) == pytest.approx(level(note.modal_response, k), abs=1e-3)


def test_a_constant_force_has_no_sound_after_a_change():
    """The knock cancels the static deflection of the changed modes."""
    recorded = rung(UNEVEN).modal_response
    recorded = recorded._replace(knock=static_part(recorded))
    changed = with_knock(recorded, recorded._replace(pole=2 * recorded.pole.real + 1j * recorded.pole.imag))
    modes = np.real(changed.pattern @ (1 / (1 - np.exp(changed.pole / changed.rate))))
    assert modes + changed.knock.sum(axis=1) == pytest.approx(np.zeros(2), abs=1e-3 * np.abs(modes).max())


def test_the_factor_of_a_stretched_curve_is_found():
    def curve(factor):
        return 10 * np.log10(0.8 * np.exp(-4 * factor * TIMES) + 0.2 * np.exp(-0.4 * factor * TIMES))[None]

    for factor in (0.3, 1.0, 4.0):
        assert decay_factor(curve(1.0), curve(factor), np.ones(1)) == pytest.approx(factor, rel=0.01)


def test_a_file_says_how_even_the_instrument_is(folder, pianos, tmp_path):
    write_instrument(tmp_path / "instrument.json", pianos[0.5])
    read = load_instrument(tmp_path)
    assert read.even == 0.5 == load_instrument(folder, even=0.5).even
    assert "50 %" in read.summary()
    own, again = (piano.keys[50].note for piano in (pianos[0.5], read))
    assert again.modal_response.pattern == pytest.approx(own.modal_response.pattern, rel=1e-6)
    assert stroke_level(again) == pytest.approx(stroke_level(own), abs=1e-3)


@pytest.mark.parametrize("even", [-0.1, 1.5, float("nan"), "half"])
def test_an_amount_is_from_0_to_1(folder, even):
    with pytest.raises(ParameterError, match="even="):
        build_instrument(load_keys(find_fits([folder])), even=even)
    with pytest.raises(ParameterError, match="even="):
        load_instrument(folder, even=even)


def test_a_built_instrument_is_not_evened(pianos, tmp_path):
    write_instrument(tmp_path / "instrument.json", pianos[0.0])
    assert load_instrument(tmp_path, even=0.0).even == 0.0
    with pytest.raises(ParameterError, match=r"even=0\.5"):
        load_instrument(tmp_path, even=0.5)


def test_commands_take_the_amount(folder, tmp_path):
    runner = CliRunner()
    made = runner.invoke(app, ["instrument", str(folder), "--even", "1", "--out", str(tmp_path / "even")])
    assert made.exit_code == 0, made.output
    assert load_instrument(tmp_path / "even").even == 1.0
    for command in (["page", str(folder)], ["page", str(tmp_path / "even")]):
        bad = runner.invoke(app, [*command, "--even", "2", "--out", str(tmp_path / "page.html")])
        assert bad.exit_code == 1
        assert len(bad.stderr.strip().splitlines()) == 1
        assert "even" in bad.stderr
