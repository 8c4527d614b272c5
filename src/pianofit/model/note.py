"""A note: string, hammer, geometry, and the path from them to a file. Only notes render, predict and play."""

from __future__ import annotations

from functools import partial
from numbers import Integral
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .. import deferred
from ..conversions import DB
from ..dsp.knock_band import centre
from ..dsp.level import level_energy
from ..errors import ParameterError, check_range, check_type
from ..excitation import GEOMETRY_FIELDS
from ..felt import law_of
from ..io.containers import RATES
from ..io.number_format import summary
from ..parameters import Geometry, String, check_velocity
from ..transducer import TRANSDUCERS
from ..x64 import float64, is_numeric
from .excite import signal_state
from .free_response import MAX_EXPONENT
from .knock_force import add_probes, knock_level
from .modal_response import PRE_ONSET_S, ModalResponse, force_pulse
from .modes import mode_frequencies, mode_table, raised_cosine_weights
from .output_path import OutputPath, apply_filter, impulse_response, sample_at_modes
from .simulate import MAX_MODES, MAX_STEPS, Simulation, contact_rate, count_modes, simulate

MAX_SECONDS = 600.0
# More samples would not fit into the memory of an ordinary machine.
MAX_SAMPLES = 2**25
# Largest factor of the measured level of a partial by another plucking position. The level of a partial with a node at
# the measured position is error.
LARGEST_CHANGE = 10.0
# Largest transposition, cents: ten octaves.
LARGEST_CENTS = 12_000.0
# Weight of a partial at a node.
TINY = 1e-9
# Signal rate for which `Note.levels` chooses the contact rate, Hz.
LEVEL_RATE = 44_100.0


class Note(NamedTuple):
    """All that maps parameters to the samples of a file; a JAX pytree with static `quantity`.

    Parameters
    ----------
    string, geometry : in SI units; see `String` and `Geometry`.
    hammer : in SI units; see `Hammer`, `SoftHammer`, `RelaxingHammer`, `FeltLaw.hammer` and `Pluck`.
    quantity : measured quantity, see `mode_table`.
    gain : file units (full scale = 1) per unit of the pickup.
    path : output path, dB over frequency, in addition to the gain.
    modal_response : measured modes and knock. They render the sound in place of string and path, per unit of gain.
        `levels` still uses string and path.

    Examples
    --------
    Half a second of a middle C with typical parameters, struck at 2 m/s:

    >>> import pianofit
    >>> it = pianofit.typical(60)
    >>> note = pianofit.Note(it.string, it.hammer, it.geometry, "bridge-force", gain=0.1)
    >>> note.render(2.0, seconds=0.5).shape
    (22050,)
    """

    string: String
    hammer: Any  # `Hammer`, `SoftHammer`, `RelaxingHammer`, a hammer of a `FeltLaw`, or `Pluck`
    geometry: Geometry
    quantity: str
    gain: float
    path: OutputPath | None = None
    modal_response: ModalResponse | None = None

    def __repr__(self) -> str:
        return summary(self, lines=True)

    @property
    def f0(self) -> Any:
        """c/2L, Hz: the fundamental of the string without stiffness."""
        return self.string.c / (2 * self.geometry.length)

    @property
    def B(self) -> Any:
        """κ²π²/(c²L²), the inharmonicity: the frequency of partial k is k f0 √(1 + B k²)."""
        return (self.string.kappa * np.pi / (self.string.c * self.geometry.length)) ** 2

    @property
    def stroke_value(self) -> Any:
        """Value of the parameter of the stroke: hammer velocity, m/s, or plucking position, m."""
        name = law_of(self.hammer).stroke.name
        return (
            getattr(self.hammer, name) if name in self.hammer._fields else getattr(self.geometry, GEOMETRY_FIELDS[name])
        )

    def with_stroke(self, value: Any) -> Note:
        """Return the note with another hammer velocity, m/s, or plucking position, m.

        A new position changes the measured levels of partials as it changes those of the string model, by at most
        `LARGEST_CHANGE`.
        """
        name = law_of(self.hammer).stroke.name
        if name in self.hammer._fields:
            return self._replace(hammer=self.hammer._replace(**{name: value}))
        geometry, response = self.geometry._replace(**{GEOMETRY_FIELDS[name]: value}), self.modal_response
        if response is not None:
            count = int(response.partial.max(initial=1))
            before, after = (raised_cosine_weights(g, count, np) for g in (self.geometry, geometry))
            ratio = after / np.where(np.abs(before) < TINY, TINY, before)
            response = response.scale_partials(np.clip(ratio, -LARGEST_CHANGE, LARGEST_CHANGE))
        return self._replace(geometry=geometry, modal_response=response)

    @property
    def size(self) -> Any:
        """Size of the stroke: hammer velocity, m/s, or static force of a pluck, N."""
        return getattr(self.hammer, law_of(self.hammer).size)

    def with_size(self, size: Any) -> Note:
        """Return the note with a stroke of another size: hammer velocity, m/s, or static force of a pluck, N."""
        return self._replace(hammer=self.hammer._replace(**{law_of(self.hammer).size: size}))

    def with_gain(self, gain: float) -> Note:
        """Return the same sound with another gain, if the size of the stroke is a factor of it; else the note itself.

        Recordings of plucks through one path then have one gain, and differ in size.
        """
        if not law_of(self.hammer).size_is_gain:
            return self
        return self.with_size(self.size * abs(self.gain / gain))._replace(gain=np.copysign(gain, self.gain))

    def with_velocity(self, velocity: float) -> Note:
        """Return the note with another hammer velocity, m/s.

        Raises
        ------
        ParameterError
            If the note is not struck by a hammer.
        """
        self._check_struck(velocity)
        return self.with_stroke(velocity)

    def _check_struck(self, velocity: Any) -> None:
        """Raise a `ParameterError` if a velocity is given for a note without a hammer."""
        law = law_of(self.hammer)
        if velocity is not None and not law.has_contact:
            check_type("velocity=", velocity, (), f"left out, because the note is {law.words.verb} without a hammer")

    def with_cents(self, cents: float) -> Note:
        """Return the note transposed by `cents`, with the same decay rates.

        Raises
        ------
        ParameterError
            If `cents` is not a number from -12,000 to 12,000.
        """
        check_range("cents=", cents, -LARGEST_CENTS, LARGEST_CENTS)
        ratio = 2 ** (cents / 1200)
        modal_response = None if self.modal_response is None else self.modal_response.scale_pitch(ratio)
        return self._replace(string=self.string._replace(c=self.string.c * ratio), modal_response=modal_response)

    @property
    def pre_onset_s(self) -> float:
        """Longest time from the start of the sound to the contact, s."""
        return 0.0 if self.modal_response is None else PRE_ONSET_S

    def render(
        self, velocity: float | None = None, *, seconds: float = 3.0, rate: int = 44_100, mono: bool = True
    ) -> np.ndarray:
        """Render the sound. It begins `pre_onset_s` before the first contact.

        Parameters
        ----------
        velocity : hammer velocity, m/s; that of the hammer if None.
        seconds : length, s.
        rate : sample rate, Hz.
        mono : return the mean of the channels.

        Returns
        -------
        The sound in file units [samples]; [channels, samples] if not `mono`.

        Raises
        ------
        ParameterError
            For a velocity, length, s, or rate, Hz, out of range.
        FitError
            If the contact does not end.
        """
        check_render(velocity, seconds, rate)
        if not (is_numeric(self.gain) and np.ndim(self.gain) == 0 and np.isfinite(self.gain)):
            check_type("gain=", self.gain, (), "one finite number, in file units per unit of the pickup")
        note = self if velocity is None else self.with_velocity(velocity)
        frames = note.render_channels(note.strike(rate), rate, round(seconds * rate), round(note.pre_onset_s * rate))
        return frames.mean(axis=0) if mono else frames

    def play(self) -> Any:
        """Return a widget that plays the note at any velocity in Jupyter or marimo; it needs the extra `widget`.

        Raises
        ------
        ParameterError
            If anywidget is not installed, or a page cannot play this felt law.
        """
        return deferred.call("web.widget", "widget", self)

    def render_stroke(self, rate: float, samples: int, touch: int = 0) -> tuple[np.ndarray, Simulation]:
        """Render the sound [samples] in file units, and return its simulation; contact begins at the index `touch`."""
        simulation = self.strike(rate)
        return self.render_mono(simulation, rate, samples, touch), simulation

    def strike(self, rate: float) -> Simulation:
        """Simulate the stroke, with a contact rate that is a multiple of `rate`, Hz; see `simulate`."""
        return simulate(self.string, self.hammer, self.geometry, rate=rate, quantity=self.quantity)

    def render_mono(self, strike: Simulation, rate: float, samples: int, touch: int = 0) -> np.ndarray:
        """Render a stroke in file units as the mean of its channels [samples]; see `render_channels`."""
        return self.render_channels(strike, rate, samples, touch).mean(axis=0)

    def render_channels(self, strike: Simulation, rate: float, samples: int, touch: int = 0) -> np.ndarray:
        """Render a stroke in file units [channels, samples].

        The index `touch` may lie before the first sample; the sound is then truncated. A stiff string sounds long
        before its main wave arrives, so only a sound that begins at the touch begins with silence.
        """
        begin = touch - round(self.pre_onset_s * rate)
        count = max(samples - begin, 0)
        if self.modal_response is None:
            sound = self._render_string_model(strike, rate, count)[None]
        else:
            sound = self.gain * self.modal_response.sound(force_pulse(strike, self.hammer), round(rate), count)
        return np.pad(sound[:, max(-begin, 0) :], ((0, 0), (max(begin, 0), 0)))[:, :samples]

    def _render_string_model(self, strike: Simulation, rate: float, count: int) -> np.ndarray:
        """Render the modes of the string through the path, from the contact on [count]."""
        pickup, free = (np.asarray(x) * self.gain for x in (strike.modes.pickup, strike.modes.free_pickup))
        modes = strike.modes._replace(pickup=pickup, free_pickup=free)
        return self.through_path(strike._replace(modes=modes).waveform(rate, count), modes.pole, rate)

    def through_path(self, sound: np.ndarray, pole: Any, rate: float) -> np.ndarray:
        """Filter the sound [samples] of modes with complex `pole`, 1/s [modes], by the output path; same length."""
        path = sample_at_modes(self.path, np.asarray(pole))
        return apply_filter(sound, impulse_response(path, rate))[: len(sound)]

    def frequencies(self, count: int) -> np.ndarray:
        """Frequencies of the first partials by the string model, Hz [partials]; measured ones differ slightly."""
        return mode_frequencies(self.string, self.geometry.length, count)

    def levels(self, velocity: float | np.ndarray | None = None, count: int = 32) -> np.ndarray:
        """Levels of the first partials, from the arrival of the wave on.

        Parameters
        ----------
        velocity : hammer velocities, m/s [...]; that of the hammer if None.
        count : number of partials.

        Returns
        -------
        Levels as `pianofit.levels` defines them, dB in file units [..., partials]. They are infinite if the contact
        does not end.

        Raises
        ------
        ParameterError
            For a velocity or a count that is not above 0.
        """
        self._check_struck(velocity)
        return self.levels_of_strokes(self.stroke_value if velocity is None else velocity, count)[0]

    def levels_of_strokes(self, value: float | np.ndarray, count: int = 32) -> tuple[np.ndarray, np.ndarray]:
        """Levels of partials as by `levels` [..., partials], and the level of the knock, dB in file units [...].

        The strokes have these values of their parameter [...].
        """
        if not is_numeric(value):
            check_type("velocity=", value, (), "a number or an array of numbers, m/s")
        g, v, law = self.geometry, np.asarray(value, float), law_of(self.hammer)
        if not (v.size and np.isfinite(v).all() and v.min() > 0):
            raise ParameterError(f"{law.words.stroke}: {value} {law.stroke.unit} must be above 0")
        check_type("count=", count, Integral, "a whole number of partials")
        check_range("count=", count, 1, MAX_MODES)
        rate = contact_rate(self.string, g, LEVEL_RATE)
        rows = max(count_modes(self.string, g, rate), 64 * int(np.ceil(count / 64)))
        plain = self._replace(gain=1.0, path=None, modal_response=None)
        level = np.asarray(_levels(plain, v.ravel(), rate, rows))[:, [*range(count), -1]]
        frequency = np.append(self.frequencies(count), centre(float(self.f0)))
        level = level + 20 * np.log10(np.abs(self.gain)) + (0.0 if self.path is None else self.path.at(frequency))
        return level[:, :count].reshape(*v.shape, count), level[:, count].reshape(v.shape)


jax.tree_util.register_pytree_node(
    Note,
    lambda note: ((note.string, note.hammer, note.geometry, note.gain, note.path, note.modal_response), note.quantity),
    lambda quantity, x: Note(*x[:3], quantity, *x[3:]),
)


@float64
@partial(jax.jit, static_argnums=3)
def _levels(note, values, rate, rows):
    """Levels of all modes, dB in the unit of the pickup, and of the knock, dB [strokes, modes + 1]."""

    def level_at(value):
        level, ended = stroke_levels(note.with_stroke(value), rate, rows, rows, MAX_STEPS)
        return jnp.where(ended, level, jnp.inf)

    return jax.vmap(level_at)(values)


def stroke_levels(note: Note, rate, n_modes: int, rows: int, steps, knock: bool = True):
    """Levels of partials, dB in the unit of the pickup, from the arrival of the wave on, and whether contact ended.

    With `knock` its level is the last, dB [rows + 1]. The string was at rest. Gain and path are left out.
    """
    string, geometry, quantity = note.string, note.geometry, note.quantity
    modes = mode_table(string, geometry, rate=rate, n_modes=n_modes, quantity=quantity)
    probed = add_probes(modes, note.f0) if knock else modes
    state = signal_state(probed, note.hammer, law_of(note.hammer), steps=steps)
    alpha, amplitude = -modes.pole.real[:rows], state.amplitude[:rows]
    size = 0.5 * jnp.log(jnp.maximum(amplitude.real**2 + amplitude.imag**2, np.finfo(float).tiny))
    # Amplitudes after the contact, extrapolated back to the arrival.
    grown = jnp.minimum(alpha * (state.time - arrival(string, geometry, quantity, jnp)), MAX_EXPONENT)
    level = DB * (size + grown + 0.5 * jnp.log(0.5 * level_energy(2 * alpha, jnp)))
    if knock:
        strike = geometry.strike_position / geometry.length
        level = jnp.append(level, knock_level(jnp.abs(state.amplitude[n_modes:]), note.f0, strike))
    return level, state.ended


def arrival(string: String, geometry: Geometry, quantity: str, xp: Any = np) -> Any:
    """Arrival time of the wave from the nearest edge of the contact window at the pickup, s after first contact."""
    end = geometry.pickup if TRANSDUCERS[quantity].on_string else geometry.length
    return xp.maximum(xp.abs(end - geometry.strike_position) - geometry.width / 2, 0.0) / string.c


def check_render(velocity: float | None, seconds: float, rate: int) -> None:
    """Raise a `ParameterError` for arguments that cannot be rendered."""
    check_velocity(velocity)
    check_range("seconds=", seconds, 0.01, MAX_SECONDS)
    check_range("rate=", rate, *RATES, " Hz")
    if seconds * rate > MAX_SAMPLES:
        raise ParameterError(
            f"seconds={seconds} at rate={rate} Hz is too long; ask for {MAX_SAMPLES // rate} s or less"
        )
