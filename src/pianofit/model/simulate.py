"""One strike from start to end: choose the contact's rate and length, strike, and keep what is needed to hear it."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..errors import FitError, ParameterError, check_range
from ..felt import check_hammer
from ..io.number_format import summary
from ..parameters import Geometry, String, check
from .contact import FreeMotion, Pulse, free_motion, strike
from .free_response import waveform
from .modes import HIGHEST, QUANTITIES, Modes, mode_frequencies, mode_table, raised_cosine_weights
from .x64 import float64

__all__ = ["Contact", "Simulation", "contact_rate", "count_modes", "simulate"]

# Second-order accuracy in the step: at this rate ordinary notes are within 1e-3 of the converged solution.
LOWEST_RATE = 88_000.0
HIGHEST_RATE = 6_000_000.0
# Design §2: at least this many modes, or all with a strike weight above -60 dB, lie below 0.4 of the rate.
ENOUGH_MODES = 30
FAINT = 1e-3
MOST_MODES = 512
# Longer contacts start over with four times the steps.
FIRST_STEPS, MOST_STEPS = 1024, 2**16


class Contact(NamedTuple):
    """One time that the hammer pressed the string."""

    start: float  # s from the first touch
    stop: float  # s from the first touch
    force: float  # the largest, N

    def document(self) -> dict[str, float]:
        """Start and duration, ms, and force, N, as `fit.json` holds them."""
        return {
            "start_ms": 1e3 * self.start, "duration_ms": 1e3 * (self.stop - self.start), "max_force_N": self.force,
        }  # fmt: skip


class Simulation(NamedTuple):
    """A strike that is over: the table it was made with and the pulse, as arrays of NumPy."""

    modes: Modes
    pulse: Pulse
    free: FreeMotion | None

    def __repr__(self) -> str:
        return summary(self, lines=True)

    def waveform(self, rate: float, samples: int) -> np.ndarray:
        """The signal [samples] from the first touch on; see `waveform`."""
        return np.asarray(waveform(self.modes, self.pulse.drive, rate=rate, samples=samples, free=self.free))

    @property
    def contacts(self) -> tuple[Contact, ...]:
        """Every time the hammer pressed the string, in order.

        A contact is a time in which the felt stays compressed; within it the force may fall to 0 where the felt's loss
        takes all of it. It ends with its last force.
        """
        force, step = np.asarray(self.pulse.force), float(self.modes.step)
        pressed = np.concatenate([[False], np.asarray(self.pulse.compression) > 0, [False]])
        edges = np.flatnonzero(np.diff(pressed.astype(int)))
        found = []
        for start, stop in zip(edges[::2], edges[1::2], strict=True):
            acts = start + np.flatnonzero(force[start:stop] > 0)
            if acts.size:
                found.append(Contact(acts[0] * step, (acts[-1] + 1) * step, float(force[start:stop].max())))
        return tuple(found)

    @property
    def contact_time(self) -> float:
        """How long the first contact lasts, s."""
        return self.contacts[0].stop if self.contacts else 0.0

    @property
    def last_touch(self) -> float:
        """When the last contact ends, s from the first touch."""
        return self.contacts[-1].stop if self.contacts else 0.0


def contact_rate(string: String, geometry: Geometry, rate: float) -> float:
    """A whole multiple of `rate`, Hz, at which enough of this string's modes can be kept.

    Raises
    ------
    ParameterError
        If the string is too short or too stiff for any sensible rate.
    """
    n = MOST_MODES
    frequencies = mode_frequencies(string, geometry.length, n)
    strong = np.flatnonzero(np.abs(raised_cosine_weights(geometry, n, np)) > FAINT)
    needed = min(ENOUGH_MODES, strong[-1] + 1 if strong.size else ENOUGH_MODES)
    wanted = max(LOWEST_RATE, 1.01 * frequencies[needed - 1] / HIGHEST)
    if wanted > HIGHEST_RATE:
        raise ParameterError(
            f"c={float(string.c):g} m/s and kappa={float(string.kappa):g} m²/s on {float(geometry.length):g} m put "
            f"partial {needed} at {frequencies[needed - 1]:.3g} Hz; use a slower, less stiff or longer string"
        )
    return rate * int(np.ceil(wanted / rate))


def count_modes(string: String, geometry: Geometry, rate: float) -> int:
    """Rows for the table: all modes below 0.4 of the contact's rate, in whole 64s so that programs are shared."""
    frequencies = mode_frequencies(string, geometry.length, MOST_MODES)
    below = int((frequencies < HIGHEST * rate).sum())
    return min(MOST_MODES, 64 * -(-below // 64))


@partial(jax.jit, static_argnames=("n_modes", "steps", "quantity", "kind"))
def _strike(string, hammer, geometry, rate, weights, start, *, n_modes, steps, quantity, kind):
    modes = mode_table(
        string, geometry, rate=rate, n_modes=n_modes, quantity=quantity, kind=kind, strike_weights=weights
    )
    free = None if start is None else free_motion(modes, start[0], start[1])
    return modes, strike(modes, hammer, steps=steps, free=free), free


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
    """Strike the string and follow the hammer until it provably cannot touch it again.

    Parameters
    ----------
    string, geometry : in SI units.
    hammer : a `Hammer`, a `RelaxingHammer`, or a hammer of a `FeltLaw`.
    rate : of the signal, Hz.
    oversampling : the contact's rate over that of the signal; as high as the string needs if None.
    quantity, kind, strike_weights : see `mode_table`; `finite_difference` needs `n_modes`, the paper's N.
    n_modes : rows of the table; as many as matter if None.
    displacement, velocity : modal coordinates [modes] of the string at t = 0, m and m/s, by `pianofit.model.project`;
        at rest by default.

    Returns
    -------
    A `Simulation`: the table of modes [modes] and the pulse [steps], SI units; its `waveform` is the signal.

    Raises
    ------
    ParameterError
        For values outside their range.
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
    check(dict(zip(String._fields, map(float, string), strict=True)), "string")
    check_hammer(hammer)
    check_geometry(geometry, quantity)
    check_range("rate=", rate, 1e3, 1e6, " Hz")
    if kind == "finite_difference" and strike_weights is None and n_modes:
        spacing = float(geometry.length) / (n_modes + 1)
        if (
            np.min(np.abs(spacing * np.arange(1, n_modes + 1) - float(geometry.strike_position)))
            >= float(geometry.width) / 2
        ):
            raise ParameterError(f"width={float(geometry.width)} m: none of the {n_modes} grid points lies under it")
    # One kind of number, whatever the caller had: JAX compiles anew for every other.
    string, hammer = String(*map(np.float64, string)), type(hammer)(*map(np.float64, hammer))
    geometry = Geometry(*map(np.float64, geometry))
    contact = np.float64(rate * oversampling if oversampling else contact_rate(string, geometry, rate))
    rows = n_modes or count_modes(string, geometry, contact)
    start = None
    if displacement is not None or velocity is not None:
        start = tuple(jnp.zeros(rows) if x is None else jnp.asarray(x) for x in (displacement, velocity))
    steps = FIRST_STEPS
    while steps <= MOST_STEPS:
        modes, pulse, free = _strike(
            string, hammer, geometry, contact, strike_weights, start,
            n_modes=rows, steps=steps, quantity=quantity, kind=kind,
        )  # fmt: skip
        if bool(pulse.over):
            return Simulation(*jax.tree.map(np.asarray, (modes, pulse, free)))
        steps *= 4
    raise FitError(
        f"v_H0={float(hammer.v_H0):g} m/s, M_H={float(hammer.M_H):g} kg: the hammer is still on the string after "
        f"{MOST_STEPS / contact:.3g} s; use a lighter or faster hammer"
    )


def check_geometry(geometry: Geometry, quantity: str) -> None:
    """Refuse a geometry that is no string.

    Raises
    ------
    ParameterError
        Naming the field and its value.
    """
    length, mass, at, width, pickup = map(float, geometry)
    if not 1e-3 <= length <= 100:
        raise ParameterError(f"length={length} m must be from 0.001 to 100")
    if not 1e-6 <= mass <= 10:
        raise ParameterError(f"mass={mass} kg must be from 1e-6 to 10")
    if not (width > 0 and at - width / 2 >= 0 and at + width / 2 <= length):
        raise ParameterError(f"strike={at} m with width={width} m must lie within the string, 0 to {length} m")
    if quantity in QUANTITIES[:2] and not 0 < pickup < length:
        raise ParameterError(f"pickup={pickup} m must lie within the string, 0 to {length} m")
