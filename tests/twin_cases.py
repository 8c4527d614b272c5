"""Twins for the tests of the fit: made by brute force, with another window, rate and step than the fit uses."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from brute_force import make_twin, matched_width
from pianofit.fit import Result, fit_recording

from pianofit.analysis import analyse
from pianofit.parameters import FIT_NAMES, Geometry, Hammer, String
from pianofit.recording import Recording, recording_from_samples
from pianofit.setup_file import Setup, setup_from_dict

RATE = 48_000
LEAD = 0.03  # s
# Relative errors allowed, and that of the felt's force between 20 and 100 % of the largest compression.
ALLOWED = {"c": 2e-4, "kappa": 0.01, "b1": 0.03, "M_H": 0.03, "v_H0": 0.03}
FELT = 0.05


class Truth(NamedTuple):
    """One struck string, measured."""

    string: String
    hammer: Hammer
    geometry: Geometry
    scale: float  # m/s at full scale

    @property
    def f0(self) -> float:
        """Hz, of the string without stiffness."""
        return self.string.c / (2 * self.geometry.length)

    @property
    def values(self) -> dict[str, float]:
        """The nine parameters by name."""
        return dict(zip(FIT_NAMES, (*self.string, *self.hammer), strict=True))


# Another string than the demo's in every respect.
FIRST = Truth(
    String(c=352.0, kappa=1.15, b1=0.42, b2=4e-5),
    Hammer(K_H=5e10, mu=0.25, p=2.9, M_H=4.9e-3, v_H0=1.4),
    Geometry(length=0.88, mass=7.2e-3, strike=0.11, width=0.015, pickup=0.31),
    scale=4.0,
)


def random_truth(seed: int) -> Truth:
    """A string from A2 to A3 with any hammer of a piano, struck from piano to forte."""
    random = np.random.default_rng(seed)

    def between(low: float, high: float) -> float:
        return float(np.exp(random.uniform(math.log(low), math.log(high))))

    length, f0 = between(0.8, 1.2), between(110, 220)
    c, mass = 2 * length * f0, between(4e-3, 10e-3)
    kappa = c * length * math.sqrt(between(5e-5, 4e-4)) / math.pi
    string = String(c, kappa, between(0.2, 0.8), between(5e-6, 1e-4))
    p, velocity, hammer_mass = random.uniform(2.2, 3.0), between(1.0, 2.5), mass * between(0.4, 1.5)
    # A felt that is pressed by 0.5 to 1.2 mm if it takes up all of the hammer's energy.
    stiffness = 0.5 * (p + 1) * hammer_mass * velocity**2 / between(0.5e-3, 1.2e-3) ** (p + 1)
    hammer = Hammer(stiffness, between(0.05, 0.3), p, hammer_mass, velocity)
    width = between(0.01, 0.025)
    geometry = Geometry(length, mass, between(0.1, 0.14) * length, width, random.uniform(0.28, 0.45) * length)
    return Truth(string, hammer, geometry, 4.0)


def setup_of(truth: Truth, **more: dict) -> Setup:
    """What a laboratory would know of `truth`: sizes and the pickup; `more` tables beside them."""
    g = truth.geometry
    data = {
        "string": {"length": g.length, "mass": g.mass},
        "strike": {"position": g.strike, "width": g.width},
        "pickup": {"quantity": "velocity", "position": g.pickup, "scale": truth.scale},
    }
    return setup_from_dict(data | more, "twin")


def record(
    truth: Truth, *, quantity: str = "velocity", noise_db: float | None = -60.0, seconds: float = 3.0, seed: int = 0,
    window: str = "parabola", rate: int = RATE, **effects: float,
) -> Recording:  # fmt: skip
    """A recording of `truth`, struck through another window of the same variance; `effects` are `make_twin`'s."""
    geometry = truth.geometry._replace(width=matched_width(window, truth.geometry.width))
    samples = make_twin(
        truth.string, truth.hammer, geometry, seconds=seconds, rate=rate, quantity=quantity, noise_db=noise_db,
        seed=seed, lead_in=LEAD, window=window, **effects,
    )  # fmt: skip
    unit = truth.scale if quantity == "velocity" else 2 * float(np.abs(samples).max())
    return recording_from_samples(samples / unit, rate, name="twin")


def fit_twin(recording: Recording, setup: Setup, *, seed: int = 0) -> Result:
    return fit_recording(recording, analyse(recording), setup, seed=seed)


def errors(document: dict, truth: Truth) -> dict[str, float]:
    """Relative errors of what a calibrated recording fixes; `felt` is the worst of the force over compression."""
    found = {name: document["parameters"][name]["value"] for name in FIT_NAMES}
    off = {name: abs(found[name] / truth.values[name] - 1) for name in ALLOWED}
    u = np.linspace(0.2, 1.0, 33) * document["derived"]["max_compression_mm"] / 1e3
    force = found["K_H"] * u ** found["p"] / (truth.hammer.K_H * u**truth.hammer.p)
    return off | {"felt": float(np.abs(force - 1).max())}


def misses(document: dict, truth: Truth) -> dict[str, float]:
    """The errors that are larger than allowed."""
    return {name: x for name, x in errors(document, truth).items() if x > ALLOWED.get(name, FELT)}
