"""Levels in batches against the simulation of a note, and their derivatives against differences."""

from __future__ import annotations

import numpy as np
import pytest
from model_cases import GEOMETRY as TENTHS
from model_cases import HAMMER, STRING

from pianofit.felt import LAWS, FeltLaw, RelaxingHammer
from pianofit.inference.batched_model import (
    level_jacobians,
    level_jacobians_per_string,
    levels,
    levels_per_string,
    run_in_batches,
)
from pianofit.inference.parametrisation import LOG_ABSENT_LOSS, STRING_SIZE
from pianofit.inference.problem import ModelInputs, StaticConfig
from pianofit.model import simulate
from pianofit.model.free_response import level_db, modal_amplitudes
from pianofit.model.note import arrival
from pianofit.parameters import Geometry, Hammer

RATE, N_MODES, STEPS, ROWS, SIZE = 88_200.0, 64, 512, 24, 4
LOG_U = np.log(3e-4)
GEOMETRY = TENTHS._replace(pickup=0.309)  # not at a node, where levels are rounding errors
LAW = LAWS["hunt-crossley"]
ENTRIES = (*LAW.columns, "v_H0")
# The last two differ from the first in every value.
HAMMERS = (
    (HAMMER, GEOMETRY),
    (Hammer(K_H=4e9, mu=0.4, p=2.3, M_H=8e-3, v_H0=2.5), GEOMETRY._replace(strike_position=0.1315, width=0.03)),
    (Hammer(K_H=2e11, mu=0.05, p=3.0, M_H=3e-3, v_H0=0.4), GEOMETRY._replace(strike_position=0.103, width=0.012)),
)
STULOV = RelaxingHammer(*HAMMER._replace(mu=0.0), epsilon=0.4, tau=6e-5)


def entries_of(hammer: Hammer | RelaxingHammer, geometry: Geometry) -> np.ndarray:
    """Batch entries of a hammer and its strike position; K_H as the force at the reference compression."""
    values = (
        dict.fromkeys(ENTRIES, np.exp(LOG_ABSENT_LOSS))
        | hammer._asdict()
        | {"x0": geometry.strike_position, "width": geometry.width}
    )
    values |= {"K_H": hammer.K_H * np.exp(hammer.p * LOG_U)}
    return np.log([max(float(values[name]), np.exp(LOG_ABSENT_LOSS)) for name in ENTRIES])


BATCH = np.stack([entries_of(*case) for case in HAMMERS])
TENSE = np.log(STRING) + np.array([[0.0, 0.0, 0.0, 0.0], [0.02, 0.1, -0.2, 0.3], [-0.01, -0.1, 0.5, -0.4]])
CENTS = np.array([0.0, 3.0, -2.0])


def inputs(free: tuple[int, ...] = ()) -> ModelInputs:
    size = Geometry(*map(np.float64, GEOMETRY))
    return ModelInputs(size, np.float64(RATE), np.float64(np.exp(LOG_U)), np.int64(STEPS), np.array(free, int))


def cfg(quantity: str = "velocity", law: FeltLaw = LAW) -> StaticConfig:
    return StaticConfig(N_MODES, ROWS, quantity, law)


def played(string, hammer, geometry: Geometry, quantity: str) -> np.ndarray:
    """Levels of the partials by `simulate`, from the arrival of the wave at the pickup, dB [ROWS]."""
    sound = simulate(string, hammer, geometry, rate=RATE, oversampling=1, quantity=quantity, n_modes=N_MODES)
    pole = np.asarray(sound.modes.pole)
    amplitude = np.asarray(modal_amplitudes(sound.modes, sound.pulse.drive)) * np.exp(
        pole.real * arrival(string, geometry, quantity)
    )
    return np.asarray(level_db(amplitude, -pole.real, np))[:ROWS]


@pytest.mark.parametrize("quantity", ["velocity", "pressure"])
def test_levels_are_those_of_what_is_played(quantity):
    found, ended = run_in_batches(levels, (np.log(STRING), BATCH), inputs(), cfg(quantity), SIZE)
    assert ended.all()
    for level, (hammer, geometry) in zip(found, HAMMERS, strict=True):
        np.testing.assert_allclose(level, played(STRING, hammer, geometry, quantity), atol=1e-6)


def test_a_felt_with_memory_sounds_as_it_is_played():
    batch = entries_of(STULOV, GEOMETRY)[None]
    found, ended = run_in_batches(levels, (np.log(STRING), batch), inputs(), cfg(law=LAWS["stulov"]), SIZE)
    assert ended.all()
    np.testing.assert_allclose(found[0], played(STRING, STULOV, GEOMETRY, "velocity"), atol=1e-6)


def test_every_lane_may_have_a_string_of_its_own():
    found, _ = run_in_batches(levels_per_string, (TENSE, CENTS, BATCH), inputs(), cfg(), SIZE)
    for level, string, cents, (hammer, geometry) in zip(found, np.exp(TENSE), CENTS, HAMMERS, strict=True):
        one = type(STRING)(string[0] * 2 ** (cents / 1200), *string[1:])  # another tension
        np.testing.assert_allclose(level, played(one, hammer, geometry, "velocity"), atol=1e-6)


FREE = (*range(6), len(LAW.columns))  # force to width, and the velocity


def differences(of, at: np.ndarray, entries: tuple[int, ...]) -> np.ndarray:
    """Derivatives of the levels `of` a batch, by central differences of order 4 [batch, ROWS, entries]."""
    step, columns = 1e-4, []
    for i in entries:
        e = step * np.eye(at.shape[1])[i]
        near, far = of(at + e) - of(at - e), of(at + 2 * e) - of(at - 2 * e)
        columns.append((8 * near - far) / (12 * step))
    return np.stack(columns, axis=2)


def test_slopes_are_those_of_the_levels():
    level, slope, ended = run_in_batches(level_jacobians, (np.log(STRING), BATCH), inputs(FREE), cfg(), SIZE)

    def of(batch: np.ndarray) -> np.ndarray:
        return run_in_batches(levels, (np.log(STRING), batch), inputs(), cfg(), SIZE)[0]

    assert ended.all()
    np.testing.assert_allclose(level, of(BATCH), atol=1e-9)
    # The end of a contact moves by whole steps, and the last force is not smooth there: 1e-4 dB in 1e-4.
    np.testing.assert_allclose(slope, differences(of, BATCH, FREE), rtol=2e-4, atol=2e-3)


def test_slopes_by_the_string_too():
    args = TENSE, CENTS, BATCH
    level, slope, _ = run_in_batches(level_jacobians_per_string, args, inputs(FREE), cfg(), SIZE)

    def of(strings: np.ndarray) -> np.ndarray:
        return run_in_batches(levels_per_string, (strings, CENTS, BATCH), inputs(), cfg(), SIZE)[0]

    np.testing.assert_allclose(level, of(TENSE), atol=1e-9)
    expected = differences(of, TENSE, tuple(range(STRING_SIZE)))
    np.testing.assert_allclose(slope[..., :STRING_SIZE], expected, rtol=2e-4, atol=2e-3)
    _, alone, _ = run_in_batches(level_jacobians, (TENSE[0], BATCH), inputs(FREE), cfg(), SIZE)
    np.testing.assert_allclose(slope[0, :, STRING_SIZE:], alone[0], rtol=1e-8, atol=1e-8)


def test_any_number_of_lanes_gives_the_same_rows():
    many = np.concatenate([BATCH, BATCH[::-1], BATCH])
    whole, _ = run_in_batches(levels, (np.log(STRING), many), inputs(), cfg(), SIZE)
    assert whole.shape == (9, ROWS)
    for count in (1, 4, 5, 8):
        some, ended = run_in_batches(levels, (np.log(STRING), many[:count]), inputs(), cfg(), SIZE)
        assert ended.shape == (count,)
        np.testing.assert_allclose(some, whole[:count], atol=1e-9)


def test_a_contact_that_does_not_end_says_so():
    slow = BATCH.copy()
    slow[1] = entries_of(HAMMER._replace(M_H=0.5, K_H=1e6, v_H0=0.05), GEOMETRY)
    _, ended = run_in_batches(levels, (np.log(STRING), slow), inputs(), cfg(), SIZE)
    assert ended.tolist() == [True, False, True]
