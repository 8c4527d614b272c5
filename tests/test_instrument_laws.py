"""The keyboard laws against a synthetic piano whose parameters are given for every key."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from instrument_cases import ERRORS, covariance_of, fit_document, library, true_note, truth, write_fit

from pianofit.errors import FitError
from pianofit.felt import law_of
from pianofit.instrument import Instrument, build_instrument, find_fits, instrument_name, load_keys
from pianofit.instrument.key_measurements import measurements_of
from pianofit.instrument.key_quantities import (
    LAW_QUANTITIES,
    LOUDEST_VELOCITY,
    key_quantities,
    literature,
    note_from_quantities,
)
from pianofit.instrument.keyboard_posterior import KeyMeasurements, Measurement, keyboard_posterior
from pianofit.instrument.quantity_law import (
    SHAPE_SD,
    STUDENT,
    LawShape,
    Observed,
    Prior,
    integrate,
    log_posterior,
    most_probable,
)
from pianofit.instrument.velocity_curve import fit_velocity_curve, loudest_velocities, velocity_warnings
from pianofit.schema.decode import convert
from pianofit.schema.fit import Fit
from pianofit.schema.instrument import Layer, VelocityCurve
from pianofit.schema.quantities import Covariance, Quantities

KEYS = list(range(24, 100, 3))
ALL = list(range(21, 109))
MEASURED = ("B", "b1", "d2", "M_H/M_S", "F/M_S", "local_exponent", "mu", "x0/L")
NAMES = list(LAW_QUANTITIES)


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
    single = {"B": 0.01, "b1": 0.1, "d2": 0.1, "M_H/M_S": 0.03, "F/M_S": 0.2, "local_exponent": 0.04, "mu": 0.2,
              "x0/L": 0.005}  # fmt: skip
    assert np.sqrt(np.mean(error**2)) < 0.75 * single[name]
    assert np.abs(error / sd).max() < 4


@pytest.mark.parametrize(
    ("folder", "name"),
    [("cp80-Fs2", "cp80"), ("cp80 c#4", "cp80"), ("pianoC4", "piano"), ("C4", ""), ("bb3", ""), ("fitted1", ""),
     ("take2", ""), ("headroom-A0-close", "")],
)  # fmt: skip
def test_an_instrument_is_named_where_a_folder_names_a_key(folder, name):
    assert instrument_name(Path(folder) / "fit.json") == name


def test_keys_are_nearer_to_the_truth_than_their_fits(piano):
    for name in ("b1", "d2", "local_exponent", "mu"):
        entries = [piano.keys[midi].values[name] for midi in KEYS]
        true = np.exp(truth(name, KEYS))
        own, value = (np.log(row / true) for row in np.transpose([(x.own_fit.value, x.value) for x in entries]))
        assert np.sqrt(np.mean(value**2)) < 0.6 * np.sqrt(np.mean(own**2)), name


def test_a_key_keeps_its_own_pitch(piano):
    for midi in KEYS:
        entry = piano.keys[midi].values["cents"]
        assert key_quantities(piano.keys[midi].note, midi)["cents"] == pytest.approx(entry.own_fit.value, abs=1e-6)
        assert entry.value == pytest.approx(entry.own_fit.value, abs=0.5)
    between = [piano.keys[midi].values["cents"].value for midi in ALL]
    assert np.abs(between - truth("cents", ALL))[3:79].max() < 1.0


def test_every_key_can_be_played_and_says_where_it_comes_from(piano):
    assert [*piano.keys] == ALL
    assert all(
        np.isfinite([*key.note.string, *key.note.hammer, *key.note.geometry]).all() for key in piano.keys.values()
    )
    states = [key.state for key in piano.keys.values()]
    assert states[0] == states[-1] == "extrapolated"
    assert {states[midi - 21] for midi in KEYS} == {"recorded"}
    assert {states[m - 21] for m in range(24, 99) if m not in KEYS} == {"interpolated"}


def test_bad_keys_are_named_and_do_not_move_the_law(tmp_path):
    """Three wrong keys of 26, two of them neighbours with the same error."""
    folder = library(tmp_path, KEYS, seed=3)
    wrong = (39, 42, 84)
    for midi in wrong:
        note = true_note(midi)
        string = note.string._replace(b1=note.string.b1 * 5)
        hammer = note.hammer._replace(M_H=note.hammer.M_H * 2.5)
        write_fit(folder, midi, fit_document(note._replace(string=string, hammer=hammer), ERRORS))
    piano = build_instrument(load_keys(find_fits([folder])))
    for name in ("b1", "M_H/M_S"):
        error = np.log(piano.laws[name].value[np.array(wrong) - 21]) - truth(name, list(wrong))
        assert np.abs(error).max() < 0.15
        others = [abs(piano.keys[midi].values[name].own_fit.z) for midi in KEYS if midi not in wrong]
        for midi in wrong:
            assert abs(piano.keys[midi].values[name].own_fit.z) > max(4.0, *others)
    assert {midi for midi in ("D#2", "F#2", "C6") if sum(midi in x for x in piano.warnings) == 2} == {
        "D#2",
        "F#2",
        "C6",
    }


def test_a_wide_interval_is_drawn_in_and_a_narrow_one_stays(tmp_path):
    folder = library(tmp_path, KEYS, seed=4)
    for midi, sd, factor in ((48, 0.5, 1.8), (60, 0.005, 1.25)):
        note = true_note(midi)
        off = note._replace(string=note.string._replace(b1=note.string.b1 * factor))
        write_fit(folder, midi, fit_document(off, ERRORS | {"b1": sd}))
    piano = build_instrument(load_keys(find_fits([folder])))
    wide, narrow = (piano.keys[midi].values["b1"] for midi in (48, 60))
    assert abs(math.log(wide.value / math.exp(truth("b1", [48])[0]))) < 0.1
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


# --- the posterior of the keyboard, with few quantities ---------------------------------------------------------------


def measured(x, means, covariances, direction=None) -> list[KeyMeasurements]:
    """Measurements with one minimum a key: means [keys, quantities], covariances [keys, quantities, quantities]."""
    size = np.shape(means)[1]
    direction = np.zeros(size) if direction is None else np.array(direction)
    return [
        KeyMeasurements(int(k), (Measurement(1.0, np.array(m), np.array(c)),), direction)
        for k, m, c in zip(x, means, covariances, strict=True)
    ]


WIDE = Prior(0.5, 0.5, 0.5)


def posterior_of_one(x, y, sd, prior=WIDE):
    """The posterior of one quantity."""
    keys = measured(x, np.array(y)[:, None], np.square(np.broadcast_to(sd, len(x)))[:, None, None])
    return keyboard_posterior(keys, np.zeros((1, 88)), [prior], ALL)


def test_a_law_without_error_passes_through_its_keys():
    x = np.arange(21, 109, 4)
    y = 0.3 + 0.2 * np.sin(x / 25)
    found = posterior_of_one(x, y, 1e-4)
    assert np.abs(found.mean[0, 0][x - 21] - y).max() < 0.01
    assert np.abs(found.mean[1, 0, x - 21] - y).max() < 1e-3


def test_intervals_cover():
    """The 95 % intervals of laws and of all keys hold the truth in 88 to 99 % of cases, over 40 pianos."""
    random, x = np.random.default_rng(7), np.arange(21, 109, 5)
    keys = np.array(ALL)
    held = {"law": [], "recorded": [], "unrecorded": []}
    for _ in range(40):
        a, b, c, d = random.normal(size=4)
        f = 0.3 * a + 0.2 * b * (keys - 64) / 44 + 0.1 * c * np.sin(keys / 15 + 6 * d)
        true = f + 0.03 * random.normal(size=88)
        found = posterior_of_one(x, (true + 0.08 * random.normal(size=88))[x - 21], 0.08, prior=Prior(0.5, 0.4, 0.5))
        inside = np.abs(found.mean[1, 0] - true) < 1.96 * found.sd[1, 0]
        held["law"].append(np.abs(found.mean[0, 0] - f) < 1.96 * found.sd[0, 0])
        held["recorded"].append(inside[x - 21])
        held["unrecorded"].append(np.delete(inside, x - 21))
    for name, cases in held.items():
        assert 0.88 < np.mean(cases) < 0.99, name


def drawn_law(random, prior=WIDE) -> tuple[np.ndarray, np.ndarray]:
    """A law and values of 88 keys, drawn from the model of one quantity."""
    keys = np.array(ALL)
    smooth, scatter, length = prior.medians * np.exp(SHAPE_SD * random.normal(size=3))
    root = np.linalg.cholesky(np.exp(-0.5 * ((keys[:, None] - keys) / length) ** 2) + 1e-8 * np.eye(88))
    law = prior.offset * random.normal() + prior.slope_sd * random.normal() * (keys - 64.5) / 43.5
    law = law + smooth * root @ random.normal(size=88)
    return law, law + scatter * random.standard_t(STUDENT, size=88)


def test_intervals_of_few_keys_cover():
    """Six exact keys hardly determine the size, length and scatter of a law, and its intervals allow for that."""
    random, held = np.random.default_rng(11), {"law": [], "value": []}
    for _ in range(150):
        law, true = drawn_law(random)
        x = np.sort(random.choice(ALL, 6, replace=False))
        found = posterior_of_one(x, true[x - 21], 1e-3)
        held["law"].append(np.abs(found.mean[0, 0] - law) < 1.96 * found.sd[0, 0])
        held["value"].append(np.delete(np.abs(found.mean[1, 0] - true) < 1.96 * found.sd[1, 0], x - 21))
    for name, cases in held.items():
        assert 0.90 < np.mean(cases) < 0.99, name


def observed_law() -> Observed:
    """Seven keys of a drawn law, whose errors are correlated."""
    x = np.array([24.0, 31, 40, 52, 60, 75, 96])
    _, true = drawn_law(np.random.default_rng(2))
    noise = 1e-3 * np.eye(7) + 1e-3
    return Observed(x, true[x.astype(int) - 21], noise, np.array([1, 1, 0.4, 1, 1.1, 1, 0.8]))


def test_the_density_of_a_shape_has_the_gradient_of_finite_differences():
    observed, u = observed_law(), np.array([0.4, -0.7, 0.9])
    steps = 1e-5 * np.eye(3)
    differences = [
        (log_posterior(observed, WIDE, u + h)[0] - log_posterior(observed, WIDE, u - h)[0]) / 2e-5 for h in steps
    ]
    assert log_posterior(observed, WIDE, u)[1] == pytest.approx(differences, rel=1e-6, abs=1e-6)
    mode = most_probable(observed, WIDE, LawShape(*WIDE.medians))
    at_mode = (np.log(mode) - np.log(WIDE.medians)) / SHAPE_SD
    assert np.abs(log_posterior(observed, WIDE, at_mode)[1]).max() < 1e-3


def test_a_law_is_the_mean_over_all_shapes():
    """Against shapes drawn from their prior and weighted by the likelihood of the keys."""
    observed, at = observed_law(), np.array(ALL, float)
    mode = most_probable(observed, WIDE, LawShape(*WIDE.medians))
    found = integrate(observed, WIDE, mode, at)

    def covariance(a, b, smooth, length):
        tilt = (WIDE.slope_sd / 43.5) ** 2 * np.outer(a - 64.5, b - 64.5)
        return WIDE.offset**2 + tilt + smooth**2 * np.exp(-0.5 * ((a[:, None] - b) / length) ** 2)

    density, means, squares = [], [], []
    for normal in np.random.default_rng(4).normal(size=(8000, 3)):
        smooth, scatter, length = WIDE.medians * np.exp(SHAPE_SD * normal)
        total = covariance(observed.x, observed.x, smooth, length) + observed.noise
        total = total + np.diag(scatter**2 / observed.weights)
        gain = np.linalg.solve(total, covariance(observed.x, at, smooth, length)).T
        mean = gain @ observed.y
        variance = np.diag(covariance(at, at, smooth, length) - gain @ covariance(observed.x, at, smooth, length))
        density.append(-0.5 * (observed.y @ np.linalg.solve(total, observed.y) + np.linalg.slogdet(total)[1]))
        means.append(mean)
        squares.append(variance + mean**2)
    share = np.exp(np.array(density) - max(density))
    share /= share.sum()
    sd = np.sqrt(share @ squares - (share @ means) ** 2)
    assert np.abs(found.law - share @ means).max() < 0.1 * sd.max()
    assert found.law_sd == pytest.approx(sd, rel=0.1)


def test_the_scatter_between_keys_is_found():
    random, x = np.random.default_rng(5), np.arange(21, 109)
    y = 0.2 + 0.004 * (x - 60) + 0.1 * random.normal(size=88)
    found = posterior_of_one(x, y, 0.03)
    assert 0.05 < found.shapes[0].scatter < 0.2
    assert np.abs(found.mean[0, 0] - 0.2 - 0.004 * (x - 60)).max() < 0.1
    # A key with a good fit keeps its own deviation.
    assert np.sqrt(np.mean((found.mean[1, 0] - y) ** 2)) < 0.03


def test_a_key_moves_only_where_its_own_data_leave_it_open():
    """Two quantities of which one key measures the sum alone. Other keys measure both, and decide their difference."""
    x = [36, 40, 44, 48, 52, 56, 60]
    means, covariances = [[0.1, -0.1]] * len(x), [np.eye(2) * 1e-4] * len(x)
    total, difference = np.array([[1, 1], [1, 1]]) / 2, np.array([[1, -1], [-1, 1]]) / 2
    means[3], covariances[3] = [1.0, -0.8], 1e-6 * total + 4.0 * difference  # the sum is 0.2
    keys = measured(x, means, covariances)
    found = keyboard_posterior(keys, np.zeros((2, 88)), [Prior(0.5, 0.3, 0.3)] * 2, ALL)
    assert found.mean[1, :, 48 - 21].sum() == pytest.approx(0.2, abs=3e-3)
    assert found.mean[1, 0, 48 - 21] == pytest.approx(0.2, abs=0.12)


def test_the_other_keys_decide_between_the_minima_of_a_key():
    x, tight = [36, 40, 44, 48, 52, 56, 60], np.eye(1) * 1e-4
    keys = measured(x, [[0.02 * i] for i in range(len(x))], [tight] * len(x))
    both = (Measurement(0.8, np.array([0.9]), tight), Measurement(0.2, np.array([0.06]), tight))
    keys[3] = KeyMeasurements(48, both, np.zeros(1))
    found = keyboard_posterior(keys, np.zeros((1, 88)), [Prior(0.5, 0.3, 0.3)], ALL)
    assert found.shares[3][1] > 0.99
    assert found.mean[1, 0, 48 - 21] == pytest.approx(0.06, abs=0.02)
    # On its own, a key keeps the weights of its fit.
    alone = keyboard_posterior([keys[3]], np.full((1, 88), 0.48), [Prior(0.5, 0.3, 0.3)], ALL)
    assert alone.shares[0] == pytest.approx([0.8, 0.2], abs=0.05)


def test_the_scale_of_a_keys_velocities_follows_from_all_its_quantities():
    """One key was struck 1.3 times as fast as its fit assumes. All quantities that depend on velocities tell it."""
    x, direction, scale = np.arange(36, 66, 3), np.array([-8.0, -1.0, 0.5]), math.log(1.3)
    means = np.zeros((len(x), 3))
    means[4] = -scale * direction
    keys = measured(x, means, [np.diag([0.3, 0.02, 0.02]) ** 2] * len(x), direction)
    found = keyboard_posterior(keys, np.zeros((3, 88)), [Prior(5.0, 2.0, 2.0), *[Prior(0.5, 0.3, 0.3)] * 2], ALL)
    assert found.log_scale[4] == pytest.approx(scale, abs=0.06)
    assert np.abs(np.delete(found.log_scale, 4)).max() < 0.06


def test_the_covariance_of_the_quantities_is_that_of_many_draws():
    """Against draws of a fit's logarithms, each converted to quantities of a note on the common velocity scale."""
    note, random = true_note(60), np.random.default_rng(3)
    errors = {"c": 1e-4, "p": 1e-3, "x0": 1e-3, "v_H0 1": 1e-3, "K_H": 3e-3}
    errors |= dict.fromkeys(("kappa", "b1", "b2", "mu", "M_H", "v_H0"), 2e-3)
    document = fit_document(note, errors, (1.0, 2.0))
    fit = convert(document, Fit, "fit.json", "")
    (key,) = [measurements_of(fit, note, 60, 0.0)]
    covariance = covariance_of(errors, (1.0, 2.0), note.hammer.p, 0.3e-3)
    base = np.log([fit.minima[0].parameters.get(n, 1.0) for n in covariance.names])
    rows = []
    for draw in random.multivariate_normal(base, covariance.matrix, size=4000):
        at = dict(zip(covariance.names, np.exp(draw), strict=True))
        s = LOUDEST_VELOCITY / (2.0 * at["v_H0"])
        hammer = note.hammer._replace(K_H=at["K_H"] * s ** (1 - at["p"]), mu=at["mu"] / s, p=at["p"], M_H=at["M_H"])
        string = note.string._replace(**{n: at[n] for n in ("c", "kappa", "b1", "b2")})
        geometry = note.geometry._replace(strike_position=at["x0"], width=at["width"])
        own = key_quantities(note._replace(string=string, hammer=hammer, geometry=geometry), 60)
        # The scale itself has a direction of its own: `scale_direction`.
        own |= {"mu": own["mu"] / at["v_H0"], "F/M_S": own["F/M_S"] / at["v_H0"] ** (at["p"] - 1)}
        rows.append([LAW_QUANTITIES[n].scaled(own[n]) for n in NAMES if n != "level"])
    sd = np.std(rows, axis=0)
    stated = np.sqrt(np.diag(key.minima[0].covariance))
    free = [i for i, n in enumerate(NAMES) if n in MEASURED or n == "cents"]
    assert stated[free] == pytest.approx(sd[free], rel=0.06)
    tied = np.corrcoef(np.array(rows).T)[NAMES.index("F/M_S"), NAMES.index("local_exponent")]
    row, column = NAMES.index("F/M_S"), NAMES.index("local_exponent")
    assert key.minima[0].covariance[row, column] / (stated[row] * stated[column]) == pytest.approx(tied, abs=0.05)


def test_uncertain_sizes_leave_all_other_quantities_as_certain():
    """The values of a fit scale with an uncertain length and mass, and no ratio that a key hands over does."""
    note = true_note(60)
    fit = convert(fit_document(note, ERRORS, (1.0, 2.0)), Fit, "fit.json", "")
    began = {name: replace(own, initial=1.1 * float(own.value)) for name, own in fit.parameters.items()}
    fit = replace(fit, parameters=Quantities(began))  # with a prior, which is removed
    (minimum,), exact = fit.minima, fit.minima[0].covariance
    assert exact is not None
    powers = {"L": {"c": 1, "kappa": 2, "b2": 2, "x0": 1, "width": 1}, "M_S": {"K_H": 1, "M_H": 1}}
    scale = np.array([[float(own.get(name, 0)) for own in powers.values()] for name in exact.names])
    moved = np.vstack([scale, np.eye(2)]) @ np.diag([0.01, 0.03])
    matrix = np.pad(exact.matrix, (0, 2)) + moved @ moved.T
    wider = replace(minimum, covariance=Covariance((*exact.names, *powers), matrix))
    certain, uncertain = (
        measurements_of(replace(fit, minima=(one,)), note, 60, 0.0).minima[0] for one in (minimum, wider)
    )
    others = [i for i, name in enumerate(NAMES) if name not in ("L", "M_S/L", "pickup/L")]
    assert uncertain.mean[others] == pytest.approx(certain.mean[others], abs=1e-6)
    sd = np.sqrt(np.diag(certain.covariance))
    difference = (uncertain.covariance - certain.covariance) / np.outer(sd, sd)
    assert np.abs(difference[np.ix_(others, others)]).max() < 1e-3
    assert math.sqrt(uncertain.covariance[NAMES.index("L"), NAMES.index("L")]) == pytest.approx(0.01, rel=0.01)


def test_values_become_parameters_and_back():
    for midi in (21, 60, 108):
        note = true_note(midi)
        back = note_from_quantities(key_quantities(note, midi), midi, "pressure", law_of(note.hammer))
        assert back.string == pytest.approx(note.string, rel=1e-12)
        assert back.hammer[:4] == pytest.approx(note.hammer[:4], rel=1e-9)
        assert back.geometry == pytest.approx(note.geometry, rel=1e-12)


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


def layers_of(velocities, midi_velocities=None) -> list[Layer]:
    midi = midi_velocities or [None] * len(velocities)
    return [Layer("a.wav", "0", 0.1, v, m) for v, m in zip(velocities, midi, strict=True)]


def test_a_curve_goes_through_layers_at_the_midi_velocities_of_their_library():
    true, midi = VelocityCurve(0.9, 1.2), [30, 74.5, 97.5, 112.5, 123.5]
    layers = layers_of([true.at(m) for m in midi], midi)
    unknown = layers_of([layer.velocity for layer in layers])
    known, ordered = (fit_velocity_curve([key] * 30) for key in (layers, unknown))
    assert known.source == "midi-velocities"
    assert [known.at(m) for m in midi] == pytest.approx([true.at(m) for m in midi], rel=0.01)
    # The order of the layers alone does not tell that most of them are loud.
    assert ordered.source == "layers"
    assert ordered.at(64) > 1.2 * true.at(64)
    # Numbers of layers are not MIDI velocities.
    numbers = layers_of([layer.velocity for layer in layers], [1, 2, 3, 4, 5])
    assert fit_velocity_curve([numbers] * 30) == ordered
    assert "1 to 5" in velocity_warnings([numbers])[0]
    # A key with a layer of unknown MIDI velocity goes by the order of its layers, the others by their numbers.
    partly = layers_of([layer.velocity for layer in layers], [*midi[:4], None])
    assert [m for m, _ in fit_velocity_curve([layers, partly]).layers] == pytest.approx(
        [*midi, *(m for m, _ in ordered.layers[:5])]
    )
    assert velocity_warnings([layers, partly]) == velocity_warnings([partly]) == []
    # Two microphones record a stroke once.
    assert fit_velocity_curve([layers * 2] * 30).layers == known.layers


def test_a_key_without_loud_layers_is_set_to_what_its_midi_velocities_mean(tmp_path):
    true = VelocityCurve(LOUDEST_VELOCITY / math.exp(1.2), 1.2)  # 4 m/s at 127
    files = []
    for midi, recorded in ((48, (20, 60, 127)), (55, (20, 60, 127)), (60, (20, 60))):
        velocities = tuple(true.at(m) for m in recorded)
        note = true_note(midi).with_size(velocities[-1])
        # A fit through an unknown path knows the velocities up to a factor.
        document = fit_document(note, ERRORS, tuple(1.7 * v for v in velocities))
        for row, m in zip(document["recordings"], recorded, strict=True):
            row["midi_velocity"] = m
        files.append(write_fit(tmp_path, midi, document))
    found = [key.summary.velocities[-1] for key in load_keys(files)]
    assert found == pytest.approx([LOUDEST_VELOCITY, LOUDEST_VELOCITY, true.at(60)])
    layers = [key.summary.layers for key in load_keys(files)]
    assert loudest_velocities([*layers[:1], layers_of([1.0])]) == [LOUDEST_VELOCITY] * 2
    # Numbers of layers are not MIDI velocities.
    assert loudest_velocities([layers_of((1.0, 3.0), (1, 2)), layers_of([1.0], [1])]) == [LOUDEST_VELOCITY] * 2


def test_midi_velocities_rise_with_the_layers():
    curve = fit_velocity_curve([layers_of((0.5, 1.0, 2.0, 4.0)), layers_of((0.6, 1.1, 2.2, 4.0))])
    velocity = [curve.at(v) for v in range(1, 128)]
    assert all(np.diff(velocity) > 0)
    assert velocity[110] == pytest.approx(4.0, rel=0.15)
    assert velocity[15] == pytest.approx(0.55, rel=0.2)
    assert fit_velocity_curve([layers_of((4.0,))]).source == "default"
    # The curve rises even if the layers fall.
    assert fit_velocity_curve([layers_of((3.0, 1.0, 0.4), (1, 64, 127))] * 30).rise > 0


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
