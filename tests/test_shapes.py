"""Shapes in signatures are checked at every call in the tests: the hook of `conftest.py` is active."""

from __future__ import annotations

import ast
import importlib
from pathlib import Path

import numpy as np
import pytest
from conftest import CHECKED
from jaxtyping import TypeCheckError

import pianofit as pf
from pianofit import model
from pianofit.model.differentiable_sums import sum_damped_exponentials, z_transform

SOURCE = Path(pf.__file__).parent
ROWS = np.full(3, -0.1 + 1j)


def test_every_module_that_writes_shapes_is_checked():
    writes = {
        ".".join(("pianofit", *file.relative_to(SOURCE).with_suffix("").parts))
        for file in SOURCE.rglob("*.py")
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom) and node.module == "jaxtyping"
    }
    assert writes
    assert all(any(f"{name}.".startswith(f"{checked}.") for checked in CHECKED) for name in writes)
    assert all(importlib.import_module(name) for name in CHECKED)


def test_rows_that_differ_are_refused():
    assert sum_damped_exponentials(ROWS, ROWS, 64).shape == (64,)
    with pytest.raises(TypeCheckError, match="log_z"):
        sum_damped_exponentials(ROWS, np.full(4, -0.1 + 1j), 64)


def test_a_table_in_place_of_a_row_is_refused():
    with pytest.raises(TypeCheckError, match="signal"):
        z_transform(np.ones((64, 1)), ROWS)


def test_a_real_array_in_place_of_a_complex_one_is_refused():
    it = pf.preset("bensa-final")
    modes = pf.mode_table(it.string, it.geometry, rate=88_200.0, n_modes=8)
    with pytest.raises(TypeCheckError, match="zeta"):
        model.mobility(modes, np.ones(3))


def test_a_whole_number_is_a_number():
    it = pf.preset("bensa-final")
    assert pf.mode_table(it.string, it.geometry, rate=88_200, n_modes=8).pole.shape == (8,)
