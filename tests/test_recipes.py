"""The paper's recipes: their steps, fixed values and bounds, statements without intervals, and errors."""

from __future__ import annotations

import contextlib
import functools
import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import pianofit
from pianofit import ParameterError, analyse, bensa2005, recording_from_samples
from pianofit.bensa2005 import search as searching
from pianofit.bensa2005.method import SearchResult, search_parameters
from pianofit.bensa2005.point_estimate import FELT_UNKNOWN, NO_INTERVALS, OPENING
from pianofit.cli import main
from pianofit.criterion import band_values, damping_for, measure
from pianofit.errors import SetupError
from pianofit.inference import InitialValues, starting_values
from pianofit.model import simulate
from pianofit.model.note import arrival
from pianofit.parameters import FIT_NAMES, Hammer, String
from pianofit.result.warnings import NOT_CONVERGED
from pianofit.schema.decode import builtins_of
from pianofit.schema.fit import Fit
from pianofit.synthetic import demo_recording, setup_text

FEW = 600


@functools.cache
def synthetic():
    return demo_recording(60.0, seed=0)


@functools.cache
def recording():
    return recording_from_samples(synthetic().samples, synthetic().rate, name="synthetic")


@functools.cache
def analysis():
    return analyse(recording())


def setup(**more: Any) -> pianofit.Setup:
    """The setup of the demo with more tables. Fixed values have no initial value."""
    initial = {name: x for name, x in synthetic().setup.initial.items() if name not in more.get("fixed", {})}
    return replace(synthetic().setup, **more | {"initial": initial | more.get("initial", {})})


def bounded():
    """Fixed values, and bounds that exclude the true values."""
    fixed, start = {"p": 2.5, "c": 304.0}, {"K_H": 1.5e9, "M_H": 4e-3, "kappa": 1.6}
    return setup(fixed=fixed, initial=start, bounds={"K_H": [1e8, 5e9], "M_H": [1e-3, 5e-3], "kappa": [1.5, 1.7]})


@functools.cache
def uncalibrated():
    """A recording at a third of its level, its analysis, and a setup without a scale and initial values."""
    quiet = recording_from_samples(0.3 * synthetic().samples, synthetic().rate, name="synthetic")
    return quiet, analyse(quiet), replace(setup(), initial={}, pickup_scale=None)


@functools.cache
def of_four_partials():
    rate, rng = 16_000, np.random.default_rng(0)
    t = np.arange(2 * rate) / rate
    samples = sum(np.exp(-2 * t) * np.sin(2 * np.pi * 220 * k * t) / k**2 for k in (1, 2, 3, 4))
    note = recording_from_samples(np.pad(0.3 * samples, (1600, 0)) + rng.normal(0, 1e-3, len(t) + 1600), rate, name="a")
    return note, analyse(note)


def start(given=None) -> InitialValues:
    return starting_values(analysis(), given or setup())


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({"length": 1.0, "fixed": {"c": 400.0}}, ("c = 400 m/s", "length = 1 m", "200.0 Hz")),
        ({"fixed": {"c": 2000.0}}, ("c = 2000 m/s", "152.")),
        ({"length": 0.03}, ("length = 0.03 m", "9.12 m/s", "152.")),
    ],
)
def test_a_string_of_another_pitch_is_refused(given, named):
    with pytest.raises(SetupError) as error:
        start(pianofit.Setup(**given))
    assert all(word in str(error.value) for word in named)


@pytest.mark.parametrize(("cents", "refused"), [(-60, True), (-40, False), (40, False), (60, True)])
def test_a_wave_speed_and_a_length_may_be_less_than_half_a_semitone_off(cents, refused):
    """`ANOTHER_PITCH`, from both sides."""
    given = pianofit.Setup(length=1.0, fixed={"c": 2 * analysis().f0 * 2 ** (cents / 1200)})
    with pytest.raises(SetupError, match="length = 1 m") if refused else contextlib.nullcontext():
        start(given)


def search(given=None, method: str = "paper", **more: Any) -> SearchResult:
    return search_parameters(recording(), analysis(), start(given), method, **more)


@functools.cache
def paper() -> SearchResult:
    return search(evaluations=3000)


@functools.cache
def short() -> SearchResult:
    return search(evaluations=FEW, seed=3)


def values(end: SearchResult) -> dict[str, float]:
    return dict(zip(FIT_NAMES, (*end.string, *end.hammer), strict=True))


def off(end: SearchResult, name: str) -> float:
    return abs(values(end)[name] / synthetic().true[name] - 1)


def criterion(string: String, hammer: Hammer, delay: float) -> dict[str, float]:
    """Eq. 19 of the sound from the onset of the recording on, `delay` seconds after the first contact."""
    begin, a, r = start(), analysis(), recording()
    measured = r.samples[r.onset :] * begin.scale
    late = round(delay * r.rate)
    sound = simulate(string, hammer, begin.geometry, rate=r.rate).waveform(r.rate, len(measured) + late)[late:]
    (cells, energy), (_, own) = (
        measure(x, r.rate, a.f0, a.B, int(a.partials.number.max()), damping_for(a.f0)) for x in (measured, sound)
    )
    return band_values(own, energy, cells.spacing)


def final(end: SearchResult) -> dict[str, float]:
    return criterion(end.string, end.hammer, end.delay)


def initial() -> dict[str, float]:
    value = [start().initial[name] for name in FIT_NAMES]
    string = String(*value[:4])
    return criterion(string, Hammer(*value[4:]), arrival(string, start().geometry, "velocity"))


# --- the three steps --------------------------------------------------------------------------------------------------


def test_the_three_steps_lead_from_the_papers_initial_values_near_the_truth():
    found, after, before = paper(), final(paper()), initial()
    assert all(after[band] < before[band] for band in ("global", "band1", "band2", "band3"))
    assert off(found, "c") < 1e-5
    assert off(found, "kappa") < 0.01
    assert off(found, "M_H") < 0.15
    assert after["band3"] < 0.01
    assert found.converged
    assert 2500 < found.evaluations < 4000


def test_the_string_is_held_while_the_hammer_is_searched():
    assert short().string == paper().string


def test_the_same_seed_gives_the_same_result():
    assert search(evaluations=FEW, seed=3) == short()


def test_the_global_criterion_goes_down_and_leaves_the_brightness_behind(monkeypatch):
    monkeypatch.setattr(searching, "ITERATIONS", 25)
    found = search(method="global")
    after = final(found)
    assert after["global"] < 0.1 * initial()["global"]
    # "The energy of high frequency components" has little weight (paper IV.B).
    assert after["band3"] > 10 * final(paper())["band3"]
    assert not found.converged


def test_the_delay_goes_back_to_the_first_contact():
    assert paper().delay == pytest.approx(
        (recording().onset - synthetic().onset) / recording().rate, abs=2 / recording().rate
    )


# --- given values -----------------------------------------------------------------------------------------------------


def test_known_values_and_bounds_hold_exactly():
    given = bounded()
    found = search(given, evaluations=FEW)
    for name, number in given.fixed.items():
        assert values(found)[name] == number
    for name, (low, high) in given.bounds.items():
        assert low <= values(found)[name] <= high
    edges = set(found.at_bound) & set(given.bounds)
    assert edges
    assert all(min(abs(np.log(values(found)[n] / np.array(given.bounds[n])))) < 1e-4 for n in edges)


def test_a_known_felt_stiffness_stays_while_the_exponent_moves():
    found = search(setup(fixed={"K_H": 1.09949e10, "v_H0": 0.79993}), evaluations=FEW)
    assert found.hammer.K_H == 1.09949e10
    assert found.hammer.v_H0 == 0.79993
    assert found.hammer.p != start().initial["p"]
    assert off(found, "p") < 0.02


def test_an_uncalibrated_recording_holds_the_assumed_velocity_and_leaves_the_onset():
    quiet, analysed, given = uncalibrated()
    begin = starting_values(analysed, given)
    found = search_parameters(quiet, analysed, begin, evaluations=FEW)
    assert found.hammer.v_H0 == begin.values["v_H0"]
    string = String(*(begin.initial[name] for name in String._fields))
    assert found.delay == arrival(string, begin.geometry, begin.quantity)


def test_a_power_law_felt_has_no_loss():
    given = replace(setup(), initial={}, felt="power")
    assert search(given, evaluations=FEW).hammer.mu == 0.0


def test_a_note_without_a_third_band_uses_the_next():
    note, analysed = of_four_partials()
    begin = starting_values(analysed, pianofit.Setup(felt="hunt-crossley"))
    found = search_parameters(note, analysed, begin, evaluations=FEW)
    assert found.hammer.p != begin.initial["p"]
    assert np.isfinite([*found.string, *found.hammer]).all()


# --- statements of a result -------------------------------------------------------------------------------------------


def fit(sound, found, given, **more: Any) -> Fit:
    return bensa2005.fit(sound, analysis=found, setup=given, **more).fit


def fitted(given=None, **more: Any) -> Fit:
    return fit(recording(), analysis(), given or setup(), **more)


@functools.cache
def result_of(calibrated: bool) -> pianofit.Result:
    """A short fit of the demo, or of the same sound without a scale."""
    sound, analysed, given = (recording(), analysis(), setup()) if calibrated else uncalibrated()
    return bensa2005.fit(sound, analysis=analysed, setup=given, evaluations=FEW)


def test_no_interval_is_claimed_and_that_is_said():
    whole = result_of(True).fit
    json.dumps(builtins_of(whole), allow_nan=False)
    assert whole.recipe == "paper"
    assert all(p.interval is None for p in whole.parameters.values())
    assert {p.status for p in whole.parameters.values()} <= {"fitted", "given", "at-bound"}
    assert not whole.invariants
    assert not whole.minima
    assert NO_INTERVALS in whole.warnings
    assert not any("intervals include" in message for message in whole.warnings)
    assert whole.identifiability_statement == OPENING["paper"]
    for name in FIT_NAMES:
        assert whole.parameters[name].initial == setup().initial[name]


def test_a_search_that_stopped_is_said(monkeypatch):
    monkeypatch.setattr(searching, "ITERATIONS", 5)
    whole = fitted(method="global")
    assert not whole.converged
    assert any(NOT_CONVERGED in message for message in whole.warnings)


def test_values_at_a_bound_are_said():
    whole = fitted(bounded(), evaluations=FEW)
    bound = [name for name, p in whole.parameters.items() if p.status == "at-bound"]
    assert set(bound) & set(bounded().bounds)
    assert any(all(name in message for name in bound) for message in whole.warnings)
    assert all(whole.parameters[name].status == "given" for name in bounded().fixed)


@pytest.mark.parametrize("calibrated", [True, False])
def test_the_levels_of_a_recipe_are_those_of_its_sounds(calibrated):
    sound, analysed = (recording(), analysis()) if calibrated else uncalibrated()[:2]
    result = result_of(calibrated)
    scale = 20 * np.log10(start().scale) if calibrated else 0.0
    compared = result.reference.compared
    for played, level in ((result.initial, compared.initial), (result.fitted, compared.fitted)):
        # Levels of the sounds as the analysis measures them, in file units.
        own = analyse(recording_from_samples(played.samples, sound.rate, name="played")).partials
        strong = own.number[own.level > own.level.max() - 20]
        both = np.intersect1d(strong, analysed.partials.number)
        measured = own.level[np.isin(own.number, both)] + scale
        np.testing.assert_allclose(level[np.isin(analysed.partials.number, both)], measured, atol=0.5)


def test_an_uncalibrated_recording_leaves_the_felt_unknown():
    whole = result_of(False).fit
    states = {name: p.status for name, p in whole.parameters.items()}
    assert all(states[name] == "not-identifiable" for name in ("K_H", "mu", "p"))
    assert states["v_H0"] == "assumed"
    assert whole.identifiability_statement == OPENING["paper"] + FELT_UNKNOWN


def test_a_band_without_partials_is_said():
    whole = fit(*of_four_partials(), pianofit.Setup(), evaluations=FEW)
    assert whole.criterion.excluded_bands == ("band3",)
    assert any("band 3" in message for message in whole.warnings)


# --- errors -----------------------------------------------------------------------------------------------------------

REFUSED = [("papers", None, "papers"), ("paper", 10, "evaluations=10"), ("global", 5000, "annealing")]


@pytest.mark.parametrize(("method", "evaluations", "named"), REFUSED)
def test_a_fit_refuses_other_methods_and_evaluations(method, evaluations, named):
    with pytest.raises(ParameterError, match=named):
        fitted(method=method, evaluations=evaluations)


def test_a_felt_with_memory_is_not_the_papers():
    given = replace(setup(), initial={}, felt="stulov")
    with pytest.raises(ParameterError, match="felt='stulov'"):
        search(given)


def test_an_unknown_recipe_is_no_command(tmp_path, capsys):
    assert main(["fit", str(tmp_path / "none.wav"), "--out", str(tmp_path / "out"), "--recipe", "papers"]) == 2
    error = capsys.readouterr().err
    assert "papers" in error
    assert all(name in error for name in ("default", "paper", "global"))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (["a.wav", "--evaluations", "900"], "--evaluations 900"),
        (["a.wav", "--recipe", "global", "--evaluations", "900"], "--recipe paper"),
        (["a.wav", "b.wav", "--recipe", "paper"], "--recipe paper fits one recording; 2 were given"),
        (["a.wav", "--recipe", "paper", "--intervals", "profile"], "--intervals profile needs --recipe default"),
    ],
)
def test_a_command_refuses_options_that_its_recipe_does_not_have(tmp_path, capsys, options, named):
    assert main(["fit", *options, "--out", str(tmp_path / "out")]) == 1
    assert named in capsys.readouterr().err


def test_the_command_line_from_end_to_end(tmp_path, capsys):
    out = tmp_path / "out"
    (tmp_path / "synthetic.wav").write_bytes(pianofit.encode_wav(synthetic().samples, synthetic().rate))
    (tmp_path / "setup.toml").write_text(setup_text(synthetic().setup))
    command = ["fit", str(tmp_path / "synthetic.wav"), "--setup", str(tmp_path / "setup.toml"), "--out", str(out)]
    assert main([*command, "--recipe", "paper", "--evaluations", str(FEW), "--seed", "1"]) == 0
    assert "No intervals" in capsys.readouterr().out
    whole = pianofit.Result.load(out).fit
    assert whole.recipe == "paper"
    assert whole.seed == 1
    assert whole.diagnostics.evaluations >= FEW // 2
    assert all(p.interval is None for p in whole.parameters.values())
    assert "recipe “paper”" in (out / "report.html").read_text()
    note, _ = pianofit.load_note(out / "fit.json")
    assert whole.parameters["K_H"].value == note.hammer.K_H
