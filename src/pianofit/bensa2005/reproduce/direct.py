"""The direct problem (paper III.C, Figures 2 to 4): a C4 struck at three velocities.

The paper takes "the hammer parameters and the striking positions" of Chaigne and Askenfelt. It gives two velocities, 2
and 4 m/s, and no losses. The losses are those of the preset `chaigne-askenfelt-C4`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import brentq
from scipy.signal import find_peaks

from ...literature import preset
from ...model import Simulation, simulate
from ...report.figures import spectrum_db
from .strokes import centroid

__all__ = ["NOTE", "ROUND_TRIP", "VELOCITIES", "Strike", "mass_for_contact", "strike"]

NOTE = preset("chaigne-askenfelt-C4")
# Travel time of a wave from the hammer to the agraffe and back, 2 x0/c, s.
ROUND_TRIP = float(2 * NOTE.geometry.strike_position / NOTE.string.c)
VELOCITIES = (1.0, 2.0, 4.0)  # m/s, soft to hard; the paper names the last two
RATE = 44_100  # Hz
OVERSAMPLING = 16
SECONDS = 1.0
# A reflection is visible if the force dips by this share of its maximum.
VISIBLE = 0.01
# Highest frequency of the spectra, Hz.
SHOWN = 6000.0


class Strike(NamedTuple):
    """One stroke. Arrays of the contact are [steps], of the spectrum [bins]."""

    velocity: float  # m/s
    time: np.ndarray  # s
    force: np.ndarray  # N
    compression: np.ndarray  # m
    contact: float  # s
    maxima: np.ndarray  # times of visible maxima of the force, s
    loop: float  # ∮ F du, J
    balance: float  # energy of the hammer before, minus that after and the work done on the string, J
    hammer_energy: float  # before the contact, J
    frequency: np.ndarray  # Hz
    level: np.ndarray  # dB of (m/s) s
    centroid: float  # Hz


def mass_for_contact(contact: float, velocity: float) -> float:
    """Return the hammer mass, kg, for a contact of `contact`, s, with all other values unchanged."""
    mass = float(NOTE.hammer.M_H)
    root: Any = brentq(lambda m: _simulate(velocity, m).contact_time - contact, 0.2 * mass, 5.0 * mass, xtol=1e-9)
    return float(root)


def _simulate(velocity: float, mass: float) -> Simulation:
    hammer = NOTE.hammer._replace(v_H0=velocity, M_H=mass)
    return simulate(NOTE.string, hammer, NOTE.geometry, rate=RATE, oversampling=OVERSAMPLING)


def strike(velocity: float) -> Strike:
    """Compute the note at a velocity, m/s."""
    mass = float(NOTE.hammer.M_H)
    simulation = _simulate(velocity, mass)
    step, pulse = float(simulation.modes.step), simulation.pulse
    force, gap, speed = (np.asarray(x) for x in (pulse.force, pulse.compression, pulse.hammer[:, 1]))
    shown = slice(0, int(1.1 * simulation.last_touch / step) + 2)
    before, after = 0.5 * mass * velocity**2, 0.5 * mass * float(speed[-1]) ** 2
    sound = simulation.waveform(RATE, int(SECONDS * RATE))
    frequency, level = spectrum_db(sound, RATE, SHOWN)
    return Strike(
        velocity=velocity, time=step * np.arange(len(force))[shown], force=force[shown], compression=gap[shown],
        contact=simulation.contact_time, maxima=step * find_peaks(force, prominence=VISIBLE * force.max())[0],
        loop=float(0.5 * ((force[1:] + force[:-1]) * np.diff(gap)).sum()),
        balance=before - after - float(pulse.work), hammer_energy=before,
        frequency=frequency, level=level, centroid=centroid(sound, RATE, float(NOTE.f0)),
    )  # fmt: skip
