"""The paper's own scheme against exact solutions and central differences; its invariants and its order."""

from __future__ import annotations

import math

import finite_difference
import numpy as np
import pytest
from model_cases import GEOMETRY, HAMMER, STRING
from reference_cases import CASES, WIDE, relative, solve

from pianofit import model
from pianofit.errors import FitError, ParameterError
from pianofit.parameters import Geometry, Hammer, String


@pytest.mark.parametrize("name", ["paper", "hard hammer", "struck in motion"])
def test_appendix_against_central_differences(name):
    """Each parameter changes the signal by 1e-5, so that truncation and rounding are about 1e-8."""
    case, _ = CASES[name]
    exact, values = solve(case, derivatives=True), {**case["string"]._asdict(), **case["hammer"]._asdict()}
    for parameter, value in values.items():
        acts = np.abs(exact.derivatives[parameter].velocity).max() / np.abs(exact.signals.velocity).max()
        change, ends = min(1e-5 / acts, 1e-2 * value), []
        for at in ({**values, parameter: value + change}, {**values, parameter: value - change}):
            moved = {"string": String(*list(at.values())[:4]), "hammer": Hammer(*list(at.values())[4:])}
            ends.append(solve(case | moved).signals)
        for kind, above, below in zip(finite_difference.Signals._fields, *ends, strict=True):
            error = relative(getattr(exact.derivatives[parameter], kind), (above - below) / (2 * change))
            assert error <= 1e-5, (parameter, kind)


def test_a_string_left_alone_is_crank_nicolsons_own_oscillation():
    """Eq. 16 of one sine has an exact solution: its two roots z solve (z - 1)² + 2aα (z² - 1) + a²ω² (z + 1)² = 0."""
    k, points, step, steps = 3, 60, 1 / 30_000, 4000
    silent = HAMMER._replace(K_H=0.0)
    x = np.arange(1, points + 1) / (points + 1)
    solution = finite_difference.solve(
        STRING, silent, WIDE, step=step, steps=steps, points=points, displacement=1e-3 * np.sin(k * np.pi * x)
    )
    s = (2 * (points + 1) * math.sin(k * math.pi / (2 * (points + 1)))) ** 2
    alpha, omega2 = STRING.b1 + STRING.b2 * s, STRING.c**2 * s + STRING.kappa**2 * s**2
    a = step / 2
    pole = -alpha + 1j * math.sqrt(omega2 - alpha**2)
    z = (1 + a * pole) / (1 - a * pole)
    # y = Re(C z^n) with v_0 = Re(p C) = 0.
    motion = 1e-3 * (1 + 1j * pole.real / pole.imag) * z ** np.arange(steps) * math.sin(k * math.pi * WIDE.pickup)
    assert abs((z - 1) ** 2 + 2 * a * alpha * (z**2 - 1) + a**2 * omega2 * (z + 1) ** 2) < 1e-14
    assert relative(solution.signals.displacement, motion.real) <= 1e-10
    assert relative(solution.signals.velocity, (pole * motion).real) <= 1e-10
    under = motion.real / math.sin(k * math.pi * WIDE.pickup) * (solution.window @ np.sin(k * np.pi * x))
    assert relative(solution.signals.under_hammer, under) <= 1e-10
    assert not solution.signals.force.any()
    assert relative(solution.signals.hammer[:, 0], under[0] + silent.v_H0 * solution.time) <= 1e-10


def test_energy_is_kept_without_losses_and_falls_with_them_after_the_contact():
    for string, hammer in ((STRING, HAMMER), (STRING._replace(b1=0.0, b2=0.0), HAMMER)):
        solution = finite_difference.solve(string, hammer, WIDE, step=1 / 44_100, steps=4000, points=60)
        apart = np.flatnonzero(solution.signals.force)[-1] + 1
        energy = solution.string_energy[apart:]
        assert apart < 400
        assert energy.min() > 0
        if string.b1 > 0:
            assert np.diff(energy).max() <= 0
            assert energy[-1] < 0.95 * energy[0]
        else:
            assert np.abs(energy / energy[0] - 1).max() <= 1e-10


@pytest.mark.parametrize("mu", [0.0, 0.2])
def test_the_felt_gives_back_what_it_took_less_its_losses(mu):
    """String and felt losses receive the energy of the hammer: b applies the force and reads the compression."""
    solution = finite_difference.solve(
        STRING._replace(b1=0.0, b2=0.0), HAMMER._replace(mu=mu), WIDE, step=1 / 400_000, steps=2400, points=60
    )
    assert solution.signals.force[-1] == 0
    lost = 0.5 * HAMMER.M_H * (HAMMER.v_H0**2 - solution.signals.hammer[-1, 1] ** 2)
    drive = solution.signals.force[1:] + solution.signals.force[:-1]
    work = 0.5 * float(drive @ np.diff(solution.signals.under_hammer))
    assert work == pytest.approx(solution.string_energy[-1], rel=1e-9)
    felt = (lost - work) / lost
    assert abs(felt) < 1e-5 if mu == 0 else 1e-2 < felt < 0.5


def test_order_two_in_grid_and_step_towards_the_continuous_string():
    """Half the spacing and step give a quarter of the difference from the converged prewarped modes."""
    geometry = Geometry(
        length=1.0, mass=0.00618, strike_position=0.24, width=0.16, pickup=0.4
    )  # all on the coarsest grid
    rate, steps = 25 * 882.0, 101
    fine = model.simulate(STRING, HAMMER, geometry, rate=rate, n_modes=128, oversampling=16)
    force, velocity = np.asarray(fine.pulse.force)[::16][:steps], fine.waveform(rate * 16, 16 * steps)[::16]
    errors = []
    for factor in (1, 2, 4, 8):
        solution = finite_difference.solve(
            STRING, HAMMER, geometry, step=1 / (rate * factor), steps=steps * factor, points=25 * factor - 1
        ).signals
        errors.append([relative(solution.force[::factor], force), relative(solution.velocity[::factor], velocity)])
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.abs(orders[-1] - 2).max() < 0.1, orders
    assert errors[-1][0] < 5e-3


def test_newton_raphson_runs_only_where_the_felt_is_pressed():
    solution = solve(CASES["hard hammer"][0])
    pressed = solution.signals.compression > 0
    assert np.array_equal(solution.iterations > 0, pressed)
    assert np.all(solution.signals.force[~pressed] == 0)
    assert solution.iterations.max() < 50


def test_a_pickup_on_a_point_reads_the_point():
    row = finite_difference.pickup_row(GEOMETRY._replace(pickup=12 / 49), 48)
    assert np.abs(row - (np.arange(1, 49) == 12)).max() < 1e-13


def test_a_window_between_the_points_is_refused():
    with pytest.raises(ParameterError, match="points=5"):
        finite_difference.solve(STRING, HAMMER, WIDE, step=1e-5, steps=4, points=5)


def test_an_iteration_that_does_not_converge_is_an_error(monkeypatch):
    monkeypatch.setattr(finite_difference, "MOST_ITERATIONS", 1)
    with pytest.raises(FitError, match=r"K_H=1.09949e\+10"):
        solve(CASES["paper"][0])
