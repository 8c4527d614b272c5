"""A measurement: one stroke, heard by the vibrometer, at a velocity that the sensor read a little wrong.

The demo's twin is one too, but struck by the program's own model: the paper's string and hammer with white noise, the
contact computed at a far higher rate than any fit uses.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from ...errors import ParameterError
from . import chosen
from .body import Body, make_axes, make_body
from .felt import FELTS, Felt
from .strike import Stroke, ring, strike

__all__ = [
    "SyntheticMeasurement",
    "Measurement",
    "felt_of",
    "make_synthetic_recording",
    "measure",
    "setup_text",
    "stroke_of",
]


@dataclass(frozen=True)
class SyntheticMeasurement:
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
    seconds: float = chosen.SECONDS  # after the stroke
    contact_rate: float = chosen.CONTACT_RATE  # steps per second of the contact, at least, Hz
    eps: float = chosen.EPS  # of the relaxing felt
    tau: float = chosen.TAU  # s, of the relaxing felt

    def __post_init__(self):
        if self.felt not in FELTS:
            raise ParameterError(f"felt={self.felt!r} must be one of {', '.join(FELTS)}")

    @classmethod
    def ideal(cls, **switches) -> SyntheticMeasurement:
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


def measure(lab: SyntheticMeasurement, velocity: float, seed: int = 0) -> Measurement:
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
    sound = ring(body, stroke, chosen.RATE, round(lab.seconds * chosen.RATE))
    true = chosen.by_name(chosen.FINAL) | {"mu": felt_of(lab).mu, "v_H0": velocity}
    if lab.felt == "memory":
        del true["mu"]
    nominal = velocity * (1 + lab.velocity_error * sensor.normal())

    return _recorded(sound, chosen.SCALE, lab.noise_db, partial(_noise, noise), nominal, true)


def make_synthetic_recording(noise_db: float | None = 60.0, seed: int = 0) -> Measurement:
    """The demo's measurement, by the model itself; the same seed gives the same samples.

    Parameters
    ----------
    noise_db : how far the noise's rms lies below that of the first second after the stroke; None for no noise.
    """
    from ...model import simulate  # by JAX, which the laboratory itself does without

    it, rate = chosen.FINAL, chosen.RATE
    stroke = simulate(it.string, it.hammer, it.geometry, rate=rate, oversampling=chosen.TWIN_OVERSAMPLING)
    sound, noise = stroke.waveform(rate, int(chosen.SECONDS * rate)), np.random.default_rng(seed).standard_normal
    return _recorded(sound, chosen.TWIN_SCALE, noise_db, noise, float(it.hammer.v_H0), chosen.by_name(it))


def _recorded(
    sound: np.ndarray, scale: float, noise_db: float | None, noise: Callable[[int], np.ndarray], nominal: float,
    true: dict[str, float],
) -> Measurement:  # fmt: skip
    """A `sound`, m/s, after some silence, with noise of rms 1 brought to its level."""
    rate = chosen.RATE
    onset = round(chosen.LEAD * rate)
    samples = clean = np.pad(sound / scale, (onset, 0))
    if noise_db is not None:
        rms = math.sqrt(np.mean(clean[onset : onset + rate] ** 2))
        samples = clean + rms * 10 ** (-noise_db / 20) * noise(len(clean))
    return Measurement(samples, rate, scale, onset, nominal, true, clean)


def setup_text(scale: float = chosen.TWIN_SCALE, velocity: float | None = None, *, hold_velocity: bool = False) -> str:
    """The `setup.toml` of a measurement, the demo's if nothing is said: what was known, and the paper's initial values.

    Parameters
    ----------
    scale : m/s at digital full scale.
    velocity : that the sensor read, m/s; the paper's initial value if None.
    hold_velocity : it is held fixed, as `pianofit` does with a measured one; otherwise it is where the fit starts, as
        in the paper.
    """
    g, values = chosen.FINAL.geometry, chosen.by_name(chosen.INITIAL) | ({} if velocity is None else {"v_H0": velocity})
    read = f"\n[[recording]]\nv_H0 = {values.pop('v_H0')!r}  # m/s, as the sensor read it\n" if hold_velocity else ""
    initial = "".join(f"{name} = {value!r}\n" for name, value in values.items())
    return f"""\
[string]
length = {g.length}
mass = {g.mass}

[strike]
position = {g.strike_position}
width = {g.width}

[pickup]
quantity = "velocity"
position = {g.pickup}
scale = {scale}  # m/s at full scale

[initial]  # Bensa et al. (2005), Tables II and III, initial values
{initial}{read}"""


def stroke_of(lab: SyntheticMeasurement, velocity: float) -> tuple[Body, Stroke]:
    """The body that is struck, and the stroke."""
    axes, resonators = make_axes(chosen.FINAL.string, lab.polarisation), chosen.RESONATORS if lab.bridge else ()
    body = make_body(axes, chosen.FINAL.geometry, chosen.MODES, resonators)
    every = math.ceil(lab.contact_rate / chosen.RATE)
    return body, strike(body, felt_of(lab), chosen.FINAL.hammer.M_H, velocity, every * chosen.RATE)


def felt_of(lab: SyntheticMeasurement) -> Felt:
    """The felt: of the paper's stiffness, with memory when slowly compressed."""
    hammer = chosen.FINAL.hammer
    if lab.felt == "memory":
        return Felt(hammer.K_H / (1 - lab.eps), hammer.p, eps=lab.eps, tau=lab.tau)
    return Felt(hammer.K_H, hammer.p, mu=hammer.mu if lab.felt == "hunt-crossley" else 0.0)


def _noise(random: np.random.Generator, samples: int) -> np.ndarray:
    """Noise of power 1 in the mean: white, and 1/f below `CORNER`."""
    frequency = np.maximum(np.fft.rfftfreq(samples, 1 / chosen.RATE), chosen.FLOOR)
    shape = np.sqrt(1 + chosen.CORNER / frequency)
    shape[0] = 0.0  # an offset would not survive the recorder
    # Lines between 0 and half of the rate stand for two each.
    both = np.full(frequency.size, 2.0)
    both[0], both[-1] = 1.0, 1.0 if samples % 2 == 0 else 2.0
    shape /= math.sqrt((both * shape**2).sum() / samples)
    return np.fft.irfft(np.fft.rfft(random.normal(size=samples)) * shape, samples)
