"""The caller's JAX settings stay unchanged, in float32 programs around ours and with ours inside them."""

from __future__ import annotations

import os
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

# `tests/test_counts.py` tests the same around a fit.
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
    """Level of the first partial, dB, as a user would write it."""
    hammer = Hammer(*HAMMER)._replace(v_H0=velocity)
    modes = model.mode_table(STRING, GEOMETRY, rate=RATE, n_modes=MODES)
    pulse = model.strike(modes, hammer, steps=STEPS)
    return model.level_db(model.modal_amplitudes(modes, pulse.drive), -modes.pole.real)[0]


def batch_loss(velocity):
    """A loss over a batch, through `jit` and `vmap`."""
    return (jax.jit(jax.vmap(level))(velocity * jnp.linspace(0.5, 2.0, 4)) ** 2).sum()


TRANSFORMED = {
    "jit": jax.jit(level),
    "vmap": lambda v: jax.vmap(level)(jnp.stack([v, v])),
    "vmap of jit": lambda v: jax.vmap(jax.jit(level))(jnp.stack([v, v])),
    "jit of jacfwd": jax.jit(jax.jacfwd(level)),
    "grad of a batch": jax.jit(jax.grad(batch_loss)),
}


@pytest.mark.parametrize("name", TRANSFORMED)
def test_in_the_scope_a_float32_is_struck_in_float64(name):
    """The caller's number and derivatives by it stay float32; all computation between is float64."""
    with jax.enable_x64(True):
        expected = np.asarray(TRANSFORMED[name](0.5))
        found = TRANSFORMED[name](jnp.float32(0.5))
    assert expected.dtype == np.float64
    tolerance = 1e-12 if found.dtype == np.float64 else 1e-6
    np.testing.assert_allclose(found, expected, rtol=tolerance)


@pytest.mark.parametrize("name", TRANSFORMED)
def test_a_trace_in_float32_is_refused_with_what_to_write(name):
    with pytest.raises(
        ParameterError, match=r"(strike|mode_table|derivative) is traced .* `with jax.enable_x64\(True\):`"
    ):
        TRANSFORMED[name](jnp.float32(0.5))


@pytest.mark.parametrize("kind", [float, np.float32, jnp.float32])
def test_untraced_numbers_of_any_kind_are_struck_in_float64(kind):
    found = level(kind(0.5))
    with jax.enable_x64(True):
        expected = float(level(0.5))
    assert isinstance(found, np.float64)  # of NumPy: the caller's next operation would convert a JAX array to float32
    assert float(found) == pytest.approx(expected, rel=1e-13)


OPENED_INSIDE = {
    "grad": jax.grad,
    "jit of grad": lambda f: jax.jit(jax.grad(f)),
    "grad of jit": lambda f: jax.grad(jax.jit(f)),
    "value_and_grad": jax.value_and_grad,
}


def opened_inside(velocity):
    with jax.enable_x64(True):
        return level(velocity)


@pytest.mark.parametrize("name", OPENED_INSIDE)
@pytest.mark.parametrize("kind", [float, jnp.float32])
def test_a_gradient_around_the_scope_is_refused_with_what_to_write(name, kind):
    """JAX runs reverse mode after the function has closed its scope."""
    with pytest.raises(ParameterError, match=r"inside `with jax.enable_x64\(True\):`"):
        OPENED_INSIDE[name](opened_inside)(kind(0.5))


def test_a_gradient_in_the_scope_passes_its_own_inner_scopes():
    with jax.enable_x64(True):
        found, expected = jax.grad(opened_inside)(0.5), jax.grad(level)(0.5)
    assert float(found) == pytest.approx(float(expected), rel=1e-12)


# The gradient of the README, a sound and random numbers of the sampler, under other settings of the caller.
UNDER_SETTINGS = """
import sys, jax
import numpy as np
import pianofit as pf
from pianofit.x64 import x64_scope
settings = dict(jax_numpy_rank_promotion="raise", jax_numpy_dtype_promotion="strict", jax_debug_nans=True,
    jax_debug_infs=True, jax_enable_custom_prng=True, jax_legacy_prng_key="error", jax_default_prng_impl="rbg",
    jax_threefry_partitionable=False)
guard = "disallow" if sys.argv[1] == "strict" else "allow"
if sys.argv[1] == "strict":
    for name, value in settings.items():
        jax.config.update(name, value)
before = dict(jax.config.values)
p = pf.preset("chabassier-F3")
def levels(hammer):
    modes = pf.mode_table(p.string, p.geometry, rate=88_200.0, n_modes=64, quantity="bridge-force")
    return pf.levels(modes, pf.strike(modes, hammer, steps=1024).drive)[:8]
with jax.enable_x64(True):
    hammer = jax.tree.map(float, p.hammer)
    first = jax.jit(jax.grad(lambda h: levels(h)[0]))
    found = [*jax.jit(jax.jacfwd(levels))(hammer), *first(hammer)]
with jax.transfer_guard(guard), jax.disable_jit(guard == "disallow"):
    found.append(pf.Note(p.string, p.hammer, p.geometry, "bridge-force", 0.1).render(seconds=0.1))
    with x64_scope():
        found.append(np.asarray(jax.random.normal(jax.random.PRNGKey(3), 4)))
assert dict(jax.config.values) == before
print(*(np.asarray(x, float).tobytes().hex() for x in found))
"""


def test_a_callers_settings_change_nothing_and_are_not_changed(monkeypatch, capsys):
    """Plain settings in this process, strict ones in another."""
    monkeypatch.setattr(sys, "argv", ["", "plain"])
    exec(UNDER_SETTINGS, {})  # noqa: S102
    strict = subprocess.run([sys.executable, "-c", UNDER_SETTINGS, "strict"], capture_output=True, text=True)
    assert strict.returncode == 0, strict.stderr
    assert capsys.readouterr().out == strict.stdout


FORKED = """
import os, pianofit
it = pianofit.preset("bensa-final")
def go():
    pianofit.simulate(it.string, it.hammer, it.geometry)
go()
child = os.fork()
if not child:
    refused = 0
    for call in (go, lambda: pianofit.fit("none.wav")):
        try:
            call()
        except pianofit.FitError as error:
            refused += "spawn" in str(error)
    os._exit(refused)
assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 2
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
def test_a_forked_process_is_refused_and_does_not_hang():
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", FORKED], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr


def test_a_missing_device_is_one_line():
    environment = os.environ | {"JAX_PLATFORMS": "cuda", "CUDA_VISIBLE_DEVICES": ""}
    code = (
        "import pianofit\nit = pianofit.preset('bensa-final')\n"
        "try:\n    pianofit.simulate(it.string, it.hammer, it.geometry)\n"
        "except pianofit.FitError as error: print(error)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert "JAX_PLATFORMS=cuda" in done.stdout, done.stderr
    assert done.stdout.count("\n") == 1
