"""The keyboard laws against a synthetic piano whose parameters are given for every key."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from instrument_cases import ERRORS, add_force, fit_document, library, true_note, truth, write_fit

from pianofit.errors import FitError
from pianofit.instrument import Instrument, build_instrument, find_fits, instrument_name, load_keys
from pianofit.instrument.build import fit_velocity_curve
from pianofit.instrument.collect_fits import LOUDEST_VELOCITY
from pianofit.instrument.key_quantities import (
    LAW_QUANTITIES,
    key_quantities,
    literature,
    note_from_quantities,
)
from pianofit.instrument.laws import Prior, fit_law
from pianofit.literature import reference_compression

KEYS = list(range(24, 100, 3))
ALL = list(range(21, 109))
MEASURED = ("B", "b1", "d2", "M_H/M_S", "F/M_S", "p", "mu", "x0/L")


@pytest.fixture(scope="module")
def piano(tmp_path_factory) -> Instrument:
    folder = library(tmp_path_factory.mktemp("library"), KEYS)
    return build_instrument(load_keys(find_fits([folder])), "twin")


@pytest.mark.parametrize("name", MEASURED)
def test_a_law_is_the_truth_within_its_intervals(piano, name):
    """Its error over all keys except the outermost, most of them never recorded, is below that of a single fit."""
    law, inside, scaled = piano.laws[name], slice(3, 79), LAW_QUANTITIES[name].scaled
    error = (scaled(law.value) - truth(name, ALL))[inside]
    sd = ((scaled(law.high) - scaled(law.low)) / (2 * 1.959964))[inside]
    single = {"B": 0.01, "b1": 0.1, "d2": 0.1, "M_H/M_S": 0.03, "F/M_S": 0.1, "p": 0.04, "mu": 0.2, "x0/L": 0.005}
    assert np.sqrt(np.mean(error**2)) < 0.75 * single[name]
    assert np.abs(error / sd).max() < 4
    assert not law.outliers


@pytest.mark.parametrize(
    ("folder", "name"),
    [("cp80-Fs2", "cp80"), ("cp80 c#4", "cp80"), ("pianoC4", "piano"), ("C4", ""), ("bb3", ""), ("fitted1", ""),
     ("take2", ""), ("headroom-A0-close", "")],
)  # fmt: skip
def test_an_instrument_is_named_where_a_folder_names_a_key(folder, name):
    assert instrument_name(Path(folder) / "fit.json") == name


def test_keys_are_nearer_to_the_truth_than_their_fits(piano):
    for name in ("b1", "d2", "p", "mu"):
        entries = [piano.keys[midi].values[name] for midi in KEYS]
        true = np.exp(truth(name, KEYS))
        own, value = (np.log(row / true) for row in np.transpose([(x.own_fit.value, x.value) for x in entries]))
        assert np.sqrt(np.mean(value**2)) < 0.6 * np.sqrt(np.mean(own**2)), name


def test_a_key_keeps_its_own_pitch(piano):
    for midi in KEYS:
        entry = piano.keys[midi].values["cents"]
        assert entry.value == entry.own_fit.value
    between = [piano.keys[midi].values["cents"].value for midi in ALL]
    assert np.abs(between - truth("cents", ALL))[3:79].max() < 1.0


def test_every_key_can_be_played_and_says_where_it_comes_from(piano):
    assert [*piano.keys] == ALL
    assert all(
        np.isfinite([*key.note.string, *key.note.hammer, *key.note.geometry]).all() for key in piano.keys.values()
    )
    states = [key.state for key in piano.keys.values()]
    assert states[0] == states[-1] == "extrapolated"
    assert {states[midi - 21] for midi in KEYS} <= {"fitted", "pulled"}
    assert {states[m - 21] for m in range(24, 99) if m not in KEYS} == {"interpolated"}


def test_bad_keys_are_named_and_play_the_law(tmp_path):
    """Three wrong keys of 26, two of them neighbours with the same error; no other key is an outlier."""
    folder = library(tmp_path, KEYS, seed=3)
    wrong = {"twin-D#2": 39, "twin-F#2": 42, "twin-C6": 84}
    for midi in wrong.values():
        note = true_note(midi)
        string = note.string._replace(b1=note.string.b1 * 5)
        hammer = note.hammer._replace(M_H=note.hammer.M_H * 2.5)
        write_fit(folder, midi, fit_document(note._replace(string=string, hammer=hammer), ERRORS))
    piano = build_instrument(load_keys(find_fits([folder])))
    for name in ("b1", "M_H/M_S"):
        assert piano.laws[name].outliers == ("D#2", "F#2", "C6")
        for midi in wrong.values():
            entry = piano.keys[midi].values[name]
            assert entry.own_fit.state == "outlier"
            assert entry.value == pytest.approx(math.exp(truth(name, [midi])[0]), rel=0.15)
    assert not any(law.outliers for name, law in piano.laws.items() if name not in ("b1", "M_H/M_S"))
    assert sum("D#2" in warning for warning in piano.warnings) == 2
    assert [midi for midi, key in piano.keys.items() if key.state == "outlier"] == [39, 42, 84]


def test_a_wide_interval_is_drawn_in_and_a_narrow_one_stays(tmp_path):
    folder = library(tmp_path, KEYS, seed=4)
    for midi, sd, factor in ((48, 0.5, 1.8), (60, 0.005, 1.25)):
        note = true_note(midi)
        off = note._replace(string=note.string._replace(b1=note.string.b1 * factor))
        write_fit(folder, midi, fit_document(off, ERRORS | {"b1": sd}))
    piano = build_instrument(load_keys(find_fits([folder])))
    wide, narrow = (piano.keys[midi].values["b1"] for midi in (48, 60))
    assert wide.own_fit.state == "pulled"
    assert abs(math.log(wide.value / math.exp(truth("b1", [48])[0]))) < 0.1
    assert narrow.own_fit.state != "pulled"
    assert narrow.value == pytest.approx(narrow.own_fit.value, rel=0.02)


def test_one_key_shifts_the_literature(tmp_path):
    folder = library(tmp_path, [60], errors=dict.fromkeys(ERRORS, 1e-3))
    piano = build_instrument(load_keys(find_fits([folder])))
    for name in ("B", "b1", "M_H/M_S"):
        law, own = piano.laws[name], math.exp(truth(name, [60])[0])
        shift = math.log(own / literature(60)[name])
        assert math.log(law.value[39] / own) == pytest.approx(0, abs=0.05)
        assert math.log(law.value[63 - 21] / literature(63)[name]) == pytest.approx(shift, rel=0.1, abs=0.02)
    assert "1 key" in piano.warnings[-1]


def test_a_law_without_error_passes_through_its_keys():
    x = np.arange(21.0, 109.0, 4.0)
    y = 0.3 + 0.2 * np.sin(x / 25)
    law = fit_law(x, y, np.full(len(x), 1e-4), x, Prior(0.5, 0.5, 0.5))
    assert np.abs(law.mean - y).max() < 0.01
    assert np.abs(law.value - y).max() < 1e-3
    assert not law.outlier.any()


def test_intervals_cover():
    """The 95 % intervals of law and keys hold the truth in 88 to 99 % of cases, over 40 pianos."""
    random, x = np.random.default_rng(7), np.arange(21.0, 109.0, 5.0)
    at = np.arange(23.0, 106.0, 5.0)
    of_law, of_keys = [], []
    for _ in range(40):
        a, b, c, d = random.normal(size=4)

        def f(keys, a=a, b=b, c=c, d=d):
            return 0.3 * a + 0.2 * b * (keys - 64) / 44 + 0.1 * c * np.sin(keys / 15 + 6 * d)

        true = f(x) + 0.03 * random.normal(size=len(x))
        law = fit_law(x, true + 0.08 * random.normal(size=len(x)), np.full(len(x), 0.08), at, Prior(0.5, 0.4, 0.5))
        of_law.append(np.abs(law.mean - f(at)) < 1.96 * law.sd)
        of_keys.append(np.abs(law.value - true) < 1.96 * law.value_sd)
    assert 0.88 < np.mean(of_law) < 0.99
    assert 0.88 < np.mean(of_keys) < 0.99


def test_neighbours_that_agree_are_no_outliers():
    """Six different bass strings are not outliers. One such string elsewhere is."""
    random, x = np.random.default_rng(8), np.arange(21.0, 105.0, 3.0)
    y = np.where(x < 39, 1.5, 0.0) + 0.02 * random.normal(size=len(x))
    y[20] += 1.5
    law = fit_law(x, y, np.full(len(x), 0.02), x, Prior(0.7, 0.5, 0.5))
    assert np.flatnonzero(law.outlier).tolist() == [20]


def test_the_scatter_between_keys_is_found():
    random = np.random.default_rng(5)
    x = np.arange(21.0, 109.0)
    y = 0.2 + 0.004 * (x - 60) + 0.1 * random.normal(size=88)
    law = fit_law(x, y, np.full(88, 0.03), x, Prior(0.5, 0.5, 0.5))
    assert 0.05 < law.scatter < 0.2
    assert np.abs(law.mean - 0.2 - 0.004 * (x - 60)).max() < 0.1
    # A key with a good fit keeps its own deviation.
    assert np.sqrt(np.mean((law.value - y) ** 2)) < 0.03


def test_values_become_parameters_and_back():
    for midi in (21, 60, 108):
        note = true_note(midi)
        back = note_from_quantities(key_quantities(note, midi), midi, "pressure")
        assert back.string == pytest.approx(note.string, rel=1e-12)
        assert back.hammer[:4] == pytest.approx(note.hammer[:4], rel=1e-9)
        assert back.geometry == pytest.approx(note.geometry, rel=1e-12)
        assert back.gain == pytest.approx(note.gain)


def test_uncalibrated_keys_come_onto_one_velocity_scale(tmp_path):
    """(K_H, mu, v_H0, gain) -> (K_H s^(1-p), mu/s, s v_H0, gain/s) changes neither the sound nor the instrument."""
    s, note = 1.7, true_note(60)
    h = note.hammer
    scaled = note._replace(
        hammer=h._replace(K_H=h.K_H * s ** (1 - h.p), mu=h.mu / s, v_H0=h.v_H0 * s), gain=note.gain / s
    )
    files = [
        write_fit(tmp_path, 60, fit_document(note, ERRORS, (1.0, 4.0)), "a"),
        write_fit(tmp_path, 60, fit_document(scaled, ERRORS, (1.7, 6.8)), "b"),
    ]
    first, second = (load_keys([file])[0] for file in files)
    assert first.summary.velocities == pytest.approx(second.summary.velocities) == (1.0, LOUDEST_VELOCITY)
    assert first.note.hammer == pytest.approx(second.note.hammer, rel=1e-9)
    assert first.note.gain == pytest.approx(second.note.gain, rel=1e-9)


@pytest.mark.parametrize("s", [0.6, 1.0, 1.7])
def test_the_felts_error_is_that_of_its_force_on_the_common_scale(tmp_path, s):
    """5 % at 0.5 mm and 4 m/s, for any velocity scale of the fit; the exponent has the error 0.1."""
    note, sd_p, at = true_note(60), 0.1 / true_note(60).hammer.p, 0.5e-3
    h = note.hammer
    scaled = note._replace(hammer=h._replace(K_H=h.K_H * s ** (1 - h.p), mu=h.mu / s, v_H0=h.v_H0 * s))
    document = fit_document(scaled, ERRORS | {"K_H": 3.0, "p": sd_p}, (s, 4.0 * s))
    add_force(document, scaled, s * at, 0.05)
    (key,) = load_keys([write_fit(tmp_path, 60, document)])
    assert key.sd["F/M_S"] == pytest.approx(math.hypot(0.05, 0.1 * math.log(reference_compression(60) / at)), rel=1e-6)


@pytest.mark.parametrize("r", [-0.9, 0.0, 0.7])
@pytest.mark.parametrize("known", ["gain_status", "v_H0_status"])
def test_a_known_velocity_lets_k_say_how_force_and_exponent_trade_off(tmp_path, r, known):
    note, at, e, sd_p = true_note(60), 0.5e-3, 0.05, 0.1
    far, near = (math.log(u / at) for u in (1.0, reference_compression(60)))
    spread = {x: math.sqrt(e**2 + (x * sd_p) ** 2 + 2 * x * r * e * sd_p) for x in (far, near)}
    document = fit_document(note, ERRORS | {"K_H": spread[far], "p": sd_p / note.hammer.p}, (1.0, 3.0))
    add_force(document, note, at, e)
    document["parameters"]["v_H0"]["status"] = "fitted"
    for row in document["recordings"]:
        row |= {"v_H0_status": "fitted", known: "given"}
    (key,) = load_keys([write_fit(tmp_path, 60, document)])
    assert key.summary.velocities == (1.0, 3.0)  # given velocities are not rescaled
    assert key.sd["F/M_S"] == pytest.approx(spread[near], rel=1e-6)


def test_a_blow_at_two_microphones_is_one_layer_and_the_gain_is_that_of_the_path(tmp_path):
    document = fit_document(true_note(60), ERRORS, (1.0, 4.0))
    soft, loud = document["recordings"]
    soft, loud = soft | {"is_reference": True}, loud | {"is_reference": False}
    room = [row | {"path_group": 1, "gain": 50.0, "is_reference": False} for row in (soft, loud)]
    one, both = (
        load_keys([write_fit(tmp_path, 60, document | {"recordings": rows}, name)])[0]
        for name, rows in (("one", [soft, loud]), ("both", [*room, soft, loud]))
    )
    assert both.summary.velocities == one.summary.velocities == (1.0, LOUDEST_VELOCITY)
    assert both.note.gain == one.note.gain


def test_midi_velocities_rise_with_the_layers():
    curve = fit_velocity_curve([(0.5, 1.0, 2.0, 4.0), (0.6, 1.1, 2.2, 4.0)])
    velocity = [curve.at(v) for v in range(1, 128)]
    assert all(np.diff(velocity) > 0)
    assert velocity[110] == pytest.approx(4.0, rel=0.15)
    assert velocity[15] == pytest.approx(0.55, rel=0.2)
    assert fit_velocity_curve([(4.0,)]).source == "default"
    # The curve rises even if the layers do not.
    assert fit_velocity_curve([(1.0, 1.0, 1.0)]).rise > 0


def test_what_is_no_library_is_refused(tmp_path):
    with pytest.raises(FitError, match="nowhere"):
        find_fits([tmp_path / "nowhere"])
    with pytest.raises(FitError, match=r"fit\.json"):
        find_fits([tmp_path])
    library(tmp_path, [60, 64])
    write_fit(tmp_path, 60, fit_document(true_note(60), ERRORS), "other")
    with pytest.raises(FitError, match=r"instruments.* other, twin.*--prefix"):
        find_fits([tmp_path])
    with pytest.raises(FitError, match=r"--prefix 'third'.*'other', 'twin'"):
        find_fits([tmp_path], "third")
    assert len(find_fits([tmp_path], "other")) == 1
    twice = [*find_fits([tmp_path], "other"), *find_fits([tmp_path], "twin")]
    with pytest.raises(FitError, match=r"C4.*--prefix"):
        load_keys(twice)
    mixed = fit_document(true_note(67)._replace(quantity="bridge-force"), ERRORS)
    with pytest.raises(FitError, match="bridge-force and pressure"):
        load_keys([*find_fits([tmp_path], "twin"), write_fit(tmp_path, 67, mixed)])


def test_a_piano_out_of_tune_keeps_its_keys(tmp_path):
    """The key of a string that is 80 cents flat follows from the folder's name."""
    note = true_note(60)
    flat = note._replace(string=note.string._replace(c=note.string.c * 2 ** (-80 / 1200)))
    key = load_keys([write_fit(tmp_path, 60, fit_document(flat, ERRORS))])[0]
    assert key.midi == 60
    assert key_quantities(key.note, 60)["cents"] == pytest.approx(-80, abs=1)
    bare = tmp_path / "fit.json"
    bare.write_text(json.dumps(fit_document(flat, ERRORS)))
    assert load_keys([Path(bare)])[0].midi == 59
