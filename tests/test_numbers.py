"""Numbers as text: intervals never round to zero width, and determine the number of digits."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pianofit.io.number_format import (
    columns,
    counted,
    format_with_interval,
    number,
    with_half_interval,
    with_interval,
    with_standard_error,
)

RAISED = str.maketrans("−⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "--0123456789", "\u00a0")


@given(st.floats(0.1, 0.99999), st.integers(-12, 12), st.floats(-11.0, -0.5), st.booleans())
def test_the_ends_of_an_interval_differ_from_the_value_and_keep_it_between_them(mantissa, power, width, negative):
    value = mantissa * 10.0**power * (-1 if negative else 1)
    half = abs(value) * 10**width
    low, high = value - half, value + half
    text, span = format_with_interval(value, (low, high))
    ends = [float(end) for end in span.strip("[]").split(", ")]
    assert ends[0] < float(text) < ends[1]
    # Two digits of the half-width: the rounding error is at most a twentieth of it.
    assert abs(float(text) - value) <= 0.051 * half
    assert ends == pytest.approx([low, high], abs=0.051 * half)
    page, between = with_interval(value, [low, high])
    plain = float(page.translate(RAISED).replace("×10", "e"))
    found, exponent = re.fullmatch(r"\(?(.+?)\)?((?:×10.*)?)", between.translate(RAISED)).groups()
    first, last = (float(end.strip() + exponent.replace("×10", "e")) for end in found.split("to"))
    assert first < plain < last


@pytest.mark.parametrize(
    ("value", "half", "text"),
    [
        (7.0213, 0.0061, "7.021 N (± 0.61 %)"),
        (7.0213, 0.05, "7.02 N (± 5 %)"),
        (14.6432, 1.2, "14.6 N (× or ÷ 3.3)"),
        (14.6432, 300.0, "14.6 N (× or ÷ many powers of ten)"),
    ],
)
def test_half_an_interval_is_per_cent_while_small_then_a_factor(value, half, text):
    assert with_half_interval(value, half, "N") == text


@pytest.mark.parametrize(
    ("value", "interval", "texts"),
    [
        (304.1, [304.0998, 304.1002], ("304.10000", "[304.09980, 304.10020]")),
        (152.05, [152.0504, 152.0506], ("152.05000", "[152.05040, 152.05060]")),
        (1.0874e10, [9.1643e9, 1.2903e10], ("1.09e+10", "[0.92e+10, 1.29e+10]")),
        (0.081474, [0.013476, 0.49259], ("0.0815", "[0.0135, 0.4926]")),
        (2e9, [1e3, 5e16], ("2e+09", "[1e+03, 5e+16]")),
        (0.12, [0.12, 0.12], ("0.12", "[0.12, 0.12]")),
        (0.12, None, ("0.12", "-")),
    ],
)
def test_intervals_for_a_terminal(value, interval, texts):
    assert format_with_interval(value, interval) == texts


@pytest.mark.parametrize(
    ("value", "error", "texts"),
    [(92.2502, 0.00661, ("92.2502", "0.0066")), (-45.31, 1.12, ("-45.3", "1.1")), (3.0, 0.0, ("3", "-")),
     (812.4, 23.0, ("812", "23"))],
)  # fmt: skip
def test_standard_errors_for_a_terminal(value, error, texts):
    assert with_standard_error(value, error) == texts


@pytest.mark.parametrize(
    ("interval", "text"),
    [((917819.0, 9.07e9), "9.18 × 10⁵ to 9.07 × 10⁹"), ((0.2, 4e9), "2 × 10⁻¹ to 4 × 10⁹"),
     ((2.0, 2500.0), "2 to 2500")],
)  # fmt: skip
def test_both_ends_of_a_wide_interval_have_a_power_of_ten_or_neither(interval, text):
    assert with_interval(interval[0] * 30, interval)[1].replace("\u00a0", " ") == text


def test_columns_are_as_wide_as_what_they_hold():
    assert columns([("", "value", "status"), ("kappa", "209.79888838", "fitted"), ("p", "3", "")], right=1) == [
        "              value  status", "kappa  209.79888838  fitted", "p                 3",
    ]  # fmt: skip


def test_numbers_of_numpy_are_numbers_and_truth_values_are_not():
    assert [number(value) for value in (np.float32(0.5), np.int64(3), True, np.True_)] == ["0.5", "3", "–", "–"]


def test_one_of_a_kind_is_counted_in_the_singular():
    assert [counted(n, "key") for n in (0, 1, 2)] == ["0 keys", "1 key", "2 keys"]
