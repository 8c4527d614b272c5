"""The page is complete, self-contained, and robust to hostile text and missing numbers."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import io
import re
import xml.etree.ElementTree as ElementTree
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import soundfile as sf
from hypothesis import given
from hypothesis import strategies as st
from report_cases import (
    NAMES,
    Page,
    content_of_recordings,
    covariance_content,
    drawn_in,
    drawn_once,
    example_content,
    example_fit,
    example_recordings,
    example_result,
    minimum,
    modal_response,
    quantities,
    response_content,
    with_reference,
)
from scipy.signal import lfilter

from pianofit.dsp.loudness import k_weighted_mean_square
from pianofit.errors import OutputError
from pianofit.io.files import replace_file
from pianofit.io.number_format import number
from pianofit.model.modal_response import PartialDecay
from pianofit.report.drawing import Panel, page_style, span
from pianofit.report.figures import _arrow_positions, draw_partials, draw_spectra
from pianofit.report.html import asset
from pianofit.report.in_short import in_short
from pianofit.report.modal_response import (
    Envelope,
    _draw_map,
    draw_envelope,
    modal_response_line,
    modal_response_text,
    spectrograms_of,
)
from pianofit.report.page import report_bytes
from pianofit.report.save import _check_inputs, _previous_outputs
from pianofit.report.sound import make_clips
from pianofit.report.text import STATUS, minima, recontact_text, rows
from pianofit.schema.decode import encode_json
from pianofit.schema.derived import Recontact
from pianofit.schema.quantities import STATUSES, Quantity


@pytest.fixture(autouse=True)
def _drawn_once(monkeypatch):
    monkeypatch.setattr("pianofit.report.page.draw_figures", drawn_once)
    monkeypatch.setattr("pianofit.report.sound.strokes_of", lambda _: ({}, False))


def written(folder, fit=None, title="a.wav, F#2", **result: Any):
    path = folder / "report.html"
    path.write_bytes(report_bytes(example_result(fit, **result), title))
    assert [entry.name for entry in folder.iterdir()] == ["report.html"]
    return path.read_text(encoding="utf-8")


def sounds_of(page):
    """{name: (samples, rate, gain in dB)} of the WAV files in the page."""
    found = {}
    for link in page.all("a"):
        if link["href"].startswith("#"):
            continue
        kind, data = link["href"].split(",", 1)
        assert kind == "data:audio/wav;base64"
        samples, rate = sf.read(io.BytesIO(base64.b64decode(data)), dtype="float64")
        found[link["data-name"]] = samples, rate, float(link["data-gain-db"])
    return found


def test_page_holds_everything_and_may_load_nothing(tmp_path):
    text = written(tmp_path, example_fit())
    page, drawn = Page(text), drawn_in(text)
    for _, attributes in Page(re.sub(r"<svg.*?</svg>", "", text, flags=re.DOTALL)).tags:
        assert not [name for name in attributes if name.startswith("on") or name in ("style", "srcset", "data")]
        for name in ("src", "href"):
            assert attributes.get(name, "data:").startswith(("data:", "#"))
    policy = next(meta["content"] for meta in page.all("meta") if meta.get("http-equiv") == "Content-Security-Policy")
    script = hashlib.sha256("".join(page.scripts).encode()).digest()
    assert f"script-src 'sha256-{base64.b64encode(script).decode()}';" in policy
    assert policy.startswith("default-src 'none'")
    assert "http" not in policy
    ids = {attributes.get("id") for _, attributes in page.tags}
    assert {link["href"][1:] for link in page.all("a") if link["href"].startswith("#")} <= ids
    assert len(page.drawings) == len(drawn) == PANELS
    assert all(len(drawing["aria-label"]) > 40 for drawing in page.drawings)
    for svg in drawn:
        links = [
            value
            for node in ElementTree.fromstring(svg).iter()  # noqa: S314  (our own page)
            for name, value in node.attrib.items()
            if name.endswith("href")
        ]
        assert all(link.startswith(("#", "data:")) for link in links)


def test_same_input_gives_the_same_page(tmp_path):
    first = written(tmp_path, example_fit())
    example_recordings.cache_clear()
    assert written(tmp_path, example_fit()) == first


# Two panels each of spectra, levels, attack, partials, force, felt and identifiability.
PANELS = 14

KEPT = {
    *STATUSES,
    "bridge-force",
    *example_content()["minima"][0]["covariance"]["names"],
}  # texts that a file cannot choose
HOSTILE = "</script><script>alert(1)</script>\"'><img src=x onerror=alert(2)>\n{{ 7 * 7 }} $\\frac$ &amp; \udcff"


def test_hostile_text_stays_text(tmp_path):
    def hostile(value):
        if isinstance(value, dict):
            return {key: hostile(entry) for key, entry in value.items()}
        if isinstance(value, list):
            return [hostile(entry) for entry in value]
        return HOSTILE if isinstance(value, str) and value not in KEPT else value

    tame = Page(written(tmp_path))
    fit = hostile(example_content())
    fit["parameters"][HOSTILE] = {"value": 1.0, "status": "fitted"}
    fit["versions"] = {HOSTILE: HOSTILE}
    page = Page(written(tmp_path, example_fit(fit), title=HOSTILE))
    assert page.scripts == tame.scripts
    assert {tag for tag, _ in page.tags} <= {tag for tag, _ in tame.tags}
    assert {name for _, attributes in page.tags for name in attributes} <= {
        name for _, attributes in tame.tags for name in attributes
    }
    assert len(page.drawings) == PANELS
    assert page.text.count("alert(2)") > 10
    assert "{{ 7 * 7 }}" in page.text


def test_claims_come_first_and_plainly(tmp_path):
    page = Page(written(tmp_path, example_fit()))
    body = page.text[page.text.index("A string and a hammer") :]
    order = [body.index(part) for part in (
        "Read this first", "One uncalibrated recording", "▶ Play", "2.6 dB", "The string's length was not given",
        "do not support the fitted hammer", "The player above")]  # fmt: skip
    assert order == sorted(order)
    assert "Not converged" not in body
    better = example_fit(levels={"initial_db": 9.0, "fitted_db": 1.2, "initial_hammer_db": 4.0, "partials": 40})
    assert "explains more of the levels" in Page(written(tmp_path, better)).text


def test_a_fit_that_failed_says_so(tmp_path):
    claims = "The felt is not identified."
    content = example_content()
    content["criterion"]["bands"]["global"] = {"initial": 0.1, "final": 0.13}
    fit = example_fit(content, identifiability_statement=claims, converged=False)
    text = Page(written(tmp_path, fit)).text
    order = [text.index(part) for part in (claims, "Not converged", "Higher criterion")]
    assert order == sorted(order)
    assert "✓" not in text
    assert "1.3 times larger (+1.1 dB)" in text


def test_a_clean_fit_says_so(tmp_path):
    entries = {name: entry | {"status": "fitted"} for name, entry in example_content()["parameters"].items()}
    text = Page(written(tmp_path, example_fit(parameters=entries))).text
    assert "✓ Read this first" in text
    assert "not measured" not in text.split("▶ Play")[0]
    assert "⚠" not in text


def test_criterion_levels_and_statuses_in_words(tmp_path):
    criterion = example_content()["criterion"] | {"excluded_bands": ["band1"]}
    del criterion["bands"]["band1"]
    text = Page(html_text := written(tmp_path, example_fit(criterion=criterion))).text
    for part in (
        "14.1 times smaller (−11.5 dB)",  # 0.83 / 0.059
        "band 1: fundamental – – excluded",
        "band 2: partials 2 to 8 0.7 0.08 8.75 times smaller (−9.4 dB)",
        "band 3: partials from 9 0.9 0.9 no change",
        "12 dB before the fit; rms over 40 levels of partials",
        "falls by 4.3 cents",
        "(0.81 to 1.49) × 10¹⁰",
        "▲ at-bound",
        "◇ assumed",
        "◐ scaled",
        "■ given",
        "✕ not-identifiable",
        "scales with an assumed length of 1 m",
    ):
        assert part in text.replace("\u00a0", " "), part
    spectra = next(drawing for drawing in drawn_in(html_text) if "frequency (Hz)" in drawing)
    assert "band 1, excluded" in spectra
    assert "band 2: partials 2 to 8" in spectra


def test_recontacts_are_reported(tmp_path):
    two = [Recontact(3.1, 0.4, 0.2), Recontact(5.0, 1.25, 3.3)]
    assert recontact_text([]) == ""
    assert recontact_text(two[:1]) == "touches again from 3.1 to 3.5 ms, with up to 0.2 N"
    assert recontact_text(two) == "touches again 2 times, from 3.1 ms to 6.25 ms, with up to 3.3 N"
    fit = example_fit(derived=example_content()["derived"] | {"recontacts": [vars(one) for one in two]})
    text = Page(written(tmp_path, fit)).text.replace("\u00a0", " ")
    for part in (
        "2.214 ms 2.150 to 2.280 ms",
        "33.4 N (31.0 to 36.0)",
        "largest compression: not identifiable; touches again 2 times",
    ):
        assert part in text


def test_a_page_names_files_and_no_folders(tmp_path):
    content = example_content()
    content["recordings"][0]["file"] = "/home/somebody/notes/a.wav"
    html = written(tmp_path, example_fit(content, warnings=["/home/somebody/notes/a.wav: the pitch falls"]))
    assert "somebody" not in html
    text = Page(html).text
    assert "a.wav: the pitch falls" in text
    assert "a.wav (left)" in text, "one of two channels was fitted"


def test_the_heads_on_the_felts_loop_lie_on_the_curve_and_follow_it():
    u, force = np.array([0.0, 1.0, 2.0, 2.0, 1.0, 0.0]), np.array([0.0, 2.0, 9.0, 8.0, 1.0, 0.0])
    (up, rise), (down, fall) = _arrow_positions(u, force)
    assert up == pytest.approx([1.0 + (0.6 * 9 - 2) / 7, 0.6 * 9])
    assert down == pytest.approx([2.0 - (8 - 0.35 * 9) / 7, 0.35 * 9])
    assert (rise > 0).all()
    assert (fall < 0).all()


def test_every_status_of_a_fit_has_a_mark():
    assert tuple(STATUS) == STATUSES
    assert len({mark for mark, _ in STATUS.values()}) == len(STATUSES)


def test_invariants_come_before_the_values_that_rest_on_guesses(tmp_path):
    text = Page(written(tmp_path, example_fit())).text.replace("\u00a0", " ")
    order = [text.index(part) for part in (
        "Invariants",
        "f 0 fundamental frequency of the string without stiffness 92.331 Hz 92.321 to 92.341 ● fitted",
        "M H / M S hammer mass over string mass 0.920 0.893 to 0.948", "x 0 / L",
        "118.0 N/kg 112.2 to 124.0 ● fitted static force of the felt at 0.5 mm, at the reference velocity shown",
        "In SI units", "◐ scaled", "184.6610 m/s")]  # fmt: skip
    assert order == sorted(order)
    without = Page(written(tmp_path, example_fit(invariants={}))).text
    assert "Invariants" not in without
    assert "In SI units" not in without


def test_minima_are_listed_by_what_differs_where_there_are_several(tmp_path):
    covariance = {"covariance": covariance_content()}
    one = example_fit(minima=[minimum(1.0, 0.0) | covariance])
    assert minima(one) is None
    assert "Minima of the objective" not in Page(written(tmp_path, one)).text
    two = example_fit(minima=[minimum(0.7, 0.0) | covariance, minimum(0.3, 1.25) | covariance])
    names, _ = minima(two)
    assert [name for name, _ in names] == ["K_H", "p"]
    text = Page(written(tmp_path, two)).text.replace("\u00a0", " ")
    assert "70 % 0 1.1 × 10¹⁰ 2.56 4, 2, 1.33 30 % 1.2 2.475 × 10¹⁰ 2.435 4, 2, 1.33" in text


def test_a_ratio_of_velocities_names_the_strokes_file():
    ratio = {"value": 0.5, "unit": "1", "interval": [0.4, 0.6], "note": "/a folder/soft.wav"}
    (row,) = rows(quantities(**{"v/v_ref 2": ratio}))
    assert (row["name"], row["note"]) == ("v/v_ref", "soft.wav")


def nothing(array):
    return np.full_like(np.asarray(array, dtype=float), np.nan)


def with_fields(record, change, *names):
    """Return the record with these fields changed."""
    return dataclasses.replace(record, **{name: change(getattr(record, name)) for name in names})


def with_partials(result, change, *names):
    analysis = result.analysis
    return with_reference(
        result, analysis=dataclasses.replace(analysis, partials=with_fields(analysis.partials, change, *names))
    )


def with_nothing(result):
    reference = result.reference
    ours = {name: with_fields(getattr(reference, name), nothing, "samples") for name in ("initial", "fitted")}
    result = with_reference(result, recording=with_fields(reference.recording, nothing, "samples", "frames"), **ours)
    columns = (name for name, x in vars(reference.partials).items() if np.ndim(x) == 1 and name != "number")
    return with_partials(result, nothing, *columns)


def without_path(result):
    fit = dataclasses.replace(result.fit, pickup=dataclasses.replace(result.fit.pickup, path=None))
    notes = tuple(tuple(note._replace(path=None) for note in notes) for notes in result.minima_notes)
    return dataclasses.replace(result, fit=fit, minima_notes=notes)


def with_borders(result, borders, excluded=()):
    criterion = dataclasses.replace(result.fit.criterion, borders=borders, excluded_bands=excluded)
    return dataclasses.replace(result, fit=dataclasses.replace(result.fit, criterion=criterion))


def without_contact(result):
    fitted = result.fitted
    pulse = SimpleNamespace(**{name: 0 * x for name, x in vars(fitted.simulation.pulse).items()})
    return with_reference(
        result, fitted=dataclasses.replace(fitted, simulation=fitted.simulation._replace(pulse=pulse))
    )


def with_magnitudes(result):
    recording, fitted = result.recording, result.fitted
    return with_reference(
        result,
        recording=with_fields(recording, lambda x: 1e-9 * x, "samples", "frames"),
        fitted=with_fields(fitted, lambda x: 1e30 * x, "samples"),
    )


def with_channels(result):
    recording = dataclasses.replace(result.recording, frames=np.tile(result.recording.samples, (5, 1)))
    fitted = dataclasses.replace(result.fitted, frames=np.tile(result.fitted.samples, (5, 1)))
    return with_reference(result, recording=recording, fitted=fitted)


def with_one_partial(_):
    content = example_content()
    for column in (content["recordings"][0]["partials"], content["pickup"]["path"]):
        column |= {name: values[:1] for name, values in column.items()}
    return example_result(example_fit(content), rate=8000, seconds=0.6, count=1, f0=1760.0, path=False)


@pytest.mark.parametrize(
    "case",
    [
        lambda it: it,
        with_nothing,
        without_path,
        without_contact,
        with_magnitudes,
        lambda it: with_partials(it, nothing, "frequency_error", "decay_error"),
        with_one_partial,
        with_channels,
    ],
    ids=["whole", "nan", "no path", "no contact", "magnitudes", "no errors", "one partial", "channels"],
)
def test_page_stands_what_a_fit_may_lack(case):
    page = Page(report_bytes(case(example_result()), "a.wav").decode())
    assert len(page.drawings) in (PANELS - 1, PANELS)  # the spectra have one panel or two
    assert set(sounds_of(page)) == set(NAMES)


def test_a_page_of_the_papers_recipe_claims_no_more_than_it(tmp_path):
    content = example_content()
    for entry in content["parameters"].values():
        entry |= {"interval": None}
    content["recordings"][0]["stroke_interval"] = None
    levels = content["levels"] | {"initial_hammer_db": None}
    fit = example_fit(content, recipe="paper", invariants={}, levels=levels)
    text = Page(written(tmp_path, fit)).text
    assert "recipe “paper”" in text
    for part in ("Identifiability", "keep their initial values", "Invariants"):
        assert part not in text.split("All results of this fit")[0], part
    assert not re.search(r"\bnan\b", text.split("All results of this fit")[0])


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0"), (304.1, "304.1"), (1.0, "1"), (100.0, "100"), (1.09949e10, "1.099 × 10¹⁰"), (1.6e-6, "1.6 × 10⁻⁶"),
     (-0.00123456, "−0.001235"), (99999.7, "100000"), (44100, "44100"), (9.9999e-4, "0.001"), (None, "–"),
     (float("nan"), "–"), (float("-inf"), "–"), ("12", "–")],
)  # fmt: skip
def test_numbers_as_a_reader_likes_them(value, text):
    assert number(value).replace("\u00a0", " ") == text


@pytest.mark.parametrize(
    ("value", "interval", "texts"),
    [
        (184.661, [184.652, 184.670], ("184.6610", "184.6520 to 184.6700")),
        (1.09949e10, [8.1e9, 1.49e10], ("1.10 × 10¹⁰", "(0.81 to 1.49) × 10¹⁰")),
        (2e9, [1e8, 5e10], ("2.00 × 10⁹", "(0.10 to 50.00) × 10⁹")),
        (5e8, [1e5, 6.142e10], ("5 × 10⁸", "1 × 10⁵ to 6.14 × 10¹⁰")),
        (2e9, [1e3, 5e16], ("2 × 10⁹", "1 × 10³ to 5 × 10¹⁶")),
        (0.12, [0.12, 0.12], ("0.12", "0.12 to 0.12")),
        (0.0, [-1.0, 1.0], ("0", "−1 to 1")),
        (1e300, [-1e-310, 1e-310], ("1.00000000000000 × 10³⁰⁰", "(−0.00000000000000 to 0.00000000000000) × 10³⁰⁰")),
        (2.5, None, ("2.5", "–")),
        (2.5, [float("nan"), 3.0], ("2.5", "–")),
    ],
)
def test_intervals_get_the_digits_they_support(value, interval, texts):
    (row,) = rows({"c": Quantity("c", value, interval=interval)})
    assert (row["value"].replace("\u00a0", " "), (row["interval"] or "–").replace("\u00a0", " ")) == texts


@given(st.floats(-1e300, 1e300), st.integers(1, 8))
def test_numbers_keep_their_value(value, digits):
    plain = number(value, digits).translate(str.maketrans("−⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "--0123456789", "\u00a0"))
    assert float(plain.replace("×10", "e")) == pytest.approx(value, rel=0.51 * 10 ** (1 - digits), abs=1e-323)


# ITU-R BS.1770-4, tables 1 and 2: the two filters at 48 kHz, as printed there.
SHELF = [1.53512485958697, -2.69169618940638, 1.19839281085285], [1.0, -1.69065929318241, 0.73248077421585]
HIGH_PASS = [1.0, -2.0, 1.0], [1.0, -1.99004745483398, 0.99007225036621]


def printed_loudness(samples):
    """Mean square of the first second at 48 kHz, in dB, by the recommendation's own filters."""
    return 10 * np.log10(np.mean(lfilter(*HIGH_PASS, lfilter(*SHELF, samples[:48000])) ** 2))


@pytest.mark.parametrize("frequency", [50.0, 300.0, 1000.0, 3000.0, 9000.0])
def test_weighting_is_the_recommendations(frequency):
    tone = np.sin(2 * np.pi * frequency * np.arange(48000) / 48000)
    ours = 10 * np.log10(k_weighted_mean_square(tone, 48000))
    settled = lfilter(*HIGH_PASS, lfilter(*SHELF, np.tile(tone, 2)))[48000:]
    assert ours == pytest.approx(10 * np.log10(np.mean(settled**2)), abs=0.15)


def _fit_of(path):
    result = example_result()
    recording = dataclasses.replace(result.recording, path=str(path))
    return with_reference(result, recording=recording)


@pytest.mark.parametrize("name", ["fitted.wav", "initial.wav", "knock.flac", "fitted-soft.wav"])
def test_a_recording_that_would_be_replaced_or_deleted_is_refused(tmp_path, name):
    """`fitted-soft.wav` belongs to an earlier fit, would be deleted by the next one, and is a recording itself."""
    content = content_of_recordings(2)
    for row, file in zip(content["recordings"], ("soft.wav", "a/loud.wav"), strict=True):
        row["file"] = file
    (tmp_path / "fit.json").write_bytes(encode_json(content))
    earlier = _previous_outputs(tmp_path)
    assert earlier == {"report.html", "knock.flac", "draws.npz", "fitted-soft.wav", "fitted-loud.wav"}
    with pytest.raises(OutputError, match=f"{name}.*use another folder"):
        _check_inputs(_fit_of(tmp_path / name), tmp_path, earlier)
    _check_inputs(_fit_of(tmp_path / "elsewhere" / name), tmp_path, earlier)
    _check_inputs(_fit_of(tmp_path / "note.wav"), tmp_path, earlier)


def test_what_is_no_fits_names_no_sounds(tmp_path):
    for text in ("", "[]", "{}", '{"recordings": 3}', '{"recordings": [{"file": 3}]}'):
        (tmp_path / "fit.json").write_text(text)
        assert _previous_outputs(tmp_path) == {"report.html", "knock.flac", "draws.npz"}


@pytest.mark.parametrize("loudest", NAMES)
def test_sounds_are_equally_loud_and_never_clip(loudest):
    result = example_result(rate=48000)
    scale = {name: 3.0 if name == loudest else 0.02 for name in NAMES}
    parts = {"original": result.recording, "initial": result.initial, "fitted": result.fitted}
    parts = {name: with_fields(part, lambda x, s=scale[name]: s * x, "samples") for name, part in parts.items()}
    result = with_reference(result, recording=parts["original"], initial=parts["initial"], fitted=parts["fitted"])
    given_sounds = {name: part.samples for name, part in parts.items()}
    sounds = sounds_of(Page(report_bytes(result, "a.wav").decode()))
    loudness = [printed_loudness(samples) for samples, _, _ in sounds.values()]
    assert max(loudness) - min(loudness) < 0.3
    assert max(np.max(np.abs(samples)) for samples, _, _ in sounds.values()) == pytest.approx(10 ** (-1 / 20), abs=1e-3)
    for name, (samples, rate, gain_db) in sounds.items():
        assert rate == 48000
        body = len(samples) - 2400  # before the fade
        expected = given_sounds[name][:body] * 10 ** (gain_db / 20)
        np.testing.assert_allclose(samples[:body], expected, atol=1.1 / 32768)


def test_sounds_are_cut_to_the_note():
    rate, onset = 8000, 3.0
    sound = np.zeros(20 * rate)
    sound[round(onset * rate) :] = 0.5
    clips = make_clips({"original": sound, "fitted": 0.1 * sound}, rate, onset)
    for clip in clips:
        samples, _ = sf.read(io.BytesIO(base64.b64decode(clip.uri.split(",")[1])))
        assert len(samples) == 8 * rate == clip.seconds * rate
        assert np.flatnonzero(samples)[0] == round(0.05 * rate)
        assert samples[-1] == 0
        assert samples[4 * rate] == pytest.approx(10 ** (-1 / 20), abs=1e-3)
    assert clips[1].gain_db - clips[0].gain_db == pytest.approx(20)


def test_high_rates_are_brought_down_without_changing_the_sound():
    t = np.arange(192000) / 192000
    (clip,) = make_clips({"original": np.sin(2 * np.pi * 1000 * t)}, 192000)
    samples, rate = sf.read(io.BytesIO(base64.b64decode(clip.uri.split(",")[1])))
    assert rate == 96000
    middle = slice(20000, 60000)
    expected = 10 ** (clip.gain_db / 20) * np.sin(2 * np.pi * 1000 * np.arange(96000) / 96000)
    np.testing.assert_allclose(samples[middle], expected[middle], atol=2e-3)


def test_silence_and_broken_samples_are_kept_silent():
    broken = np.full(8000, np.nan)
    clips = make_clips({"a": np.zeros(8000), "b": broken, "c": np.zeros(0)}, 8000)
    assert [clip.gain_db for clip in clips] == [0.0] * 3
    for clip in clips:
        samples, _ = sf.read(io.BytesIO(base64.b64decode(clip.uri.split(",")[1])))
        assert not samples.any()


@pytest.mark.parametrize(
    "lost", [lambda x: np.full_like(x, np.nan), lambda x: 0 * x, lambda x: x[..., :1]], ids=["nan", "silent", "short"]
)
def test_page_allows_an_empty_modal_response(lost):
    result = example_result(example_fit(modal_response=response_content()), modes=True)
    levels = {"measured": np.linspace(-10.0, -40.0, 200), "string model": np.linspace(-10.0, -60.0, 200)}
    envelope = Envelope(1, 92.0, np.linspace(0.0, 3.0, 200), levels)
    empty = envelope._replace(time=lost(envelope.time), levels={name: lost(x) for name, x in levels.items()})
    time, frequency, measured, _ = spectrograms_of(result)
    with page_style():
        assert Panel(draw_envelope, (empty,)).figure()
        values = time, frequency, lost(measured), "viridis", span(lost(measured)), "dB"
        assert Panel(_draw_map, values).figure()


def test_unwritable_places_are_named_and_nothing_is_left(tmp_path, monkeypatch):
    with pytest.raises(OutputError, match=r"nowhere/report\.html: cannot be written \(No such file.*choose"):
        replace_file(tmp_path / "nowhere" / "report.html", b"page")
    place = tmp_path / "report.html"
    place.write_text("before")

    def full(self, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.replace", full)
    with pytest.raises(OutputError, match=r"report\.html: cannot be written \(No space left on device\); make room"):
        replace_file(place, b"page")
    assert [entry.name for entry in tmp_path.iterdir()] == ["report.html"]
    assert place.read_text() == "before"


@pytest.mark.parametrize("name", ["initial", "fitted"])
def test_a_strike_on_a_node_does_not_flatten_the_levels(name):
    import matplotlib.pyplot as plt

    from pianofit.report.figures import draw_levels

    levels = example_fit().reference.partials
    level = getattr(levels, name).copy()
    level[3] = -380.0
    axes = plt.figure().add_subplot()
    draw_levels(axes, dataclasses.replace(levels, **{name: level}))
    low, high = axes.get_ylim()
    plt.close("all")
    columns = (levels.measured, levels.initial, levels.fitted)
    assert -150 < low < min(x.min() for x in columns)
    assert high > max(x.max() for x in columns)


def test_bands_beyond_the_spectra_are_not_in_their_picture():
    result = example_result()
    last = draw_spectra(result)[-1].figure()
    end = last.axes[0].get_xlim()[1]
    for panel in draw_spectra(with_borders(result, (50.0, 0.1 * end, 1.5 * end, 1.8 * end), ("band3",))):
        (axes,) = panel.figure().axes
        assert axes.get_xlim()[1] <= last.axes[0].lines[0].get_xdata()[-1] * 1.001
        assert "band 3" not in " ".join(text.get_text() for text in axes.texts)


def test_a_decay_that_a_beat_hides_leaves_room_to_the_others():
    result = example_result()
    hidden = with_partials(result, lambda decay: np.where(np.arange(len(decay)) == 2, 1e-3, decay), "decay")
    with_beat, plain = (draw_partials(it)[1].figure() for it in (hidden, result))
    low = [figure.axes[0].get_ylim()[0] for figure in (with_beat, plain)]
    assert 1e-2 < low[0] <= low[1]
    labels = [[text.get_text() for text in figure.legends[0].get_texts()] for figure in (with_beat, plain)]
    assert "below this axis" in labels[0]
    assert "below this axis" not in labels[1]


DECAYS = [
    PartialDecay(1, 92.331, 3, 4.25, 12.5, 0.75, 6.5, (0.0125, 0.25)),
    PartialDecay(2, 184.9, 1, 3.0, 3.0, np.nan, np.nan, (0.02, 0.02)),
]


def test_modal_response_is_drawn_described_and_playable(tmp_path, monkeypatch):
    monkeypatch.setattr("pianofit.report.page.decays_and_beats", lambda _: DECAYS)
    html = written(tmp_path, example_fit(modal_response=response_content()), modes=True)
    page = Page(html)
    assert len(page.drawings) == PANELS + 9  # six envelopes; recorded, played and their difference
    for part in (
        "8.2 dB with the string model", "3.9 dB with modes", "2.6 dB with modes and knock", "4 modes and a knock",
        "1 92.33 3 4.2 12 0.75 6.5 0.013 to 0.25 2 184.90 1 3 3 – – 0.02", "String model",
    ):  # fmt: skip
        assert part in page.text.replace("\u00a0", " "), part
    drawn = drawn_in(html)
    assert sum(svg.count("data:image/png") for svg in drawn) == 3 * 2  # levels and their scales are rasters
    assert all(
        f">{label}<" in " ".join(drawn) for label in ("fitted minus recorded", "partial 3, 277 Hz", "string model")
    )
    sounds = sounds_of(page)
    assert {name: x.ndim for name, (x, *_) in sounds.items()} == {"original": 2, "fitted": 2, "string model": 1}
    loudness = [10 * np.log10(np.mean([k_weighted_mean_square(c[:16000], 16000) for c in np.atleast_2d(x.T)]))
                for x, *_ in sounds.values()]  # fmt: skip
    assert np.ptp(loudness) < 0.1  # as two loudspeakers play them, mono in both


@pytest.mark.parametrize(
    ("response", "model", "errors"),
    [
        (modal_response("modes", (8.0, 3.0, 3.5)), "4 modes", ("3.0", "8.0", "3.5")),
        (modal_response("string model", (4.0, 4.5, 5.0)), "the string model alone", ("4.0", "4.5", "5.0")),
        (modal_response(left_out=None), "4 modes and a knock", ()),
    ],
    ids=["modes", "string model", "one recording"],
)
def test_text_and_line_name_the_render_model_and_all_errors(response, model, errors):
    for text in (modal_response_text(response), modal_response_line(response)):
        assert model in text
        assert all(error in text for error in errors)
        assert ("not tested" in text) == (not errors)
    assert "\n" not in modal_response_line(response)


def test_a_key_with_the_string_model_alone_has_no_table_and_no_third_line(tmp_path):
    html = written(tmp_path, example_fit(modal_response=response_content("string model")))
    page = Page(html)
    assert "This key uses the string model alone." in page.text
    assert "T60 early" not in page.text
    assert set(sounds_of(page)) == set(NAMES)
    assert len(page.drawings) == PANELS + 9


def test_no_colour_of_the_style_is_its_own_definition():
    """A CSS variable that refers to itself is invalid, and elements with that colour are invisible."""
    for name, value in re.findall(r"(--[\w-]+): ([^;]+);", asset("page.css", "pianofit.report")):
        assert name not in value


def test_in_short_states_what_was_measured():
    """Cents and differences of loudness are computed again from pitch and sounds."""
    result = example_result()
    sounds = {"original": result.recording.samples, "fitted": 0.5 * result.recording.samples}
    onset = result.fit.reference.onset_s
    words = dict(in_short(result, make_clips(sounds, result.recording.rate, onset), []))
    cents = 1200 * np.log2(result.fit.derived.f0 / 440.0)
    assert f"{round((cents + 50) % 100 - 50):+d} cents".replace("-", "−") in words["Tuning"]
    assert "6 dB softer" in words["Loudness"]
    assert number(result.fit.levels.fitted_db, 2) in words["Match"]
    quieter = dict(
        in_short(result, make_clips(sounds | {"fitted": sounds["original"]}, result.recording.rate, onset), [])
    )
    assert "as loud as" in quieter["Loudness"]
