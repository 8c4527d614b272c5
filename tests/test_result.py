"""A result: quantities by name, tables, figures, saving and loading."""

from __future__ import annotations

import copy
import csv
import json
import sys
from dataclasses import replace
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
from hypothesis import given
from hypothesis import strategies as st
from twin_cases import short_fit as result

import pianofit
from pianofit.errors import FitError, OutputError, ParameterError
from pianofit.parameters import FIT_NAMES, PARAMETERS
from pianofit.result.draws import Draws
from pianofit.schema.decode import encode_json
from pianofit.schema.quantities import STATUSES, Quantities

HOSTILE = '<script>alert("x")</script>'


@pytest.fixture
def saved(tmp_path) -> Path:
    return result().save(tmp_path / "fit", page=False)


def hostile() -> pianofit.Result:
    """The same result with HTML code in names, notes and sentences."""
    fit = result().fit
    c = replace(fit.parameters.c, note=HOSTILE, unit=HOSTILE)
    parameters = Quantities(fit.parameters.entries | {"c": c})
    invariants = Quantities(fit.invariants.entries | {HOSTILE: replace(fit.invariants.f0, name=HOSTILE)})
    fit = replace(
        fit, identifiability_statement=HOSTILE, warnings=(HOSTILE,), parameters=parameters, invariants=invariants
    )
    return replace(result(), fit=fit)


# --- numbers by name --------------------------------------------------------------------------------------------------


def test_every_number_is_there_by_name():
    written = result().to_dict()
    for table, entries in ((result().parameters, written["parameters"]), (result().invariants, written["invariants"])):
        assert list(table) == list(entries)
        for name, quantity in table.items():
            entry = entries[name]
            assert (quantity.name, quantity.value, quantity.unit) == (name, entry["value"], entry["unit"])
            assert quantity.interval == (None if entry["interval"] is None else tuple(entry["interval"]))
            assert quantity.status == entry["status"]
            assert quantity.status in STATUSES
            assert quantity.meaning
    assert result().parameters["K_H"] == result().parameters.K_H
    assert result().parameters.K_H.meaning == PARAMETERS["K_H"].meaning
    assert result().identifiability_statement == written["identifiability_statement"]
    assert result().warnings == tuple(written["warnings"])
    assert copy.copy(result().parameters) == result().parameters


def test_a_result_is_sent_to_another_process_after_it_has_computed():
    loaded = replace(result(), recordings=())
    assert loaded.derived(lambda draw: draw.t60(1)).value > 0
    assert ForkingPickler.loads(ForkingPickler.dumps(loaded)).to_dict() == loaded.to_dict()


def test_a_result_is_read_only():
    with pytest.raises(AttributeError, match="c cannot be changed"):
        result().parameters.c = 1.0  # pyright: ignore[reportAttributeAccessIssue]
    with pytest.raises(ValueError, match="read-only"):
        result().covariance.matrix[0, 0] = 1.0
    assert copy.deepcopy(result().parameters) == result().parameters


def test_a_fit_is_equal_only_to_itself():
    """Its arrays have no single truth value when they are compared."""
    fit = result().fit
    assert fit == fit
    assert fit != copy.deepcopy(fit)
    assert fit.recordings[0].partials != copy.deepcopy(fit.recordings[0].partials)


def test_a_name_that_is_not_there_is_a_question():
    with pytest.raises(AttributeError, match="did you mean K_H"):
        _ = result().parameters.KH
    with pytest.raises(KeyError, match="did you mean K_H"):
        _ = result().parameters["KH"]
    assert "K_H" in dir(result().parameters)


def test_the_note_is_the_fitted_string_and_hammer():
    note = result().note
    values = note.string._asdict() | note.hammer._asdict()
    for name in FIT_NAMES:
        assert values[name] == pytest.approx(result().parameters[name].value, rel=1e-12)
    (share, first), *_ = result().mixture
    assert share == pytest.approx(1 / len(result().mixture), abs=0.5)
    assert first is note


def test_the_covariance_is_that_of_the_intervals():
    covariance = result().covariance
    assert covariance.names[:2] == ("c", "kappa")
    assert covariance.names[-1] == "v_H0"
    assert covariance["c", "kappa"] == covariance["kappa", "c"]
    with pytest.raises(KeyError, match=r"'kapa'.*did you mean kappa"):
        _ = covariance["c", "kapa"]
    for name in ("c", "b1", "M_H", "v_H0"):
        low, high = result().parameters[name].interval
        assert np.log(high / low) == pytest.approx(2 * 1.96 * covariance[name, name] ** 0.5, rel=0.05), name
    correlation = result().correlation
    np.testing.assert_allclose(np.diag(correlation.matrix), 1.0)
    assert correlation["K_H", "p"] > 0.9
    assert "epsilon" not in correlation.names


# --- display ----------------------------------------------------------------------------------------------------------


def test_what_a_prompt_shows_is_short():
    things = [
        result(), result().reference, result().fitted, result().recording, result().analysis,
        result().analysis.partials, result().parameters, result().invariants, result().covariance,
    ]  # fmt: skip
    for thing in things:
        assert 10 < len(repr(thing)) < 2000, type(thing)
    assert result().identifiability_statement[:60] in repr(result())
    assert result().identifiability_statement in result().summary()


def test_what_a_notebook_shows_is_escaped():
    page = hostile()._repr_html_()
    assert "<script" not in page
    assert page.count("&lt;script&gt;") == 5
    assert page.index("&lt;script&gt;") < page.index("<table>"), "the statement comes first"
    assert page.index("F/M_S") < page.index("K_H"), "the invariants come before the parameters"
    seen = replace(result().analysis, note=HOSTILE)
    assert "<script" not in seen._repr_html_()
    assert seen._repr_html_().count("<tr>") == len(seen.partials) + 6


@pytest.mark.parametrize("name", ["spectrum", "force", "levels", "correlations", "envelopes"])
def test_a_figure_is_drawn_on_new_axes_or_on_given_ones(name):
    plt = pytest.importorskip("matplotlib.pyplot")
    plt.switch_backend("Agg")
    _, given = plt.subplots()
    draw = getattr(result().plot, name)
    assert draw(given) is given
    axes = draw()
    assert axes is not given
    for panel in (given, axes):
        assert panel.has_data()
        panel.figure.canvas.draw()
    plt.close("all")


def test_the_figures_show_this_fit(monkeypatch):
    plt = pytest.importorskip("matplotlib.pyplot")
    plt.switch_backend("Agg")
    force = {line.get_label(): line for line in result().plot.force().lines}["fitted"].get_ydata()
    assert np.nanmax(force) == pytest.approx(result().fit.derived.quantities.peak_force.value)
    # Each contact ends where it does in its stroke, also if the strokes have different time steps.
    presets = {"initial": pianofit.typical("C2"), "fitted": pianofit.typical("C7")}
    strokes = {name: pianofit.simulate(it.string, it.hammer, it.geometry) for name, it in presets.items()}
    assert float(strokes["initial"].modes.step) != float(strokes["fitted"].modes.step)
    monkeypatch.setattr("pianofit.report.figures._strokes", lambda _: strokes)
    for line in result().plot.force().lines:
        stroke = strokes[line.get_label()]
        last = line.get_xdata()[line.get_ydata() > 0][-1]
        assert last == pytest.approx(1e3 * stroke.last_touch, abs=1e3 * float(stroke.modes.step))
    levels = {line.get_label(): line for line in result().plot.levels().lines}["fitted"].get_ydata()
    np.testing.assert_array_equal(levels, result().reference.compared.fitted)
    assert {text.get_text() for text in result().plot.spectrum().get_legend().get_texts()} == {
        "measured", "initial", "fitted",
    }  # fmt: skip
    lines = {line.get_label(): line for line in result().plot.envelopes(number=2).lines}
    assert "partial 2, " in lines["string model"].axes.get_title(loc="left")
    with pytest.raises(ParameterError, match=r"number=0 .*\[1, 2"):
        result().plot.envelopes(number=0)
    plt.close("all")


# --- export -----------------------------------------------------------------------------------------------------------


def test_a_table_is_written_without_pandas(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    result().parameters.to_csv(tmp_path / "table.csv")
    with (tmp_path / "table.csv").open(newline="") as file:
        rows = {row["name"]: row for row in csv.DictReader(file)}
    assert list(rows) == list(result().parameters)
    for name, quantity in result().parameters.items():
        assert float(rows[name]["value"]) == quantity.value
        assert rows[name]["low"] == ("" if quantity.interval is None else repr(quantity.interval[0]))


def test_what_is_not_installed_is_named(monkeypatch):
    for package in ("pandas", "arviz_base"):
        monkeypatch.setitem(sys.modules, package, None)
    with_draws = replace(result(), draws=Draws({"p": np.ones((2, 10))}))
    for call in (
        result().to_dataframe, result().invariants.to_dataframe, result().covariance.to_dataframe,
        result().analysis.to_dataframe, with_draws.to_arviz,
    ):  # fmt: skip
        with pytest.raises(OutputError, match=r"needs (pandas|arviz_base), .*pip install 'pianofit\[notebook\]'"):
            call()


def test_tables_for_pandas():
    pytest.importorskip("pandas")
    frame = result().to_dataframe()
    assert frame.loc["K_H", "value"] == result().parameters.K_H.value
    assert tuple(frame.loc["c", ["low", "high"]]) == result().parameters.c.interval
    covariance = result().covariance
    assert covariance.to_dataframe().loc["c", "kappa"] == covariance["c", "kappa"]
    partials = result().analysis.to_dataframe()
    np.testing.assert_array_equal(partials["frequency"], result().analysis.partials.frequency)
    assert partials.index.name == "number"


def test_draws_for_arviz():
    with pytest.raises(FitError, match="intervals='posterior'"):
        result().to_arviz()
    pytest.importorskip("arviz_base")
    draws = np.random.default_rng(0).normal(size=(2, 50))
    posterior = replace(result(), draws=Draws({"p": draws, "x0/L": draws})).to_arviz().posterior
    for name in ("p", "x0 over L"):
        np.testing.assert_array_equal(posterior[name].to_numpy(), draws)


def test_a_dict_is_a_copy():
    mine = result().to_dict()
    mine["parameters"]["c"]["value"] = 0.0
    assert result().parameters.c.value > 0
    assert mine["identifiability_statement"] == result().identifiability_statement


# --- saving and loading -----------------------------------------------------------------------------------------------


def test_a_result_is_saved_and_read_back(saved):
    assert sorted(file.name for file in saved.iterdir()) == ["fit.json", "fitted.wav", "initial.wav"]
    assert json.loads((saved / "fit.json").read_text()) == result().to_dict()
    for place in (saved, str(saved), saved / "fit.json"):
        back = pianofit.Result.load(place)
        assert back.parameters == result().parameters
        assert back.invariants == result().invariants
        assert (back.warnings, back.weights) == (result().warnings, result().weights)
        assert back.identifiability_statement == result().identifiability_statement
        np.testing.assert_allclose(back.note.string, result().note.string, rtol=1e-12)
        np.testing.assert_allclose(back.note.hammer, result().note.hammer, rtol=1e-12)
        np.testing.assert_allclose(back.note.geometry, result().note.geometry, rtol=1e-12)
        assert back.note.gain == result().note.gain
        assert len(repr(back)) < 2000
        assert back._repr_html_() == result()._repr_html_()


def test_what_a_file_does_not_hold_is_said(saved):
    back = pianofit.Result.load(saved)
    calls: list[Any] = [
        lambda: back.recording, lambda: back.fitted, lambda: back.analysis, back.plot.spectrum, back.plot.envelopes,
        lambda: back.save(saved / "again"), lambda: back.report(saved),
    ]  # fmt: skip
    for call in calls:
        with pytest.raises(FitError, match=r"^synthetic: .*with_recordings"):
            call()
    drawn = Quantities.of(replace(quantity, interval_method="posterior") for quantity in result().parameters.values())
    (saved / "changed.json").write_bytes(encode_json(replace(result().fit, parameters=drawn)))
    with pytest.raises(FitError, match=r"draws\.npz"):
        pianofit.Result.load(saved / "changed.json").to_arviz()
    with pytest.raises(FitError, match="intervals='posterior'"):
        back.to_arviz()
    assert back.covariance.names == result().covariance.names
    np.testing.assert_allclose(back.covariance.matrix, result().covariance.matrix, rtol=1e-12)
    assert back.plot.correlations().get_title() == result().plot.correlations().get_title()
    for entry in (None, {"names": ["c"], "matrix": [[1.0, 0.0]]}, {"names": ["c"], "matrix": [["x"]]}):
        changed = json.loads((saved / "fit.json").read_text())
        changed["minima"][0]["covariance"] = entry
        (saved / "changed.json").write_text(json.dumps(changed))
        with pytest.raises(FitError, match="covariance"):
            _ = pianofit.Result.load(saved / "changed.json").covariance
    (saved / "changed.json").unlink()
    assert sorted(file.name for file in saved.iterdir()) == ["fit.json", "fitted.wav", "initial.wav"]


def test_a_folder_in_use_is_kept(saved):
    before = (saved / "fit.json").read_bytes()
    with pytest.raises(OutputError, match="not empty"):
        result().save(saved)
    assert result().save(saved, force=True, page=False) == saved
    assert (saved / "fit.json").read_bytes() == before


def test_an_earlier_page_is_there_until_the_new_one_is(saved, monkeypatch):
    """Writing a page takes seconds. A process that is killed meanwhile leaves the earlier files complete."""
    from pianofit.report import save

    (saved / "report.html").write_text("of an earlier fit")
    before = {file.name: file.read_bytes() for file in saved.iterdir()}
    seen = []

    def report_bytes(*_):
        seen.append({file.name: file.read_bytes() for file in saved.iterdir()})
        return b"new"

    monkeypatch.setattr(save, "report_bytes", report_bytes)
    result().save(saved, force=True)
    assert seen == [before]
    assert (saved / "report.html").read_text() == "new"
    assert {file.name for file in saved.iterdir()} == set(before)


def test_every_recording_has_a_sound_of_its_own(tmp_path):
    """Also if two recordings have the same name in two folders."""
    first = result().reference
    other = replace(first, recording=replace(first.recording, path="soft/a.wav"))
    alike = replace(first, recording=replace(first.recording, path="loud/a.wav", rate=44_100))
    three = replace(result(), recordings=(first, other, alike))
    names = sorted(file.name for file in three.save(tmp_path / "fit", page=False).glob("fitted-*"))
    assert names == ["fitted-a-2.wav", "fitted-a-3.wav", "fitted-synthetic.wav"]
    assert soundfile.info(tmp_path / "fit" / "fitted-a-3.wav").samplerate == 44_100
    assert soundfile.info(tmp_path / "fit" / "fitted-a-2.wav").samplerate == first.recording.rate != 44_100


def test_the_page_goes_where_it_is_asked_to(tmp_path):
    assert result().report(tmp_path) == tmp_path / "report.html"
    page = hostile().report(tmp_path / "own.html", title=HOSTILE).read_text()
    assert HOSTILE not in page


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"schema": 99}, "99"),
        ({"identifiability_statement": None}, "identifiability_statement = None must be a text"),
        ({"warnings": 3}, "warnings = 3 must be a list"),
        ({"invariants": {"f0": {"value": None}}}, "invariants.f0.value = None must be a number"),
        ({"parameters": {}}, "parameters.c is missing"),
    ],
)
def test_a_file_that_is_no_fit_is_refused(saved, change, named):
    (saved / "fit.json").write_text(json.dumps(result().to_dict() | change))
    with pytest.raises(FitError, match=r"fit\.json: ") as caught:
        pianofit.Result.load(saved)
    assert named in str(caught.value)


@given(st.lists(st.sampled_from(["x", "x-1", "x-2", "x-3", "y"]), min_size=2, max_size=6))
def test_fitted_sounds_have_different_names(stems):
    from pianofit.report.save import stroke_names

    assert len({*stroke_names(stems)}) == len(stems)


def test_fitted_sounds_have_names_that_file_systems_accept():
    from pianofit.report.save import stroke_names

    names = stroke_names(["ü" * 125 + "soft", "ü" * 125 + "loud", "\udcff"])
    assert len({*names}) == 3
    assert max(len(name.encode()) for name in names) <= 255


def test_levels_are_compared_up_to_6_khz_and_within_60_db():
    """The range that pages and docs/files.md state."""
    from pianofit.result.comparison import audible_partials

    frequency, level = np.array([100.0, 200.0, 300.0, 5999.0, 6001.0]), np.array([0.0, -59.9, -60.1, -30.0, 0.0])
    assert audible_partials(frequency, level).tolist() == [True, True, False, True, False]
