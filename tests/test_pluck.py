"""Plucked strings: the model against exact solutions and a brute-force string, fits against the truth, real plucks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from brute_pluck import pluck
from pluck_cases import draw

import pianofit
from pianofit import FitError, Geometry, Note, ParameterError, Pluck, Setup, SetupError, String
from pianofit.cli.fits import setup_of_options
from pianofit.excitation import NAMES, OTHERS, PLUCK, STROKES
from pianofit.felt import law_of
from pianofit.report.release import displacements
from pianofit.transducer import QUANTITIES, TRANSDUCERS

GUITAR = Path(__file__).parents[2] / "shared" / "guitar"
STRING = String(143.0, 0.42, 0.9, 4e-4)
PLACE = Geometry(length=0.65, mass=4e-3, strike_position=0.11, width=0.02, pickup=0.17)
RATE = 44_100
# Two programs agree to this; the intervals of a recording with little noise are narrower.
SAME = 1e-6


def note(
    quantity: str = "bridge-force", string: String = STRING, geometry: Geometry = PLACE, force: float = 1.0
) -> Note:
    return Note(string, Pluck(force), geometry, quantity, 1.0)


def test_an_ideal_pluck_has_the_modes_of_a_triangle():
    ideal = note(string=String(143.0, 1e-3, 1e-3, 1e-12), geometry=PLACE._replace(width=1e-5))
    k = np.arange(1, 41)
    exact = np.sin(k * np.pi * PLACE.strike_position / PLACE.length) / k**2
    np.testing.assert_allclose(displacements(ideal, 40), exact / exact[0], rtol=1e-5)
    # The force on the bridge of mode k is T β_k q_k, so it falls as 1/k; without losses levels are those of its square.
    level = ideal.levels(count=40)
    np.testing.assert_allclose(level - level[0], 20 * np.log10(np.abs(exact * k / exact[0])), atol=0.01)


def test_the_released_energy_is_the_work_of_the_force():
    released = note(string=STRING._replace(b1=1e-3, b2=1e-12)).strike(RATE)
    modes, free = released.modes, released.free
    at_release = np.asarray(modes.strike) @ np.asarray(free.amplitude).real  # displacement under the force of 1 N
    assert float(free.energy) == pytest.approx(0.5 * at_release, rel=1e-9)
    assert released.contacts == ()


@pytest.mark.parametrize("quantity", ["velocity", "displacement", "bridge-force"])
def test_the_sound_is_that_of_a_string_by_brute_force(quantity):
    expected = pluck(STRING, PLACE, rate=RATE, samples=RATE, quantity=quantity)
    found = note(quantity).render(seconds=1.0, rate=RATE)
    window = np.hanning(RATE)
    a, b = np.fft.rfft(window * expected), np.fft.rfft(window * found)
    strong = np.abs(a) > 1e-3 * np.abs(a).max()
    np.testing.assert_allclose(b[strong], a[strong], rtol=1e-4)


def test_the_size_is_a_gain_and_positions_mirror():
    loud, soft = (note(force=force).levels(count=30) for force in (2.0, 1.0))
    np.testing.assert_allclose(loud - soft, 20 * np.log10(2), atol=1e-9)
    mirrored = PLACE._replace(strike_position=PLACE.length - PLACE.strike_position)
    # Only the time from the pluck to the bridge differs, a millisecond of decay.
    np.testing.assert_allclose(note(geometry=mirrored).levels(count=30), soft, atol=0.5)


def test_a_pickup_on_the_string_exchanges_with_the_pluck():
    one = PLACE._replace(width=1e-4)
    other = one._replace(strike_position=one.pickup, pickup=one.strike_position)
    levels = [note("magnetic-pickup", geometry=g).levels(count=20) for g in (one, other)]
    np.testing.assert_allclose(levels[0], levels[1], atol=1e-3)


def test_every_excitation_answers_what_a_fit_asks():
    assert ("hammer", *OTHERS) == NAMES
    for law in (pianofit.felt.DEFAULT_LAW, *OTHERS.values()):
        assert law.kind in NAMES
        assert law.stroke is STROKES[law.kind]
        geometry = law.typical(pianofit.typical("A2").geometry, 0.5)
        low, high = law.stroke.bounds(geometry)
        assert low < law.stroke.prior(geometry)[0] < high
        for values in (law.stroke.coarse(geometry), law.stroke.fine(geometry)):
            assert (np.diff(values) > 0).all()
        starts = law.stroke.starts(geometry, np.arange(3.0))
        assert all(len(start) == 3 for start in starts)
    assert law_of(Pluck(1.0)) is PLUCK
    assert {name for name in QUANTITIES if TRANSDUCERS[name].unknown_path} == {"pressure", "magnetic-pickup"}


# --- fits -------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def fitted():
    case = draw(5, "magnetic-pickup", strokes=3)
    return case, pianofit.fit(*case.recordings[:2], setup=case.setup, progress=False)


def test_a_fit_of_brute_force_plucks_holds_the_truth(fitted):
    case, result = fitted
    assert (result.fit.excitation, result.fit.felt, result.fit.stroke_name) == ("pluck", "pluck", "x0")
    for name in ("c", "kappa", "b1", "b2"):
        low, high = result.parameters[name].interval
        assert low * (1 - SAME) <= case.true[name] <= high * (1 + SAME), name
    for row, position in zip(result.fit.recordings, case.positions, strict=False):
        low, high = row.stroke_interval
        assert low * (1 - SAME) <= position * case.setup.length <= high * (1 + SAME)
        assert high < 1.05 * low
    for name, value in (("x0/L", result.parameters.x0), ("width/L", result.parameters.width)):
        np.testing.assert_allclose(result.invariants[name].interval, np.array(value.interval) / case.setup.length)
    assert result.parameters.width.status == "not-identifiable"
    assert "v_H0" not in result.parameters
    assert not result.fit.velocity_scale_open


def test_a_saved_fit_is_the_same_and_predicts(fitted, tmp_path):
    case, result = fitted
    result.save(tmp_path / "fit", page=False)
    loaded = pianofit.Result.load(tmp_path / "fit")
    assert loaded.fit.parameters.x0.value == result.fit.parameters.x0.value
    for one, other in zip(loaded.minima_notes[0], result.minima_notes[0], strict=True):
        assert one.stroke_value == pytest.approx(other.stroke_value, rel=1e-6)
        np.testing.assert_allclose(one.render(seconds=0.2), other.render(seconds=0.2), rtol=1e-4, atol=1e-6)
    prediction = loaded.predict(case.recordings[2])
    assert prediction.stroke_value == pytest.approx(case.positions[2] * case.setup.length, rel=0.02)
    assert prediction.error_db < 1.0
    with pytest.raises(ParameterError, match="stroke_value"):
        _ = prediction.velocity


def test_the_page_of_a_pluck_has_no_hammer(fitted, tmp_path):
    _, result = fitted
    page = result.report(tmp_path / "report.html").read_text(encoding="utf-8")
    assert "plucking position" in page
    prose = page.partition("All results of this fit")[0]
    assert not [word for word in ("hammer velocity", "Hammer force", "felt") if word in prose]


def test_figures_of_a_hammer_are_refused(fitted):
    _, result = fitted
    for name in ("force", "felt"):
        with pytest.raises(FitError, match="plucked"):
            getattr(result.plot, name)()
    assert "pluck" in repr(result.note).lower()


def test_one_pluck_at_a_pickup_is_reported_as_ambiguous():
    case = draw(2, "magnetic-pickup", strokes=1, pickup_known=False)
    result = pianofit.fit(*case.recordings, setup=case.setup, progress=False)
    both = sorted([case.positions[0], case.true["pickup"] / case.setup.length])
    found = [sorted([n.geometry.strike_position, n.geometry.pickup]) for (n,) in result.minima_notes[:2]]
    for places in found:
        np.testing.assert_allclose(np.array(places) / case.setup.length, both, rtol=0.02)
    assert result.weights[0] < 0.9
    low, high = result.invariants["x0/L"].interval
    assert low <= both[0] * 1.01
    assert high >= both[1] * 0.99


def test_options_make_the_setup_and_contradict_a_file(tmp_path):
    made = setup_of_options(None, None, "pluck", "magnetic-pickup", 0.16)
    assert made == Setup(excitation="pluck", pickup_quantity="magnetic-pickup", pickup_position=0.16)
    (file := tmp_path / "setup.toml").write_text('string.length = 0.6\npickup.quantity = "bridge-force"\n')
    assert setup_of_options(file, None, "pluck", None, None).length == 0.6
    with pytest.raises(SetupError, match="quantity"):
        setup_of_options(file, None, "pluck", "magnetic-pickup", None)


@pytest.mark.parametrize(
    ("tables", "named"),
    [
        ({"felt": {"law": "power"}}, "felt"),
        ({"fixed": {"v_H0": 2.0}}, "v_H0"),
        ({"initial": {"K_H": 1e9}}, "K_H"),
        ({"pickup": {"quantity": "velocity", "position": 0.1, "scale": 1.0}}, "scale"),
        ({"recording": [{"file": "a.wav", "v_H0": 1.0}]}, "v_H0"),
        ({"pickup": {"quantity": "velocity"}}, "position"),
        ({"excitation": {"kind": "bow"}}, "bow"),
    ],
)
def test_values_that_a_pluck_does_not_have_are_rejected(tables, named):
    with pytest.raises(SetupError, match=named):
        Setup.from_dict({"excitation": {"kind": "pluck"}} | tables)


def test_a_velocity_of_a_pluck_is_rejected():
    with pytest.raises(ParameterError, match="velocity"):
        note().render(2.0)
    with pytest.raises(ParameterError, match="velocity"):
        pianofit.fit((np.zeros(RATE), RATE), setup=Setup(excitation="pluck"), velocity=2.0, progress=False)


# --- a real guitar ----------------------------------------------------------------------------------------------------


def test_a_wrong_position_is_told():
    case = draw(2, "magnetic-pickup", strokes=1)
    wrong = replace(case.setup, strike_position=0.3 * case.setup.length)
    told = [
        [line for line in pianofit.fit(*case.recordings, setup=setup, progress=False).warnings if "explain" in line]
        for setup in (case.setup, wrong)
    ]
    assert [len(lines) for lines in told] == [0, 1]


@pytest.mark.parametrize("table", ["strike", "pickup"])
def test_a_position_from_the_farther_end_is_rejected(table):
    """Its levels are those of the position from the nearer end, which the search has."""
    case = draw(2, "magnetic-pickup", strokes=1)
    setup = replace(case.setup, **{f"{table}_position": 0.6 * case.setup.length})
    with pytest.raises(SetupError, match=rf"\[{table}\] position.*nearer end, {0.4 * case.setup.length:.3g} m"):
        pianofit.fit(*case.recordings, setup=setup, progress=False)


@pytest.mark.skipif(not GUITAR.is_dir(), reason=f"{GUITAR} is not there")
def test_one_real_pluck_has_one_pitch_at_microphone_and_pickup():
    quantities = {"microphone": "pressure", "pickup": "magnetic-pickup"}
    results = {
        role: pianofit.fit(
            GUITAR / f"guitar-A3-v2-rr1-{role}.flac",
            setup=Setup(excitation="pluck", pickup_quantity=quantity),
            progress=False,
        )
        for role, quantity in quantities.items()
    }
    for name in ("f0", "B"):
        (a, b), (c, d) = (result.invariants[name].interval for result in results.values())
        assert max(a, c) <= min(b, d), name
    for name in ("b1", "b2"):
        (a, b), (c, d) = (result.parameters[name].interval for result in results.values())
        assert max(a, c) <= min(b, d), name
    for result in results.values():
        assert result.parameters.width.status == "not-identifiable"
        assert result.fit.converged


def test_a_pluck_of_a_displaced_string_has_the_energy_of_both_together():
    it, n = pianofit.preset("bensa-final"), 64
    shape = np.eye(n)[0] * 1e-3
    done = pianofit.simulate(it.string, pianofit.Pluck(1.0), it.geometry, n_modes=n, displacement=shape)
    modes, q = done.modes, done.free.amplitude.real
    alone = pianofit.simulate(it.string, pianofit.Pluck(1.0), it.geometry, n_modes=n).free.amplitude.real
    assert q == pytest.approx(alone + shape, abs=1e-12)
    energy = 0.5 * np.sum(modes.strike / modes.modal_gain * modes.omega2 * q**2, where=modes.modal_gain > 0)
    assert done.free.energy == pytest.approx(energy, rel=0.01)  # the losses add 0.3 %
