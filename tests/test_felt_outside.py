"""A user's felt law: from recordings through fit, fit.json and page to rendering."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import pianofit
from pianofit import FeltLaw, FitError, Note, Parameter, ParameterError, Setup, SetupError, bensa2005
from pianofit.felt import LAWS
from pianofit.felt.law import scale_velocity
from pianofit.felt.relaxing import STULOV, force, storage
from pianofit.result.derived import scale_mass

# A felt with loss that hardens more than a power law.
FOAM = FeltLaw(
    "foam",
    {
        "K": Parameter("N/m²", "stiffness of the soft beginning", 1e5, 1e11, 3e7, 1.5),
        "s": Parameter("m", "compression at which it has doubled", 1e-5, 1e-2, lambda midi: 0.018 / midi, 1.0),
        "d": Parameter("s/m", "loss of the foam", 1e-3, 1e1),
    },
    lambda u, w, felt: felt.K * u**2 * (1 + u / felt.s) * (1 + felt.d * w),
    lambda u, felt: felt.K * (u**3 / 3 + u**4 / (4 * felt.s)),
)
PRESET = pianofit.preset("chabassier-F3")
TRUE = FOAM.hammer(K=8e7, s=2e-4, d=0.2, M_H=PRESET.hammer.M_H, v_H0=2.0)
VELOCITIES = (0.6, 1.5, 4.0)  # m/s


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """The folder of a fit of three layers with FOAM; their velocities are given."""
    random, recordings = np.random.default_rng(0), []
    for velocity in VELOCITIES:
        stroke = pianofit.simulate(
            PRESET.string, TRUE._replace(v_H0=velocity), PRESET.geometry, quantity="bridge-force"
        )
        samples = np.pad(stroke.waveform(44_100, 88_200), (4_410, 0)) / 100
        samples += random.normal(0.0, 3e-5, len(samples))
        recordings.append(pianofit.recording_from_samples(samples, 44_100, name=f"{velocity}.wav"))
    infos = tuple(pianofit.RecordingInfo(file=f"{v}.wav", v_H0=v) for v in VELOCITIES)
    sizes = {"length": PRESET.geometry.length, "mass": PRESET.geometry.mass}
    result = pianofit.fit(*recordings, setup=Setup(**sizes, recordings=infos, felt=FOAM), progress=False)
    return result.save(tmp_path_factory.mktemp("fit") / "foam")


def test_its_parameters_are_found_within_their_intervals(folder):
    result = pianofit.Result.load(folder, felt=FOAM)
    for name in FOAM.parameters:
        low, high = result.parameters[name].interval or (np.nan, np.nan)
        assert low < getattr(TRUE, name) < high, name
        assert high / low < 1.3, name  # the prior spans a factor of 50 and more
    assert result.fit.converged
    assert {result.parameters[name].status for name in ("K", "s", "d", "M_H")} == {"fitted"}
    assert result.parameters.M_H.interval is not None
    low, high = result.parameters.M_H.interval
    assert low < PRESET.hammer.M_H < high < 1.3 * low
    assert result.parameters.K.meaning == "stiffness of the soft beginning"
    assert not {"K_H", "p"} & {*result.parameters}


def test_its_file_and_page_have_its_name_and_curve(folder):
    assert json.loads((folder / "fit.json").read_text())["felt"] == "foam"
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "“foam”" in page
    assert "compression at which it has doubled" in page
    assert "u<sup>p</sup>" not in page


def test_a_file_of_it_plays_with_the_law_and_says_so_without(folder):
    note, rate = pianofit.load_note(folder / "fit.json", felt=FOAM)
    assert (type(note.hammer), rate) == (FOAM.hammer_type, 44_100)
    table = json.loads((folder / "fit.json").read_text())["parameters"]
    assert {name: getattr(note.hammer, name) for name in FOAM.parameters} == {
        name: table[name]["value"] for name in FOAM.parameters
    }
    assert np.abs(note.render(3.0, seconds=0.1)).max() > 0
    with pytest.raises(FitError, match=r"'foam'.*load_note\(path, felt=law\)"):
        pianofit.load_note(folder / "fit.json")
    with pytest.raises(FitError, match=r"'foam'.*'stulov'"):
        pianofit.load_note(folder / "fit.json", felt=STULOV)


SMALL = {"a": Parameter("N", "", 1.0, 2.0)}


def law(name: str = "foam", **changes) -> FeltLaw:
    return FeltLaw(**{"name": name, "parameters": SMALL, "force": lambda u, _, felt: felt.a * u} | changes)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: Setup(felt=law("power")), SetupError, "power"),
        (lambda: Setup(felt=FOAM, fixed={"d": 20.0}), SetupError, r"\[fixed\] d = 20.0 must be .* 0.001 to 10 s/m"),
        (lambda: Setup(felt=FOAM, fixed={"K_H": 1e9}), SetupError, "K_H .*foam.* d"),
        (lambda: law(parameters={"a": Parameter("N", "", 2.0, 1.0)}), ParameterError, "foam: a: .*2.0.*1.0"),
        (lambda: law(parameters={"a": Parameter("N", "", 1.0, 2.0, 3.0)}), ParameterError, "a: median=3.0 must be"),
        (lambda: law(parameters={"a": Parameter("N", "", 1.0, 2.0, None, 0.0)}), ParameterError, "spread=0.0 must be"),
        (lambda: law(power=("a", "q")), ParameterError, r"power=\('a', 'q'\)"),
    ],
)
def test_what_cannot_be_fitted_is_refused(make, error, message):
    with pytest.raises(error, match=message):
        make()


def test_the_papers_recipes_have_the_papers_felt():
    sound = Note(PRESET.string, PRESET.hammer, PRESET.geometry, "bridge-force", 0.002).render(seconds=0.5)
    with pytest.raises(ParameterError, match=r"method='paper'.*felt='foam'"):
        bensa2005.fit((sound, 44_100), setup=Setup(felt=FOAM), progress=False)


def test_a_prior_that_says_nothing_is_the_box():
    loss = FOAM.parameters["d"]
    assert loss.prior_median(60) == pytest.approx(0.1)
    assert loss.prior_median(60) * np.exp(1.96 * loss.prior_sd) == pytest.approx(loss.upper)
    assert FOAM.parameters["s"].prior_median(60) == pytest.approx(3e-4)  # a median may depend on the key


def test_what_scales_with_lengths_and_masses_follows_from_the_units():
    assert (FOAM.parameters_with_unit("N m"), FOAM.parameters_with_unit("N")) == (("K", "s", "d"), ("K",))
    found = {name: law.parameters_with_unit("N m") for name, law in LAWS.items()}
    soft = ("K_H", "mu", "skin")
    assert found == {"hunt-crossley": ("K_H", "mu"), "power": ("K_H",), "soft-skin": soft, "stulov": ("K_H",)}


# Parameters whose units have lengths and forces in numerator and denominator.
FUR = FeltLaw(
    "fur",
    {
        "K": Parameter("N/m^p", "stiffness", 1e3, 1e15),
        "p": Parameter("1", "exponent", 1.0, 5.0),
        "a": Parameter("1/m", "rise of the stiffness", 1.0, 1e5),
        "w0": Parameter("m/s", "speed at which the loss doubles the force", 1e-2, 1e3),
        "y": Parameter("m²/N^2", "compliance squared", 1e-15, 1.0),
    },
    lambda u, w, felt: felt.K * u**felt.p * (1 + felt.a * u) * (1 + w / felt.w0) + u / felt.y**0.5,
    power=("K", "p"),
)


@pytest.mark.parametrize("scale", [scale_velocity, scale_mass])
def test_a_law_scales_as_its_units_say_and_the_contact_lasts_as_long(scale):
    before = {"K": 4e8, "p": 2.5, "a": 800.0, "w0": 20.0, "y": 1e-9, "M_H": PRESET.hammer.M_H, "v_H0": 1.5}
    after = scale({**before, "M_S": PRESET.geometry.mass}, FUR, 1.7)
    geometry = PRESET.geometry._replace(mass=after.pop("M_S"))
    assert after["y"] == pytest.approx(before["y"] * (1.0 if scale is scale_velocity else 1.7**-2))
    first = pianofit.simulate(PRESET.string, FUR.hammer(**before), PRESET.geometry)
    second = pianofit.simulate(PRESET.string, FUR.hammer(**after), geometry)
    np.testing.assert_allclose(second.pulse.force, 1.7 * np.asarray(first.pulse.force), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_a_relaxing_felt_stores_no_more_than_it_takes(seed):
    """Compression follows a random curve; the relaxation equation is solved in fine steps."""
    random = np.random.default_rng(seed)
    felt = STULOV.make_hammer({"K_H": 1e9, "p": 2.5, "epsilon": 0.6, "tau": 2e-4, "M_H": 5e-3, "v_H0": 1.0})
    t = np.linspace(0.0, 2e-3, 40_001)
    waves = sum(random.normal() * np.sin(np.pi * k * t / t[-1]) for k in range(1, 8))
    u = 3e-4 * np.abs(waves)
    c, step = np.zeros_like(u), t[1]
    for n in range(len(u) - 1):
        c[n + 1] = c[n] + (u[n] ** felt.p - c[n]) * -np.expm1(-step / felt.tau)
    push = force(u, 0.0, felt, c)
    taken = np.append(0.0, np.cumsum(0.5 * (push[1:] + push[:-1]) * np.diff(u)))
    lost = taken - (storage(u, felt, c) - storage(u[0], felt, c[0]))
    assert np.diff(lost).min() > -1e-6 * lost[-1]
    assert lost[-1] > 0


LAW_FILE = """
from ..parameters import Parameter
from .law import FeltLaw

LAWS = (FeltLaw("straw", {"k": Parameter("N/m", "stiffness", 1e3, 1e6)}, lambda u, w, felt: felt.k * u),)
"""
USE = """
import pianofit
from pianofit.felt import LAWS

straw = LAWS["straw"]
assert pianofit.Setup.from_dict({"felt": {"law": "straw"}, "fixed": {"k": 2e4}}, "here").law is straw
it = pianofit.typical(60)
hammer = straw.hammer(k=2e4, M_H=it.hammer.M_H, v_H0=1.0)
assert pianofit.simulate(it.string, hammer, it.geometry).pulse.force.max() > 1
"""


def test_a_law_of_the_package_is_one_file(tmp_path):
    package = Path(pianofit.__file__).parent
    shutil.copytree(package, tmp_path / "pianofit", ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "pianofit" / "felt" / "straw.py").write_text(LAW_FILE)
    subprocess.run([sys.executable, "-c", USE], check=True, env={"PYTHONPATH": str(tmp_path)}, timeout=300)
    shown = [sys.executable, "-m", "pianofit", "fit", "--help"]
    done = subprocess.run(
        shown, capture_output=True, text=True, check=True, env={"PYTHONPATH": str(tmp_path), "COLUMNS": "200"}
    )
    assert "straw" in done.stdout
