"""A stroke on a string that may still move, for playing: tables and contacts whose compiled programs are few and kept.

The same steps as `model.simulate`, which traces anew for every number of modes. Here the tables are padded to powers
of two (rows above the highest mode weigh nothing), a string at rest is a string that moves by zero, and the traced
programs stay on disk.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ..errors import FitError, ParameterError
from ..felt import RelaxingHammer, is_builtin, law_of
from ..model.contact import impulse_amplitude, strike_moving_string
from ..model.damped_sums import BLOCK, real_powers
from ..model.modal_response import FAINT, ForcePulse, until_last
from ..model.modes import HIGHEST, Modes, mode_table
from ..model.note import Note
from ..model.output_path import apply_to_modes, impulse
from ..model.program_cache import persistent_jit
from ..model.simulate import MOST_STEPS, contact_rate, count_modes
from ..parameters import Hammer

__all__ = ["StringTables", "stroke", "table_of"]

LEAST_MODES = 64
# Steps of a contact that programs have room for: of nearly all, and `MOST_STEPS`.
FIRST_STEPS = 4096


class StringTables(NamedTuple):
    """One string's table, as NumPy arrays [modes]."""

    modes: Modes
    powers: tuple[np.ndarray, np.ndarray]  # of the modes, for the steps of a block, see `model.contact.follow`
    pole: np.ndarray  # complex, 1/s: as it rings by itself, each partial at its own decay
    rate: float  # of the contact, Hz
    unit: np.ndarray  # complex: what a unit T leaves ringing, m/N, in the string's own displacement
    drive: np.ndarray  # complex: the same in file units, before the path
    pickup: np.ndarray  # complex: signal = Re(pickup · a) before the path, for a displacement q = Re(a)
    faint: np.ndarray  # |pickup · a| of a mode that is not heard behind the path, file units: -160 dB
    path: np.ndarray | None  # [samples] at the signals' rate: what the signal goes through, see `path.impulse`


@persistent_jit
def _table(string, geometry, rate, cfg):
    n_modes, quantity = cfg
    modes = mode_table(string, geometry, rate=rate, n_modes=n_modes, quantity=quantity)
    return (*modes, *real_powers(modes.pole * modes.step, BLOCK + 1, 1), impulse_amplitude(modes))


@persistent_jit
def _stroke(modes, hammer, displacement, velocity, powers, cfg):
    (steps,) = cfg
    return strike_moving_string(modes, hammer, displacement, velocity, powers, steps)


def table_of(note: Note, rate: float) -> StringTables:
    """The table of a string for signals at `rate`, with the gain, and the path's response."""
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
    own = np.asarray(modes.pole)
    size, turn = np.abs(own), np.imag(own)
    path, pole = apply_to_modes(note.path, own)
    # The scheme's displacement is the string's own up to this factor, see `modes`.
    angle = np.minimum(0.5 * size / contact, HIGHEST * np.pi)
    warp = angle / (np.sin(angle) * np.cos(angle))
    below = turn < np.pi * rate
    gain = np.where(below, note.gain, 0.0)
    pickup = gain * modes.free_pickup
    faint = np.full(len(own), FAINT) if path is None else FAINT * 10 ** (-path.db / 20)
    return StringTables(
        modes, (re, im), pole, contact, unit * warp, gain * modes.pickup * unit, pickup, faint, impulse(path, rate)
    )


def stroke(
    table: StringTables, hammer: Hammer | RelaxingHammer, state: np.ndarray, where: str
) -> tuple[np.ndarray, ForcePulse]:
    """What a hammer gives a string that moves as q = Re(state · exp(p t)), complex [modes]: T [steps], and the force.

    Raises `FitError`, naming `where` if the hammer stays on the string; `ParameterError` for a hammer whose felt is not
    one of the package's own.
    """
    if not is_builtin(law := law_of(hammer)):  # its code may change between runs, and the programs of playing are kept
        raise ParameterError(f"{where}: felt law {law.name} cannot be played; use Note.render, or one of the package's")
    hammer = type(hammer)(*map(np.float64, hammer))
    velocity = np.real(np.asarray(table.modes.pole) * state)
    steps = FIRST_STEPS
    while steps <= MOST_STEPS:
        drive, newton, over = _stroke(table.modes, hammer, np.real(state), velocity, table.powers, (steps,))
        if bool(over):
            force = ForcePulse(until_last(np.asarray(newton)), 1 / table.rate, float(hammer.v_H0))
            return until_last(np.asarray(drive)), force
        steps *= 16
    raise FitError(
        f"{where}: at v_H0={float(hammer.v_H0):g} m/s the hammer is still on the string after "
        f"{MOST_STEPS / table.rate:.3g} s; check this key's M_H and K_H"
    )
