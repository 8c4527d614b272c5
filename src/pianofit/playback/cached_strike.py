"""A stroke on a string that may still move, with few compiled programs, which are kept on disk.

The time steps are those of `model.simulate`, which compiles a new program for every number of modes. Here the mode
tables are padded to powers of two; rows above the highest mode have weight zero. A string at rest is a moving string
with zero state, so that both use one program.
"""

from typing import Any, NamedTuple

import numpy as np

from ..dsp.damped_sums import AMPLITUDE_FLOOR
from ..errors import FitError, ParameterError
from ..felt import is_builtin, law_of
from ..model.contact import impulse_amplitude, strike_moving_string
from ..model.differentiable_sums import BLOCK, real_powers
from ..model.modal_response import ForcePulse, release_pulse, trim_trailing_zeros
from ..model.modes import MAX_RELATIVE_FREQUENCY, Modes, mode_table
from ..model.note import Note
from ..model.output_path import impulse_response, sample_at_modes
from ..model.program_cache import persistent_jit
from ..model.simulate import MAX_STEPS, contact_rate, count_modes

LEAST_MODES = 64
# First size of the step buffer, enough for nearly all contacts; later sizes grow up to `MAX_STEPS`.
FIRST_STEPS = 4096


class StringTables(NamedTuple):
    """Tables of one string, as NumPy arrays [modes]."""

    modes: Modes
    powers: tuple[np.ndarray, np.ndarray]  # powers of the poles for the steps of a block, see `model.contact`
    rate: float  # of the contact, Hz
    unit: np.ndarray  # complex: amplitude that a unit T, or the release of 1 N, leaves, m/N, in physical displacement
    drive: np.ndarray  # complex: the same in file units, before the output path
    pickup: np.ndarray  # complex: signal = Re(pickup · a) before the output path, for a displacement q = Re(a)
    per_impulse: np.ndarray  # complex: amplitude after a unit impulse of the `ForcePulse`, file units before the path
    faint: np.ndarray  # largest |pickup · a| that is inaudible behind the output path, file units: -160 dB
    path: np.ndarray | None  # impulse response of the output path at the signal rate [samples]


@persistent_jit
def _table(string, geometry, rate, cfg):
    n_modes, quantity = cfg
    modes = mode_table(string, geometry, rate=rate, n_modes=n_modes, quantity=quantity)
    return (*modes, *real_powers(modes.pole * modes.step, BLOCK + 1, 1), impulse_amplitude(modes))


@persistent_jit
def _stroke(modes, hammer, displacement, velocity, powers, cfg):
    (steps,) = cfg
    return strike_moving_string(modes, hammer, displacement, velocity, powers, steps)


def string_tables(note: Note, rate: float) -> StringTables:
    """Tables of the string of `note` for signals at `rate`, Hz, with its gain and output path."""
    contact = contact_rate(note.string, note.geometry, rate)
    rows = LEAST_MODES
    while rows < count_modes(note.string, note.geometry, contact):
        rows *= 2
    string, geometry = (type(x)(*map(np.float64, x)) for x in (note.string, note.geometry))
    columns: list[Any]
    *columns, re, im, unit = (
        np.asarray(x) for x in _table(string, geometry, np.float64(contact), (rows, note.quantity))
    )
    modes = Modes(*columns)
    pole = np.asarray(modes.pole)
    size, omega = np.abs(pole), np.imag(pole)
    path = sample_at_modes(note.path, pole)
    # Ratio of physical to numerical displacement, see `modes`.
    angle = np.minimum(0.5 * size / contact, MAX_RELATIVE_FREQUENCY * np.pi)
    warp = angle / (np.sin(angle) * np.cos(angle))
    gain = np.where(omega < np.pi * rate, note.gain, 0.0)
    pickup = gain * modes.free_pickup
    unit, drive = unit * warp, gain * modes.pickup * unit
    per_impulse = 2 * contact * drive  # a step of force F lasts 1/contact and has T = 2 F
    if not (law := law_of(note.hammer)).has_contact:
        unit = law.displacement(modes, note.with_size(1.0).hammer) * (
            1 + 1j * np.real(modes.free_rate) / np.imag(modes.free_rate)
        )
        drive = per_impulse = pickup * unit
    faint = np.full(len(pole), AMPLITUDE_FLOOR) if path is None else AMPLITUDE_FLOOR * 10 ** (-path.db / 20)
    return StringTables(
        modes,
        (re, im),
        contact,
        unit,
        drive,
        pickup,
        per_impulse,
        faint,
        impulse_response(path, rate),
    )


def strike_string(
    table: StringTables, hammer: Any, where: str, state: np.ndarray | None = None
) -> tuple[np.ndarray, ForcePulse]:
    """Strike a string that moves as q = Re(state · exp(p t)), state complex [modes]; return T [steps] and the force.

    Without a `state` the string is at rest. A pluck has the T of one step that leaves its static displacement.

    Raises `FitError`, which names `where`, if the hammer stays on the string. Raises `ParameterError` for a felt law
    that is not built in.
    """
    if not is_builtin(law := law_of(hammer)):  # its code may change between runs, but compiled programs are kept
        raise ParameterError(f"{where}: felt law {law.name} cannot be played; use Note.render, or a built-in law")
    if not law.has_contact:
        size = float(getattr(hammer, law.size))
        return np.array([size]), release_pulse(size, 1 / table.rate)
    hammer = type(hammer)(*map(np.float64, hammer))
    pole = np.asarray(table.modes.pole)
    state = np.zeros_like(pole) if state is None else state
    velocity = np.real(pole * state)
    steps = FIRST_STEPS
    while steps <= MAX_STEPS:
        drive, newton, has_ended = _stroke(table.modes, hammer, np.real(state), velocity, table.powers, (steps,))
        if bool(has_ended):
            force = ForcePulse(trim_trailing_zeros(np.asarray(newton)), 1 / table.rate, float(hammer.v_H0))
            return trim_trailing_zeros(np.asarray(drive)), force
        steps *= 16
    raise FitError(
        f"{where}: at v_H0={float(hammer.v_H0):g} m/s the hammer is still on the string after "
        f"{MAX_STEPS / table.rate:.3g} s; check this key's M_H and K_H"
    )
