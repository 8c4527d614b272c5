"""The page of several recordings: players, identifiability, and bands compared with random draws."""

from __future__ import annotations

import base64
import functools
import io
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import soundfile as sf
from report_cases import (
    SHARED,
    Page,
    content_of_recordings,
    covariance_content,
    drawn_in,
    drawn_once,
    example_content,
    example_fit,
    example_held_out,
    example_recordings,
    example_result,
    example_strokes,
    fit_of_recordings,
    minimum,
    response_content,
)
from scipy.signal import resample_poly

from pianofit.felt import RelaxingHammer
from pianofit.model.note import Note
from pianofit.parameters import Geometry, Hammer, String
from pianofit.report.drawing import page_style
from pianofit.report.identifiability import (
    CONDITIONAL,
    DETERMINED,
    UNDETERMINED,
    draw_identifiability,
    half_widths,
    identifiability_sections,
)
from pianofit.report.page import report_bytes
from pianofit.report.sound import make_clips, slider_of, strokes_of
from pianofit.report.static_law import StaticLaw, _loop, draw_felt, static_law
from pianofit.result import Result
from pianofit.result.fitted_recording import RenderedFit
from pianofit.schema.quantities import Covariance

HOSTILE = "</script><script>alert(1)</script>\"'><img src=x onerror=alert(2)>\n{{ 7 * 7 }} $\\frac$ &amp; \udcff"


STROKES = functools.cache(example_strokes)


@pytest.fixture(autouse=True)
def _drawn_once(monkeypatch):
    monkeypatch.setattr("pianofit.report.page.draw_figures", drawn_once)
    monkeypatch.setattr("pianofit.report.sound.strokes_of", lambda _: STROKES())


def written(fit=None, held_out=None, **sizes):
    return report_bytes(example_result(fit or fit_of_recordings(), **sizes), "three recordings", held_out).decode()


def sounds_of(page, player):
    """Samples of one player's WAV files, by name, and their rate."""
    links = [link for link in page.all("a") if link.get("data-player") == player]
    read = {a["data-name"]: sf.read(io.BytesIO(base64.b64decode(a["href"].split(",", 1)[1]))) for a in links}
    assert all(float(a["data-seconds"]) == len(read[a["data-name"]][0]) / read[a["data-name"]][1] for a in links)
    return {name: samples for name, (samples, _) in read.items()}, next(iter(read.values()))[1]


def test_page_shows_all_takes_and_what_was_left_out():
    html = written(held_out=example_held_out())
    page, drawn = Page(html), drawn_in(html)
    assert len(page.drawings) == len(drawn) == 19
    assert all(len(drawing["aria-label"]) > 40 for drawing in page.drawings)
    players = [tag["id"] for tag in page.all("div") if "player" in tag.get("class", "").split()]
    assert players == ["note", "strokes", "recording-2", "recording-3"]  # the first recording's is the note's own
    for part in (
        "Velocity slider", "from the softest to the loudest recording", "recording-2.flac, 0.6 m/s",
        "recording-3.flac 2.1 m/s 2.16 m/s 23 1.75 dB 4.5 dB –",
        "recording-2.flac 1.4 m/s 1.44 m/s 22 1.5 dB 4 dB 0.875 dB",
        "median error is 1.5 dB", "1.62 dB", "Estimated output path", "Leave-one-out prediction",
        "Ratios of the hammer velocities (the least certain one: ± 10 %)", "70 % 0 1.1 × 10¹⁰ 2.56", "recording-3.flac",
    ):  # fmt: skip
        assert part in page.text.replace("\u00a0", " "), part
    assert "/a folder" not in html
    assert any("recording 2: 0.6 m/s, error 1.2 dB" in svg for svg in drawn)
    order = [next(at for at, svg in enumerate(drawn) if f"recording {i}:" in svg) for i in (2, 3, 1)]
    assert order == sorted(order)  # from soft to loud


def test_figure_of_identifiability_has_the_given_numbers():
    content = content_of_recordings()
    for name, half in {"f0": 1.2e-8, "F/M_S": 0.05, "K_H": 8.348, "b1": 300.0}.items():
        table = content["parameters" if name in content["parameters"] else "invariants"]
        table[name] = with_half_interval(table[name], half)
    result = example_result(example_fit(content))
    drawn = " ".join(drawn_in(report_bytes(result, "three recordings").decode()))
    for label in ("± 1.2\u00a0×\u00a010⁻⁶ %", "± 5 %", "× or ÷ 4200", "unknown"):
        assert label in drawn, label
    below = [round(100 * r) for i, row in enumerate(result.correlation.matrix) for r in row[:i] if abs(r) >= 0.1]
    assert below
    for r in below:
        assert f">{r:+d}<".replace("-", "−") in drawn


def test_one_recording_has_a_felt_and_a_slider_but_no_recordings(monkeypatch):
    monkeypatch.setattr("pianofit.report.sound.strokes_of", lambda _: (STROKES()[0], False))
    text = Page(written(example_fit())).text
    for part in ("Other recordings", "Levels of each recording", "Estimated output path", "left out", "softest"):
        assert part not in text
    for part in ("Felt", "Velocity slider", "Identifiability", "half to twice the recorded velocity"):
        assert part in text


def test_page_of_five_long_takes_stays_small(monkeypatch):
    monkeypatch.setattr("pianofit.report.sound.strokes_of", lambda _: STROKES(rate=48_000, seconds=8.1))
    sizes, held_out = {"rate": 48_000, "seconds": 8.1}, example_held_out(5)
    rings = fit_of_recordings(5, modal_response=response_content())  # its page holds all that one without has
    assert len(written(rings, held_out, modes=True, **sizes)) < 8.2e6


def test_hostile_names_of_takes_stay_text():
    tame = Page(written(held_out=example_held_out()))
    content, held_out = content_of_recordings(), example_held_out()
    for recording in content["recordings"]:
        recording["file"] = HOSTILE
    hostile = replace(held_out, recordings=tuple(replace(row, file=HOSTILE) for row in held_out.recordings))
    page = Page(written(example_fit(content), hostile))
    assert page.scripts == tame.scripts
    assert {tag for tag, _ in page.tags} <= {tag for tag, _ in tame.tags}
    assert page.text.count("alert(2)") > 10


def test_soft_stays_soft_on_the_slider_and_recordings_are_equally_loud():
    result, (strokes, _) = example_result(fit_of_recordings()), STROKES()
    page = Page(report_bytes(result, "three recordings").decode())
    sounds, rate = sounds_of(page, "strokes")
    assert rate == 16000
    gain = 10 ** (-1 / 20) / max(np.abs(x).max() for x in strokes.values())
    body = slice(0, len(next(iter(strokes.values()))) - round(0.05 * rate))
    for played, given in zip(sounds.values(), strokes.values(), strict=True):
        np.testing.assert_allclose(played[body], gain * given[body], atol=1.1 / 32768)
    pair, _ = sounds_of(page, "recording-2")
    assert list(pair) == ["original", "fitted"]
    assert max(np.abs(x).max() for x in pair.values()) == pytest.approx(10 ** (-1 / 20), abs=1e-3)
    shape = result.recordings[1].recording.samples[: len(pair["original"]) - 800]
    assert np.corrcoef(pair["original"][: len(shape)], shape)[0, 1] > 0.999


@pytest.mark.parametrize(("rate", "factor"), [(44100, 2), (96000, 3), (44101, 2), (220500, 7)])
def test_light_sounds_are_brought_down_without_changing_them(rate, factor):
    t = np.arange(rate // 2) / rate
    sound = np.exp(-9 * t) * np.sin(2 * np.pi * 440 * t) + 0.3 * np.sin(2 * np.pi * 5000 * t)
    (clip,) = make_clips({"a": sound}, rate, lead_in=0.0, highest_rate=32000, matched=False)
    samples, new_rate = sf.read(io.BytesIO(base64.b64decode(clip.uri.split(",")[1])))
    assert new_rate == round(rate / factor)
    expected = 10 ** (clip.gain_db / 20) * resample_poly(sound, 1, factor)
    middle = slice(len(samples) // 10, len(samples) * 8 // 10)
    np.testing.assert_allclose(samples[middle], expected[middle], atol=3e-3)


# ---- figures of what a fit may lack ----


def nothing(array):
    return np.full_like(np.asarray(array, float), np.nan)


U = np.linspace(0.02, 1.0, 48)
FORCE = 30 * U**2.5 * np.array([1.0, 0.8, 1.25])[:, None]


@pytest.mark.parametrize(
    "law",
    [
        StaticLaw(U, FORCE, 0.7 * FORCE), StaticLaw(U, nothing(FORCE)), StaticLaw(U, 0 * FORCE),
        StaticLaw(U, np.exp(FORCE * [[0.0], [-9.0], [9.0]])),
    ],
    ids=["relaxing", "nan", "none", "wild"],
)  # fmt: skip
@pytest.mark.parametrize("pulse", [lambda x: x, nothing, lambda x: x[:0]], ids=["whole", "nan", "empty"])
def test_figure_of_the_felt_stands_any_law_and_stroke(monkeypatch, law, pulse):
    monkeypatch.setattr("pianofit.report.static_law.static_law", lambda _: law)
    result = example_result(fit_of_recordings())
    changed = []
    for fitted in result.recordings:
        given = {name: pulse(x) for name, x in vars(fitted.fitted.simulation.pulse).items()}
        simulation = fitted.fitted.simulation._replace(pulse=SimpleNamespace(**given))
        changed.append(replace(fitted, fitted=replace(fitted.fitted, simulation=simulation)))
    with page_style():
        assert len([panel.figure() for panel in draw_felt(replace(result, recordings=tuple(changed)))]) == 2


@pytest.mark.parametrize(
    ("correlation", "halves"),
    [
        (Covariance(("p",), np.ones((1, 1))), [("p", 300.0, False)]),
        (Covariance(("p", "mu"), nothing(np.eye(2))), [("p", 1e-30, True)]),
    ],
    ids=["one unknown", "nan correlation"],
)
def test_figure_of_identifiability_stands_any_numbers(monkeypatch, correlation, halves):
    monkeypatch.setattr(Result, "correlation", correlation)
    monkeypatch.setattr("pianofit.report.identifiability.half_widths", lambda _: halves)
    with page_style():
        assert len([panel.figure() for panel in draw_identifiability(example_result())]) == 2


def test_page_stands_predictions_that_failed():
    held_out = example_held_out()
    first, *others = held_out.recordings
    missing = dict.fromkeys(("predicted_stroke_value", "predicted_db", "partials", "nearest_db", "blend_db"))
    rows = (replace(first, **missing), *others)
    failed = replace(held_out, recordings=rows, median_inner_db=None, worst_inner_db=None)
    assert "three recordings" in written(held_out=failed)


# ---- arrays from a fit ----

VALUES = dict(zip(SHARED, (180.0, 0.9, 0.5, 4e-4, 5e9, 2.5, 0.2, 6e-3, 0.12, 0.02, 0.3, 2e-4), strict=False))
VALUES |= {"epsilon": 0.3, "tau": 2e-4}
GEOMETRY = Geometry(1.0, 0.02, 0.12, 0.02, 0.3)
RATE = 22_050


def scaled_by_velocity(covariance: Covariance) -> Covariance:
    """Return the same with a common scale s of the velocities, log s ~ N(0, 1): K_H varies as s^(1-p), μ as 1/s."""
    change = np.array([float(name.startswith("v_H0")) for name in covariance.names])
    change[SHARED.index("K_H")], change[SHARED.index("mu")] = 1 - VALUES["p"], -1.0
    return Covariance(covariance.names, covariance.matrix + np.outer(change, change))


@functools.cache
def rendered(velocity: float, memory: bool) -> RenderedFit:
    """Return the sound of a note with these parameters."""
    hammer = Hammer(VALUES["K_H"], 0.0 if memory else VALUES["mu"], VALUES["p"], VALUES["M_H"], velocity)
    string = String(*(VALUES[name] for name in SHARED[:4]))
    note = Note(string, RelaxingHammer(*hammer, 0.3, 2e-4) if memory else hammer, GEOMETRY, "velocity", 2.0, None)
    samples, simulation = note.render_stroke(RATE, RATE)
    return RenderedFit(note, samples, simulation)


def result_of(
    velocities=(3.0, 0.75, 1.5), reference_index=0, memory=False, free=("c", "kappa", "K_H", "p", "M_H"), interval=True
) -> Result:
    """Return a result with strokes of one note, whose parameters have intervals of a factor of 1.1 if `interval`."""
    content = content_of_recordings(len(velocities), velocities)
    for i, row in enumerate(content["recordings"]):
        row["is_reference"] = i == reference_index
    fixed = {"M_S", "v_H0"}.difference(free)
    names = {name: [0.9, 1.1] for name in free} | dict.fromkeys(fixed)
    content["parameters"] = {
        name: {"value": 1.0, "interval": span if interval else None, "status": "fitted"} for name, span in names.items()
    }
    spans = {"f0": [99.0, 101.0], "x0/L": None, "F/M_S": [80.0, 125.0]}
    content["invariants"] = {name: {"value": 100.0, "interval": span} for name, span in spans.items()}
    covariance = covariance_content(len(velocities), [name for name in free if name in SHARED])
    if memory:
        names = [*SHARED, "epsilon", "tau"]
        factor = np.zeros((len(names), len(names)))
        rows = [names.index(name) for name in free]
        factor[np.ix_(rows, rows)] = np.random.default_rng(4).normal(0, 0.01, (len(rows), len(rows)))
        covariance = {"names": names, "matrix": (factor @ factor.T).tolist()}
    content["minima"] = [minimum(1.0, 0.0) | {"covariance": covariance}]
    fit = example_fit(content)
    sounds = [rendered(velocity, memory) for velocity in velocities]
    (template,) = example_recordings(rate=RATE, seconds=1.0, count=12)
    return example_result(fit, tuple(replace(template, fitted=sound) for sound in sounds))


@pytest.mark.parametrize("memory", [False, True], ids=["hunt-crossley", "stulov"])
def test_the_felts_band_is_what_chance_gives(memory):
    result = result_of(memory=memory, free=("K_H", "p", "M_H", *(("epsilon", "tau") if memory else ("mu",))))
    law = static_law(result)
    deepest = max(np.max(recording.fitted.simulation.pulse.compression) for recording in result.recordings)
    assert law.compression_mm[-1] == pytest.approx(1e3 * float(deepest))
    names, cov = result.covariance.names, result.covariance.matrix
    drawn = np.random.default_rng(0).multivariate_normal(np.zeros(len(cov)), cov, 40_000)
    value = {name: VALUES.get(name, 1.0) * np.exp(drawn[:, i]) for i, name in enumerate(names)}
    for at in (0, 20, 47):
        force = value["K_H"] * (1e-3 * law.compression_mm[at]) ** value["p"]
        ends = np.quantile(np.log(force), [0.5, 0.025, 0.975])
        width = ends[2] - ends[1]
        np.testing.assert_allclose(np.log(law.force[:, at]), ends, atol=0.03 * width)
        if law.slow is not None:
            assert law.slow[0, at] == pytest.approx(0.7 * law.force[0, at])
            slow = np.quantile(np.log((1 - value["epsilon"]) * force), [0.025, 0.975])
            assert np.log(law.slow[2, at] / law.slow[1, at]) == pytest.approx(slow[1] - slow[0], rel=0.05)
    assert (law.slow is None) != memory


def test_half_widths_and_correlations_are_those_of_the_fit():
    result = result_of()
    correlation = result.correlation
    assert correlation is not None
    assert correlation.names == ("c", "kappa", "K_H", "p", "M_H")
    expected = [("f0", 101 / 99, True), ("F/M_S", 125 / 80, True), ("K_H", 1.1 / 0.9, False), ("p", 1.1 / 0.9, False)]
    halves = half_widths(result.fit)
    assert [(name, combined) for name, _, combined in halves] == [(name, c) for name, _, c in expected]
    np.testing.assert_allclose([half for _, half, _ in halves], [0.5 * np.log(x) for _, x, _ in expected])
    cov = result.covariance.matrix
    drawn = np.random.default_rng(1).multivariate_normal(np.zeros(len(cov)), cov, 40_000)
    sampled = np.corrcoef([drawn[:, SHARED.index(name)] for name in correlation.names])
    np.testing.assert_allclose(correlation.matrix, sampled, atol=0.02)


def with_covariance(result: Result, covariance: Covariance, **recording: object) -> Result:
    """Return the result with another covariance, and with other entries of its first recording."""
    (minimum,), (first, *others) = result.fit.minima, result.fit.recordings
    minima = (replace(minimum, covariance=covariance),)
    return replace(result, fit=replace(result.fit, minima=minima, recordings=(replace(first, **recording), *others)))


def test_an_unmeasured_scale_of_velocities_hides_nothing_of_the_felt():
    plain = result_of()
    wider = scaled_by_velocity(plain.covariance)
    scaled = with_covariance(plain, wider)
    wide = with_covariance(plain, wider, gain_status="given")
    np.testing.assert_allclose(static_law(scaled).force, static_law(plain).force, rtol=1e-6)
    assert np.log(static_law(wide).force[2, 20] / static_law(plain).force[2, 20]) > 1
    one, other = scaled.correlation, plain.correlation
    assert one.names == other.names  # μ varies only with the scale
    np.testing.assert_allclose(one.matrix, other.matrix, atol=1e-6)


def test_a_fit_without_intervals_claims_no_band():
    result = result_of(velocities=(2.0,), interval=False)
    assert result.correlation is None
    law = static_law(result)
    np.testing.assert_array_equal(law.force[1], law.force[0])
    np.testing.assert_array_equal(law.force[2], law.force[0])


def test_the_slider_ends_at_the_takes_and_plays_the_fitted_note():
    result = result_of(reference_index=2)
    strokes, is_recorded_range = strokes_of(result)
    velocities = [*strokes]
    assert is_recorded_range
    np.testing.assert_allclose([velocities[i] for i in (0, 3, -1)], [0.75, 1.5, 3.0], rtol=1e-12)
    assert slider_of(result)["first"] == 3
    for index, recording in ((0, 1), (3, 2), (-1, 0)):
        played = strokes[velocities[index]]
        assert len(played) == round(2.5 * RATE)
        np.testing.assert_allclose(played[:RATE], result.recordings[recording].fitted.samples, atol=1e-9)
    power = [np.mean(sound**2) for sound in strokes.values()]
    assert np.all(np.diff(power) > 0)


def test_one_take_is_played_from_half_to_twice_its_velocity():
    strokes, is_recorded_range = strokes_of(result_of(velocities=(15.0,)))
    assert not is_recorded_range
    np.testing.assert_allclose([*strokes][:: len(strokes) - 1], [7.5, 20.0], rtol=1e-12)  # no hammer is faster


def test_a_loop_reaches_the_largest_force_and_compression_of_its_stroke():
    for fitted in result_of().recordings:
        pulse, (compression, force) = fitted.fitted.simulation.pulse, _loop(fitted)
        assert np.nanmax(compression) == pytest.approx(1e3 * float(np.max(pulse.compression)), rel=1e-2)
        assert np.nanmax(force) == pytest.approx(float(np.max(pulse.force)), rel=1e-2)


# ---- text ----


def sections_of(content):
    sections = identifiability_sections(example_fit(content))
    return {heading: " ".join(sentences).replace("\u00a0", " ") for heading, sentences in sections}


def with_half_interval(entry, half):
    """Return the entry with a 95 % interval of this half-width, as a logarithm."""
    return entry | {"interval": [entry["value"] * math.exp(-half), entry["value"] * math.exp(half)]}


def content_with_half_intervals(**halves):
    content = example_content()
    for name, half in halves.items():
        key = name.replace("_over_", "/")
        content["invariants"][key] = with_half_interval(content["invariants"][key], half)
    return content


def test_what_is_fixed_and_what_is_not_is_said():
    fit = content_with_half_intervals(f0=1e-4, B=0.02, F_over_M_S=0.05, M_H_over_M_S=0.03)
    fit["parameters"]["K_H"] = with_half_interval(fit["parameters"]["K_H"], 0.9)
    fit["parameters"]["p"] = fit["parameters"]["p"] | {"interval": [2.0, 3.0], "status": "fitted"}
    sections = sections_of(fit)
    for part in (
        "f₀ = 92.3310 Hz (± 0.17 cents)", "B = 2.300 × 10⁻⁴ (± 2 %)", "F/M_S = 118.0 N/kg (± 5 %)",
        "at 0.5 mm, at the reference velocity shown", "uncertain by a factor of 2.5", "M_H/M_S = 0.920 (± 3 %)",
        "assumed mass", "common scale was not measured",
    ):  # fmt: skip
        assert part in sections[DETERMINED], part
    assert "x0/L" not in sections[DETERMINED]  # it was given
    assert set(sections) == {DETERMINED}


@pytest.mark.parametrize("known", ["gain_status", "stroke_status"])
def test_no_scale_is_open_where_gain_or_velocity_were_given(known):
    content = content_of_recordings()
    content["parameters"]["v_H0"] |= {"status": "fitted"}
    for recording in content["recordings"]:
        recording[known] = "given"
    sections = sections_of(content)
    assert "Hammer velocities (the least certain one: ± 10 %)" in sections[DETERMINED]
    assert "common scale" not in " ".join(sections.values())
    for recording in content["recordings"]:
        recording["stroke_status"] = "not-identifiable"
    assert "Hammer velocities" not in " ".join(sections_of(content).values())


def test_a_scale_is_open_where_not_even_ratios_are_identified():
    content = example_content()
    content["parameters"]["v_H0"] |= {"status": "not-identifiable"}
    assert example_fit(content).velocity_scale_open
    content["recordings"][0]["gain_status"] = "given"
    assert not example_fit(content).velocity_scale_open


def test_what_the_claims_question_is_not_called_determined():
    fit = content_with_half_intervals(F_over_M_S=0.05, M_H_over_M_S=0.03)
    for name in ("K_H", "mu", "p", "M_H"):
        fit["parameters"][name] |= {"status": "not-identifiable", "interval": [1.0, 1.1]}
    for name in ("F/M_S", "M_H/M_S"):
        fit["invariants"][name]["status"] = "not-identifiable"
    sections = sections_of(fit)
    for part in ("118.0 N/kg", "M_H/M_S"):
        assert part in sections[CONDITIONAL]
        assert part not in sections[DETERMINED]
    assert UNDETERMINED not in sections
    vague = content_with_half_intervals(F_over_M_S=1.5, M_H_over_M_S=12.0) | {"parameters": fit["parameters"]}
    for name in ("F/M_S", "M_H/M_S"):
        vague["invariants"][name]["status"] = "not-identifiable"
    sections = sections_of(vague)
    assert CONDITIONAL not in sections
    assert "× or ÷ 4.5" in sections[UNDETERMINED]
    assert "× or ÷ many powers of ten" in sections[UNDETERMINED]


def test_nothing_known_is_nothing_said():
    assert identifiability_sections(example_fit(invariants={})) == []
