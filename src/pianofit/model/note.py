"""A note: string, hammer, geometry, and what lies between them and a file. Only notes render, predict and play."""

from __future__ import annotations

from functools import partial
from numbers import Real
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..errors import ParameterError, check_range, check_type
from ..felt import RelaxingHammer
from ..io.audio import RATES
from ..io.number_format import summary
from ..parameters import Geometry, Hammer, String, check_velocity
from .arguments import is_numeric
from .contact import strike
from .free_response import level_db, modal_amplitudes
from .modal_response import PRE_ONSET_S, ModalResponse, force_of
from .modes import mode_frequencies, mode_table
from .output_path import OutputPath, apply_to_modes, filtered, impulse
from .simulate import MOST_MODES, Simulation, contact_rate, count_modes, simulate
from .x64 import float64

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
    hammer: Hammer | RelaxingHammer
    geometry: Geometry
    quantity: str  # what is heard, see `mode_table`
    gain: float  # file units (full scale = 1) per unit of the pickup
    path: OutputPath | None = None  # dB over frequency, beside the gain
    ringing: ModalResponse | None = (
        None  # what sounds in place of string and path, per unit of gain; they keep the levels
    )

    def __repr__(self) -> str:
        return summary(self, lines=True)

    @property
    def f0(self) -> Any:
        """c/2L, Hz: the fundamental of the string without stiffness."""
        return self.string.c / (2 * self.geometry.length)

    @property
    def B(self) -> Any:
        """κ²π²/(c²L²), the string's inharmonicity: partial k is k f0 √(1 + B k²)."""
        return (self.string.kappa * np.pi / (self.string.c * self.geometry.length)) ** 2

    def with_velocity(self, velocity: float) -> Note:
        """The same note with another hammer velocity, m/s."""
        return self._replace(hammer=self.hammer._replace(v_H0=velocity))

    def with_cents(self, cents: float) -> Note:
        """The same note at another pitch."""
        check_type("cents=", cents, Real, "a number")
        ratio = 2 ** (cents / 1200)
        ringing = None if self.ringing is None else self.ringing.scale_pitch(ratio)
        return self._replace(string=self.string._replace(c=self.string.c * ratio), ringing=ringing)

    @property
    def pre_onset_s(self) -> float:
        """How long before the contact the sound can begin, s."""
        return 0.0 if self.ringing is None else PRE_ONSET_S

    def render(
        self, velocity: float | None = None, *, seconds: float = 3.0, rate: int = 44_100, mono: bool = True
    ) -> np.ndarray:
        """The sound in file units, at another hammer velocity, m/s, if given.

        It begins `lead` seconds before the first contact.

        Returns
        -------
        [samples], the mean of the channels; [channels, samples] if not `mono`.

        Raises
        ------
        ParameterError
            For a velocity, length, s, or rate, Hz, out of range.
        FitError
            If the contact does not end.
        """
        check_render(velocity, seconds, rate)
        note = self if velocity is None else self.with_velocity(velocity)
        frames = note.render_channels(note.strike(rate), rate, round(seconds * rate), round(note.pre_onset_s * rate))
        return frames.mean(axis=0) if mono else frames

    def play(self) -> Any:
        """The note to strike in a notebook (Jupyter, marimo), at any velocity: a widget, by the extra `widget`.

        Raises
        ------
        ParameterError
            If anywidget is not installed, or the felt is none that a page plays.
        """
        from ..web.widget import widget

        return widget(self)

    def render_stroke(self, rate: float, samples: int, touch: int = 0) -> tuple[np.ndarray, Simulation]:
        """The sound [samples] in file units, and the stroke behind it; the contact begins at the index `touch`."""
        simulation = self.strike(rate)
        return self.render_mono(simulation, rate, samples, touch), simulation

    def strike(self, rate: float) -> Simulation:
        """The stroke, with the contact at a multiple of `rate`, Hz."""
        return simulate(self.string, self.hammer, self.geometry, rate=rate, quantity=self.quantity)

    def render_mono(self, strike: Simulation, rate: float, samples: int, touch: int = 0) -> np.ndarray:
        """A stroke of this note in file units, the mean of its channels [samples]; see `frames`."""
        return self.render_channels(strike, rate, samples, touch).mean(axis=0)

    def render_channels(self, strike: Simulation, rate: float, samples: int, touch: int = 0) -> np.ndarray:
        """A stroke of this note in file units [channels, samples].

        The index `touch` may lie before the first sample: then the sound is cut. A stiff string is heard long before
        its main wave arrives, so only what begins at the touch begins with silence.
        """
        begin = touch - round(self.pre_onset_s * rate)
        count = max(samples - begin, 0)
        sound = self._by_law(strike, rate, count)[None] if self.ringing is None else (
            self.gain * self.ringing.sound(force_of(strike, float(self.hammer.v_H0)), round(rate), count)
        )  # fmt: skip
        return np.pad(sound[:, max(-begin, 0) :], ((0, 0), (max(begin, 0), 0)))[:, :samples]

    def _by_law(self, strike: Simulation, rate: float, count: int) -> np.ndarray:
        """The string's own modes through the path, from the contact on [count]."""
        path, pole = apply_to_modes(self.path, np.asarray(strike.modes.pole))
        own = strike.modes._replace(pickup=np.asarray(strike.modes.pickup) * self.gain, pole=pole)
        sound = strike._replace(modes=own).waveform(rate, count)
        return filtered(sound, impulse(path, rate))[:count]

    def frequencies(self, count: int) -> np.ndarray:
        """Where the string has its first partials, Hz [partials]; real ones lie beside it."""
        return mode_frequencies(self.string, self.geometry.length, count)

    def levels(self, velocity: float | np.ndarray | None = None, count: int = 32) -> np.ndarray:
        """Levels of the first partials at one or many hammer velocities, m/s, from the wave's arrival on.

        Returns
        -------
        dB in file units [..., partials], the leading axes being those of `velocity`; as of `levels`. Infinite
        where the contact does not end.

        Raises
        ------
        ParameterError
            For a velocity that is not above 0, or a count that is not.
        """
        velocity = self.hammer.v_H0 if velocity is None else velocity
        if not is_numeric(velocity):
            check_type("velocity=", velocity, (), "a number or an array of numbers, m/s")
        g, v = self.geometry, np.asarray(velocity, float)
        if not (v.size and np.isfinite(v).all() and v.min() > 0):
            raise ParameterError(f"velocity={velocity} m/s must be above 0")
        check_range("count=", count, 1, MOST_MODES)
        rate = contact_rate(self.string, g, LEVEL_RATE)
        rows = max(count_modes(self.string, g, rate), 64 * int(np.ceil(count / 64)))
        slow = self.with_velocity(min(SLOWEST, float(v.min()))).strike(LEVEL_RATE)
        steps = BLOCK * int(np.ceil(SPARE * slow.last_touch * rate / BLOCK))
        delay = arrival(self.string, g, self.quantity)
        level = _levels(self.string, self.hammer, g, v.ravel(), rate, delay, rows, steps, self.quantity)
        own = 20 * np.log10(np.abs(self.gain)) + (0.0 if self.path is None else self.path.at(self.frequencies(count)))
        return (np.asarray(level)[:, :count] + own).reshape(*v.shape, count)


jax.tree_util.register_pytree_node(
    Note,
    lambda note: ((note.string, note.hammer, note.geometry, note.gain, note.path, note.ringing), note.quantity),
    lambda quantity, x: Note(*x[:3], quantity, *x[3:]),
)


@float64
@partial(jax.jit, static_argnums=(6, 7, 8))
def _levels(string, hammer, geometry, velocity, rate, delay, rows, steps, quantity):
    """Levels of all modes [velocities, modes], dB in the pickup's unit; infinite where the contact does not end."""
    modes = mode_table(string, geometry, rate=rate, n_modes=rows, quantity=quantity)

    def one(v):
        pulse = strike(modes, hammer._replace(v_H0=v), steps=steps)
        level = level_db(modal_amplitudes(modes, pulse.drive) * jnp.exp(modes.pole.real * delay), -modes.pole.real)
        return jnp.where(pulse.compression[-1] <= 0, level, jnp.inf)

    return jax.vmap(one)(velocity)


def arrival(string: String, geometry: Geometry, quantity: str) -> float:
    """When the wave from the nearest edge of the contact window reaches the pickup, s after the first contact."""
    end = geometry.length if quantity in ("bridge-force", "pressure") else geometry.pickup
    return float(max(abs(end - geometry.strike_position) - geometry.width / 2, 0.0) / string.c)


def check_render(velocity: float | None, seconds: float, rate: int) -> None:
    """Refuse what cannot be rendered.

    Raises
    ------
    ParameterError
        Naming the argument, its value and its range.
    """
    check_velocity(velocity)
    check_range("seconds=", seconds, 0.01, MOST_SECONDS)
    check_range("rate=", rate, *RATES, " Hz")
    if seconds * rate > MOST_SAMPLES:
        raise ParameterError(
            f"seconds={seconds} at rate={rate} Hz is too long; ask for {MOST_SAMPLES // rate} s or less"
        )
