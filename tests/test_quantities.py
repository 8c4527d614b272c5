"""A quantity is a number with an uncertainty: formats, LaTeX, and short representations at a prompt."""

from __future__ import annotations

import math
from dataclasses import replace

import jax
import numpy as np
import pytest
from instrument_cases import true_note

import pianofit
from pianofit.conversions import HALF_WIDTH_95
from pianofit.errors import ParameterError
from pianofit.io.uncertainty_format import latex_name, latex_unit
from pianofit.model.modal_response import ModalResponse, VelocityGain
from pianofit.model.output_path import OutputPath, VelocityDiscrepancy
from pianofit.parameters import Hammer, String


def quantity(value: float, sd: float, **more) -> pianofit.Quantity:
    return pianofit.Quantity(
        "M_H", value, "kg", (value - HALF_WIDTH_95 * sd, value + HALF_WIDTH_95 * sd), "fitted", "", **more
    )


@pytest.mark.parametrize(
    ("value", "sd", "spec", "text"),
    # Results of the package `uncertainties`, version 3.2.
    [
        (2.277, 0.004, "S", "2.277(4)"),
        (3.1415, 0.01, ".1uS", "3.14(1)"),
        (12.3456, 1.234, "S", "12.3(1.2)"),
        (123.4, 12, "S", "123(12)"),
        (1.2346e10, 1.5e7, ".2uS", "1.2346(15)e+10"),
        (1.2346e10, 1.5e7, "L", r"\left(1.2346 \pm 0.0015\right) \times 10^{10}"),
        (1.2346e10, 1.5e7, "P", "(1.2346±0.0015)×10¹⁰"),
        (1.2346e10, 1.5e7, ".2u", "(1.2346+/-0.0015)e+10"),
        (0.2, 0.01, "", None),
        (2.277, 0.004, ".1f", "2.3+/-0.0"),
        (9.996, 0.0099, "S", "9.996(10)"),
        (-1.5, 0.02, "S", "-1.500(20)"),
        (2.277, 0.004, "12S", "    2.277(4)"),
        (2.277, 0.004, "p", "(2.277+/-0.004)"),
    ],
)
def test_a_format_is_that_of_uncertainties(value, sd, spec, text):
    it = quantity(value, sd)
    assert format(it, spec) == (str(it) if text is None else text)


@pytest.mark.parametrize(("first", "digits"), [(354, 2), (355, 1), (949, 1), (950, 2)])
def test_an_uncertainty_is_rounded_by_the_rule_of_the_particle_data_group(first, digits):
    written = f"{quantity(500.0, first * 1e-5):S}".partition("(")[2].rstrip(")")
    assert len(written) == digits


def test_a_written_value_is_the_value():
    random = np.random.default_rng(0)
    for value, share in zip(10 ** random.uniform(-12, 12, 300), 10 ** random.uniform(-8, -1.2, 300), strict=True):
        text = f"{quantity(value, value * share):S}"
        number, _, rest = text.partition("(")
        digits, _, power = rest.partition(")")
        assert abs(float(number + power) / value - 1) < 0.6 * share
        last = 0 if "." in digits else len(number.partition(".")[2])
        assert float(f"{digits}e{-last}") * float(f"1{power}") == pytest.approx(value * share, rel=0.15)


def test_there_is_an_uncertainty_where_the_interval_has_one():
    it = quantity(2.277, 0.004)
    assert float(it) == 2.277
    assert it.sd == pytest.approx(0.004)
    assert math.sqrt(it) == math.sqrt(2.277)
    # For a Gaussian of the logarithm it is the relative standard deviation, if that is small.
    for s, symmetric in ((0.01, True), (0.09, True), (0.12, False), (1.0, False)):
        wide = replace(it, value=3.0, interval=(3 * math.exp(-HALF_WIDTH_95 * s), 3 * math.exp(HALF_WIDTH_95 * s)))
        assert (wide.sd is not None) == symmetric
        if symmetric:
            assert wide.sd == pytest.approx(3 * s, rel=0.02)
    point = replace(it, interval=(2.277, 2.277))
    for none in (replace(it, interval=None), replace(it, interval_unbounded=("low",)), point):
        assert none.sd is None


def test_without_an_uncertainty_the_interval_is_written():
    it = quantity(2.277, 0.4)
    loose = replace(it, interval=(1.5, 4.5))
    assert f"{loose:S}" == f"{loose:P}" == "2.28 [1.50, 4.50]"
    assert f"{loose:L}" == r"2.28\;[1.50,\,4.50]"
    assert f"{replace(loose, interval_unbounded=('high',)):S}" == "2.28 (> 1.50)"
    assert f"{replace(loose, interval_unbounded=('low',)):S}" == "2.28 (< 4.50)"
    assert "4.5" not in f"{replace(loose, interval_unbounded=('low', 'high')):S}"
    assert f"{replace(it, interval=None):S}" == "2.277"
    assert f"{replace(it, interval=None, value=2.277e-9):L}" == r"2.277 \times 10^{-9}"


@pytest.mark.parametrize("spec", ["x", "S.2", ".uS", ".99u", "d"])
def test_another_format_is_refused(spec):
    with pytest.raises(ParameterError, match="format"):
        format(quantity(1.0, 0.1), spec)


def test_a_notebook_shows_latex_and_no_commands_of_a_file():
    assert quantity(2.277, 0.004)._repr_latex_() == r"$M_{\mathrm{H}} = 2.277 \pm 0.004\,\mathrm{kg}$"
    names = {"kappa": r"\kappa", "x0/L": r"x_{0}/L", "p": "p", "b1": "b_{1}", "v/v_ref 2": r"v/v_{\mathrm{ref\,2}}"}
    assert {name: latex_name(name) for name in names} == names
    assert (latex_unit("m²/s"), latex_unit("1")) == (r"\,\mathrm{m^{2}/s}", "")
    hostile = r"}\href{javascript:alert(1)}{$x$"
    for text in (latex_name(hostile), latex_unit(hostile)):
        assert "href{" not in text
        assert text.count("{") == text.count("}")
        assert "$" not in text


# --- at a prompt ------------------------------------------------------------------------------------------------------


def test_what_holds_arrays_is_shown_in_a_few_lines():
    k = np.arange(1.0, 400.0)
    path = OutputPath(60 * k, k, VelocityDiscrepancy(np.arange(1.0, 9.0), np.zeros((8, 399))))
    part = VelocityGain(np.arange(1.0, 9.0), np.ones((8, 900), complex))
    own = np.zeros((2, 900))
    ringing = ModalResponse(np.ones(900, int), own[0] + 0j, own.T, own + 0j, np.zeros((2, 44_100)), 44_100, part)
    note = true_note(60)._replace(path=path, modal_response=ringing)
    shown = repr(note)
    assert len(shown) < 1000
    assert shown.count("\n") < 12
    for word in ("frequency=[399]", "knock=[2, 44100]", f"K_H={note.hammer.K_H:.6g}", "quantity='pressure'"):
        assert word in shown
    stroke = note.strike(44_100)
    many = Hammer(*(np.ones(1000) for _ in range(5)))
    for thing in (
        stroke,
        stroke.modes,
        stroke.pulse,
        many,
        pianofit.typical("C4").string,
        pianofit.preset("bensa-final"),
    ):
        assert 10 < len(repr(thing)) < 1000, type(thing)


def test_numbers_alone_are_shown_to_the_last_digit():
    string = String(0.1 + 0.2, 1.0, 2.0, 3.0)
    assert eval(repr(string), {"String": String}) == string  # noqa: S307


def test_inside_a_computation_a_note_is_shown_too():
    seen = []
    jax.jit(lambda note: seen.append(repr(note)) or note.gain)(true_note(60))
    assert "quantity='pressure'" in seen[0]


def test_a_setup_shows_what_was_given():
    setup = pianofit.Setup(length=1.0, fixed={"M_H": 0.005}, recordings=(pianofit.RecordingInfo(v_H0=0.8),))
    shown = repr(setup)
    for part in ("length=1.0", "fixed={'M_H': 0.005}", "v_H0=0.8"):
        assert part in shown
    assert "strike_position" not in shown
