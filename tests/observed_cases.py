"""Analyses written by hand, and analyses without errors of the model's own string."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pianofit.analysis import Analysis, Partials
from pianofit.inference import starting_values
from pianofit.model import simulate
from pianofit.model.free_response import level_db, modal_amplitudes
from pianofit.model.note import arrival
from pianofit.parameters import Geometry, Hammer, String
from pianofit.recording.recording import Recording, recording_from_samples
from pianofit.setup import Setup

F0, B, B1, D2 = 262.0, 4e-4, 0.5, 0.01


def frequency(number: np.ndarray, f0: float = F0) -> np.ndarray:
    """Of the string under the tension of this `f0`: f² = (k f0)² + F0² B k⁴."""
    return number * np.hypot(f0, F0 * np.sqrt(B) * np.asarray(number, float))


def analysis(
    number, level, *, f0: float = F0, absent=(), bound=(), level_error: float = 0.1, systematic: float = 0.0,
    glide_start: float = 0.0,
) -> Analysis:  # fmt: skip
    """Partials `number` with `level` dB; frequencies and decays follow the string model with small errors."""
    number, size = np.array(number), len(number)
    f = frequency(number, f0)
    partials = Partials(
        number=number, frequency=f, frequency_error=1e-4 * f, frequency_systematic=np.zeros((size, size)),
        decay=B1 + D2 * number**2.0, decay_error=0.01 * (B1 + D2 * number**2.0),
        decay_systematic=np.zeros((size, size)),
        late_decay=np.full(size, np.nan), late_decay_error=np.full(size, np.nan),
        slope_times=np.full((size, 3), np.nan),
        level=np.array(level, float), level_error=np.full(size, level_error),
        level_systematic=systematic**2 * np.ones((size, size)), level_decay_sensitivity_s=np.full(size, 0.1),
        snr=np.full(size, 40.0), beating=np.zeros(size),
        absent=np.array(absent, int), absent_bound=np.array(bound, float),
    )  # fmt: skip
    return Analysis(
        f0=f0, f0_error=1e-3, B=B * (F0 / f0) ** 2, B_error=1e-6, b1=B1, b1_error=0.01, d2=D2, d2_error=1e-4,
        partials=partials,
        scatter_cents=0.0, scatter_decay=0.0, glide_cents=0.0, glide=(), noise_density=np.full(size, 1e-12), note=None,
        warnings=(), glide_start=glide_start,
    )  # fmt: skip


# Given values of a fit of a microphone's recordings.
PRESSURE = starting_values(analysis([1, 2], [0.0, -10.0]), Setup())
STRING = String(c=330.0, kappa=1.3, b1=0.6, b2=5e-5)
HAMMER = Hammer(K_H=3e10, mu=0.3, p=2.7, M_H=5e-3, v_H0=2.2)
GEOMETRY = Geometry(length=0.63, mass=4e-3, strike_position=0.0771, width=0.014, pickup=0.1973)
SCALE = 4.0  # m/s at full scale


def played(
    velocity: float = HAMMER.v_H0, *, count: int = 18, quantity: str = "velocity", path_db: np.ndarray | None = None
) -> Analysis:
    """Analysis without errors of the model's own string, from a contact with fine steps."""
    hammer = HAMMER._replace(v_H0=velocity)
    sound = simulate(STRING, hammer, GEOMETRY, rate=88_200, oversampling=16, quantity=quantity, n_modes=128)
    pole = np.asarray(sound.modes.pole)
    delay = arrival(STRING, GEOMETRY, quantity)
    amplitude = np.asarray(modal_amplitudes(sound.modes, sound.pulse.drive)) * np.exp(pole.real * delay)
    level = np.asarray(level_db(amplitude, -pole.real, np))[:count]
    number = np.arange(1, count + 1)
    f, decay = np.abs(pole.imag[:count]) / (2 * np.pi), -pole.real[:count]
    unit = 20 * np.log10(SCALE) if path_db is None else -path_db
    one = analysis(number, level - unit, level_error=0.01)
    s = np.pi / GEOMETRY.length
    partials = replace(one.partials, frequency=f, decay=decay, frequency_error=1e-6 * f, decay_error=1e-3 * decay)
    # Its string model deviates a little, as in a real analysis.
    return replace(
        one, f0=STRING.c / (2 * GEOMETRY.length) * (1 + 1e-5), B=1.03 * (STRING.kappa * s / STRING.c) ** 2,
        b1=1.1 * STRING.b1, d2=0.9 * STRING.b2 * s**2, partials=partials,
    )  # fmt: skip


def setup(**more) -> Setup:
    """The given values."""
    g = GEOMETRY
    data = {
        "string": {"length": g.length, "mass": g.mass}, "strike": {"position": g.strike_position, "width": g.width},
        "pickup": {"quantity": "velocity", "position": g.pickup, "scale": SCALE}, "felt": {"law": "hunt-crossley"},
    }  # fmt: skip
    return Setup.from_dict(data | more, "here")


def tone(seed: int = 0, name: str = "tone") -> Recording:
    """A recording of which only the name, the rate and the distinct content are used."""
    t = np.arange(44_100) / 44_100
    sound = np.where(t > 0.05, np.exp(-5 * t) * np.sin(1600 * t), 0.0)
    samples = 0.5 * sound + np.random.default_rng(seed).normal(0.0, 1e-4, t.size)
    return recording_from_samples(samples, 44_100, name=name)
