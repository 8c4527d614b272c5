"""Comparison of two fits: z of independent fits, reasons for a missing z, and the felts in one figure."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import json
import math
from pathlib import Path

import numpy as np
import pytest
from twin_cases import short_fit as fitted

import pianofit
from pianofit.cli import main
from pianofit.conversions import HALF_WIDTH_95
from pianofit.errors import FitError, ParameterError
from pianofit.felt import law_of
from pianofit.report.static_law import static_law
from pianofit.schema.decode import encode_json
from pianofit.schema.fit import Fit
from pianofit.schema.quantities import Quantities, Quantity


def with_quantities(fit: Fit, **entries: Quantity) -> Fit:
    """Return the fit with other entries in its tables."""
    tables = {
        table: Quantities(dict(getattr(fit, table)) | {n: q for n, q in entries.items() if n in getattr(fit, table)})
        for table in ("parameters", "invariants")
    }
    derived = Quantities({n: entries.get(n, q) for n, q in fit.derived.quantities.items()})
    return dataclasses.replace(fit, **tables, derived=dataclasses.replace(fit.derived, quantities=derived))


def with_row(fit: Fit, **changes: object) -> Fit:
    """Return the fit with changes of its first recording."""
    first, *others = fit.recordings
    return dataclasses.replace(fit, recordings=(dataclasses.replace(first, **changes), *others))


def changed(factor: float = 1.0, names: tuple[str, ...] = (), **statuses: str) -> pianofit.Result:
    """Return the fit with values and intervals times `factor`, and with other statuses."""
    fit = with_row(fitted().fit, sha256="of another recording")
    table = {**fit.invariants, **fit.parameters, **fit.derived.quantities}
    for name in names:
        low, high = table[name].interval
        interval = (factor * low, factor * high)
        table[name] = dataclasses.replace(table[name], value=factor * table[name].value, interval=interval)
    for name, status in statuses.items():
        table[name] = dataclasses.replace(table[name], status=status)
    return dataclasses.replace(fitted(), fit=with_quantities(fit, **table))


def spread(name: str) -> float:
    """Return the standard deviation of the logarithm of one value."""
    low, high = fitted().parameters[name].interval
    return math.log(high / low) / (2 * HALF_WIDTH_95)


# --- values -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("factor", [1.0, 1.0001, 0.9, 3.0])
def test_z_is_the_difference_of_logarithms_over_the_combined_deviation(factor):
    found = pianofit.compare(fitted(), changed(factor, ("M_H", "v_H0")))["M_H"]
    assert found.reason == ""
    assert found.z == pytest.approx(math.log(factor) / (math.sqrt(2) * spread("M_H")), rel=1e-6, abs=1e-9)
    assert found.difference == pytest.approx((factor - 1) * fitted().parameters.M_H.value, rel=1e-12, abs=1e-18)
    assert found.sd > 0
    assert found.difference == pytest.approx(found.z * found.sd, rel=1e-9, abs=1e-18)


def test_to_first_order_the_deviation_is_the_root_of_the_sum_of_variances():
    found = pianofit.compare(fitted(), changed(1.0001, ("b1",)))["b1"]
    assert found.sd == pytest.approx(math.sqrt(2) * spread("b1") * fitted().parameters.b1.value, rel=1e-3)


def test_exchanging_the_fits_changes_the_sign_and_nothing_else():
    other = changed(1.02, ("M_H", "b1", "mu"))
    forward, reverse = pianofit.compare(fitted(), other), pianofit.compare(other, fitted())
    assert [q.name for q in forward] == [q.name for q in reverse]
    for one, two in zip(forward, reverse, strict=True):
        assert (one.a, one.b) == (two.b, two.a)
        assert (one.z is None) == (two.z is None)
        if one.z is not None:
            assert one.z == pytest.approx(-two.z, abs=1e-9)
            assert one.sd == pytest.approx(two.sd, rel=1e-9)


def test_every_quantity_of_both_is_there_with_z_or_a_reason():
    found = pianofit.compare(fitted(), changed())
    names = [q.name for q in found]
    assert {*fitted().invariants, *fitted().parameters} <= {*names}
    assert len(names) == len({*names}) == len(found)
    assert all((q.z is None) == bool(q.reason) for q in found)
    with pytest.raises(KeyError, match="'KH'"):
        _ = found["KH"]


@pytest.mark.parametrize(
    ("statuses", "name", "word"),
    [
        ({"M_H": "given"}, "M_H", "fixed in B"), ({"M_H": "assumed"}, "M_H", "assumed in B"),
        ({"M_H": "at-bound"}, "M_H", "bound in B"), ({"p": "not-identifiable"}, "p", "not identifiable in B"),
        ({"L": "assumed", "c": "scaled"}, "c", "assumed length in B"),
        ({"M_S": "assumed", "M_H": "scaled"}, "M_H", "assumed mass in B"),
        ({}, "L", "fixed in A and B"), ({}, "K_H", "unit changes with p"),
    ],
)  # fmt: skip
def test_a_value_that_is_not_measured_has_a_reason_and_no_z(statuses, name, word):
    found = pianofit.compare(fitted(), changed(**statuses))
    assert found[name].z is None
    assert word in found[name].reason
    assert found["f0"].z == 0


def test_one_assumption_of_both_is_comparable_and_two_are_not():
    scaled = {"L": "assumed", "c": "scaled", "M_S": "assumed", "M_H": "scaled"}
    one = changed(**scaled)
    assert pianofit.compare(one, changed(**scaled))["c"].z == 0
    length = one.fit.parameters["L"]
    longer = with_quantities(one.fit, L=dataclasses.replace(length, value=1.001 * length.value))
    found = pianofit.compare(one, dataclasses.replace(one, fit=longer))
    assert "different" in found["c"].reason
    assert found["M_H"].z == 0, "it scales with the mass alone"


def test_an_unmeasured_velocity_is_not_compared():
    scaled = changed(v_H0="scaled", mu="scaled", felt_force="scaled")
    fit = with_row(scaled.fit, gain_status="fitted", stroke_status="scaled")
    scaled = dataclasses.replace(scaled, fit=fit)
    found = pianofit.compare(fitted(), scaled)
    for q in found:
        if q.name in ("v_H0", "mu") or q.name == "felt_force":
            assert "not measured in B" in q.reason
    assert found["p"].z == 0
    assert any("No hammer velocity" in message for message in found.warnings)


def test_ratios_of_velocities_are_those_of_the_same_recordings():
    def with_ratio(checksum: str) -> pianofit.Result:
        it = changed()
        (row,), name = it.fit.recordings, "v/v_ref 2"
        ratio = dataclasses.replace(it.fit.invariants["B"], name=name, note="soft.wav")
        other = dataclasses.replace(row, stroke=1, is_reference=False, sha256=checksum)
        invariants = Quantities(dict(it.fit.invariants) | {name: ratio})
        fit = dataclasses.replace(it.fit, invariants=invariants, recordings=(row, other))
        return dataclasses.replace(it, fit=fit)

    assert pianofit.compare(with_ratio("x"), with_ratio("x"))["v/v_ref 2"].z == 0
    assert "different recordings" in pianofit.compare(with_ratio("x"), with_ratio("y"))["v/v_ref 2"].reason
    assert "only in A" in pianofit.compare(with_ratio("x"), changed())["v/v_ref 2"].reason


def test_the_same_recordings_another_key_and_a_stopped_search_are_said():
    assert any("independent" in message for message in pianofit.compare(fitted(), fitted()).warnings)
    assert not pianofit.compare(fitted(), changed()).warnings
    assert any("keys" in message for message in pianofit.compare(fitted(), changed(1.06, ("f0",))).warnings)
    stopped = dataclasses.replace(fitted(), fit=dataclasses.replace(fitted().fit, converged=False))
    found = pianofit.compare(fitted(), stopped)
    assert all(q.z is None for q in found)
    assert "converge in B" in found["f0"].reason


def test_z_is_a_standard_normal_number_for_independent_draws():
    """Values drawn from the posterior of one fit and compared in pairs have z of mean 0 and standard deviation 1."""
    names, covariance = fitted().covariance.names, fitted().covariance.matrix
    at = names.index("M_H")
    random = np.random.default_rng(0)
    draws = np.exp(random.normal(0.0, math.sqrt(covariance[at, at]), 60))
    fits = [changed(factor, ("M_H",)) for factor in draws]
    z = [pianofit.compare(a, b)["M_H"].z for a, b in itertools.pairwise(fits[::1])][::2]
    assert abs(np.mean(z)) < 4 / math.sqrt(len(z))
    assert 0.6 < np.std(z) < 1.5


# --- felts ------------------------------------------------------------------------------------------------------------


def softer(factor: float) -> pianofit.Result:
    """Return the fit with the force of its felt times `factor`."""
    it = changed(factor, ("K_H",))
    hammer = it.note.hammer
    note = it.note._replace(hammer=hammer._replace(K_H=factor * hammer.K_H))
    return dataclasses.replace(it, minima_notes=((note,),))


def test_the_felts_are_compared_at_the_reference_compression_of_the_key():
    found = pianofit.compare(fitted(), softer(1.5))
    first, second = found.felts
    np.testing.assert_array_equal(first.compression_mm, second.compression_mm)
    np.testing.assert_allclose(second.force, 1.5 * first.force, rtol=1e-9)
    row, hammer = found["felt_force"], fitted().note.hammer
    u = 1e-3 * fitted().fit.derived.reference_compression_mm
    assert found.compressions_mm == (1e3 * u, 1e3 * u)
    assert row.a.value == pytest.approx(law_of(hammer).force(u, 0.0, hammer), rel=1e-9)
    assert row.a.value == pytest.approx(found["F/M_S"].a.value * fitted().parameters.M_S.value, rel=1e-9)
    assert row.z == 0  # `softer` changes only the note
    assert first.at(1e3 * u)[0] == pytest.approx(row.a.value, rel=1e-3)
    assert found.felt_unit == row.unit == "N"
    assert first.compression_mm[-1] == pytest.approx(static_law(fitted()).compression_mm[-1])


def test_an_assumed_mass_is_divided_out():
    found = pianofit.compare(fitted(), changed(M_S="assumed"))
    assert found.felt_unit == "N/kg"
    mass = float(fitted().note.geometry.mass)
    np.testing.assert_allclose(found.felts[0].force * mass, static_law(fitted()).force, rtol=1e-9)


def test_fits_without_a_covariance_are_compared_and_not_drawn():
    without = dataclasses.replace(fitted(), fit=dataclasses.replace(fitted().fit, minima=()))
    found = pianofit.compare(fitted(), without)
    assert found.felts is None
    assert found["f0"].z == 0
    for draw in (found.plot, found.figure):
        with pytest.raises(FitError, match="covariance"):
            draw()


def test_the_figure_names_both_and_has_units():
    plt = pytest.importorskip("matplotlib.pyplot")
    plt.switch_backend("Agg")
    found = pianofit.compare(fitted(), softer(2.0), labels=("$soft", "_loud"))
    axes = found.plot()
    texts = [text.get_text() for text in axes.get_legend().get_texts()]
    assert len(texts) == 4
    assert "soft" in "".join(texts)
    assert "_loud" in "".join(texts)
    assert "(mm)" in axes.get_xlabel()
    assert "(N)" in axes.get_ylabel()
    assert found.plot(axes) is axes
    axes.figure.canvas.draw()
    plt.close("all")
    for kind, begin in (("png", b"\x89PNG"), ("svg", b"<?xml"), ("pdf", b"%PDF")):
        content = found.figure(kind)
        assert content.startswith(begin)
        assert content == found.figure(kind)
    with pytest.raises(ParameterError, match="kind='gif'"):
        found.figure("gif")


def test_a_relaxing_felt_has_two_laws_in_the_figure_and_room_for_their_names():
    found = pianofit.compare(fitted(), softer(2.0), labels=("a folder whose name goes on and on", "b"))
    relaxing = tuple(dataclasses.replace(felt, slow=0.7 * felt.force) for felt in found.felts)
    both = dataclasses.replace(found, felts=relaxing).figure("svg").decode()
    assert "b, slow" in both
    assert "and on" not in both, "a long label is cut"
    height = [float(text.partition('height="')[2].partition("pt")[0]) for text in (found.figure("svg").decode(), both)]
    assert height[1] > height[0]


# --- two results in one figure ----------------------------------------------------------------------------------------

FIGURES = ("spectrum", "force", "felt", "levels", "envelopes")


@pytest.mark.parametrize("name", [*FIGURES, "correlations"])
def test_a_figure_names_its_axes_with_units_and_its_label(name):
    plt = pytest.importorskip("matplotlib.pyplot")
    plt.switch_backend("Agg")
    axes = getattr(fitted().plot, name)(label="soft")
    if name == "correlations":
        assert "soft" in axes.get_title(loc="left")
        assert "%" in axes.get_title(loc="left")
        assert axes.get_xlabel()
        assert axes.get_ylabel()
    else:
        unitless = ("partial number",)
        for text in (axes.get_xlabel(), axes.get_ylabel()):
            assert text.endswith(")") or text.startswith(unitless), text
        assert all(text.get_text().startswith("soft: ") for text in axes.get_legend().get_texts())
    axes.figure.canvas.draw()
    plt.close("all")


@pytest.mark.parametrize("name", FIGURES)
def test_two_results_in_one_figure_can_be_distinguished(name):
    plt = pytest.importorskip("matplotlib.pyplot")
    plt.switch_backend("Agg")
    draw = getattr(fitted().plot, name)
    axes = draw(label="soft")
    limits, texts = (axes.get_xlim(), axes.get_ylim()), len(axes.texts)
    assert draw(axes, label="loud") is axes
    hues: dict[str, set[str]] = {}
    for line in axes.lines:
        owner, _, _ = line.get_label().partition(": ")
        if owner in ("soft", "loud"):
            hues.setdefault(owner, set()).add(line.get_color())
    assert len(hues["soft"]) == len(hues["loud"]) == 1
    assert hues["soft"] != hues["loud"]
    assert (axes.get_xlim(), axes.get_ylim()) == limits, "those of two equal drawings are those of one"
    assert len(axes.texts) == texts
    names = [text.get_text() for text in axes.get_legend().get_texts()]
    assert len(names) == len({*names})
    assert {name.partition(": ")[0] for name in names} == {"soft", "loud"}
    third = draw(axes, label="third").lines[-1].get_color()
    assert {third}.isdisjoint(hues["soft"] | hues["loud"])
    axes.figure.canvas.draw()
    plt.close("all")


def test_the_limits_hold_both_drawings():
    plt = pytest.importorskip("matplotlib.pyplot")
    plt.switch_backend("Agg")
    axes = softer(3.0).plot.felt(label="hard")
    top = axes.get_ylim()[1]
    fitted().plot.felt(axes, label="soft")
    assert axes.get_ylim()[1] == top
    fitted_top = fitted().plot.felt().get_ylim()[1]
    assert top == pytest.approx(3.0 * fitted_top, rel=1e-6)
    plt.close("all")


def test_the_felt_is_drawn_of_a_fit_that_was_read_back(tmp_path):
    plt = pytest.importorskip("matplotlib.pyplot")
    plt.switch_backend("Agg")
    fitted().save(tmp_path / "fit", page=False)
    back = pianofit.Result.load(tmp_path / "fit").plot.felt()
    for one, two in zip(back.lines, fitted().plot.felt().lines, strict=True):
        np.testing.assert_allclose(one.get_xydata(), two.get_xydata(), rtol=1e-9)
    assert len(back.collections) == 1, "the band"
    plt.close("all")


# --- table, data, command ---------------------------------------------------------------------------------------------


def test_a_comparison_is_shown_and_written():
    found = pianofit.compare(fitted(), changed(), labels=("<b>", "other"))
    assert len(repr(found).splitlines()) == len(found) + 1
    assert "<b>" not in found._repr_html_()
    document = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert [entry["name"] for entry in document["quantities"]] == [q.name for q in found]
    assert document["felt_unit"] == "N"
    (law, _), (own, _) = document["felts"], found.felts
    assert law == {"compression_mm": own.compression_mm.tolist(), "force": own.force.tolist(), "slow": None}
    with pytest.raises(dataclasses.FrozenInstanceError):
        found.labels = ("a", "b")


def test_a_table_for_pandas():
    pytest.importorskip("pandas")
    frame = pianofit.compare(fitted(), changed()).to_dataframe()
    assert frame.loc["M_H", "z"] == 0


@pytest.mark.parametrize(
    ("arguments", "error", "named"),
    [
        ((3, "b"), ParameterError, "a=3"), (("nothing", "b"), FitError, "nothing"),
        ((None, None), ParameterError, "a=None"),
    ],
)  # fmt: skip
def test_an_argument_that_is_not_a_fit_is_named(arguments, error, named):
    with pytest.raises(error, match=named):
        pianofit.compare(*arguments)


@pytest.mark.parametrize("labels", [("a",), "ab", ("a", "a"), ("a", ""), ("a", 1)])
def test_labels_are_two_different_texts(labels):
    with pytest.raises(ParameterError, match="labels"):
        pianofit.compare(fitted(), fitted(), labels=labels)


@pytest.mark.parametrize("part", ["converged", "recordings", "invariants", "parameters"])
@pytest.mark.parametrize("held", [None, [], [{}], {"f0": {}}, "text"])
def test_a_file_that_lacks_something_is_one_error(part, held, tmp_path):
    (tmp_path / "fit.json").write_bytes(encode_json(fitted().to_dict() | {part: held}))
    with contextlib.suppress(FitError):
        pianofit.compare(tmp_path, fitted())


def test_without_a_covariance_the_felts_are_left_out(tmp_path):
    (tmp_path / "fit.json").write_bytes(encode_json(dataclasses.replace(fitted().fit, minima=())))
    found = pianofit.compare(tmp_path, fitted())
    assert found.felts is None
    assert any("covariance" in message for message in found.warnings)


def test_the_command_compares_folders(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, it in (("soft", fitted()), ("loud", changed(1.01, ("M_H",)))):
        it.save(tmp_path / name, page=False)
    out = tmp_path / "felts.svg"
    assert main(["compare", "soft", "loud/fit.json", "--out", str(out), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["labels"] == ["soft", "loud"]
    of = {entry["name"]: entry for entry in document["quantities"]}
    assert of["M_H"]["z"] == pytest.approx(math.log(1.01) / (math.sqrt(2) * spread("M_H")), rel=1e-6)
    assert out.read_bytes().startswith(b"<?xml")
    assert main(["compare", "soft", "loud", "--out", str(out)]) == 1
    assert "--force" in capsys.readouterr().err
    assert main(["compare", "soft", "loud", "--out", "felts.gif"]) == 1
    assert "felts.gif" in capsys.readouterr().err
    assert main(["compare", "soft", "nowhere"]) == 1
    assert "nowhere" in capsys.readouterr().err
    assert main(["compare", "soft", "loud"]) == 0
    assert "M_H" in capsys.readouterr().out
    assert {path.name for path in Path(tmp_path).iterdir()} == {"soft", "loud", "felts.svg"}
