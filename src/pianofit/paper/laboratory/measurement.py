"""A measurement: one stroke, heard by the vibrometer, at a velocity that the sensor read a little wrong."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...errors import ParameterError
from ...recording import RATES
from .. import twin
from . import chosen
from .body import Body, make_axes, make_body
from .felt import FELTS, Felt
from .strike import Stroke, ring, strike

__all__ = ["Laboratory", "Measurement", "stroke_of", "felt_of", "measure", "setup_text"]

# name -> lower, upper, unit.
LIMITS = {
    "velocity": (0.05, chosen.FASTEST, "m/s"),
    "noise_db": (-20.0, 200.0, "dB below the first second's rms, or None"),
    "velocity_error": (0.0, 0.2, "of the velocity"),
    "seconds": (0.1, 60.0, "s"),
    "rate": (*RATES, "Hz"),
    "contact_rate": (1e5, 2e7, "Hz"),
    "eps": (0.0, 0.99, "(1)"),
    "tau": (1e-7, 1e-1, "s"),
    "seed": (0, 2**32, "(1)"),
}


@dataclass(frozen=True)
class Laboratory:
    """What the laboratory has that the paper's model has not. `Laboratory.ideal()` has none of it.

    Raises
    ------
    ParameterError
        For a value outside its range.
    """

    polarisation: bool = True  # a second one
    bridge: bool = True  # that gives way
    felt: str = "memory"  # memory | hunt-crossley (the paper's) | power (elastic)
    noise_db: float | None = 60.0  # rms of the first second over that of the noise; None for no noise
    velocity_error: float = 0.02  # standard deviation of what the sensor reads, relative
    seconds: float = chosen.SECONDS  # after the stroke
    rate: int = chosen.RATE  # Hz
    contact_rate: float = chosen.CONTACT_RATE  # steps per second of the contact, at least, Hz
    eps: float = chosen.EPS  # of the relaxing felt
    tau: float = chosen.TAU  # s, of the relaxing felt

    def __post_init__(self):
        if self.felt not in FELTS:
            raise ParameterError(f"felt={self.felt!r} must be one of {', '.join(FELTS)}")
        for name in ("polarisation", "bridge"):
            if not isinstance(getattr(self, name), bool):
                raise ParameterError(f"{name}={getattr(self, name)!r} must be True or False")
        for name in ("velocity_error", "seconds", "contact_rate", "eps", "tau"):
            within(name, getattr(self, name))
        within("rate", self.rate, whole=True)
        if self.noise_db is not None:
            within("noise_db", self.noise_db)

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
    true: dict[str, float]  # the nine parameters (no mu for a relaxing felt), and those of what the model leaves out
    clean: np.ndarray  # `samples` without noise
    force: np.ndarray  # of the felt, N [steps], constant over each step from the first touch on
    force_rate: float  # Hz


def measure(lab: Laboratory, velocity: float, seed: int = 0) -> Measurement:
    """Strike with `velocity`, m/s, the true one; the same seed gives the same samples.

    Raises
    ------
    ParameterError
        For a velocity or a seed outside its range.
    """
    velocity, seed = within("velocity", velocity), int(within("seed", seed, whole=True))
    body, stroke = stroke_of(lab, velocity)
    onset = round(chosen.LEAD * lab.rate)
    clean = np.pad(ring(body, stroke, lab.rate, round(lab.seconds * lab.rate)) / chosen.SCALE, (onset, 0))
    samples = clean
    if lab.noise_db is not None:
        rms = math.sqrt(np.mean(clean[onset : onset + lab.rate] ** 2))
        samples = clean + rms * 10 ** (-lab.noise_db / 20) * _noise(len(clean), lab.rate, _random(seed, "noise"))
    nominal = velocity * (1 + lab.velocity_error * _random(seed, "velocity").normal())
    true = _truth(lab, velocity)
    return Measurement(samples, lab.rate, chosen.SCALE, onset, nominal, true, clean, stroke.force, 1 / stroke.step)


def setup_text(measurement: Measurement, *, hold_velocity: bool = True) -> str:
    """The `setup.toml` of one measurement: what the laboratory knew, and the paper's initial values.

    Parameters
    ----------
    hold_velocity : the velocity that the sensor read is held fixed, as `pianofit` does with a measured one; otherwise
        it is where the fit starts, as in the paper.
    """
    read = measurement.nominal_velocity
    if not hold_velocity:
        return twin.setup_text(measurement.scale, v_H0=read)
    return (
        twin.setup_text(measurement.scale, v_H0=None) + f"\n[[take]]\nv_H0 = {read!r}  # m/s, as the sensor read it\n"
    )


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


def _truth(lab: Laboratory, velocity: float) -> dict[str, float]:
    true = chosen.FINAL.string._asdict() | chosen.FINAL.hammer._asdict() | {"v_H0": velocity}
    if lab.felt == "power":
        true["mu"] = 0.0
    if lab.felt == "memory":
        del true["mu"]
        true |= {"felt.eps": lab.eps, "felt.tau": lab.tau}
    if lab.polarisation:
        true |= {
            "polarisation.angle": chosen.ANGLE,
            "polarisation.cents": chosen.CENTS,
            "polarisation.slower": chosen.SLOWER,
        }
    if lab.bridge:
        for n, resonator in enumerate(chosen.RESONATORS, 1):
            true |= {f"bridge.{n}.{name}": value for name, value in resonator._asdict().items()}
    return {name: float(value) for name, value in true.items()}


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


def _random(seed: int, purpose: str) -> np.random.Generator:
    """A stream of its own for each purpose: switching one off leaves the other as it was."""
    return np.random.default_rng([("noise", "velocity").index(purpose), seed])


def within(name: str, value: object, whole: bool = False) -> float:
    """`value`, if it is a number (a whole one) within its limits; an error that names it, if not."""
    low, high, unit = LIMITS[name]
    kinds = (int, np.integer) if whole else (int, float, np.integer, np.floating)
    if isinstance(value, bool) or not isinstance(value, kinds) or not low <= float(value) <= high:
        number = "a whole number" if whole else "a number"
        raise ParameterError(f"{name}={value!r} must be {number} from {low:g} to {high:g} {unit}".removesuffix(" (1)"))
    return float(value)
