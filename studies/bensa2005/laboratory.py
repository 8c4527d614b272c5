"""Synthetic measurements with effects that the paper's model does not describe.

The recordings of Bensa et al. (2005) are not public. A fit of synthetic recordings of the same model always looks
perfect. This laboratory therefore adds effects to the paper's string and hammer, which have the final values of its
Tables II and III. Each effect can be switched off:

- `polarisation`: a second polarisation, 2 cents sharp and with a slower decay. The axes of the supports are turned by
  20° against the hammer, which couples the polarisations. This causes beating and decay in two stages.
- `bridge`: a compliant support at the end of the string, made of five damped resonators in both directions. Some
  partials decay faster and shift by fractions of a cent.
- `felt`: a relaxing felt (Stulov) in place of the paper's Hunt-Crossley law.
- `noise_db`: noise of the vibrometer, white with some 1/f below 100 Hz.
- `velocity_error`: a sensor that reads the hammer velocity with an error of a few per cent.

All values that the paper does not give are here and in `body`, each with its reason, or in the presets `bensa-final`
and `bensa-initial` of `pianofit.literature`. They are not measured: they are plausible, and large enough to have a
visible effect. Fits of these measurements show the errors that such effects cause. They do not show how accurate the
model is for a real string.

Method: `body` writes string, polarisations and bridge as one linear system with symmetric matrices and transforms it
into damped exponentials. `contact` steps hammer and felt against it at 1.4 MHz or more. Afterwards the exponentials
decay freely. The laboratory shares no code with `pianofit.model`, which has another scheme: with all effects off, each
is an independent check of the other. No step creates energy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pianofit.errors import ParameterError
from pianofit.literature import Preset, preset
from pianofit.setup import RecordingInfo, Setup

from .body import RESONATORS, Body, make_axes, make_body
from .contact import FELTS, Contact, Felt, ring, strike

__all__ = ["FINAL", "INITIAL", "RATE", "SCALE", "Measurement", "SyntheticMeasurement", "measure", "values_by_name"]

FINAL, INITIAL = preset("bensa-final"), preset("bensa-initial")
RATE = 44_100  # Hz, a common one; the paper names a digital tape
LEAD = 0.05  # s of silence before the note
# Velocity at digital full scale, m/s. The paper's velocities reach 2.3 m/s, with a peak of 3 m/s at the pickup.
SCALE = 5.0
# Range of hammer velocities, m/s, within the noise and the range of the vibrometer.
SLOWEST, FASTEST = 0.05, 3.5
# The paper does not give N. The contact window of 20 mm hardly drives modes beyond number 160. 256 modes change the
# signal by 2e-6 of its peak, as much as half the contact step at the default rate does.
MODES = 160
# Noise of the vibrometer: white, rising as 1/f below CORNER because of speckle and vibration of the building, and flat
# below FLOOR. The 1/f part has some 4 % of the power.
CORNER, FLOOR = 100.0, 10.0  # Hz


@dataclass(frozen=True)
class SyntheticMeasurement:
    """Effects of the laboratory that the paper's model does not describe. `SyntheticMeasurement.ideal()` has none.

    The relaxing felt (Stulov 1995): a slow compression has the force K (1 - ε) u^p, so K (1 - ε) is the paper's K_H.
    The loss is K_H α d(u^p)/dt with α = ετ/(1 - ε) = 20 µs. It equals the paper's μ at a compression of pα/μ = 0.26 mm,
    which is typical at the paper's velocities. (Stulov's own hammers have some ten times that, but they are not the
    paper's hammer.) τ is long enough to affect the ripple that reflections from the near end cause in the force: the
    stiffness is a third larger for sudden compressions.

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
    seconds: float = 3.0  # length after the stroke, s
    contact_rate: float = 1.4e6  # least number of contact steps per second, Hz
    eps: float = 0.25  # of the relaxing felt
    tau: float = 60e-6  # s, of the relaxing felt

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

    def setup(self, *, hold_velocity: bool = False) -> Setup:
        """Return the given values of the measurement, with the paper's initial values.

        The reading of the sensor is the initial value of the velocity, as in the paper. With `hold_velocity` it is the
        measured velocity of the recording, which a fit does not change.
        """
        g, initial, reading = FINAL.geometry, values_by_name(INITIAL), self.nominal_velocity
        recordings: tuple[RecordingInfo, ...] = ()
        if hold_velocity:
            del initial["v_H0"]
            recordings = (RecordingInfo(v_H0=reading),)
        else:
            initial["v_H0"] = reading
        return Setup(
            length=g.length,
            mass=g.mass,
            strike_position=g.strike_position,
            strike_width=g.width,
            pickup_quantity="velocity",
            pickup_position=g.pickup,
            pickup_scale=self.scale,
            initial=initial,
            recordings=recordings,
        )


def values_by_name(preset: Preset) -> dict[str, float]:
    """Return the nine parameters by name."""
    return {name: float(x) for name, x in {**preset.string._asdict(), **preset.hammer._asdict()}.items()}


def measure(lab: SyntheticMeasurement, velocity: float, seed: int = 0) -> Measurement:
    """Measure a stroke with the true hammer `velocity`, m/s. The same seed gives the same samples.

    Raises
    ------
    ParameterError
        For a velocity below the noise of the vibrometer or above its range.
    """
    if not SLOWEST <= velocity <= FASTEST:
        raise ParameterError(f"velocity={velocity!r} must be from {SLOWEST} to {FASTEST} m/s")
    # Separate random streams: noise and sensor do not affect each other.
    noise, sensor = (np.random.default_rng([stream, seed]) for stream in range(2))
    sound = ring(*stroke_of(lab, velocity), RATE, round(lab.seconds * RATE))
    onset = round(LEAD * RATE)
    samples = clean = np.pad(sound / SCALE, (onset, 0))
    if lab.noise_db is not None:
        rms = math.sqrt(np.mean(clean[onset : onset + RATE] ** 2))
        samples = clean + rms * 10 ** (-lab.noise_db / 20) * _noise(noise, len(clean))
    true = values_by_name(FINAL) | {"mu": felt_of(lab).mu, "v_H0": velocity}
    if lab.felt == "memory":
        del true["mu"]
    return Measurement(samples, RATE, SCALE, onset, velocity * (1 + lab.velocity_error * sensor.normal()), true, clean)


def stroke_of(lab: SyntheticMeasurement, velocity: float) -> tuple[Body, Contact]:
    """Return the body and its contact with the hammer."""
    axes, resonators = make_axes(FINAL.string, lab.polarisation), RESONATORS if lab.bridge else ()
    body = make_body(axes, FINAL.geometry, MODES, resonators)
    oversampling = math.ceil(lab.contact_rate / RATE)
    return body, strike(body, felt_of(lab), FINAL.hammer.M_H, velocity, oversampling * RATE)


def felt_of(lab: SyntheticMeasurement) -> Felt:
    """Return the felt. A relaxing felt has the paper's stiffness for slow compressions."""
    hammer = FINAL.hammer
    if lab.felt == "memory":
        return Felt(hammer.K_H / (1 - lab.eps), hammer.p, eps=lab.eps, tau=lab.tau)
    return Felt(hammer.K_H, hammer.p, mu=hammer.mu if lab.felt == "hunt-crossley" else 0.0)


def _noise(random: np.random.Generator, samples: int) -> np.ndarray:
    """Noise with mean power 1: white, and 1/f below `CORNER`."""
    frequency = np.maximum(np.fft.rfftfreq(samples, 1 / RATE), FLOOR)
    shape = np.sqrt(1 + CORNER / frequency)
    shape[0] = 0.0  # a recorder removes the offset
    # Lines between 0 and half the sampling rate have a conjugate.
    both = np.full(frequency.size, 2.0)
    both[0], both[-1] = 1.0, 1.0 if samples % 2 == 0 else 2.0
    shape /= math.sqrt((both * shape**2).sum() / samples)
    return np.fft.irfft(np.fft.rfft(random.normal(size=samples)) * shape, samples)
