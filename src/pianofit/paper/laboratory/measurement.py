"""A measurement: one stroke, heard by the vibrometer, at a velocity that the sensor read a little wrong."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...errors import ParameterError
from .. import twin
from . import chosen
from .body import Body, make_axes, make_body
from .felt import FELTS, Felt
from .strike import Stroke, ring, strike

__all__ = ["Laboratory", "Measurement", "felt_of", "measure", "setup_text", "stroke_of"]


@dataclass(frozen=True)
class Laboratory:
    """What the laboratory has that the paper's model has not. `Laboratory.ideal()` has none of it.

    Raises
    ------
    ParameterError
        For a felt that it has not.
    """

    polarisation: bool = True  # a second one
    bridge: bool = True  # that gives way
    felt: str = "memory"  # memory | hunt-crossley (the paper's) | power (elastic)
    noise_db: float | None = 60.0  # rms of the first second over that of the noise; None for no noise
    velocity_error: float = 0.02  # standard deviation of what the sensor reads, relative
    seconds: float = twin.SECONDS  # after the stroke
    rate: int = twin.RATE  # Hz
    contact_rate: float = chosen.CONTACT_RATE  # steps per second of the contact, at least, Hz
    eps: float = chosen.EPS  # of the relaxing felt
    tau: float = chosen.TAU  # s, of the relaxing felt

    def __post_init__(self):
        if self.felt not in FELTS:
            raise ParameterError(f"felt={self.felt!r} must be one of {', '.join(FELTS)}")

    @classmethod
    def ideal(cls, **switches) -> Laboratory:
        """The paper's own model, but for the switches given."""
        none = {"polarisation": False, "bridge": False, "felt": "hunt-crossley", "noise_db": None, "velocity_error": 0}
        return cls(**(none | switches))


class Measurement(NamedTuple):
    """What was recorded, and what was behind it."""

    samples: np.ndarray  # as a file holds them, full scale = 1: silence, then the note
    rate: int  # Hz
    scale: float  # m/s at full scale
    onset: int  # sample of the first touch
    nominal_velocity: float  # what the sensor read, m/s
    true: dict[str, float]  # the nine parameters; no mu for a relaxing felt
    clean: np.ndarray  # `samples` without noise


def measure(lab: Laboratory, velocity: float, seed: int = 0) -> Measurement:
    """Strike with `velocity`, m/s, the true one; the same seed gives the same samples.

    Raises
    ------
    ParameterError
        For a velocity at which the vibrometer hears nothing, or leaves its range.
    """
    if not chosen.SLOWEST <= velocity <= chosen.FASTEST:
        raise ParameterError(f"velocity={velocity!r} must be from {chosen.SLOWEST} to {chosen.FASTEST} m/s")
    body, stroke = stroke_of(lab, velocity)
    # Streams of their own: switching one off leaves the other as it was.
    noise, sensor = (np.random.default_rng([stream, seed]) for stream in range(2))
    onset = round(twin.LEAD * lab.rate)
    samples = clean = np.pad(ring(body, stroke, lab.rate, round(lab.seconds * lab.rate)) / chosen.SCALE, (onset, 0))
    if lab.noise_db is not None:
        rms = math.sqrt(np.mean(clean[onset : onset + lab.rate] ** 2))
        samples = clean + rms * 10 ** (-lab.noise_db / 20) * _noise(len(clean), lab.rate, noise)
    nominal = velocity * (1 + lab.velocity_error * sensor.normal())
    values = chosen.FINAL.string._asdict() | chosen.FINAL.hammer._asdict() | {"v_H0": velocity}
    values |= {"mu": felt_of(lab).mu}
    true = {name: float(value) for name, value in values.items() if name != "mu" or lab.felt != "memory"}
    return Measurement(samples, lab.rate, chosen.SCALE, onset, nominal, true, clean)


def setup_text(measurement: Measurement, *, hold_velocity: bool = True) -> str:
    """The `setup.toml` of one measurement: what the laboratory knew, and the paper's initial values.

    `hold_velocity`: the velocity that the sensor read is held fixed, as `pianofit` does with a measured one; otherwise
    it is where the fit starts, as in the paper.
    """
    read = measurement.nominal_velocity
    if not hold_velocity:
        return twin.setup_text(measurement.scale, v_H0=read)
    held = f"\n[[recording]]\nv_H0 = {read!r}  # m/s, as the sensor read it\n"
    return twin.setup_text(measurement.scale, v_H0=None) + held


def stroke_of(lab: Laboratory, velocity: float) -> tuple[Body, Stroke]:
    """The body that is struck, and the stroke."""
    axes, resonators = make_axes(chosen.FINAL.string, lab.polarisation), chosen.RESONATORS if lab.bridge else ()
    body = make_body(axes, chosen.FINAL.geometry, chosen.MODES, resonators)
    every = math.ceil(lab.contact_rate / lab.rate)
    return body, strike(body, felt_of(lab), chosen.FINAL.hammer.M_H, velocity, every * lab.rate)


def felt_of(lab: Laboratory) -> Felt:
    """The felt: of the paper's stiffness, with memory when slowly compressed."""
    hammer = chosen.FINAL.hammer
    if lab.felt == "memory":
        return Felt(hammer.K_H / (1 - lab.eps), hammer.p, eps=lab.eps, tau=lab.tau)
    return Felt(hammer.K_H, hammer.p, mu=hammer.mu if lab.felt == "hunt-crossley" else 0.0)


def _noise(samples: int, rate: int, random: np.random.Generator) -> np.ndarray:
    """Noise of power 1 in the mean: white, and 1/f below `CORNER`."""
    frequency = np.maximum(np.fft.rfftfreq(samples, 1 / rate), chosen.FLOOR)
    shape = np.sqrt(1 + chosen.CORNER / frequency)
    shape[0] = 0.0  # an offset would not survive the recorder
    # Lines between 0 and half of the rate stand for two each.
    both = np.full(frequency.size, 2.0)
    both[0], both[-1] = 1.0, 1.0 if samples % 2 == 0 else 2.0
    shape /= math.sqrt((both * shape**2).sum() / samples)
    return np.fft.irfft(np.fft.rfft(random.normal(size=samples)) * shape, samples)
