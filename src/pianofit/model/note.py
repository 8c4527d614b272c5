"""A note: string, hammer, geometry, and the path to a file. The only thing that renders, predicts and plays."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..errors import ParameterError
from ..felt import MemoryHammer
from ..parameters import Geometry, Hammer, String, check_velocity
from ..recording import RATES
from .contact import strike
from .modes import mode_frequencies, mode_table
from .path import OutputPath, filtered, impulse, through
from .precision import float64
from .response import level_db, ringing
from .simulate import Simulation, contact_rate, count_modes, simulate

__all__ = ["MOST_SAMPLES", "MOST_SECONDS", "Note", "arrival", "check_render"]

MOST_SECONDS = 600.0
# More would not fit into an ordinary machine's memory while it is computed.
MOST_SAMPLES = 2**25
# Signals whose contact `Note.levels` solves, Hz.
LEVEL_RATE = 44_100.0
# Their contacts last as long as this hammer's, m/s, or a slower one's, and a factor longer, in whole blocks of steps.
SLOWEST = 0.05
SPARE = 1.3
BLOCK = 256


class Note(NamedTuple):
    """Everything between a set of parameters and a file's samples; a JAX pytree, `quantity` static.

    For example the literature's middle C, struck at 2 m/s, half a second of it:

    >>> import pianofit
    >>> it = pianofit.typical(60)
    >>> note = pianofit.Note(it.string, it.hammer, it.geometry, "bridge-force", gain=0.1)
    >>> note.render(2.0, seconds=0.5).shape
    (22050,)
    """

    string: String
    hammer: Hammer | MemoryHammer
    geometry: Geometry
    quantity: str  # what is heard, see `mode_table`
    gain: float  # file units (full scale = 1) per unit of the pickup
    path: OutputPath | None = None  # dB over frequency, beside the gain

    def struck(self, velocity: float) -> Note:
        """The same note with another hammer velocity, m/s."""
        return self._replace(hammer=self.hammer._replace(v_H0=velocity))

    def render(self, velocity: float | None = None, *, seconds: float = 3.0, rate: int = 44_100) -> np.ndarray:
        """The sound [samples] in file units from the first contact on, at another hammer velocity, m/s, if given.

        Raises
        ------
        ParameterError
            For a velocity, length, s, or rate, Hz, out of range.
        FitError
            If the contact does not end.
        """
        check_render(velocity, seconds, rate)
        note = self if velocity is None else self.struck(velocity)
        return note.play(rate, round(seconds * rate))[0]

    def play(self, rate: float, samples: int, touch: int = 0) -> tuple[np.ndarray, Simulation]:
        """The sound [samples] in file units, and the stroke behind it; the contact begins at the index `touch`."""
        simulation = self.strike(rate)
        return self.heard(simulation, rate, samples, touch), simulation

    def strike(self, rate: float) -> Simulation:
        """The stroke, with the contact at a multiple of `rate`, Hz."""
        return simulate(self.string, self.hammer, self.geometry, rate=rate, quantity=self.quantity)

    def heard(self, strike: Simulation, rate: float, samples: int, touch: int = 0) -> np.ndarray:
        """A stroke of this note in file units [samples].

        The index `touch` may lie before the first sample: then the sound is cut. A stiff string is heard long before
        its main wave arrives, so only what begins at the touch begins with silence.
        """
        path, pole = through(self.path, np.asarray(strike.modes.pole))
        own = strike.modes._replace(pickup=np.asarray(strike.modes.pickup) * self.gain, pole=pole)
        sound = strike._replace(modes=own).waveform(rate, max(samples - touch, 0))
        sound = filtered(sound, impulse(path, rate))[: len(sound)]
        return np.pad(sound[max(-touch, 0) :], (max(touch, 0), 0))[:samples]

    def frequencies(self, count: int) -> np.ndarray:
        """Where the string has partials 1 to `count`, Hz [partials]; real ones lie beside it."""
        return mode_frequencies(self.string, self.geometry.length, count)

    def levels(self, velocity: float | np.ndarray | None = None, count: int = 32) -> np.ndarray:
        """Levels of partials 1 to `count` at one or many hammer velocities, m/s, from the wave's arrival on.

        Returns
        -------
        dB in file units [..., partials], the leading axes being those of `velocity`; see `response.level_db`. Infinite
        where the contact does not end.
        """
        g, v = self.geometry, np.asarray(self.hammer.v_H0 if velocity is None else velocity, float)
        rate = contact_rate(self.string, g, LEVEL_RATE)
        rows = max(count_modes(self.string, g, rate), 64 * int(np.ceil(count / 64)))
        slow = self.struck(min(SLOWEST, float(v.min()))).strike(LEVEL_RATE)
        steps = BLOCK * int(np.ceil(SPARE * slow.last_touch * rate / BLOCK))
        delay = arrival(self.string, g, self.quantity)
        level = _levels(self.string, self.hammer, g, v.ravel(), rate, delay, rows, steps, self.quantity)
        own = 20 * np.log10(np.abs(self.gain)) + (0.0 if self.path is None else self.path.at(self.frequencies(count)))
        return (np.asarray(level)[:, :count] + own).reshape(*v.shape, count)


jax.tree_util.register_pytree_node(
    Note,
    lambda note: ((note.string, note.hammer, note.geometry, note.gain, note.path), note.quantity),
    lambda quantity, x: Note(x[0], x[1], x[2], quantity, x[3], x[4]),
)


@float64
@partial(jax.jit, static_argnums=(6, 7, 8))
def _levels(string, hammer, geometry, velocity, rate, delay, rows, steps, quantity):
    """Levels of all modes [velocities, modes], dB in the pickup's unit; infinite where the contact does not end."""
    modes = mode_table(string, geometry, rate=rate, n_modes=rows, quantity=quantity)

    def one(v):
        pulse = strike(modes, hammer._replace(v_H0=v), steps=steps)
        level = level_db(ringing(modes, pulse.drive) * jnp.exp(modes.pole.real * delay), -modes.pole.real)
        return jnp.where(pulse.compression[-1] <= 0, level, jnp.inf)

    return jax.vmap(one)(velocity)


def arrival(string: String, geometry: Geometry, quantity: str) -> float:
    """When the wave from the nearest edge of the contact window reaches the pickup, s after the first contact."""
    end = geometry.length if quantity in ("bridge-force", "pressure") else geometry.pickup
    return float(max(abs(end - geometry.strike) - geometry.width / 2, 0.0) / string.c)


def check_render(velocity: float | None, seconds: float, rate: int) -> None:
    """Refuse what cannot be rendered.

    Raises
    ------
    ParameterError
        Naming the argument, its value and its range.
    """
    check_velocity(velocity)
    if not 0.01 <= seconds <= MOST_SECONDS:
        raise ParameterError(f"seconds={seconds} must be from 0.01 to {MOST_SECONDS:g}")
    if not RATES[0] <= rate <= RATES[1]:
        raise ParameterError(f"rate={rate} Hz must be from {RATES[0]} to {RATES[1]}")
    if seconds * rate > MOST_SAMPLES:
        raise ParameterError(
            f"seconds={seconds} at rate={rate} Hz is too long; ask for {MOST_SAMPLES // rate} s or less"
        )
