"""The felt laws in motion: against another stepping method, energy balance, and order of accuracy."""

from __future__ import annotations

import model_cases as cases
import numpy as np
import pytest
from felt_cases import (
    HAMMERS,
    LOSSLESS,
    ORDER_MODES,
    RETURNING,
    STULOV,
    memories,
    memory_of,
    motion,
    relative,
    speeds,
    stepped,
)  # fmt: skip
from model_cases import GEOMETRY, RATE, STRING

from pianofit.felt import RelaxingHammer
from pianofit.parameters import Hammer
from studies.bensa2005.body import Axis, make_body
from studies.bensa2005.contact import Felt
from studies.bensa2005.contact import strike as laboratory_strike

pytestmark = pytest.mark.usefixtures("float64")

# --- another stepping method ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", HAMMERS)
def test_every_law_is_the_modal_stepping(name):
    modes = cases.table(STRING, GEOMETRY, rate=RATE, n_modes=64)
    slow, pulse = stepped(modes, HAMMERS[name], 360), cases.strike(modes, HAMMERS[name], steps=512)
    assert slow.force.max() > 3.0
    assert slow.force[-1] == 0.0
    assert relative(pulse.force[:360], slow.force) < 1e-10
    assert relative(pulse.compression[:360], slow.u) < 1e-10
    assert relative(pulse.hammer[:360], slow.hammer) < 1e-10


def test_a_felt_that_is_touched_again_has_kept_its_memory():
    """Relaxation slower than the interruption softens the second contact; faster relaxation does not."""
    modes = cases.table(STRING, GEOMETRY, rate=RATE, n_modes=64)
    for tau in (2e-3, 2e-5):
        hammer = RelaxingHammer(*RETURNING, epsilon=0.5, tau=tau)
        slow, pulse = stepped(modes, hammer, 500), cases.strike(modes, hammer, steps=512)
        touches = np.sum(np.diff((slow.force > 0).astype(int)) == 1)
        assert touches >= 2
        assert relative(pulse.force[:500], slow.force) < 1e-9


@pytest.mark.parametrize("epsilon", [0.3, 0.9])
def test_the_laboratorys_felt_pushes_the_same(epsilon):
    """They agree until separation. Then the surface of the laboratory's felt relaxes; here only c decays."""
    n, hammer = 48, STULOV._replace(epsilon=epsilon, tau=80e-6)
    body = make_body((Axis(STRING, 1.0),), GEOMETRY, n, ())
    fine = 16 * RATE
    memory = Felt(hammer.K_H, hammer.p, eps=hammer.epsilon, tau=hammer.tau)
    stroke = laboratory_strike(body, memory, hammer.M_H, hammer.v_H0, fine)
    errors = []
    for factor in (4, 8):
        _, pulse = cases.hit(STRING, hammer, GEOMETRY, factor * RATE, n_modes=n, steps=8192)
        v_H, exact = np.asarray(pulse.hammer)[:, 1], stroke.hammer[:: 16 // factor, 1]
        last = int(np.flatnonzero(np.asarray(pulse.force) > 0)[-1])
        errors.append(relative(v_H[:last], exact[:last]))
    assert errors[1] < 2e-5
    assert errors[1] < 0.35 * errors[0]


# --- energy ----------------------------------------------------------------------------------------------------------


def stored(u, c, hammer) -> np.ndarray:
    """Storage function, J, at the compression of the felt: u in contact, the dent (εc)^(1/p) without contact."""
    p, epsilon = hammer.p, memory_of(hammer)[0]
    own = np.maximum(np.maximum(u, 0.0), (epsilon * c) ** (1 / p))
    return hammer.K_H * (
        own ** (p + 1) / (p + 1) - epsilon * c * own + epsilon * p / (p + 1) * np.maximum(c, 0.0) ** ((p + 1) / p)
    )


def string_energies(modes, drive) -> np.ndarray:
    """Energy of the string, J, after every step of the pulse, mode by mode."""
    omega2, alpha, phi, gamma = (np.asarray(x) for x in (modes.omega2, modes.alpha, modes.strike, modes.modal_gain))
    mass = np.where(gamma == 0, 0.0, phi / np.where(gamma == 0, 1.0, gamma))
    a = float(modes.step) / 2
    D = 1 + 2 * a * alpha + a**2 * omega2
    q = v = np.zeros_like(omega2)
    energies = []
    for T in np.asarray(drive):
        new = ((1 - 2 * a * alpha - a**2 * omega2) * v - 2 * a * omega2 * q + a * gamma * T) / D
        q, v = q + a * (v + new), new
        energies.append(0.5 * float(np.sum(mass * (v**2 + omega2 * q**2))))
    return np.array(energies)


def total_energy(string, hammer, rate: float, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Energy of string, hammer and felt over the initial energy [steps], and the expected dissipation of the felt."""
    modes, pulse = cases.hit(string, hammer, GEOMETRY, rate, steps=steps)
    u, step = np.asarray(pulse.compression), float(modes.step)
    c, w = memories(u, hammer, step), speeds(u, hammer, step)
    total = string_energies(modes, pulse.drive) + 0.5 * hammer.M_H * np.asarray(pulse.hammer)[:, 1] ** 2
    total = total + stored(u, c, hammer)
    p, (epsilon, tau) = hammer.p, memory_of(hammer)
    a = np.maximum(u, 0.0) ** p
    own = np.maximum(np.maximum(u, 0.0), (epsilon * c) ** (1 / p))
    burnt = hammer.K_H * epsilon * (own - c ** (1 / p)) * (a - c) / tau
    burnt += np.where(np.asarray(pulse.force) > 0, hammer.K_H * hammer.mu * a * w**2, 0.0)
    lost = np.concatenate([[0.0], np.cumsum(0.5 * step * (burnt[1:] + burnt[:-1]))])
    return total / total[0], lost / total[0]


@pytest.mark.parametrize("name", HAMMERS)
def test_energy_balances_to_second_order_and_hardly_ever_rises(name):
    hammer, errors, rises = HAMMERS[name], [], []
    for factor in (1, 2, 4, 8):
        total, lost = total_energy(LOSSLESS, hammer, factor * RATE, 512 * factor)
        errors.append(np.abs(total - 1 + lost).max())
        rises.append((total - np.minimum.accumulate(total)).max())
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert errors[0] < 1e-4
    assert np.abs(orders - 2).max() < 0.1
    assert np.all(np.array(rises) <= 1e-5 / 4 ** np.arange(4))
    assert (lost[-1] > 1e-3) == (name != "power")


@pytest.mark.parametrize("mass", [1e-3, 2e-2])
@pytest.mark.parametrize("tau", [5e-6, 1e-4, 5e-3])
def test_energy_balances_where_the_felt_is_left_and_touched_again(mass, tau):
    """The dent of a felt without contact also stores energy."""
    hammer, errors, rises = RelaxingHammer(*RETURNING._replace(M_H=mass), epsilon=0.8, tau=tau), [], []
    for factor in (4, 8, 16):
        total, lost = total_energy(LOSSLESS, hammer, factor * RATE, 512 * factor)
        errors.append(np.abs(total - 1 + lost).max())
        rises.append((total - np.minimum.accumulate(total)).max())
    assert errors[0] < 3e-3
    assert np.abs(np.log2(np.divide(errors[:-1], errors[1:])) - 2).max() < 0.1
    assert np.all(np.array(rises) < errors)


# --- order of accuracy -----------------------------------------------------------------------------------------------

TOUCHING = 50  # samples
LIGHT = Hammer(K_H=1.1e10, mu=0.1, p=2.5, M_H=1e-3, v_H0=2.0)
ORDER_HAMMERS = {
    "power": LIGHT._replace(mu=0.0),
    "hunt-crossley": LIGHT,
    "stulov": RelaxingHammer(*LIGHT._replace(mu=0.0), epsilon=0.4, tau=60e-6),
    "stulov, slow": RelaxingHammer(*LIGHT._replace(mu=0.0), epsilon=0.6, tau=1e-3),
    "both losses": RelaxingHammer(*LIGHT, epsilon=0.4, tau=30e-6),
}


@pytest.mark.parametrize("name", ORDER_HAMMERS)
def test_the_force_is_of_second_order(name):
    hammer = ORDER_HAMMERS[name]
    exact = motion(hammer, np.arange(TOUCHING) / RATE)
    assert exact[1:].min() > 0
    pulses = []
    for factor in (1, 2, 4, 8, 16):
        _, pulse = cases.hit(STRING, hammer, GEOMETRY, RATE * factor, n_modes=ORDER_MODES, steps=1024)
        pulses.append(np.asarray(pulse.force)[::factor][:TOUCHING])
    errors = np.array([relative(pulse, exact) for pulse in pulses])
    assert np.abs(np.log2(errors[:-1] / errors[1:]) - 2).max() < 0.1, np.log2(errors[:-1] / errors[1:])
    assert relative((4 * pulses[-1] - pulses[-2]) / 3, exact) < 1e-6
