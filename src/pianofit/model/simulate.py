"""Simulation of a whole strike: choose contact rate and duration, strike, and keep all that a waveform needs."""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from ..errors import FitError, ParameterError, check_range
from ..excitation import Excitation
from ..felt import check_hammer, law_of
from ..io.files import short_repr
from ..io.number_format import summary
from ..parameters import Geometry, String, check
from ..transducer import ON_STRING
from ..x64 import float64, is_numeric
from .contact import Pulse
from .excite import excite
from .free_motion import FreeMotion, free_motion
from .free_response import waveform
from .modes import MAX_RELATIVE_FREQUENCY, Modes, mode_frequencies, mode_table, raised_cosine_weights
from .program_cache import KEYBOARD_SHAPES, persistent_jit

# The error is of second order in the step: at this rate ordinary notes are within 1e-3 of the converged solution.
MIN_CONTACT_RATE = 88_000.0
MAX_CONTACT_RATE = 6_000_000.0
# At least this many modes, or all with a strike weight above -60 dB, lie below 0.4 of the rate (design §2).
SUFFICIENT_MODES = 30
WEAK_STRIKE = 1e-3
MAX_MODES = 512
# Longer contacts are computed again with four times the steps.
FIRST_STEPS, MAX_STEPS = 1024, 2**16


class Contact(NamedTuple):
    """An interval in which the hammer presses the string."""

    start: float  # s from the first touch
    stop: float  # s from the first touch
    force: float  # largest force, N


class Simulation(NamedTuple):
    """A simulated strike, from `simulate`: arrays of NumPy in SI units."""

    modes: Modes  # the table of modes [modes]
    pulse: Pulse  # force and motion during the contact [steps]
    free: FreeMotion | None  # motion of the string before the strike; None if it was at rest

    def __repr__(self) -> str:
        return summary(self, lines=True)

    def waveform(self, rate: float, samples: int) -> np.ndarray:
        """Return the signal from the first touch on, in the unit of the pickup; see `pianofit.waveform`.

        Parameters
        ----------
        rate : sample rate, Hz; the contact rate must be a whole multiple of it.
        samples : number of samples.

        Raises
        ------
        ParameterError
            If the contact rate is not a whole multiple of `rate`.
        """
        return np.asarray(waveform(self.modes, self.pulse.drive, rate=rate, samples=samples, free=self.free))

    @property
    def contacts(self) -> tuple[Contact, ...]:
        """All contacts of hammer and string, in order.

        The felt stays compressed during a contact. The force may fall to 0 within it, if the loss of the felt exceeds
        the elastic force. A contact ends with its last force, interpolated between steps.
        """
        force, u, step = np.asarray(self.pulse.force), np.asarray(self.pulse.compression), float(self.modes.step)
        pressed = np.concatenate([[False], u > 0, [False]])
        edges = np.flatnonzero(np.diff(pressed.astype(int)))
        contacts = []
        for start, stop in zip(edges[::2], edges[1::2], strict=True):
            acting = start + np.flatnonzero(force[start:stop] > 0)
            if acting.size:
                last = acting[-1]
                apart = last == stop - 1 and stop < len(u)  # else the loss of the felt ends the force
                end = last + (u[last] / (u[last] - u[stop]) if apart else 1.0)
                contacts.append(Contact(acting[0] * step, float(end) * step, float(force[start:stop].max())))
        return tuple(contacts)

    @property
    def contact_time(self) -> float:
        """Duration of the first contact, s."""
        return self.contacts[0].stop if self.contacts else 0.0

    @property
    def last_touch(self) -> float:
        """End of the last contact, s from the first touch."""
        return self.contacts[-1].stop if self.contacts else 0.0


def contact_rate(string: String, geometry: Geometry, rate: float) -> float:
    """Return a whole multiple of `rate`, Hz, at which the table holds enough modes of this string.

    Raises `ParameterError` if the string is so short or stiff that the rate would exceed 6 MHz.
    """
    n = MAX_MODES
    frequencies = mode_frequencies(string, geometry.length, n)
    driven = np.flatnonzero(np.abs(raised_cosine_weights(geometry, n, np)) > WEAK_STRIKE)
    needed = min(SUFFICIENT_MODES, driven[-1] + 1 if driven.size else SUFFICIENT_MODES)
    least_rate = max(MIN_CONTACT_RATE, 1.01 * frequencies[needed - 1] / MAX_RELATIVE_FREQUENCY)
    if least_rate > MAX_CONTACT_RATE:
        raise ParameterError(
            f"c={float(string.c):g} m/s and kappa={float(string.kappa):g} m²/s on {float(geometry.length):g} m put "
            f"partial {needed} at {frequencies[needed - 1]:.3g} Hz; use a slower, less stiff or longer string"
        )
    return rate * int(np.ceil(least_rate / rate))


def count_modes(string: String, geometry: Geometry, rate: float) -> int:
    """Rows of the table: all modes below 0.4 of the contact rate, in multiples of 64 so that programs are shared."""
    frequencies = mode_frequencies(string, geometry.length, MAX_MODES)
    below = (frequencies < MAX_RELATIVE_FREQUENCY * rate).sum()
    return min(MAX_MODES, 64 * int(np.ceil(below / 64)))


class StrikeConfig(NamedTuple):
    """Static arguments of the programs that strike."""

    n_modes: int
    steps: int  # of the contact, or of its stored pulse
    quantity: str
    law: Excitation
    kind: str = "continuous"


@partial(persistent_jit, loaded=KEYBOARD_SHAPES)
def _strike(string, hammer, geometry, rate, weights, start, cfg: StrikeConfig):
    """The table, the pulse, and the free motion before it, each as a tuple of arrays."""
    table = {"rate": rate, "n_modes": cfg.n_modes, "quantity": cfg.quantity, "kind": cfg.kind}
    modes = mode_table(String(*string), Geometry(*geometry), strike_weights=weights, **table)
    free = None if start is None else free_motion(modes, *start)
    pulse, free = excite(modes, cfg.law.hammer_type(*hammer), cfg.law, steps=cfg.steps, free=free)
    return tuple(modes), tuple(pulse), None if free is None else tuple(free)


def simulation_of(modes: Sequence, pulse: Sequence, free: Sequence | None) -> Simulation:
    """Return the stroke with these arrays of a program, which returns plain tuples."""
    return Simulation(Modes(*modes), Pulse(*pulse), None if free is None else FreeMotion(*free))


@float64
def simulate(
    string: String,
    hammer: Any,
    geometry: Geometry,
    *,
    rate: float = 44_100.0,
    quantity: str = "velocity",
    kind: str = "continuous",
    n_modes: int | None = None,
    oversampling: int | None = None,
    strike_weights=None,
    displacement=None,
    velocity=None,
) -> Simulation:
    """Simulate a strike until the hammer provably cannot touch the string again.

    Parameters
    ----------
    string, geometry : in SI units; see `String` and `Geometry`.
    hammer : a `Hammer`, a `SoftHammer`, a `RelaxingHammer`, a hammer of a `FeltLaw`, or a `Pluck`.
    rate : sample rate of the signal, Hz.
    oversampling : contact rate over sample rate; if None as high as the string needs.
    quantity, kind, strike_weights : see `mode_table`.
    n_modes : rows of the table, for `finite_difference` also the paper's N; if None all modes below 0.4 of the contact
        rate.
    displacement, velocity : modal coordinates [modes] of the string at t = 0, m and m/s, from `pianofit.model.project`;
        at rest by default.

    Returns
    -------
    A `Simulation`: the table of modes [modes] and the pulse [steps], SI units; `waveform` returns the signal.

    Raises
    ------
    ParameterError
        For values out of range.
    FitError
        If the contact does not end within 65,536 steps.

    Examples
    --------
    >>> import pianofit
    >>> it = pianofit.preset("chabassier-F3")
    >>> strike = pianofit.simulate(it.string, it.hammer, it.geometry, quantity="bridge-force")
    >>> f"{1e3 * strike.contact_time:.1f} ms", strike.waveform(44_100, 1000).shape
    ('2.4 ms', (1000,))
    """
    check_stroke(string, hammer, geometry, quantity, rate)
    if kind == "finite_difference" and strike_weights is None and n_modes:
        points, width = np.arange(1, n_modes + 1) * (float(geometry.length) / (n_modes + 1)), float(geometry.width)
        if np.abs(points - float(geometry.strike_position)).min() >= width / 2:
            raise ParameterError(f"width={width} m: none of the {n_modes} grid points lies within it")
    # One type for all numbers: JAX compiles again for every other type.
    values = tuple(tuple(map(np.float64, part)) for part in (string, hammer, geometry))
    step_rate = np.float64(rate * oversampling if oversampling else contact_rate(string, geometry, rate))
    rows = n_modes or count_modes(string, geometry, step_rate)
    start = None
    if displacement is not None or velocity is not None:
        start = tuple(
            np.zeros(rows) if x is None else _checked_coordinates(name, x, rows)
            for name, x in (("displacement", displacement), ("velocity", velocity))
        )
    steps = FIRST_STEPS
    while steps <= MAX_STEPS:
        cfg = StrikeConfig(rows, steps, quantity, law_of(hammer), kind)
        parts = _strike(*values, step_rate, strike_weights, start, cfg)
        done = simulation_of(*jax.tree.map(np.asarray, parts))
        if done.pulse.contact_ended:
            return done
        steps *= 4
    raise endless_contact(hammer, step_rate)


def _checked_coordinates(name: str, value: Any, rows: int) -> np.ndarray:
    """Return modal coordinates of the string [modes]."""
    array = np.asarray(value)
    if array.shape != (rows,) or not is_numeric(array) or not np.isfinite(array).all():
        raise ParameterError(
            f"{name}={short_repr(value)} must be finite modal coordinates [modes], of shape ({rows},); give n_modes too"
        )
    return array.astype(float)


def endless_contact(hammer: Any, step_rate: float) -> FitError:
    """Return the error of a contact that does not end within `MAX_STEPS` steps."""
    return FitError(
        f"v_H0={float(hammer.v_H0):g} m/s, M_H={float(hammer.M_H):g} kg: the hammer is still on the string after "
        f"{MAX_STEPS / step_rate:.3g} s; use a lighter or faster hammer"
    )


def check_stroke(string: String, hammer: Any, geometry: Geometry, quantity: str, rate: float) -> None:
    """Raise a `ParameterError` for a stroke, or a sample rate in Hz, that cannot be simulated."""
    for part in (string, hammer, geometry):
        for name, value in zip(part._fields, part, strict=True):
            if np.ndim(value):
                raise ParameterError(f"{name}={short_repr(value)} must be one number; simulate one string at a time")
    check(dict(zip(String._fields, map(float, string), strict=True)), "string")
    check_hammer(hammer)
    check_geometry(geometry, quantity)
    check_range("rate=", rate, 1e3, 1e6, " Hz")


def check_geometry(geometry: Geometry, quantity: str) -> None:
    """Raise a `ParameterError` that names the field and its value if a geometry is impossible."""
    length, mass, at, width, pickup = map(float, geometry)
    if not 1e-3 <= length <= 100:
        raise ParameterError(f"length={length} m must be from 0.001 to 100")
    if not 1e-6 <= mass <= 10:
        raise ParameterError(f"mass={mass} kg must be from 1e-6 to 10")
    if not (width > 0 and at - width / 2 >= 0 and at + width / 2 <= length):
        raise ParameterError(f"strike={at} m with width={width} m must lie within the string, 0 to {length} m")
    if quantity in ON_STRING and not 0 < pickup < length:
        raise ParameterError(f"pickup={pickup} m must lie within the string, 0 to {length} m")
