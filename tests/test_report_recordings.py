"""The page of several recordings: players, identifiability, and bands compared with random draws."""

from __future__ import annotations

import base64
import dataclasses
import io
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import soundfile as sf
from report_cases import (
    Page,
    drawn_in,
    drawn_once,
    example_curves,
    example_fit,
    example_held_out,
    fit_of_recordings,
    ringing_entry,
    with_recordings,
    with_ringing,
)
from scipy.signal import resample_poly

from pianofit.felt import LAWS, RelaxingHammer
from pianofit.inference.parametrisation import names_of
from pianofit.model.note import Note
from pianofit.parameters import Geometry, Hammer, String
from pianofit.report.build import felt_of, identifiability_of, paths_of, recordings_of, strokes_of
from pianofit.report.figure_data import Felt, IdentifiabilityData
from pianofit.report.identifiability_text import (
    CONDITIONAL,
    DETERMINED,
    UNDETERMINED,
    identifiability_sections,
    open_scale,
)
from pianofit.report.page import report_bytes
from pianofit.report.sound import make_clips
from pianofit.schema.quantities import Quantities

HOSTILE = "</script><script>alert(1)</script>\"'><img src=x onerror=alert(2)>\n{{ 7 * 7 }} $\\frac$ &amp; \udcff"


@pytest.fixture(scope="module")
def curves():
    return with_recordings(example_curves(rate=16000, seconds=2.0, count=12))


@pytest.fixture(autouse=True)
def _drawn_once(monkeypatch):
    monkeypatch.setattr("pianofit.report.page.draw_figures", drawn_once)


def written(folder, fit, curves, held_out=None):
    path = folder / "report.html"
    path.write_bytes(report_bytes(fit, curves, "three recordings", held_out))
    return path.read_text(encoding="utf-8")


def sounds_of(page, player):
    """Samples of one player's WAV files, by name, and their rate."""
    links = [link for link in page.all("a") if link.get("data-player") == player]
    read = {a["data-name"]: sf.read(io.BytesIO(base64.b64decode(a["href"].split(",", 1)[1]))) for a in links}
    assert all(float(a["data-seconds"]) == len(read[a["data-name"]][0]) / read[a["data-name"]][1] for a in links)
    return {name: samples for name, (samples, _) in read.items()}, next(iter(read.values()))[1]


def test_page_shows_all_takes_and_what_was_left_out(tmp_path, curves):
    html = written(tmp_path, fit_of_recordings(), curves, example_held_out())
    page, drawn = Page(html), drawn_in(html)
    assert len(page.drawings) == len(drawn) == 18
    assert all(len(drawing["aria-label"]) > 40 for drawing in page.drawings)
    players = [tag["id"] for tag in page.all("div") if "player" in tag.get("class", "").split()]
    assert players == ["note", "strokes", "recording-2", "recording-3"]  # the first recording's is the note's own
    for part in (
        "Velocity slider", "from the softest to the loudest recording", "recording-2.flac, 0.6 m/s",
        "recording-3.flac 2.1 m/s 2.16 m/s 23 1.75 dB 4.5 dB –",
        "recording-2.flac 1.4 m/s 1.44 m/s 22 1.5 dB 4 dB 0.875 dB",
        "median error is 1.5 dB", "1.62 dB", "Estimated output path", "Leave-one-out prediction",
        "Ratios of the hammer velocities (the least certain ± 10 %)", "70 % 0 1.1 × 10¹⁰ 2.56", "recording-3.flac",
    ):  # fmt: skip
        assert part in page.text.replace("\u00a0", " "), part
    assert any("recording 2: 0.6 m/s, error 1.2 dB" in svg for svg in drawn)
    order = [next(at for at, svg in enumerate(drawn) if f"recording {i}:" in svg) for i in (2, 3, 1)]
    assert order == sorted(order)  # from soft to loud


def test_figure_of_identifiability_has_the_given_numbers(tmp_path, curves):
    half_widths = (("f0", 1.2e-8, True), ("F/M_S", 0.05, True), ("K_H", 8.348, False), ("b1", 300.0, False))
    data = dataclasses.replace(curves.identifiability, half_widths=half_widths)
    html = written(tmp_path, fit_of_recordings(), dataclasses.replace(curves, identifiability=data))
    drawn = " ".join(drawn_in(html))
    for label in ("± 1.2\u00a0×\u00a010⁻⁶ %", "± 5 %", "× or ÷ 4200", "unknown"):
        assert label in drawn, label
    below = [round(100 * r) for i, row in enumerate(data.correlation) for r in row[:i] if abs(r) >= 0.1]
    for r in below:
        assert f">{r:+d}<".replace("-", "−") in drawn


def test_one_recording_has_a_felt_and_a_slider_but_no_recordings(tmp_path, curves):
    one = dataclasses.replace(
        curves, recordings=curves.recordings[:1], strokes=dataclasses.replace(curves.strokes, inside=False)
    )
    text = Page(written(tmp_path, example_fit(), one)).text
    for part in ("Other recordings", "Levels of each recording", "Estimated output path", "left out", "softest"):
        assert part not in text
    for part in ("Felt", "Velocity slider", "Identifiability", "half to twice the recorded velocity"):
        assert part in text


def test_page_of_five_long_takes_stays_small(tmp_path):
    long = with_recordings(example_curves(rate=48000, seconds=8.1, count=5), (0.5, 1.0, 2.0, 3.0, 4.0))
    assert len(written(tmp_path, fit_of_recordings(5), long, example_held_out(5))) < 8e6
    rings = fit_of_recordings(5, ringing=ringing_entry())
    assert len(written(tmp_path, rings, with_ringing(long), example_held_out(5))) < 8.5e6


def test_hostile_names_of_takes_stay_text(tmp_path, curves):
    tame = Page(written(tmp_path, fit_of_recordings(), curves, example_held_out()))
    fit, held_out = fit_of_recordings(), example_held_out()
    for recording in (*fit["recordings"], *held_out["recordings"]):
        recording["file"] = HOSTILE
    page = Page(written(tmp_path, fit, curves, held_out))
    assert page.scripts == tame.scripts
    assert {tag for tag, _ in page.tags} <= {tag for tag, _ in tame.tags}
    assert page.text.count("alert(2)") > 10


def test_soft_stays_soft_on_the_slider_and_recordings_are_equally_loud(tmp_path, curves):
    page = Page(written(tmp_path, fit_of_recordings(), curves))
    sounds, rate = sounds_of(page, "strokes")
    assert rate == 16000
    gain = 10 ** (-1 / 20) / max(np.abs(x).max() for x in curves.strokes.sounds)
    body = slice(0, len(curves.strokes.sounds[0]) - round(0.05 * rate))
    for played, given in zip(sounds.values(), curves.strokes.sounds, strict=True):
        np.testing.assert_allclose(played[body], gain * given[body], atol=1.1 / 32768)
    pair, _ = sounds_of(page, "recording-2")
    assert list(pair) == ["original", "fitted"]
    assert max(np.abs(x).max() for x in pair.values()) == pytest.approx(10 ** (-1 / 20), abs=1e-3)
    shape = curves.recordings[1].sound_original[: len(pair["original"]) - 800]
    assert np.corrcoef(pair["original"][: len(shape)], shape)[0, 1] > 0.999


@pytest.mark.parametrize(("rate", "factor"), [(44100, 2), (96000, 3), (44101, 2), (220500, 7)])
def test_light_sounds_are_brought_down_without_changing_them(rate, factor):
    t = np.arange(rate // 2) / rate
    sound = np.exp(-9 * t) * np.sin(2 * np.pi * 440 * t) + 0.3 * np.sin(2 * np.pi * 5000 * t)
    (clip,) = make_clips({"a": sound}, rate, lead_in=0.0, highest_rate=32000, matched=False)
    samples, new_rate = sf.read(io.BytesIO(base64.b64decode(clip.uri.split(",")[1])))
    assert (new_rate, clip.rate) == (round(rate / factor), round(rate / factor))
    expected = 10 ** (clip.gain_db / 20) * resample_poly(sound, 1, factor)
    middle = slice(len(samples) // 10, len(samples) * 8 // 10)
    np.testing.assert_allclose(samples[middle], expected[middle], atol=3e-3)


def nothing(array):
    return np.full_like(np.asarray(array, float), np.nan)


@pytest.mark.parametrize(
    "case",
    [
        lambda c: dataclasses.replace(c, felt=Felt(c.felt.compression, nothing(c.felt.force)), strokes=None),
        lambda c: dataclasses.replace(c, felt=Felt(c.felt.compression, 0 * c.felt.force)),
        lambda c: dataclasses.replace(c, felt=Felt(c.felt.compression, np.exp(c.felt.force * [[0.0], [-9.0], [9.0]]))),
        lambda c: dataclasses.replace(
            c, identifiability=IdentifiabilityData(("p",), np.ones((1, 1)), (("p", 300.0, False),))),
        lambda c: dataclasses.replace(
            c, identifiability=IdentifiabilityData(("p", "mu"), nothing(np.eye(2)), (("p", 1e-30, True),))),
        lambda c: dataclasses.replace(c, recordings=tuple(
            dataclasses.replace(t, force=nothing(t.force), compression=nothing(t.compression), level=nothing(t.level))
            for t in c.recordings)),
        lambda c: dataclasses.replace(c, recordings=tuple(
            dataclasses.replace(t, force=np.zeros(0), compression=np.zeros(0), sound_fitted=np.zeros(0))
            for t in c.recordings)),
        lambda c: dataclasses.replace(c, recordings=c.recordings * 5, paths=((np.array([100.0]), np.array([0.0])),)),
    ],
    ids=["nan felt", "no felt", "wild felt", "one unknown", "nan correlation", "nan", "empty", "many"],
)  # fmt: skip
def test_page_stands_what_takes_may_lack(tmp_path, curves, case):
    held_out = example_held_out()
    held_out["recordings"][0] |= dict.fromkeys(("predicted_v_H0", "predicted_db", "partials", "nearest_db", "blend_db"))
    held_out |= {"median_inner_db": None, "worst_inner_db": None}
    assert written(tmp_path, fit_of_recordings(), case(curves), held_out)


# ---- arrays from a fit ----

NAMES = names_of(LAWS["hunt-crossley"])
VALUES = dict(zip(NAMES, (180.0, 0.9, 0.5, 4e-4, 5e9, 2.5, 0.2, 6e-3, 0.12, 0.02, 0.3, 2e-4), strict=True))
GEOMETRY = Geometry(1.0, 0.02, 0.12, 0.02, 0.3)


def covariance(names, strokes, seed=4, size=0.01):
    """Return a random covariance of the logarithms of `names`, then of the velocities of the strokes."""
    factor = np.zeros((len(NAMES) + strokes, len(NAMES) + strokes))
    rows = [NAMES.index(name) for name in names]
    factor[np.ix_(rows, rows)] = np.random.default_rng(seed).normal(0, size, (len(rows), len(rows)))
    return factor @ factor.T


def scaled_by_velocity(cov):
    """Return the same with a common scale s of the velocities, log s ~ N(0, 1): K_H varies as s^(1-p), μ as 1/s."""
    change = np.zeros(len(cov))
    change[NAMES.index("K_H")], change[NAMES.index("mu")] = 1 - VALUES["p"], -1.0
    change[len(NAMES) :] = 1.0
    return cov + np.outer(change, change)


class FakeFit(SimpleNamespace):
    """A result with the attributes that these tests use."""

    parameters = property(lambda self: Quantities.of(self.document["parameters"]))


def fake_fit(
    velocities=(3.0, 0.75, 1.5), reference_index=0, memory=False, free=("c", "kappa", "K_H", "p", "M_H")
) -> Any:
    """Return an invented result with strokes of one note."""
    string = String(*(VALUES[n] for n in NAMES[:4]))
    recordings = []
    for i, v in enumerate(velocities):
        hammer = Hammer(VALUES["K_H"], 0.0 if memory else VALUES["mu"], VALUES["p"], VALUES["M_H"], v)
        note = Note(string, RelaxingHammer(*hammer, 0.3, 2e-4) if memory else hammer, GEOMETRY, "velocity", 2.0, None)
        samples, simulation = note.render_stroke(22050, 22050)
        number = np.arange(1, 6 + i)
        fitted = SimpleNamespace(note=note, samples=samples, simulation=simulation, level=np.zeros(len(number)))
        recordings.append(SimpleNamespace(
            partials=SimpleNamespace(number=number, level_error=np.full(len(number), 0.1)), level=np.zeros(len(number)),
            fitted=fitted, final=fitted, recording=SimpleNamespace(rate=22050, onset=100 * i, samples=samples),
            levels={"fitted_db": 0.5},
        ))  # fmt: skip
    table = {name: {"value": 1.0, "interval": [0.9, 1.1], "status": "fitted"} for name in free}
    invariants = {"f0": {"interval": [99.0, 101.0]}, "x0/L": {"interval": None}, "F/M_S": {"interval": [80.0, 125.0]}}
    document = {
        "parameters": table, "invariants": invariants,
        "recordings": [{"group": 0, "stroke": i} for i, _ in enumerate(recordings)],
    }  # fmt: skip
    return FakeFit(
        document=document, recordings=tuple(recordings), reference_index=reference_index,
        note=recordings[reference_index].fitted.note,
        covariance=SimpleNamespace(names=(*NAMES, "v_H0", *("v_H0 2", "v_H0 3")[: len(velocities) - 1]),
                                   matrix=covariance(free, len(velocities))),
        fitted=recordings[reference_index].fitted, recording=recordings[reference_index].recording,
    )  # fmt: skip


@pytest.mark.parametrize("memory", [False, True], ids=["hunt-crossley", "stulov"])
def test_the_felts_band_is_what_chance_gives(memory):
    result = fake_fit(memory=memory, free=("K_H", "p", "M_H", *(("epsilon", "tau") if memory else ("mu",))))
    felt = felt_of(result)
    deepest = max(np.max(recording.fitted.simulation.pulse.compression) for recording in result.recordings)
    assert felt.compression[-1] == pytest.approx(1e3 * float(deepest))
    cov = result.covariance.matrix
    drawn = np.random.default_rng(0).multivariate_normal(np.zeros(len(cov)), cov, 40_000)
    value = {name: VALUES[name] * np.exp(drawn[:, i]) for i, name in enumerate(NAMES)}
    for at in (0, 20, 47):
        force = value["K_H"] * (1e-3 * felt.compression[at]) ** value["p"]
        ends = np.quantile(np.log(force), [0.5, 0.025, 0.975])
        width = ends[2] - ends[1]
        np.testing.assert_allclose(np.log(felt.force[:, at]), ends, atol=0.03 * width)
        if felt.slow is not None:
            assert felt.slow[0, at] == pytest.approx(0.7 * felt.force[0, at])
            slow = np.quantile(np.log((1 - value["epsilon"]) * force), [0.025, 0.975])
            assert np.log(felt.slow[2, at] / felt.slow[1, at]) == pytest.approx(slow[1] - slow[0], rel=0.05)
    assert (felt.slow is None) != memory


def test_half_widths_and_correlations_are_those_of_the_fit():
    result = fake_fit()
    data = identifiability_of(result)
    assert data is not None
    assert data.names == ("c", "kappa", "K_H", "p", "M_H")
    expected = [("f0", 101 / 99, True), ("F/M_S", 125 / 80, True), ("K_H", 1.1 / 0.9, False), ("p", 1.1 / 0.9, False)]
    assert [(name, combined) for name, _, combined in data.half_widths] == [(name, c) for name, _, c in expected]
    np.testing.assert_allclose([half for _, half, _ in data.half_widths], [0.5 * np.log(x) for _, x, _ in expected])
    cov = result.covariance.matrix
    drawn = np.random.default_rng(1).multivariate_normal(np.zeros(len(cov)), cov, 40_000)
    sampled = np.corrcoef([drawn[:, NAMES.index(name)] for name in data.names])
    np.testing.assert_allclose(data.correlation, sampled, atol=0.02)


def test_an_unmeasured_scale_of_velocities_hides_nothing_of_the_felt():
    plain, scaled = fake_fit(), fake_fit()
    scaled.covariance = SimpleNamespace(
        names=plain.covariance.names, matrix=scaled_by_velocity(plain.covariance.matrix)
    )
    scaled.document["parameters"]["v_H0"] = {"value": 3.0, "interval": [1.0, 9.0], "status": "scaled"}
    wide = fake_fit()
    wide.covariance = scaled.covariance
    np.testing.assert_allclose(felt_of(scaled).force, felt_of(plain).force, rtol=1e-6)
    assert np.log(felt_of(wide).force[2, 20] / felt_of(plain).force[2, 20]) > 1
    assert identifiability_of(scaled).names == identifiability_of(plain).names  # μ varies only with the scale
    np.testing.assert_allclose(identifiability_of(scaled).correlation, identifiability_of(plain).correlation, atol=1e-6)


def test_a_fit_without_intervals_claims_no_band():
    result = fake_fit(velocities=(2.0,))
    for entry in result.document["parameters"].values():
        entry["interval"] = None
    assert identifiability_of(result) is None
    felt = felt_of(result)
    np.testing.assert_array_equal(felt.force[1], felt.force[0])
    np.testing.assert_array_equal(felt.force[2], felt.force[0])


def test_the_slider_ends_at_the_takes_and_plays_the_fitted_note():
    result = fake_fit(reference_index=2)
    strokes = strokes_of(result)
    assert strokes is not None
    assert strokes.inside
    np.testing.assert_allclose(strokes.velocity[[0, 3, -1]], [0.75, 1.5, 3.0], rtol=1e-12)
    assert strokes.first == 3
    for index, recording in ((0, 1), (3, 2), (-1, 0)):
        played = strokes.sounds[index]
        assert len(played) == round(2.5 * 22050)
        np.testing.assert_allclose(played[:22050], result.recordings[recording].fitted.samples, atol=1e-9)
    power = [np.mean(sound**2) for sound in strokes.sounds]
    assert np.all(np.diff(power) > 0)


def test_one_take_is_played_from_half_to_twice_its_velocity():
    strokes = strokes_of(fake_fit(velocities=(15.0,)))
    assert strokes is not None
    assert not strokes.inside
    np.testing.assert_allclose(strokes.velocity[[0, -1]], [7.5, 20.0], rtol=1e-12)  # no hammer is faster


def test_every_take_comes_with_its_own_loop_and_place():
    result = fake_fit()
    recordings = recordings_of(result)
    assert [recording.place for recording in recordings] == [1, 2, 3]
    assert [recording.velocity for recording in recordings] == [3.0, 0.75, 1.5]
    for recording, fitted in zip(recordings, result.recordings, strict=True):
        pulse = fitted.fitted.simulation.pulse
        assert np.nanmax(recording.compression) == pytest.approx(1e3 * float(np.max(pulse.compression)), rel=1e-2)
        assert np.nanmax(recording.force) == pytest.approx(float(np.max(pulse.force)), rel=1e-2)
        assert len(recording.level) == len(recording.number) == len(fitted.partials.number)
        assert recording.onset == fitted.recording.onset / 22050
    assert paths_of(result) == ()


# ---- text ----


def sections_of(fit):
    return {heading: " ".join(sentences).replace("\u00a0", " ") for heading, sentences in identifiability_sections(fit)}


def with_half_interval(entry, half):
    """Return the entry with a 95 % interval of this half-width, as a logarithm."""
    return entry | {"interval": [entry["value"] * np.exp(-half), entry["value"] * np.exp(half)]}


def fit_with_half_intervals(**halves):
    fit = example_fit()
    for name, half in halves.items():
        key = name.replace("_over_", "/")
        fit["invariants"][key] = with_half_interval(fit["invariants"][key], half)
    return fit


def test_what_is_fixed_and_what_is_not_is_said():
    fit = fit_with_half_intervals(f0=1e-4, B=0.02, F_over_M_S=0.05, M_H_over_M_S=0.03)
    fit["parameters"]["K_H"] = with_half_interval(fit["parameters"]["K_H"], 0.9)
    fit["parameters"]["p"] = fit["parameters"]["p"] | {"interval": [2.0, 3.0], "status": "fitted"}
    sections = sections_of(fit)
    for part in (
        "f₀ = 92.3310 Hz (± 0.17 cents)", "B = 2.300 × 10⁻⁴ (± 2 %)", "F/M_S = 118.0 N/kg (± 5 %)",
        "at 0.5 mm, at the reference velocity shown", "known to a factor of 2.5", "M_H/M_S = 0.920 (± 3 %)",
        "assumed mass", "common scale was not measured",
    ):  # fmt: skip
        assert part in sections[DETERMINED], part
    assert "x0/L" not in sections[DETERMINED]  # it was given
    assert set(sections) == {DETERMINED}


@pytest.mark.parametrize("known", ["gain_status", "v_H0_status"])
def test_no_scale_is_open_where_gain_or_velocity_were_given(known):
    fit = fit_of_recordings()
    fit["parameters"]["v_H0"] |= {"status": "fitted"}
    for recording in fit["recordings"]:
        recording[known] = "given"
    sections = sections_of(fit)
    assert "Hammer velocities (the least certain ± 10 %)" in sections[DETERMINED]
    assert "common scale" not in " ".join(sections.values())
    for recording in fit["recordings"]:
        recording["v_H0_status"] = "not-identifiable"
    assert "Hammer velocities" not in " ".join(sections_of(fit).values())


def test_a_scale_is_open_where_not_even_ratios_are_identified():
    fit = example_fit()
    fit["parameters"]["v_H0"] |= {"status": "not-identifiable"}
    assert open_scale(fit)
    fit["recordings"][0]["gain_status"] = "given"
    assert not open_scale(fit)


def test_what_the_claims_question_is_not_called_determined():
    fit = fit_with_half_intervals(F_over_M_S=0.05, M_H_over_M_S=0.03)
    for name in ("K_H", "mu", "p", "M_H"):
        fit["parameters"][name] = {"status": "not-identifiable", "interval": [1.0, 1.1]}
    for name in ("F/M_S", "M_H/M_S"):
        fit["invariants"][name]["status"] = "not-identifiable"
    sections = sections_of(fit)
    for part in ("118.0 N/kg", "M_H/M_S"):
        assert part in sections[CONDITIONAL]
        assert part not in sections[DETERMINED]
    assert UNDETERMINED not in sections
    vague = fit_with_half_intervals(F_over_M_S=1.5, M_H_over_M_S=12.0) | {"parameters": fit["parameters"]}
    for name in ("F/M_S", "M_H/M_S"):
        vague["invariants"][name]["status"] = "not-identifiable"
    sections = sections_of(vague)
    assert CONDITIONAL not in sections
    assert "to a factor of 4.5" in sections[UNDETERMINED]
    assert "to many powers of ten" in sections[UNDETERMINED]


def test_nothing_known_is_nothing_said():
    assert identifiability_sections(example_fit(invariants={})) == []
