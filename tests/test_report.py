"""The page is complete, self-contained, and robust to hostile text and missing numbers."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import io
import re
import xml.etree.ElementTree as ElementTree
from types import SimpleNamespace

import numpy as np
import pytest
import soundfile as sf
from hypothesis import given
from hypothesis import strategies as st
from report_cases import (
    NAMES,
    Page,
    drawn_in,
    drawn_once,
    example_curves,
    example_fit,
    minimum,
    ringing_entry,
    with_ringing,
)
from scipy.signal import lfilter

from pianofit.errors import OutputError
from pianofit.io.files import replace_file
from pianofit.io.number_format import number
from pianofit.report.figures import _arrow_positions, _partials, _spectra
from pianofit.report.html import asset
from pianofit.report.page import FigureData, report_bytes
from pianofit.report.save import _check_inputs, _previous_outputs
from pianofit.report.sound import k_weighted_mean_square, make_clips
from pianofit.report.text import STATUS, minima, modal_response_line, modal_response_text, recontact_text, rows
from pianofit.schema.quantities import STATUSES


@pytest.fixture(scope="module")
def curves():
    return example_curves(rate=16000, seconds=2.0)


@pytest.fixture(autouse=True)
def _drawn_once(monkeypatch):
    monkeypatch.setattr("pianofit.report.page.draw_figures", drawn_once)


def written(folder, fit, curves, title="a.wav, F#2"):
    path = folder / "report.html"
    path.write_bytes(report_bytes(fit, curves, title))
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


def test_page_holds_everything_and_may_load_nothing(tmp_path, curves):
    text = written(tmp_path, example_fit(), curves)
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


def test_same_input_gives_the_same_page(tmp_path, curves):
    first = written(tmp_path, example_fit(), curves)
    assert written(tmp_path, example_fit(), example_curves(rate=16000, seconds=2.0)) == first


# Two panels each of spectra, levels, attack, partials and force.
PANELS = 10

HOSTILE = "</script><script>alert(1)</script>\"'><img src=x onerror=alert(2)>\n{{ 7 * 7 }} $\\frac$ &amp; \udcff"


def test_hostile_text_stays_text(tmp_path, curves):
    def hostile(value):
        if isinstance(value, dict):
            return {key: hostile(entry) for key, entry in value.items()}
        if isinstance(value, list):
            return [hostile(entry) for entry in value]
        return HOSTILE if isinstance(value, str) and value not in STATUSES else value

    tame = Page(written(tmp_path, example_fit(), curves))
    fit = hostile(example_fit())
    fit["parameters"][HOSTILE] = {"value": 1.0, "status": "fitted"}
    fit["versions"] = {HOSTILE: HOSTILE}
    page = Page(written(tmp_path, fit, curves, title=HOSTILE))
    assert page.scripts == tame.scripts
    assert {tag for tag, _ in page.tags} <= {tag for tag, _ in tame.tags}
    assert {name for _, attributes in page.tags for name in attributes} <= {
        name for _, attributes in tame.tags for name in attributes
    }
    assert len(page.drawings) == PANELS
    assert page.text.count("alert(2)") > 10
    assert "{{ 7 * 7 }}" in page.text


def test_claims_come_first_and_plainly(tmp_path, curves):
    page = Page(written(tmp_path, example_fit(), curves))
    body = page.text[page.text.index("A string and a hammer") :]
    order = [body.index(part) for part in (
        "Read this first", "One uncalibrated recording", "▶ Play", "2.6 dB", "do not support the fitted hammer",
        "The string's length was not given", "The player above")]  # fmt: skip
    assert order == sorted(order)
    assert "Not converged" not in body
    better = example_fit(levels={"initial_db": 9.0, "fitted_db": 1.2, "path_only_db": 4.0, "partials": 40})
    assert "explains more of the levels" in Page(written(tmp_path, better, curves)).text


@pytest.mark.parametrize("claims", ["", "The felt is not identified."])
def test_a_fit_that_failed_says_so(tmp_path, curves, claims):
    fit = example_fit(claims=claims, converged=False)
    fit["criterion"]["global"] = {"initial": 0.1, "final": 0.13}
    text = Page(written(tmp_path, fit, curves)).text
    order = [text.index(part) for part in ([claims] if claims else []) + ["Not converged", "Higher criterion"]]
    assert order == sorted(order)
    assert "✓" not in text
    assert "1.3 times larger (+1.1 dB)" in text


def test_a_clean_fit_says_so(tmp_path, curves):
    fit = example_fit(claims="")
    fit["parameters"] = {name: entry | {"status": "fitted"} for name, entry in fit["parameters"].items()}
    text = Page(written(tmp_path, fit, curves)).text
    assert "✓ Converged" in text
    assert "not measured" not in text.split("▶ Play")[0]
    assert "⚠" not in text


def test_criterion_levels_and_statuses_in_words(tmp_path, curves):
    fit = example_fit()
    fit["criterion"]["dropped"] = ["band1"]
    del fit["criterion"]["band1"]
    text = Page(html_text := written(tmp_path, fit, curves)).text
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
    drawn = drawn_in(html_text)
    assert "band 1, excluded" in drawn[0]
    assert "band 2: partials 2 to 8" in drawn[0]


def test_recontacts_are_reported(tmp_path, curves):
    first = {"start_ms": 3.1, "duration_ms": 0.4, "max_force_N": 0.2}
    assert recontact_text([]) == ""
    assert recontact_text([first]) == "touches again from 3.1 to 3.5 ms, with up to 0.2 N"
    two = [first, {"start_ms": 5.0, "duration_ms": 1.25, "max_force_N": 3.3}]
    assert recontact_text(two) == "touches again 2 times, from 3.1 ms to 6.25 ms, with up to 3.3 N"
    fit = example_fit()
    fit["derived"] |= {"later_contacts": two}
    text = Page(written(tmp_path, fit, curves)).text.replace("\u00a0", " ")
    for part in ("2.21 ms", "33.4 N", "0.65 mm; touches again 2 times"):
        assert part in text


def test_a_page_names_files_and_no_folders(tmp_path, curves):
    fit = example_fit(messages=["/home/somebody/notes/a.wav: the pitch falls"])
    fit["recordings"][0] |= {"file": "/home/somebody/notes/a.wav"}
    html = written(tmp_path, fit, curves)
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


def test_invariants_come_before_the_values_that_rest_on_guesses(tmp_path, curves):
    text = Page(written(tmp_path, example_fit(), curves)).text.replace("\u00a0", " ")
    order = [text.index(part) for part in (
        "Assumption-free quantities",
        "f 0 fundamental frequency of the string without stiffness 92.331 Hz 92.321 to 92.341 ● fitted",
        "M H / M S hammer mass over string mass 0.920 0.893 to 0.948", "x 0 / L",
        "118.0 N/kg 112.2 to 124.0 ● fitted static force of the felt at 0.5 mm, at the reference velocity shown",
        "In SI units", "◐ scaled", "184.6610 m/s")]  # fmt: skip
    assert order == sorted(order)
    without = Page(written(tmp_path, example_fit(invariants={}), curves)).text
    assert "Assumption-free quantities" not in without
    assert "In SI units" not in without


def test_minima_are_listed_by_what_differs_where_there_are_several(tmp_path, curves):
    one = example_fit(minima=[minimum(1.0, 0.0)])
    assert minima(one) is None
    assert "Posterior modes" not in Page(written(tmp_path, one, curves)).text
    two = example_fit(minima=[minimum(0.7, 0.0), minimum(0.3, 1.25)])
    found = minima(two)
    assert [name for name, _ in found["names"]] == ["K_H", "p"]
    text = Page(written(tmp_path, two, curves)).text.replace("\u00a0", " ")
    assert "70 % 0 1.1 × 10¹⁰ 2.56 4, 2, 1.33 30 % 1.2 2.475 × 10¹⁰ 2.435 4, 2, 1.33" in text


def test_a_ratio_of_velocities_names_the_strokes_file():
    ratio = {"v/v_ref 2": {"value": 0.5, "unit": "1", "interval": [0.4, 0.6], "note": "/a folder/soft.wav"}}
    (row,) = rows(ratio)
    assert (row["name"], row["note"]) == ("v/v_ref", "soft.wav")


def nothing(array):
    return np.full_like(np.asarray(array, dtype=float), np.nan)


def with_nothing(curves):
    def of(x):
        if isinstance(x, dict):
            return {name: nothing(one) for name, one in x.items()}
        return nothing(x) if isinstance(x, np.ndarray) else x

    fields = {f.name: getattr(curves, f.name) for f in dataclasses.fields(curves)}
    return FigureData(**{name: x if name in ("number", "frequency") else of(x) for name, x in fields.items()})


@pytest.mark.parametrize(
    "case",
    [
        lambda c: c,
        with_nothing,
        lambda c: dataclasses.replace(c, path=None, borders=()),
        lambda c: dataclasses.replace(c, borders=(100.0, 700.0)),
        lambda c: dataclasses.replace(
            c,
            decay=-c.decay,
            force=c.force | {"fitted": 0 * c.force_ms},
            compression=c.compression | {"fitted": -c.force_ms},
        ),
        lambda c: dataclasses.replace(
            c,
            attack=c.attack | {"measured": 1e-9 * c.attack["measured"]},
            sounds=c.sounds | {"fitted": 1e30 * c.sounds["fitted"]},
        ),
        lambda c: dataclasses.replace(c, level_error=nothing(c.number), frequency_cents_error=nothing(c.number)),
        lambda _: example_curves(rate=8000, seconds=0.6, count=1, f0=1760.0, path=False),
        lambda c: dataclasses.replace(c, sounds=c.sounds | {"original": np.tile(c.sounds["original"], (5, 1))}),
    ],
    ids=["whole", "nan", "no path", "one band", "no contact", "magnitudes", "no errors", "one partial", "channels"],
)
def test_page_stands_what_a_fit_may_lack(tmp_path, curves, case):
    lacking = case(curves)
    page = Page(written(tmp_path, example_fit(), lacking))
    assert len(page.drawings) in (PANELS - 1, PANELS)  # the spectra have one panel or two
    assert set(sounds_of(page)) == set(NAMES)


def test_a_page_of_the_papers_recipe_claims_no_more_than_it(tmp_path, curves):
    fit = example_fit(recipe="paper", invariants={}, levels=example_fit()["levels"] | {"path_only_db": None})
    for entry in (*fit["parameters"].values(), *fit["recordings"]):
        entry |= {"interval": None, "v_H0_interval": None}
    text = Page(written(tmp_path, fit, curves)).text
    assert "recipe “paper”" in text
    for part in ("Identifiability", "initial hammer leaves", "Assumption-free quantities"):
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
        (5e8, [1e5, 6.142e10], ("5 × 10⁸", "100000 to 6.14 × 10¹⁰")),
        (2e9, [1e3, 5e16], ("2 × 10⁹", "1000 to 5 × 10¹⁶")),
        (0.12, [0.12, 0.12], ("0.12", "0.12 to 0.12")),
        (0.0, [-1.0, 1.0], ("0", "−1 to 1")),
        (1e300, [-1e-310, 1e-310], ("1.00000000000000 × 10³⁰⁰", "(−0.00000000000000 to 0.00000000000000) × 10³⁰⁰")),
        (2.5, None, ("2.5", "–")),
        (2.5, [float("nan"), 3.0], ("2.5", "–")),
    ],
)
def test_intervals_get_the_digits_they_support(value, interval, texts):
    (row,) = rows({"c": {"value": value, "interval": interval}})
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


def _fit_of(*paths):
    return SimpleNamespace(recordings=[SimpleNamespace(recording=SimpleNamespace(path=str(path))) for path in paths])


@pytest.mark.parametrize("name", ["fitted.wav", "initial.wav", "knock.flac", "fitted-soft.wav"])
def test_a_recording_that_would_be_replaced_or_deleted_is_refused(tmp_path, name):
    """`fitted-soft.wav` belongs to an earlier fit, would be deleted by the next one, and is a recording itself."""
    (tmp_path / "fit.json").write_text('{"recordings": [{"file": "soft.wav"}, {"file": "a/loud.wav"}]}')
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
def test_sounds_are_equally_loud_and_never_clip(tmp_path, loudest):
    curves = example_curves(rate=48000, seconds=2.0)
    scale = {name: 3.0 if name == loudest else 0.02 for name in NAMES}
    given_sounds = {name: scale[name] * curves.sounds[name] for name in NAMES}
    curves = dataclasses.replace(curves, sounds=given_sounds)
    sounds = sounds_of(Page(written(tmp_path, example_fit(), curves)))
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
def test_page_allows_an_empty_modal_response(tmp_path, curves, lost):
    whole = with_ringing(curves).ringing
    envelopes = tuple(
        dataclasses.replace(one, time=lost(one.time), measured=lost(one.measured), law=lost(one.law), fitted=None)
        for one in whole.envelopes
    )
    empty = dataclasses.replace(
        whole, envelopes=envelopes, measured=lost(whole.measured), played=lost(whole.played), decays=()
    )
    assert written(tmp_path, example_fit(ringing=ringing_entry()), dataclasses.replace(curves, ringing=empty))


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
def test_a_strike_on_a_node_does_not_flatten_the_levels(curves, name):
    import matplotlib.pyplot as plt

    from pianofit.report.figures import draw_levels

    level = curves.levels[name].copy()
    level[3] = -380.0
    axes = plt.figure().add_subplot()
    draw_levels(axes, dataclasses.replace(curves, levels=curves.levels | {name: level}))
    low, high = axes.get_ylim()
    plt.close("all")
    assert -150 < low < min(x.min() for x in curves.levels.values())
    assert high > max(x.max() for x in curves.levels.values())


def test_bands_beyond_the_spectra_are_not_in_their_picture(curves):
    end = float(curves.frequency[-1])
    high = dataclasses.replace(curves, borders=(50.0, 0.1 * end, 1.5 * end, 1.8 * end))
    for figure in _spectra(high, ("band3",)):
        (axes,) = figure.axes
        assert axes.get_xlim()[1] <= end
        assert "band 3" not in " ".join(text.get_text() for text in axes.texts)


def test_a_decay_that_a_beat_hides_leaves_room_to_the_others(curves):
    hidden = dataclasses.replace(curves, decay=np.where(curves.number == 3, 1e-3, curves.decay))
    (_, with_beat), (_, plain) = (_partials(c) for c in (hidden, curves))
    low = [figure.axes[0].get_ylim()[0] for figure in (with_beat, plain)]
    assert 1e-2 < low[0] <= low[1]
    labels = [[text.get_text() for text in figure.legends[0].get_texts()] for figure in (with_beat, plain)]
    assert "below this axis" in labels[0]
    assert "below this axis" not in labels[1]


def test_modal_response_is_drawn_described_and_playable(tmp_path, curves):
    html = written(tmp_path, example_fit(ringing=ringing_entry()), with_ringing(curves))
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
        f">{label}<" in " ".join(drawn) for label in ("fitted minus recorded", "partial 3, 276 Hz", "string model")
    )
    sounds = sounds_of(page)
    assert {name: x.ndim for name, (x, *_) in sounds.items()} == {"original": 2, "fitted": 2, "string model": 1}
    loudness = [10 * np.log10(np.mean([k_weighted_mean_square(c[:16000], 16000) for c in np.atleast_2d(x.T)]))
                for x, *_ in sounds.values()]  # fmt: skip
    assert np.ptp(loudness) < 0.1  # as two loudspeakers play them, mono in both


@pytest.mark.parametrize(
    ("entry", "model", "errors"),
    [
        (ringing_entry("modes", (8.0, 3.0, 3.5)), "4 modes", ("3.0", "8.0", "3.5")),
        (ringing_entry("law", (4.0, 4.5, 5.0)), "the string model alone", ("4.0", "4.5", "5.0")),
        (ringing_entry(left_out=None), "4 modes and a knock", ()),
    ],
    ids=["modes", "law", "one recording"],
)  # fmt: skip
def test_text_and_line_name_the_render_model_and_all_errors(entry, model, errors):
    for text in (modal_response_text(entry), modal_response_line(entry)):
        assert model in text
        assert all(error in text for error in errors)
        assert ("not tested" in text) == (not errors)
    assert "\n" not in modal_response_line(entry)


def test_a_key_with_the_string_model_alone_has_no_table_and_no_third_line(tmp_path, curves):
    whole = with_ringing(curves)
    envelopes = tuple(dataclasses.replace(one, fitted=None) for one in whole.ringing.envelopes)
    law_only = dataclasses.replace(whole.ringing, envelopes=envelopes, decays=())
    html = written(tmp_path, example_fit(ringing=ringing_entry("law")), dataclasses.replace(curves, ringing=law_only))
    page = Page(html)
    assert "This key uses the string model alone." in page.text
    assert "T60" not in page.text
    assert set(sounds_of(page)) == set(NAMES)
    assert len(page.drawings) == PANELS + 9


def test_no_colour_of_the_style_is_its_own_definition():
    """A CSS variable that refers to itself is invalid, and elements with that colour are invisible."""
    for name, value in re.findall(r"(--[\w-]+): ([^;]+);", asset("page.css", "pianofit.report")):
        assert name not in value
