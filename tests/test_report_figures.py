"""Figures, equations and symbols of a page: all references resolve, in light and in dark mode."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest
from report_cases import Page, drawn_in, drawn_once, example_content, example_fit, example_result, response_content

from pianofit.felt import LAWS
from pianofit.parameters import PARAMETERS
from pianofit.report.drawing import COLOURS, FITTED, Panel
from pianofit.report.equations import HAMMER, MODES, PATH, STRING, equations, formula_html, symbols
from pianofit.report.html import asset, pictures
from pianofit.report.page import report_bytes
from pianofit.report.text import SYMBOLS


@pytest.fixture(scope="module")
def html():
    fit = example_fit(modal_response=response_content())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pianofit.report.page.draw_figures", drawn_once)
        patch.setattr("pianofit.report.sound.strokes_of", lambda _: ({}, False))
        return report_bytes(example_result(fit, modes=True), "a.wav, F#2").decode()


# ---- figures ----


def colours_of(mode):
    """Return property -> value in `page.css`, for light or dark pages."""
    light, dark = re.findall(r":root(?:\.auto)? \{(.*?)\}", asset("page.css", "pianofit.report"), re.DOTALL)
    return dict(re.findall(r"--([\w-]+): ([^;]+);", {"light": light, "dark": dark}[mode]))


@pytest.mark.parametrize("mode", ["light", "dark"])
def test_every_colour_of_a_drawing_has_a_value_in_both_modes(html, mode):
    found = colours_of(mode)
    for drawing in drawn_in(html):
        plain = re.sub(r'<g class="shades">.*?</g>', "", drawing, flags=re.DOTALL)
        plain = re.sub(r'"data:image/[^"]*"', "", plain)
        assert re.findall(r"#[0-9a-f]{6}\b", plain) == []
        assert {*re.findall(r"var\(--([\w-]+)\)", plain)} <= {*found}
    assert {*COLOURS.values()} <= {*found}


def contrast(one, other):
    """Return the contrast of two colours #rrggbb by WCAG 2."""

    def luminance(colour):
        code = colour[1:] if len(colour) == 7 else "".join(2 * c for c in colour[1:])
        x = np.array([int(code[i : i + 2], 16) for i in (0, 2, 4)]) / 255
        return np.where(x <= 0.03928, x / 12.92, ((x + 0.055) / 1.055) ** 2.4) @ [0.2126, 0.7152, 0.0722]

    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("mode", ["light", "dark"])
def test_lines_stand_out_from_the_page_in_both_modes(mode):
    found = colours_of(mode)
    for name in ("ink", "measured", "initial", "law", "fitted", "group", "bad", "warn", "good"):
        assert contrast(found[name], found["paper"]) > 3.0, name  # WCAG 2.1, 1.4.11: graphics


def test_no_two_elements_of_a_page_share_an_id_and_every_reference_leads_somewhere(html):
    ids = [attributes["id"] for _, attributes in Page(html).tags if "id" in attributes]
    assert len(ids) == len({*ids})
    for drawing in drawn_in(html):
        led = {*re.findall(r'href="#([^"]+)"', drawing), *re.findall(r"url\(#([^)]+)\)", drawing)}
        assert led <= {*re.findall(r'id="([^"]+)"', drawing)}


def test_a_drawing_keeps_its_text_in_reading_order():
    def draw(axes):
        axes.plot([0.0, 1.0], [0.0, 1.0], color=FITTED)
        axes.set(title="a <b> & c", xlabel="$M_{H}/M_{S}$")

    (element,) = pictures({"": [Panel(draw)]})[""]
    texts = [re.sub("<[^>]+>", "", one) for one in re.findall(r"<text.*?</text>", element, re.DOTALL)]
    assert "MH/MS" in texts
    assert "a &lt;b&gt; &amp; c" in texts
    assert "<style" not in element
    assert re.match(r"<svg [^>]*viewBox", element)


def test_captions_name_no_colours(html):
    captions = " ".join(re.findall(r"<figcaption>(.*?)</figcaption>", html, re.DOTALL)).lower()
    assert not re.findall(r"\b(black|white|blue|orange|green|grey|pale)\b", captions)


# ---- equations ----


@pytest.mark.parametrize("law", LAWS)
def test_the_box_has_every_symbol_with_the_unit_of_the_one_table(law):
    box = equations(example_fit(felt=law, modal_response=response_content()), LAWS[law])
    units = {symbol: unit for symbol, _, unit in box["symbols"]}
    for name, parameter in LAWS[law].hammer_parameters.items():
        shown = units[SYMBOLS.get(name, name)]
        assert shown == ("" if parameter.unit == "1" else parameter.unit.replace("^p", "ᵖ"))
    for name, entry in (example_content()["parameters"] | example_content()["invariants"]).items():
        assert SYMBOLS.get(name, name) in units, entry
    others = (formula for formulas in (PATH | MODES).values() for formula in formulas)
    lines = [*LAWS[law].formula, *STRING, *HAMMER, *others]
    assert {symbol for formula in lines for symbol in symbols(formula)} <= {*units}
    assert units["κ"] == PARAMETERS["kappa"].unit
    assert len(units) == len(box["symbols"])
    assert all(meaning for _, meaning, _ in box["symbols"])


@pytest.mark.parametrize("law", LAWS)
def test_a_formula_of_a_felt_has_all_parameters_of_its_law(law):
    found = {symbol for formula in LAWS[law].formula for symbol in symbols(formula)}
    assert {SYMBOLS.get(name, name) for name in LAWS[law].parameters} <= found


def test_a_felt_from_outside_keeps_its_own_meanings():
    own = {"s": {"value": 1.0, "unit": "m", "meaning": "compression at which it has doubled", "status": "fitted"}}
    fit = example_fit(felt="foam", parameters=example_content()["parameters"] | own)
    for formula in ((), (r"F = u^2 (1 + \frac{u}{s})",), ("F = 1 & <b>{",)):  # none, one, and another notation
        box = equations(fit, dataclasses.replace(LAWS["power"], formula=formula))
        assert ("s", "compression at which it has doubled", "m") in box["symbols"]
    assert "1 &amp; &lt;b&gt;{" in box["lines"][2][1][0]


def test_formulas_are_set_and_escaped():
    assert formula_html(r"\frac{a_1}{2} < -b^{2 k}") == (
        '<span class="formula"><span class="frac"><span><i>a</i><sub>1</sub></span><span>2</span></span> &lt; '
        "−<i>b</i><sup>2 <i>k</i></sup></span>"
    )
    assert symbols(r"\ddot{y}_H = \op{log}_{10} v_{H0} + β_k^2") == ["y_H", "v_H0", "β_k"]


@pytest.mark.parametrize("formula", ["{a", "a}", "a_", r"\frac{a}", r"\unknown{a}"])
def test_a_broken_formula_is_refused(formula):
    with pytest.raises(ValueError, match="formula"):
        formula_html(formula)
