"""The reproduction of the paper: descriptors, claims, searches and limits against given values, and the files."""

from __future__ import annotations

import csv
import math
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest
import soundfile as sf
from report_cases import Page

from pianofit.bensa2005.descent import LeastSquares
from pianofit.errors import ParameterError
from pianofit.literature import preset
from pianofit.model.note import Note
from pianofit.parameters import FIT_NAMES
from studies.bensa2005 import claims, findings, limits
from studies.bensa2005.__main__ import app
from studies.bensa2005.direct import strike
from studies.bensa2005.findings import FULL, QUICK, spread_of
from studies.bensa2005.hammer_search import HammerSearch, criterion_plane, search_comparison
from studies.bensa2005.laboratory import SCALE
from studies.bensa2005.page import played, reproduce
from studies.bensa2005.strokes import attack_time, centroid

RATE = 44_100

# --- descriptors ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("length", [0.0004, 0.00123, 0.0029])
@pytest.mark.parametrize("height", [3.0, -0.01])
def test_attack_time_of_a_ramp_is_four_fifths_of_it(length, height):
    t = np.arange(RATE) / RATE
    assert attack_time(height * np.minimum(t / length, 1.0), RATE, 150.0) == pytest.approx(0.8 * length, rel=1e-6)


def test_attack_time_of_a_sine_is_that_of_its_first_quarter():
    t = np.arange(RATE) / RATE
    expected = (math.asin(0.9) - math.asin(0.1)) / (2 * math.pi * 200.0)
    assert attack_time(np.sin(2 * np.pi * 200.0 * t), RATE, 150.0) == pytest.approx(expected, rel=2e-3)


def test_attack_time_looks_at_the_first_wave_only():
    t = np.arange(RATE) / RATE
    wave = np.minimum(t / 0.001, 1.0)
    wave[RATE // 100 :] = 50.0
    assert attack_time(wave, RATE, 150.0) == pytest.approx(0.0008, rel=1e-6)


@pytest.mark.parametrize("samples", [np.zeros(1000), np.zeros(1)])
def test_silence_has_neither_attack_nor_centroid(samples):
    with pytest.raises(ParameterError, match="samples="):
        attack_time(samples, RATE, 150.0)
    with pytest.raises(ParameterError, match="silent"):
        centroid(np.zeros(RATE), RATE, 150.0)


def tones(partials: dict[float, float], decay: float = 1.0) -> np.ndarray:
    t = np.arange(RATE) / RATE
    parts = (a * np.exp(-decay * t) * np.sin(2 * np.pi * f * t + f) for f, a in partials.items())
    return sum(parts, np.zeros(len(t)))


def test_centroid_is_the_mean_of_frequencies_by_amplitude():
    partials = {151.0: 1.0, 304.0: 0.5, 1220.0: 0.1, 5330.0: 0.03, 9000.0: 5.0}  # the last lies above its range
    low = {f: a for f, a in partials.items() if f < 6000}
    expected = sum(f * a for f, a in low.items()) / sum(low.values())
    assert centroid(tones(partials), RATE, 152.0) == pytest.approx(expected, rel=2e-3)
    assert centroid(7.0 * tones(partials), RATE, 152.0) == pytest.approx(centroid(tones(partials), RATE, 152.0))


def test_centroid_hardly_hears_the_noise_of_a_measurement():
    sound = tones({152.0 * k: 1 / k**2 for k in range(1, 30)})
    noise = 1e-3 * np.sqrt(np.mean(sound**2)) * np.random.default_rng(0).standard_normal(len(sound))
    assert centroid(sound + noise, RATE, 152.0) == pytest.approx(centroid(sound, RATE, 152.0), rel=2e-3)


# --- the direct problem -----------------------------------------------------------------------------------------------


def test_the_loops_area_is_what_hammer_and_string_lose():
    for stroke in map(strike, (1.0, 4.0)):
        assert stroke.loop == pytest.approx(stroke.balance, rel=1e-9)
        assert 0 < stroke.loop < 0.1 * stroke.hammer_energy


# --- band 3 -----------------------------------------------------------------------------------------------------------


def made_up(deep: float = 0.0) -> HammerSearch:
    """Two minima at ±1 along the first coordinate, the left one `deep`er; a parabola along the others."""
    slope = np.sqrt(deep)

    def residuals(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x = z[:, 0]
        floor = np.full((len(z), 1), 0.1)  # a residual that no parameter removes
        r = np.concatenate([(x**2 - 1)[:, None], (slope * (x + 1))[:, None], z[:, 1:], floor], axis=1)
        jacobian = np.zeros((len(z), r.shape[1], 5))
        jacobian[:, 0, 0], jacobian[:, 1, 0] = 2 * x, slope
        jacobian[:, 2:6, 1:] = np.eye(4)
        return r, jacobian

    def cost(z: np.ndarray) -> np.ndarray:
        return 0.5 * (residuals(z)[0] ** 2).sum(axis=1)

    box = np.array([2.0, 1.0, 1.0, 1.0, 1.0])
    return HammerSearch(LeastSquares(cost, residuals, -box, box), np.array([1.5, 0.3, 0.0, 0.0, 0.0]), np.zeros(5))


def test_the_landscape_finds_its_minima_and_no_other():
    plane = criterion_plane(made_up(0.2), 31)
    assert [round(float(m.z[0]), 2) for m in plane.minima] == [-1.0, 0.89]
    assert all(abs(m.z[1]) < 1e-6 for m in plane.minima)
    assert plane.minima[0].cost == pytest.approx(0.005)
    assert plane.minima[1].cost > 0.1
    assert plane.criterion.shape == (31, 31)


def test_the_race_counts_who_found_the_deepest_minimum():
    run = search_comparison(made_up(0.2), 6, 1, iterations=400, evaluations=640)
    trapped = run.ends["gradient"] > 0.1
    assert trapped[0], "the first start is the initial point, in the shallow basin"
    assert 0 < trapped.sum() < 6
    assert run.successes("polished") == 6
    assert len(run.minima) == 2
    assert (run.ends["polished"] <= run.ends["annealed"] + 1e-12).all()
    again = search_comparison(made_up(0.2), 6, 1, iterations=400, evaluations=640)
    assert again.ends["annealed"].tolist() == run.ends["annealed"].tolist()


# --- limits -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow  # every grid's modes by its own matrices
def test_kappa_through_the_grid_agrees_with_the_closed_form():
    """Every mode of the scheme satisfies (2/δt tan ωδt/2)² = c² s + κ² s², which gives κ by least squares."""
    final, number = preset("bensa-final"), np.arange(2, 9)
    beta = number * np.pi / final.geometry.length
    omega = np.sqrt(final.string.c**2 * beta**2 + final.string.kappa**2 * beta**4)
    for fit in limits.dispersion_errors(number)[: len(limits.GRIDS)]:
        h = final.geometry.length / (fit.points + 1)
        s = (2 / h * np.sin(beta * h / 2)) ** 2
        warped = 2 * fit.rate * np.tan(omega / (2 * fit.rate))
        weight = 1 / warped**2  # cents
        a = np.stack([s, s**2], axis=1) * weight[:, None]
        c2, kappa2 = np.linalg.lstsq(a, warped**2 * weight, rcond=None)[0]
        assert fit.kappa == pytest.approx(math.sqrt(kappa2), rel=2e-4)
        assert fit.c == pytest.approx(math.sqrt(c2), rel=1e-6)


def test_prewarped_modes_bend_nothing_and_finer_grids_bend_less():
    *grids, prewarped = limits.dispersion_errors(limits.BAND2)
    assert prewarped.off == pytest.approx(0.0, abs=1e-6)
    assert [b.off for b in grids] == sorted((b.off for b in grids), reverse=True)
    assert grids[0].off > 0.2
    assert limits.inverse_dispersion_error().off == pytest.approx(-0.3, abs=0.01)  # (1.737² - (2.142² - 1.737²))^½


# --- files ------------------------------------------------------------------------------------------------------------


def test_spread_is_relative_and_by_name():
    rows = [dict.fromkeys(FIT_NAMES, 2.0), dict.fromkeys(FIT_NAMES, 2.0) | {"K_H": 2.2}]
    spread = spread_of(rows)
    assert spread["c"] == 0
    assert spread["K_H"] == pytest.approx(math.log(1.1) / math.sqrt(2))


def test_sounds_keep_their_level_in_their_files(tmp_path):
    sound = np.sin(np.arange(8000) / 5)
    stroke: Any = SimpleNamespace(recording=SimpleNamespace(rate=8000), sounds={"measured": sound, "read": 0.1 * sound})
    clips = played(tmp_path, "0.844", stroke, {"measured": "measured", "read": "three bands, string read"})
    samples, rate = sf.read(tmp_path / "0.844-three-bands-string-read.wav")
    assert rate == 8000
    np.testing.assert_allclose(samples, 0.1 * sound / SCALE, atol=1e-7)
    assert [clip.name for clip in clips] == ["measured", "three bands, string read"]
    assert {path.name for path in tmp_path.iterdir()} == {
        "0.844-measured.wav",
        "0.844-three-bands-string-read.wav",
    }


CLAIMS = 17
FIGURES = {
    "figure-2", "figure-3", "figure-4", "figure-6", "figure-7", "band-3", "searches", "descriptors", "predictions",
    "repeated", "effects", "kappa", "b2",
}  # fmt: skip


def check_folder(folder, plan) -> Page:
    """All contents exist, on the page and in files, and the page loads nothing."""
    text = (folder / "index.html").read_text(encoding="utf-8")
    page = Page(text)
    assert {path.stem for path in (folder / "figures").iterdir()} == FIGURES
    assert len(page.all("img")) == len(FIGURES)
    assert all(len(image["alt"]) > 20 and image["src"].startswith("data:image/svg+xml") for image in page.all("img"))
    for name in ("table-2", "table-3", "shares", "kappa", "b2", "effects", "searches", "repeated", "predictions"):
        assert len((folder / f"data/{name}.csv").read_text().splitlines()) > 1
    sounds = [path.name for path in (folder / "sounds").iterdir()]
    assert len(sounds) == 6 + 4 * (len(plan.velocities) - 1)
    assert "recordings are not public" in page.text
    assert text.count("default-src 'none'") == 1
    for _, attributes in page.tags:
        for name in ("src", "href"):
            link = attributes.get(name, "data:")
            assert link.startswith(("data:", "#")) or (folder / link).exists(), link
    for name in ("nan", "inf ", "None", "Undefined"):
        assert name not in page.text
    return page


class FakeResult(NamedTuple):
    """The part of a result that the page uses."""

    parameters: dict[str, Any]
    initial: Any
    fitted: Any


def known_fit(stroke, recipe, seed, annealing=None, tries=1):
    """In place of a fit: the true values, with a softer felt so that recipes and seeds differ."""
    first, last = preset("bensa-initial"), preset("bensa-final")
    softer = {"paper": 0.9, "read": 0.95, "global": 0.4, "default": 1.0}[recipe] * (1 + 0.01 * (seed % 7))
    struck = stroke.measurement.nominal_velocity
    hammer = last.hammer._replace(v_H0=struck, K_H=softer * last.hammer.K_H)
    notes = [
        SimpleNamespace(note=Note(string, hammer, last.geometry, "velocity", 0.2, None))
        for string, hammer in ((first.string, first.hammer._replace(v_H0=struck)), (last.string, hammer))
    ]
    values = last.string._asdict() | hammer._asdict()
    parameters = {k: SimpleNamespace(value=v, interval=(0.9 * v, 1.1 * v)) for k, v in values.items()}
    return FakeResult(parameters, *notes)


def run_command(*arguments: str) -> int:
    """Run `python -m studies.bensa2005`, and return the exit code."""
    return app(args=arguments, standalone_mode=False) or 0


def test_a_quick_run_of_the_command_makes_all_files(tmp_path, capsys, monkeypatch):
    """The whole command with given values in place of the fits. The slow tests include the fits."""
    monkeypatch.setattr(findings, "fitted", known_fit)
    assert run_command("--out", str(tmp_path / "out"), "--quick") == 0
    page = check_folder(tmp_path / "out", QUICK)
    shown = capsys.readouterr()
    assert shown.err == ""  # no terminal, no progress
    lines = [line for line in shown.out.splitlines() if line.startswith(tuple(claims.WORDS.values()))]
    assert len(lines) == CLAIMS
    outcome = {line[18:].split(" (")[0]: line[:18].strip() for line in lines}
    assert all(claim in page.text for claim in outcome)
    rows = [*csv.reader((tmp_path / "out/data/b2.csv").read_text().splitlines())][1:]
    assert all(value == repr(float(value)) for row in rows for value in row), "all digits, and no more"
    assert outcome["The waveform comes clearly nearer the measured one."] == claims.WORDS["yes"]
    assert outcome["Three bands keep attack and brightness better than a global criterion."] == claims.WORDS["yes"]
    before = (tmp_path / "out" / "index.html").read_bytes()
    assert run_command("--out", str(tmp_path / "out"), "--quick") == 1
    assert "not empty" in capsys.readouterr().err
    assert (tmp_path / "out" / "index.html").read_bytes() == before


@pytest.mark.slow
def test_a_quick_run_with_its_fits_makes_all_files_and_makes_them_again(tmp_path):
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        assert len(reproduce(tmp_path / name, seed=3, plan=QUICK)) == CLAIMS
    check_folder(tmp_path / "first", QUICK)
    for file in (tmp_path / "first").rglob("*.*"):
        if file.is_file():
            assert file.read_bytes() == (tmp_path / "second" / file.relative_to(tmp_path / "first")).read_bytes(), file


@pytest.mark.slow
def test_a_full_run_brings_the_papers_main_findings(tmp_path):
    outcome = {claim.text: claim.verdict.outcome for claim in reproduce(tmp_path, seed=0)}
    check_folder(tmp_path, FULL)
    for claim in (
        "The contact is shorter when the hammer is faster.",
        "Force over compression is a loop; its area is the energy lost in the felt.",
        "The sound is brighter when the hammer is faster.",
        "Band 3 has local minima.",
    ):
        assert outcome[claim] == "yes", claim
    assert outcome["The fitted κ is that of the string."] == "no"
    assert outcome["b2 is found in band 2."] == "no"
