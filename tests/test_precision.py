"""The caller's JAX stays as it is: float32 programs around ours, and ours inside theirs."""

from __future__ import annotations

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from float32_caller import environment
from model_cases import GEOMETRY, HAMMER, STRING

from pianofit import model
from pianofit.errors import ParameterError
from pianofit.parameters import Hammer

STEPS, MODES, RATE = 512, 32, 88_200.0

# The whole of it around a fit: `tests/test_counts.py`.
BEFORE_AND_AFTER = """
from float32_caller import state
before = state()
import pianofit
names = [getattr(pianofit, name) for name in pianofit.__all__]
it = pianofit.preset("bensa-final")
struck = pianofit.simulate(it.string, it.hammer, it.geometry)
sound = struck.waveform(44_100, 44_100)
assert sound.dtype == "float64" and struck.pulse.force.dtype == "float64"
assert struck.contact_time > 1e-3
after = state()
assert before == after, {k: (v, after[0][k]) for k, v in before[0].items() if after[0][k] != v}
"""


def test_a_float32_program_is_the_same_before_and_after():
    done = subprocess.run([sys.executable, "-c", BEFORE_AND_AFTER], capture_output=True, text=True, env=environment())
    assert done.returncode == 0, done.stderr


def level(velocity):
    """Of the first partial, dB, as a caller would write it."""
    hammer = Hammer(*HAMMER)._replace(v_H0=velocity)
    modes = model.mode_table(STRING, GEOMETRY, rate=RATE, n_modes=MODES)
    pulse = model.strike(modes, hammer, steps=STEPS)
    return model.level_db(model.ringing(modes, pulse.drive), -modes.pole.real)[0]


def many(velocity):
    """A loss over a batch, through `jit` and `vmap`."""
    return (jax.jit(jax.vmap(level))(velocity * jnp.linspace(0.5, 2.0, 4)) ** 2).sum()


TRANSFORMED = {
    "jit": jax.jit(level),
    "vmap": lambda v: jax.vmap(level)(jnp.stack([v, v])),
    "vmap of jit": lambda v: jax.vmap(jax.jit(level))(jnp.stack([v, v])),
    "jit of jacfwd": jax.jit(jax.jacfwd(level)),
    "grad of a batch": jax.jit(jax.grad(many)),
}


@pytest.mark.parametrize("name", TRANSFORMED)
def test_in_the_scope_a_float32_is_struck_in_float64(name):
    """The caller's number is a float32 and stays one, as are derivatives by it; between, everything is float64."""
    with jax.enable_x64(True):
        expected = np.asarray(TRANSFORMED[name](0.5))
        found = TRANSFORMED[name](jnp.float32(0.5))
    assert expected.dtype == np.float64
    tolerance = 1e-12 if found.dtype == np.float64 else 1e-6
    np.testing.assert_allclose(found, expected, rtol=tolerance)


@pytest.mark.parametrize("name", TRANSFORMED)
def test_a_trace_in_float32_is_refused_with_what_to_write(name):
    with pytest.raises(ParameterError, match=r"(strike|mode_table) is traced .* inside `with jax.enable_x64\(True\):`"):
        TRANSFORMED[name](jnp.float32(0.5))


@pytest.mark.parametrize("kind", [float, np.float32, jnp.float32])
def test_untraced_numbers_of_any_kind_are_struck_in_float64(kind):
    found = level(kind(0.5))
    with jax.enable_x64(True):
        expected = float(level(0.5))
    assert isinstance(found, np.float64)  # of NumPy: JAX's own would be narrowed by the caller's next operation
    assert float(found) == pytest.approx(expected, rel=1e-13)
