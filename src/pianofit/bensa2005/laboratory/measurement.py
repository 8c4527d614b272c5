"""Synthetic measurements: one stroke with the noise of the vibrometer and the reading of the velocity sensor.

The synthetic recording of the demo is computed by `pianofit.model` instead: the paper's string and hammer with white
noise, with the contact computed at a far higher rate than in a fit.
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
    """Effects of the laboratory that the paper's model does not describe. `SyntheticMeasurement.ideal()` has none.

    Raises
    ------
    ParameterError
        If `felt` is not one of the felt laws.
    """

    polarisation: bool = True  # second polarisation
    bridge: bool = True  # compliant support
    felt: str = "memory"  # memory | hunt-crossley (the paper's) | power (elastic)
    noise_db: float | None = 60.0  # rms of the first second relative to the noise; None for no noise
    velocity_error: float = 0.02  # standard deviation of the sensor's reading, relative
    seconds: float = chosen.SECONDS  # length after the stroke, s
    contact_rate: float = chosen.CONTACT_RATE  # least number of contact steps per second, Hz
    eps: float = chosen.EPS  # of the relaxing felt
    tau: float = chosen.TAU  # s, of the relaxing felt

    def __post_init__(self):
        if self.felt not in FELTS:
            raise ParameterError(f"felt={self.felt!r} must be one of {', '.join(FELTS)}")

    @classmethod
    def ideal(cls, **switches) -> SyntheticMeasurement:
        """Return the paper's own model, with only the effects in `switches`."""
        none = {"polarisation": False, "bridge": False, "felt": "hunt-crossley", "noise_db": None, "velocity_error": 0}
        return cls(**(none | switches))


class Measurement(NamedTuple):
    """A synthetic recording with its true parameters."""

    samples: np.ndarray  # as in a file, full scale = 1: silence, then the note
    rate: int  # Hz
    scale: float  # m/s at full scale
    onset: int  # sample of the first contact
    nominal_velocity: float  # reading of the sensor, m/s
    true: dict[str, float]  # the nine parameters; no mu for a relaxing felt
    clean: np.ndarray  # `samples` without noise


def measure(lab: SyntheticMeasurement, velocity: float, seed: int = 0) -> Measurement:
    """Measure a stroke with the true hammer `velocity`, m/s. The same seed gives the same samples.

    Raises
    ------
    ParameterError
        For a velocity below the noise of the vibrometer or above its range.
    """
    if not chosen.SLOWEST <= velocity <= chosen.FASTEST:
        raise ParameterError(f"velocity={velocity!r} must be from {chosen.SLOWEST} to {chosen.FASTEST} m/s")
    body, stroke = stroke_of(lab, velocity)
    # Separate random streams: noise and sensor do not affect each other.
    noise, sensor = (np.random.default_rng([stream, seed]) for stream in range(2))
    sound = ring(body, stroke, chosen.RATE, round(lab.seconds * chosen.RATE))
    true = chosen.by_name(chosen.FINAL) | {"mu": felt_of(lab).mu, "v_H0": velocity}
    if lab.felt == "memory":
        del true["mu"]
    nominal = velocity * (1 + lab.velocity_error * sensor.normal())

    return _recorded(sound, chosen.SCALE, lab.noise_db, partial(_noise, noise), nominal, true)


def make_synthetic_recording(noise_db: float | None = 60.0, seed: int = 0) -> Measurement:
    """Return the synthetic recording of the demo, computed by `pianofit.model`. The same seed gives the same samples.

    Parameters
    ----------
    noise_db : rms of the first second after the stroke relative to the noise, dB; None for no noise.
    """
    from ...model import simulate  # imported here because it loads JAX

    final, rate = chosen.FINAL, chosen.RATE
    stroke = simulate(final.string, final.hammer, final.geometry, rate=rate, oversampling=chosen.DEMO_OVERSAMPLING)
    sound, noise = stroke.waveform(rate, int(chosen.SECONDS * rate)), np.random.default_rng(seed).standard_normal
    return _recorded(sound, chosen.DEMO_SCALE, noise_db, noise, float(final.hammer.v_H0), chosen.by_name(final))


def _recorded(
    sound: np.ndarray, scale: float, noise_db: float | None, noise: Callable[[int], np.ndarray], nominal: float,
    true: dict[str, float],
) -> Measurement:  # fmt: skip
    """Return a `sound`, m/s, after some silence and with `noise` (rms 1) at the level `noise_db`."""
    rate = chosen.RATE
    onset = round(chosen.LEAD * rate)
    samples = clean = np.pad(sound / scale, (onset, 0))
    if noise_db is not None:
        rms = math.sqrt(np.mean(clean[onset : onset + rate] ** 2))
        samples = clean + rms * 10 ** (-noise_db / 20) * noise(len(clean))
    return Measurement(samples, rate, scale, onset, nominal, true, clean)


def setup_text(scale: float = chosen.DEMO_SCALE, velocity: float | None = None, *, hold_velocity: bool = False) -> str:
    """Return the `setup.toml` of a measurement, by default of the demo: given values and the paper's initial values.

    Parameters
    ----------
    scale : m/s at digital full scale.
    velocity : reading of the sensor, m/s; the paper's initial value if None.
    hold_velocity : if True, the velocity is fixed, as in `pianofit` for a measured velocity. Otherwise it is the
        initial value of the fit, as in the paper.
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
    """Return the body and the stroke."""
    axes, resonators = make_axes(chosen.FINAL.string, lab.polarisation), chosen.RESONATORS if lab.bridge else ()
    body = make_body(axes, chosen.FINAL.geometry, chosen.MODES, resonators)
    oversampling = math.ceil(lab.contact_rate / chosen.RATE)
    return body, strike(body, felt_of(lab), chosen.FINAL.hammer.M_H, velocity, oversampling * chosen.RATE)


def felt_of(lab: SyntheticMeasurement) -> Felt:
    """Return the felt. A relaxing felt has the paper's stiffness for slow compressions."""
    hammer = chosen.FINAL.hammer
    if lab.felt == "memory":
        return Felt(hammer.K_H / (1 - lab.eps), hammer.p, eps=lab.eps, tau=lab.tau)
    return Felt(hammer.K_H, hammer.p, mu=hammer.mu if lab.felt == "hunt-crossley" else 0.0)


def _noise(random: np.random.Generator, samples: int) -> np.ndarray:
    """Noise with mean power 1: white, and 1/f below `CORNER`."""
    frequency = np.maximum(np.fft.rfftfreq(samples, 1 / chosen.RATE), chosen.FLOOR)
    shape = np.sqrt(1 + chosen.CORNER / frequency)
    shape[0] = 0.0  # a recorder removes the offset
    # Lines between 0 and half the sampling rate have a conjugate.
    both = np.full(frequency.size, 2.0)
    both[0], both[-1] = 1.0, 1.0 if samples % 2 == 0 else 2.0
    shape /= math.sqrt((both * shape**2).sum() / samples)
    return np.fft.irfft(np.fft.rfft(random.normal(size=samples)) * shape, samples)
