"""Tuning curves against octaves solved by brute force, their intervals against drawn keyboards, lists and files."""

from __future__ import annotations

import csv
import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from instrument_cases import fit_document, library, rung, true_note, write_fit
from scipy.optimize import brentq
from typer.testing import CliRunner, Result

import pianofit
from pianofit.cli import app
from pianofit.instrument import build_instrument, find_fits, load_keys, write_instrument
from pianofit.instrument.key_quantities import LAW_QUANTITIES, literature
from pianofit.instrument.keyboard_posterior import (
    KeyMeasurements,
    Measurement,
    joint_laws,
    keyboard_posterior,
)
from pianofit.instrument.quantity_law import SHAPE_SD, STUDENT
from pianofit.literature import STRINGS
from pianofit.model.modal_response import ModalResponse
from pianofit.model.modes import mode_frequencies
from pianofit.parameters import String
from pianofit.schema.tuning import TunedKey, Tuning
from pianofit.tuner.curves import OCTAVE_TYPES, tuning_curve
from pianofit.tuner.save import write_tuning
from pianofit.tuner.tuning import CHOSEN, KEYS, Recorded, _unison, posterior_of, tuning_of

A4 = 69 - 21
RECORDED = (24, 33, 41, 48, 55, 60, 67, 76, 88, 100)
# Standard deviations of fits, cents and log B.
FIT_SD = (0.4, 0.03)


def run(*words: object) -> Result:
    return CliRunner().invoke(app, [str(word) for word in words])


@pytest.fixture(scope="module")
def fits(tmp_path_factory) -> Path:
    return library(tmp_path_factory.mktemp("batch"), [30, 42, 54, 66, 78, 90])


@pytest.fixture(scope="module")
def tuned(fits) -> Tuning:
    return pianofit.tuning(fits)


@pytest.fixture(scope="module")
def built(fits, tmp_path_factory) -> Path:
    """The file of the instrument of these fits."""
    file = tmp_path_factory.mktemp("built") / "instrument.json"
    write_instrument(file, build_instrument(load_keys(find_fits([fits])), "twin"))
    return file


def partials(f0: float, B: float, count: int = 6) -> np.ndarray:
    """Partials of a string of 1 m with this fundamental and inharmonicity, by the model of the string, Hz."""
    c = 2 * f0
    return mode_frequencies(String(c, c * math.sqrt(B) / math.pi, 1.0, 1e-3), 1.0, count)


def root_of(difference: Callable[[float], float], guess: float) -> float:
    return float(brentq(difference, 0.7 * guess, 1.4 * guess, xtol=1e-12))  # pyright: ignore[reportArgumentType]


def at_first_partial(frequency: float, B: float) -> float:
    """The fundamental of a string whose partial 1 has a frequency."""
    return root_of(lambda f0: partials(f0, B, 1)[0] - frequency, frequency)


def by_brute_force(B: np.ndarray, k: int) -> np.ndarray:
    """Cents of the first partials of a piano that a tuner tunes by the beats of partials k and k/2."""
    f0 = np.zeros(88)
    f0[A4] = at_first_partial(440.0, B[A4])

    def silence(own: int, other: int, lower: bool) -> float:
        """The fundamental at which a key does not beat against the key an octave away."""
        mine, theirs = (k, k // 2) if lower else (k // 2, k)
        there = partials(f0[other], B[other], k)[theirs - 1]
        return root_of(lambda f: partials(f, B[own], k)[mine - 1] - there, f0[other] * (0.5 if lower else 2.0))

    f0[A4 - 12] = silence(A4 - 12, A4, True)
    first = partials(f0[A4 - 12], B[A4 - 12])[0]
    for i in range(1, 12):
        f0[A4 - 12 + i] = at_first_partial(first * (440.0 / first) ** (i / 12), B[A4 - 12 + i])
    for i in range(A4 + 1, 88):
        f0[i] = silence(i, i - 12, False)
    for i in range(A4 - 13, -1, -1):
        f0[i] = silence(i, i + 12, True)
    tempered = 440.0 * 2 ** ((np.arange(88) - A4) / 12)
    return np.array([1200 * math.log2(partials(f, b)[0] / t) for f, b, t in zip(f0, B, tempered, strict=True)])


@pytest.mark.parametrize("k", OCTAVE_TYPES.values())
def test_a_curve_is_that_of_octaves_without_beats(k):
    random = np.random.default_rng(k)
    B = np.array([literature(midi)["B"] for midi in KEYS.tolist()]) * np.exp(0.2 * random.normal(size=88))
    np.testing.assert_allclose(tuning_curve(B, k), by_brute_force(B, k), atol=1e-8)


def test_without_stiffness_every_curve_is_equal_temperament():
    assert np.abs(tuning_curve(np.zeros(88), 4)).max() == 0.0


# --- the posterior ----------------------------------------------------------------------------------------------------


def measure(value: np.ndarray, random: np.random.Generator) -> Recorded:
    """Fits with errors of some keys of a piano [2, 88]."""
    covariance = np.diag(np.square(FIT_SD))
    covariance[0, 1] = covariance[1, 0] = -0.5 * FIT_SD[0] * FIT_SD[1]
    keys = tuple(
        KeyMeasurements(
            midi,
            (Measurement(1.0, random.multivariate_normal(value[:, midi - 21], covariance), covariance),),
            np.zeros(2),
        )
        for midi in RECORDED
    )
    return Recorded("drawn", CHOSEN, keys, reference(), {}, ())


def reference() -> np.ndarray:
    rows = [literature(midi) for midi in KEYS.tolist()]
    return np.array([LAW_QUANTITIES[name].scaled([row[name] for row in rows]) for name in CHOSEN])


def drawn_piano(random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Laws and values of a piano [2, 88] from the priors of the keyboard."""
    place, distance = np.linspace(-1, 1, 88), (KEYS[:, None] - KEYS) ** 2
    law = reference()
    scatter = np.zeros_like(law)
    for q, name in enumerate(CHOSEN):
        prior = LAW_QUANTITIES[name].prior
        smooth, size, length = prior.medians * np.exp(SHAPE_SD * random.normal(size=3))
        root = np.linalg.cholesky(np.exp(-0.5 * distance / length**2) + 1e-8 * np.eye(88))
        law[q] += prior.offset * random.normal() + prior.slope_sd * random.normal() * place
        law[q] += smooth * root @ random.normal(size=88)
        scatter[q] = size * random.standard_t(STUDENT, size=88)
    return law, law + scatter


def truth_of(law: np.ndarray, value: np.ndarray) -> dict[str, np.ndarray]:
    """The numbers of a tuning that intervals should hold, without the code of the package."""
    B = np.exp(value[1])
    first, smooth = (x[0] + 600 * np.log2(1 + np.exp(x[1])) for x in (value, law))
    return {"B": B, "as_found": first, "law": smooth, "deviation": first - smooth} | {
        name: tuning_curve(B, k) for name, k in OCTAVE_TYPES.items()
    }


def interval_of(key: TunedKey, name: str) -> tuple[float, float] | None:
    it = key.curves.get(name) if name in OCTAVE_TYPES else getattr(key, name)  # pyright: ignore[reportArgumentType, reportCallIssue]
    return None if it is None else it.interval


def test_intervals_hold_the_truth_of_drawn_keyboards():
    held: dict[str, list[bool]] = {}
    for seed in range(20):
        random = np.random.default_rng(seed)
        law, value = drawn_piano(random)
        recorded = measure(value, random)
        found = tuning_of(recorded, posterior_of(recorded), 440.0, "4:2")
        for name, row in truth_of(law, value).items():
            for key, true in zip(found.keys, row, strict=True):
                ends = interval_of(key, name)
                if ends is not None and ends[0] < ends[1]:
                    held.setdefault(name, []).append(ends[0] <= true <= ends[1])
    shares = {name: 100 * float(np.mean(flags)) for name, flags in held.items()}
    assert all(90 <= share <= 99 for share in shares.values()), shares


def test_joint_laws_have_the_margins_of_the_keyboard_and_the_covariance_of_a_prediction():
    random = np.random.default_rng(1)
    recorded = measure(drawn_piano(random)[1], random)
    priors = [LAW_QUANTITIES[name].prior for name in CHOSEN]
    at = KEYS.tolist()
    joint = joint_laws(recorded.keys, recorded.reference, priors, at, (0, 1))
    margins = keyboard_posterior(recorded.keys, recorded.reference, priors, at)
    sd = np.sqrt(np.diag(joint.covariance)).reshape(joint.mean.shape)
    np.testing.assert_allclose(joint.mean, margins.mean, rtol=1e-9)
    np.testing.assert_allclose(sd, margins.sd, rtol=1e-9)
    at = sorted([*RECORDED, 50])
    other = joint_laws(recorded.keys, recorded.reference[:, np.array(at) - 21], priors, at, (0, 1))
    for ours, theirs in zip(joint.value_of(50 - 21), other.value_of(at.index(50)), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9)
    draws = joint.draw(20_000, np.random.default_rng(2))
    np.testing.assert_allclose(draws.mean(axis=0), joint.mean, atol=6 * sd.max() / 140)
    np.testing.assert_allclose(np.std(draws, axis=0), sd, rtol=0.05)


# --- from fits --------------------------------------------------------------------------------------------------------


def test_a_synthetic_piano_has_its_inharmonicity_and_tuning(tuned):
    for key in tuned.keys:
        note = true_note(key.midi)
        true = partials(note.f0, note.B, 1)[0]
        if key.recorded:
            assert abs(key.B.value / note.B - 1) < 0.05
            assert abs(1200 * math.log2(key.first_partial.value / true)) < 3
    inside = [key.B.interval[0] <= true_note(key.midi).B <= key.B.interval[1] for key in tuned.keys]
    assert np.mean(inside) > 0.9
    assert {key.note for key in tuned.keys if key.recorded} == {"F#1", "F#2", "F#3", "F#4", "F#5", "F#6"}


def test_targets_do_not_beat(tuned):
    for lower, upper in zip(tuned.keys, tuned.keys[12:], strict=False):
        ours = partials(at_first_partial(lower.target.value, lower.B.value), lower.B.value)[3]
        theirs = partials(at_first_partial(upper.target.value, upper.B.value), upper.B.value)[1]
        assert ours == pytest.approx(theirs, rel=1e-9)


def test_another_a4_moves_targets_and_not_the_piano(fits, tuned):
    other = pianofit.tuning(fits, a4=442.0)
    shift = 1200 * math.log2(442 / 440)
    for here, there in zip(tuned.keys, other.keys, strict=True):
        assert there.first_partial.value == pytest.approx(here.first_partial.value)
        assert there.target.value / here.target.value == pytest.approx(442 / 440)
        assert there.as_found.value == pytest.approx(here.as_found.value - shift)
        assert there.curves == here.curves


def test_an_instrument_gives_the_tuning_of_its_fits(built, tuned):
    """Only the correlations of each fit are lost."""
    of_file = pianofit.tuning(built)
    for ours, theirs in zip(of_file.keys, tuned.keys, strict=True):
        low, high = theirs.as_found.interval
        assert abs(ours.as_found.value - theirs.as_found.value) < 0.1 * (high - low)
        assert ours.recorded == theirs.recorded
    assert pianofit.tuning([built.parent]) == of_file


def test_a_mistuned_key_is_off_by_what_it_is_off(tmp_path):
    library(tmp_path, list(range(30, 96, 6)), errors={"c": 1e-4, "kappa": 5e-3})
    note = true_note(60)
    off = note._replace(string=note.string._replace(c=note.string.c * 2 ** (8 / 1200)))
    write_fit(tmp_path, 60, fit_document(off, {"c": 1e-4, "kappa": 5e-3}))
    found = pianofit.tuning(tmp_path)
    assert found.off[0] == "C4"
    (key,) = [key for key in found.keys if key.note == "C4"]
    assert key.deviation is not None
    assert key.deviation.interval[0] < 8 < key.deviation.interval[1]
    assert all(abs(other.deviation.value) < 1 for other in found.keys if other.deviation and other is not key)


def test_few_keys_have_no_law_of_their_own(tmp_path):
    found = pianofit.tuning(library(tmp_path, [48, 60]))
    assert found.off == ()
    assert len(found.warnings) == 2  # few keys, and no modal response


def beating(cents: float, partials: slice = slice(None)) -> ModalResponse:
    """Two slowly decaying modes of equal amplitude in every partial, split by some cents in some partials."""
    response = rung(66).modal_response
    assert response is not None
    pole, pattern = -0.4 + 1j * np.imag(response.pole), response.pattern.copy()
    pattern[:, 1::2] = pattern[:, ::2]
    ratio = np.ones(len(pole) // 2)
    ratio[partials] = 2 ** (cents / 1200)
    pole[1::2] = -0.4 + 1j * np.imag(pole[::2]) * ratio
    return response._replace(pole=pole, pattern=pattern, pole_error=np.full(len(pole), 0.01))


def tuning_with(response: ModalResponse) -> tuple[Tuning, TunedKey]:
    recorded = measure(reference(), np.random.default_rng(0))._replace(responses={60: response})
    found = tuning_of(recorded, posterior_of(recorded), 440.0, "2:1")
    return found, found.keys[60 - 21]


@pytest.mark.parametrize(("cents", "is_wide"), [(1.0, False), (5.0, True)])
def test_beats_are_the_split_of_the_modes(cents, is_wide):
    found, key = tuning_with(beating(cents))
    for beat in key.beats:
        assert beat.rate.value == pytest.approx(beat.frequency * (2 ** (cents / 1200) - 1), rel=0.01)
        assert beat.cents.interval[0] <= cents * 1.001
        assert cents * 0.999 <= beat.cents.interval[1]
    assert key.unison_cents is not None
    assert key.unison_cents.value == pytest.approx(cents, rel=0.01)
    assert found.wide_unisons == (("C4",) if is_wide else ())


@pytest.mark.parametrize(("cents", "at_limit"), [(12.0, True), (12.0, False), (40.0, True), (40.0, False)])
def test_a_unison_too_wide_for_the_modes_of_high_partials_is_not_a_good_one(cents, at_limit):
    """These modes lie 23.3 Hz apart at most. Beyond, one mode is at the limit or none is found."""
    response, limit = beating(cents), 2 * np.pi * 23.3
    pole = response.pole.copy()
    beyond = np.imag(pole[1::2] - pole[::2]) > limit
    pole[1::2] = np.where(beyond, pole[::2] + 1j * limit * at_limit, pole[1::2])
    found, key = tuning_with(response._replace(pole=pole))
    assert 0 < beyond.sum() < len(beyond)
    if at_limit or cents < 20:
        assert key.unison_cents is not None
        assert key.unison_cents.interval[0] > 2
        assert key.unison_cents.interval[1] == pytest.approx(cents, rel=0.01)
        assert found.wide_unisons == ("C4",)
    else:
        assert key.unison_cents is None


def test_few_partials_determine_no_interval_of_their_median():
    response = beating(5.0)
    few = response.partial <= 5
    response = response._replace(
        partial=response.partial[few], pole=response.pole[few], pole_error=response.pole_error[few],
        pattern=response.pattern[:, few],
    )  # fmt: skip
    found, key = tuning_with(response)
    assert len(key.beats) == 5
    assert key.unison_cents is None
    assert found.wide_unisons == ()


@pytest.mark.parametrize("count", [6, 8, 11, 16])
def test_the_interval_of_a_unison_holds_its_median(count):
    """Order statistics cover the median of any distribution."""
    random, held = np.random.default_rng(count), 0
    response = rung(66, count).modal_response
    assert response is not None
    pole = -0.4 + 1j * np.imag(response.pole)
    for _ in range(200):
        cents = 4 * np.exp(0.5 * random.normal(size=count))  # its median is 4
        pole[1::2] = -0.4 + 1j * np.imag(pole[::2]) * 2 ** (cents / 1200)
        pattern = np.repeat(response.pattern[:, ::2], 2, axis=1)
        beats = response._replace(pole=pole, pattern=pattern, pole_error=np.full(len(pole), 1e-6), velocity_gain=None)
        interval = _unison(60, beats)["unison_cents"].interval
        held += interval[0] <= 4 <= interval[1]
    assert held >= 182  # 95 % less two standard errors


def test_a_few_partials_that_beat_are_not_a_mistuned_unison():
    found, key = tuning_with(beating(9.0, slice(5, 8)))
    assert len(key.beats) == 3
    assert key.unison_cents is not None
    assert key.unison_cents.value == 0
    assert found.wide_unisons == ()


# --- published tables -------------------------------------------------------------------------------------------------


def young(midi: float) -> float:
    """B of plain wire strings: R. W. Young, J. Acoust. Soc. Am. 24, 267 (1952), six pianos.

    "About 1.2 cents for the second mode of vibration of the middle C string. Above this point every eight semitones it
    is doubled." The inharmonicity of mode n is 1200/2 log2(1 + B n²).
    """
    return (2 ** (1.2 / 600) - 1) / 4 * 2 ** ((midi - 60) / 8)


def test_published_strings_have_the_inharmonicity_that_young_measured():
    """Plain strings of a grand after Chabassier (2012) against six pianos of 1952, from C4 on."""
    plain = [string for string in STRINGS if string.midi >= 60]
    assert len(plain) == 3
    for string in plain:
        assert abs(math.log(string.B / young(string.midi))) < math.log(1.5), string.note


def test_a_piano_of_the_published_table_is_found_again(fits):
    """The six strings of the table as fits: all values of B within 95 % intervals, at its keys and by Young between."""
    covariance = np.diag(np.square(FIT_SD))
    keys = tuple(
        KeyMeasurements(s.midi, (Measurement(1.0, np.array([0.0, math.log(s.B)]), covariance),), np.zeros(2))
        for s in STRINGS
    )
    recorded = Recorded("after Chabassier", CHOSEN, keys, reference(), {}, ())
    found = tuning_of(recorded, posterior_of(recorded), 440.0, "2:1")
    for string in STRINGS:
        low, high = found.keys[string.midi - 21].B.interval
        assert low < string.B < high, string.note
    between = [key for key in found.keys if 60 <= key.midi <= 96]
    assert max(abs(math.log(key.B.value / young(key.midi))) for key in between) < math.log(1.5)


# --- files and the command --------------------------------------------------------------------------------------------


def test_the_command_writes_all_files(fits, tmp_path):
    done = run("tuning", fits, "--out", tmp_path / "out", "--a4", 442, "--octave", "6:3")
    assert done.exit_code == 0, done.output
    names = {file.name for file in (tmp_path / "out").iterdir()}
    assert names == {"tuning.html", "tuning.csv", "tuning.json", "tuning.ept"}
    with (tmp_path / "out" / "tuning.csv").open() as file:
        rows = list(csv.DictReader(file))
    document = json.loads((tmp_path / "out" / "tuning.json").read_text())
    assert [row["key"] for row in rows] == [key["note"] for key in document["keys"]]
    assert float(rows[0]["curve_6_3_cents_low"]) == document["keys"][0]["curves"]["6:3"]["interval"][0]
    assert float(rows[A4]["target_hz"]) == pytest.approx(442.0)
    assert rows[0]["deviation_cents"] == ""
    again = run("tuning", fits, "--out", tmp_path / "out")
    assert again.exit_code == 1
    printed = run("tuning", fits, "--json")
    assert json.loads(printed.output)["a4"] == 440.0


def ept(folder: Path) -> ElementTree.Element:
    return ElementTree.fromstring((folder / "tuning.ept").read_bytes())  # noqa: S314  (written just now)


def test_entropy_piano_tuner_reads_its_file(tuned, tmp_path):
    """As `PianoFileIOXml::read` does: attributes of the elements piano, keyboard and key."""
    write_tuning(tmp_path, tuned)
    root = ept(tmp_path)
    assert (root.tag, root.get("version")) == ("entropyPianoTunerFile", "1")
    piano, keyboard = root.find("piano"), root.find("piano/keyboard")
    assert piano is not None
    assert keyboard is not None
    assert (int(piano.attrib["type"]), float(piano.attrib["concertPitch"])) == (0, 440.0)
    assert (int(keyboard.attrib["numberOfKeys"]), int(keyboard.attrib["keyNumberOfA"])) == (88, A4)
    for element, key in zip(keyboard.iter("key"), tuned.keys, strict=True):
        assert int(element.attrib["key"]) == key.midi - 21
        assert element.attrib["recorded"] == str(int(key.recorded))
        assert float(element.attrib["computedFrequency"]) == pytest.approx(key.target.value)
        assert float(element.attrib["recordedFrequency"]) == (key.first_partial.value if key.recorded else 0)
        assert float(element.attrib["measuredInharmonicity"]) == (key.B.value if key.recorded else 0)


def test_computed_frequencies_of_the_file_belong_to_440_hz(fits, tmp_path):
    write_tuning(tmp_path, pianofit.tuning(fits, a4=435.0))
    element = list(ept(tmp_path).iter("key"))[A4]
    assert float(element.attrib["computedFrequency"]) == pytest.approx(440.0)


def test_names_are_escaped(fits, tuned, tmp_path):
    library(tmp_path, [40, 52, 64])
    for file in sorted((tmp_path / "keys").iterdir()):
        file.rename(file.with_name(file.name.replace("twin", "<i>&")))
    found = pianofit.tuning(tmp_path)
    assert found.name == "<i>&"
    (tmp_path / "out").mkdir()
    write_tuning(tmp_path / "out", found)
    assert "<i>&<" not in (tmp_path / "out" / "tuning.html").read_text()
    name = ept(tmp_path / "out").find("piano/name")
    assert name is not None
    assert name.text == "<i>&"


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--a4", "44"], "--a4 44"),
        (["--a4", "nan"], "--a4 nan"),
        (["--prefix", "other"], "'other'"),
    ],
)
def test_a_bad_option_is_one_line(fits, words, named):
    done = run("tuning", fits, *words)
    assert done.exit_code == 1
    assert named in done.output
    assert done.output.count("\n") == 1


def test_bad_files_are_one_line_and_nothing_is_written(fits, built, tmp_path):
    (tmp_path / "text.json").write_text("not json")
    (tmp_path / "empty").mkdir()
    shutil.copy(built, tmp_path)
    other = next(fits.glob("keys/*/fit.json"))
    for words in (["none"], ["text.json"], ["empty"], ["instrument.json", other]):
        done = run("tuning", *(tmp_path / word for word in words), "--out", tmp_path / "out")
        assert done.exit_code == 1
        assert done.output.count("\n") == 1
        assert not (tmp_path / "out").exists()
    assert run("tuning", fits, "--octave", "3:1").exit_code == 2
    for bad in ({"octave": "8:4"}, {"a4": 0.0}, {"paths": []}):
        with pytest.raises(pianofit.ParameterError, match=next(iter(bad))):
            pianofit.tuning(**({"paths": fits} | bad))  # pyright: ignore[reportArgumentType]


def test_an_instrument_without_fits_has_no_tuning(built, tmp_path):
    file = tmp_path / "instrument.json"
    document = json.loads(built.read_text())
    for key in document["keys"]:
        key["values"] = {}
    file.write_text(json.dumps(document))
    with pytest.raises(pianofit.FitError, match=r"instrument\.json"):
        pianofit.tuning(file)
