"""Many strokes in one compiled program, each with its own string, hammer and geometry.

Steps and modes are those of one stroke that is simulated first, so all strokes share a program. Each stops once its own
contact is proven over.
"""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from ..felt import law_of
from ..parameters import Geometry, String
from .contact import Pulse
from .differentiable_sums import BLOCK
from .excite import excite_until_over
from .free_motion import FreeMotion
from .modes import Modes, mode_table
from .note import Note
from .program_cache import persistent_jit
from .simulate import Simulation, StrikeConfig, simulation_of

# Strokes of one call. Larger batches wait for their longest contact.
BATCH_SIZE = 16
# Name of the axis of `jax.vmap`.
BATCH = "strokes"
# Stored steps over those of the first stroke, and their multiple, so that keys share programs.
MARGIN, STEPS = 2.0, 1024


@persistent_jit
def strokes(strings, hammers, geometries, rate, cfg: StrikeConfig):
    """Tables of modes, pulses and free motions as tuples of arrays [strokes, ...], and computed steps [strokes].

    The arguments are fields in their order [strokes, fields], and the contact rate in Hz.
    """

    def one(string, hammer, geometry):
        modes, pulse, steps, free = stroke_until_over(string, hammer, geometry, rate, cfg)
        return tuple(modes), tuple(pulse), None if free is None else tuple(free), steps

    return jax.vmap(one, axis_name=BATCH)(strings, hammers, geometries)


def stroke_until_over(
    string, hammer, geometry, rate, cfg: StrikeConfig
) -> tuple[Modes, Pulse, jax.Array, FreeMotion | None]:
    """Table of modes, pulse, number of computed steps and free motion of one stroke of a batch.

    The arguments are fields in their order [fields]. The free motion is that after a pluck, or None.
    """
    table = {"rate": rate, "n_modes": cfg.n_modes, "quantity": cfg.quantity}
    modes = mode_table(String(*string), Geometry(*geometry), **table)
    hammer = cfg.law.hammer_type(*hammer)
    pulse, steps, free = excite_until_over(modes, hammer, cfg.law, steps=cfg.steps, batch=BATCH)
    return modes, pulse, steps, free


def strokes_arguments(notes: Sequence[Note], first: Simulation) -> tuple[tuple[np.ndarray, ...], Any, StrikeConfig]:
    """Return arguments of `strokes` for notes that differ only in their parameters: arrays, rate, configuration.

    `first` is the stroke of one of the notes.
    """
    modes, step = len(first.modes.pole), float(first.modes.step)
    steps = STEPS * max(int(np.ceil(MARGIN * first.last_touch / step / STEPS)), 1)
    cfg = StrikeConfig(modes, steps, notes[0].quantity, law_of(notes[0].hammer))
    return parameter_arrays(notes), np.float64(1 / step), cfg


def parameter_arrays(notes: Sequence[Note]) -> tuple[np.ndarray, ...]:
    """Return string, hammer and geometry of the notes, each as fields in their order [notes, fields]."""
    parts = ("string", "hammer", "geometry")
    return tuple(np.array([[*map(float, getattr(note, part))] for note in notes]) for part in parts)


def simulations(result: tuple) -> list[Simulation]:
    """Return every stroke from the result of `strokes`. The pulse of an unfinished contact says so."""
    modes, pulses, free, steps = result
    drive = pulses[0]
    pressed = drive.shape[1] - np.argmax(drive[:, ::-1] != 0, axis=1)
    steps = np.minimum(steps, BLOCK * (pressed // BLOCK + 1))

    def one(i: int) -> Simulation:
        table, motion = jax.tree.map(lambda x: x[i], (modes, free))
        return simulation_of(table, [x[i, : steps[i]] if x.ndim > 1 else x[i] for x in pulses], motion)

    return [one(i) for i in range(len(steps))]
