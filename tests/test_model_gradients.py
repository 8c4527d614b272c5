"""Derivatives of everything with respect to all nine parameters, and the place and width of the strike.

Forward mode, reverse mode and central differences must agree. Columns are derivatives by the logarithm of a parameter,
in the unit of the output. The differences use a step of 5e-6 in the logarithm. Their truncation is h²/6 times the third
derivative: at σ = 300 1/s and 9 kHz the spectrum's is (ω/σ)² = 4e4 times the first, which makes 2e-7. Rounding
of hundreds of Newton solves is 1e-12 of the value. Divided by the step it is 2e-7 of the value. Both are below 1e-5.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model_cases import GEOMETRY, HAMMER, RATE, STRING

from pianofit import model
from pianofit.parameters import FIT_NAMES, Hammer, String

pytestmark = pytest.mark.usefixtures("float64")

STEPS, MODES, SIGMA = 512, 64, 300.0
STEP, ROUNDING = 5e-6, 1e-12
NAMES = (*FIT_NAMES, "strike", "width")
PLACE = (GEOMETRY.strike_position, GEOMETRY.width)
FREQUENCY = jnp.asarray(np.concatenate([np.linspace(100, 1000, 13), np.linspace(1500, 9000, 11)]))
KINDS = {"prewarped": ("velocity", "continuous"), "grid": ("bridge-force", "finite_difference")}


def _outputs(values, quantity: str, kind: str) -> dict:
    geometry = GEOMETRY._replace(strike_position=values[9], width=values[10])
    modes = model.mode_table(String(*values[:4]), geometry, rate=RATE, n_modes=MODES, quantity=quantity, kind=kind)
    pulse = model.strike(modes, Hammer(*values[4:9]), steps=STEPS)
    Y = model.spectrum(modes, pulse.drive, FREQUENCY, SIGMA)
    A = model.modal_amplitudes(modes, pulse.drive)[:20]
    return {
        "force": pulse.force,
        "compression": pulse.compression[:250],
        "hammer velocity": pulse.hammer[:, 1],
        "work": pulse.work[None],
        "spectrum": jnp.concatenate([Y.real, Y.imag]),
        "ringing": jnp.concatenate([A.real, A.imag]),
        "levels": model.level_db(A[:6], -modes.pole.real[:6]),
        "frequencies": modes.pole.imag[:20],
        "decays": modes.pole.real[:20],
    }


CASES = {
    "paper": np.array([*STRING, *HAMMER, *PLACE]),
    "bass": np.array([155.0, 0.6, 0.25, 1e-5, 4e8, 0.05, 2.3, 4.9e-3, 2.0, *PLACE]),
    "hard, touching again": np.array([*STRING, 1e13, 0.1, 2.5, 1e-3, 2.0, *PLACE]),
    "steep, modes above the limit": np.array([700.0, 5.0, 5.0, 2e-3, 1e14, 0.05, 4.0, 2.5e-3, 6.0, *PLACE]),
}


class _Compiled:
    """One table's outputs and their Jacobian, compiled once for the whole module."""

    def __init__(self, quantity: str, kind: str):
        self.outputs = lambda values: _outputs(values, quantity, kind)
        self.values = jax.jit(self.outputs)
        self._along = jax.jit(lambda at, tangent: jax.jvp(self.outputs, (at,), (tangent,))[1])

    def forward(self, at: np.ndarray) -> dict:
        columns = [self._along(at, tangent) for tangent in np.eye(at.size)]
        return {name: np.stack([column[name] for column in columns], axis=-1) for name in columns[0]}


_compile = functools.cache(_Compiled)


@pytest.fixture(params=KINDS)
def compiled(request):
    return _compile(*KINDS[request.param])


@pytest.fixture
def prewarped():
    return _compile(*KINDS["prewarped"])


def _differences(function, at) -> dict:
    columns = [
        jax.tree.map(lambda a, b: (a - b) / (2 * STEP), function(at * np.exp(e)), function(at * np.exp(-e)))
        for e in STEP * np.eye(at.size)
    ]
    return {name: np.stack([column[name] for column in columns], axis=-1) for name in columns[0]}


@pytest.mark.parametrize("case", CASES)
def test_forward_mode_against_central_differences(compiled, case):
    at = CASES[case]
    values, exact, differences = compiled.values(at), compiled.forward(at), _differences(compiled.values, at)
    for name, value in values.items():
        a, b = np.asarray(exact[name]) * at, differences[name]
        assert np.all(np.isfinite(a)), name
        allowed = 1e-5 * np.abs(b).max(axis=0) + ROUNDING / STEP * float(jnp.abs(value).max())
        # The window on the grid ends at points, so its position and width have no derivatives.
        assert np.all(np.abs(a - b)[:, :9] <= allowed[:9]), _worst(name, a, b, allowed)


def _worst(name, a, b, allowed) -> str:
    share = (np.abs(a - b).max(axis=0) / allowed).round(3).tolist()
    return f"{name}: error over tolerance {dict(zip(NAMES, share, strict=True))}"


def test_place_and_width_of_the_strike(prewarped):
    at = CASES["paper"]
    values, exact, differences = prewarped.values(at), prewarped.forward(at), _differences(prewarped.values, at)
    for name in ("force", "compression", "ringing", "spectrum"):
        a, b = np.asarray(exact[name]) * at, differences[name]
        allowed = 1e-5 * np.abs(b).max(axis=0) + ROUNDING / STEP * float(jnp.abs(values[name]).max())
        assert np.abs(b[:, 9:]).max() > 1e-3 * float(jnp.abs(values[name]).max())
        assert np.all(np.abs(a - b)[:, 9:] <= allowed[9:]), _worst(name, a, b, allowed)


def test_reverse_mode_equals_forward_mode(prewarped):
    compiled, random = prewarped, np.random.default_rng(0)
    values = compiled.values(CASES["paper"])
    weights = {name: random.normal(size=v.shape) / float(jnp.abs(v).max()) for name, v in values.items()}
    gradient = jax.jit(
        jax.grad(lambda at: sum((weights[name] * value).sum() for name, value in compiled.outputs(at).items()))
    )
    for at in CASES.values():
        rows = compiled.forward(at)
        expected = sum(weights[name] @ np.asarray(rows[name]) for name in weights) * at
        found = np.asarray(gradient(at)) * at
        assert np.abs(found - expected).max() <= 1e-9 * np.abs(expected).max()


def test_levels_of_modes_without_weight_have_finite_gradients():
    """The energy of mode 3 is 0, and its level constant: its derivatives are 0 in both modes of differentiation."""
    amplitude = jnp.array([1.0, 0.1, 0.0])

    def levels(gain):
        return model.level_db(gain * amplitude + 0j, jnp.full(3, 2.0))

    forward, reverse = jax.jacfwd(levels)(2.0), jax.jit(jax.jacrev(levels))(2.0)
    np.testing.assert_allclose(forward, [10 / np.log(10), 10 / np.log(10), 0.0], rtol=1e-12)
    np.testing.assert_allclose(reverse, forward, rtol=1e-12)
    assert np.isnan(model.level_db(np.array([np.nan + 0j]), np.array([2.0]), np)).all()  # is not silence


def test_second_derivatives_against_differences_of_the_gradient():
    def energy(logarithms):
        values = jnp.exp(logarithms)
        modes = model.mode_table(String(*values[:4]), GEOMETRY, rate=RATE, n_modes=24)
        drive = model.strike(modes, Hammer(*values[4:]), steps=STEPS).drive
        return jnp.log((jnp.abs(model.spectrum(modes, drive, FREQUENCY, SIGMA)) ** 2).sum())

    def slope(at, along):
        return jax.jvp(energy, (at,), (along,))[1]

    def curvature(at, along, across):
        return jax.jvp(lambda x: slope(x, along), (at,), (across,))[1]

    slope, curvature = jax.jit(slope), jax.jit(curvature)
    start, random = np.log(CASES["paper"][:9]), np.random.default_rng(2)
    pairs = [random.normal(size=(2, 9)), *(np.eye(9)[[i, (i + 4) % 9]] for i in range(9))]
    exact = np.array([curvature(start, *pair) for pair in pairs])
    differences = [
        (slope(start + STEP * across, along) - slope(start - STEP * across, along)) / (2 * STEP)
        for along, across in pairs
    ]
    np.testing.assert_allclose([curvature(start, *pair[::-1]) for pair in pairs], exact, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(differences, exact, rtol=1e-5, atol=ROUNDING / STEP * 0.1)
    assert np.abs(exact).max() > 0.1


def test_many_at_once_equal_one_by_one(prewarped):
    random = np.random.default_rng(1)
    points = CASES["paper"] * np.exp(0.2 * random.normal(size=(6, 11)))
    points[:, 9:] = PLACE
    batch = jax.jit(jax.vmap(prewarped.outputs))(points)
    for i, at in enumerate(points):
        for name, value in prewarped.values(at).items():
            np.testing.assert_allclose(batch[name][i], value, rtol=1e-8, atol=1e-9 * float(jnp.abs(value).max()))


@pytest.mark.parametrize("felt", [{"mu": 0.0}, {"mu": 0.0, "p": 1.0, "K_H": 1e5}, {"v_H0": 1e-2}])
def test_derivatives_stay_finite_without_losses(prewarped, felt):
    """No logarithm, root or power in the model may turn a tangent at zero into NaN."""
    at = np.array([*STRING._replace(b1=0.0, b2=0.0), *HAMMER._replace(**felt), *PLACE])
    for name, rows in prewarped.forward(at).items():
        assert np.all(np.isfinite(rows)), name
