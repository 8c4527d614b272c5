"""Every prior of a fit, with its source, and its initial and given values.

A prior describes a piano before its recording is analysed. None of these numbers is fitted to the recordings of a fit.
Scales are standard deviations of logarithms unless a unit is given. `benchmarks/path_prior.py` compares the prior of τ
with notes recorded at several velocities.

The initial string follows from the recording: wave speed and stiffness from the frequencies of the partials, losses
from their decays. The recording does not determine the hammer directly, so it starts at the literature's values for the
key. A length or mass that the setup does not give is the literature's too, and every value that depends on it is marked
so.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from ..analysis import Analysis, cents_above
from ..conversions import midi_of
from ..errors import SetupError
from ..excitation import GEOMETRY_FIELDS, Excitation
from ..excitation.hammer import GAIN_DEVIATION, PATH
from ..felt import ALL_PARAMETERS, COMMON_PARAMETERS, DEFAULT_LAW
from ..felt.published import HAMMER_SD as HAMMER_SD
from ..literature import typical
from ..parameters import HAMMER_NAMES, PARAMETERS, Geometry, Hammer
from ..setup import Setup
from ..transducer import TRANSDUCERS

# --- hammer: about the literature's values for the key (literature.typical), with the standard deviations `HAMMER_SD`;
# the felt law has the felt's priors
# String: about the analysis of one recording, wide enough to have no effect.
STRING_SD = {"c": 0.01, "kappa": 2.0, "b1": 2.0, "b2": 3.0}
# Exponents with which values scale with the string length if the sound stays the same.
LENGTH_EXPONENTS = {"c": 1.0, "kappa": 2.0, "b2": 2.0, "x0": 1.0, "width": 1.0, "pickup": 1.0}

# --- between string and table of partials -----------------------------------------------------------------------------
# The gain of an output path is unknown, dB.
GAIN = 60.0
# Standard deviation of a detected onset from the arrival of the wave, s,
ONSET = 1e-3
# plus this in periods: the first arrival on a stiff string is faint, and the largest of the first period is detected.
ONSET_PERIODS = 0.5
# Degrees of freedom of Student's t: with 4 a search can discard the fundamental and stay there.
STUDENT = 10.0
# Standard deviation of a knock from the force, dB: 1.1 in five treble keys of five pianos, 1.8 in eleven keys of all
# registers, levelled libraries included (benchmarks/knock_study.py).
KNOCK_SD = 1.5
# Standard deviation of the path of a knock from that of the gain, dB: keybed and action sound too.
KNOCK_PATH_SD = 30.0
# A censored partial may exceed the bound of its band by this, dB: leakage of neighbours can cancel it.
CENSORED_MARGIN = 1.0
# Initial hammer velocity, m/s, if none is given: a moderate forte.
ASSUMED_VELOCITY = 2.0
# Largest distance, cents, of a given wave speed and length from the measured pitch. Errors of a ruler and of a
# stretched octave are smaller, and a larger distance belongs to the neighbouring key.
ANOTHER_PITCH = 50.0


class Hyperprior(NamedTuple):
    """Log-normal priors of a table's hyperparameters: medians and spreads of the logarithm."""

    median: tuple[float, ...]
    spread: tuple[float, ...]

    @property
    def log_median(self) -> np.ndarray:
        """Logarithms of the medians."""
        return np.log(self.median)


# Levels: excess of a recording, dB; amplitude of the smooth path, dB, and its length, octaves; amplitude of other
# sounds over the loudest partial (53 to 75 dB below it); deviation of a partial from the hammer model that strokes of
# similar velocity share, dB over an e-fold of velocity. τ is integrated over: see PATH.
LEVEL = Hyperprior((0.7, 8.0, 0.7, 0.002, 1.0), (0.7, 0.4, 0.4, 0.9, 1.0))
# Frequencies: excess over the string model, cents, from partial to partial; amplitude of the smooth deviation at
# `REFERENCE_PARTIAL`, cents, and its length, octaves. Soundboard, windings and end supports make neighbouring partials
# deviate alike.
FREQUENCY = Hyperprior((0.5, 0.5, 0.7), (1.5, 1.5, 0.4))
# Decays: the same, relative to the string model.
DECAY = Hyperprior((0.2, 0.2, 0.7), (1.0, 1.0, 0.4))
# Smallest ratio of an envelope's decay rate to the string model: the logarithm of a slope that beats made flat or
# rising would count as a deviation by orders of magnitude.
LEAST_DECAY_RATIO = 0.1
# Partial at which the smooth deviation of frequencies has its amplitude.
REFERENCE_PARTIAL = 10.0
# Exponent of its growth with the number of the partial: windings, shear and rotary inertia act on short waves. Keys of
# four pianos decide (`benchmarks/string_deviations.py`).
DEVIATION_GROWTH = 1.0


def path_nodes(roughness: tuple[float, float] = PATH) -> tuple[np.ndarray, np.ndarray]:
    """Three nodes of log τ and their weights: Gauss-Hermite over the log-normal prior of the `roughness`."""
    x, weight = np.polynomial.hermite_e.hermegauss(3)
    return np.log(roughness[0]) + roughness[1] * x, weight / weight.sum()


def log_gain(gain: float, others: Sequence[float] = (0.0,), deviations: Sequence[float] = GAIN_DEVIATION) -> float:
    """Log predictive density of a recording's gain, dB, given those of `others` through its path.

    All recordings of a path either share a gain or do not. As in F, the other recordings decide between the two.
    """
    given, sd = np.asarray(others, float), np.array(deviations)
    square = ((given - given.mean()) ** 2).sum()
    regime = -(len(given) - 1) * np.log(sd) - 0.5 * square / sd**2
    spread = sd * np.sqrt(1 + 1 / len(given))
    predictive = -0.5 * ((gain - given.mean()) / spread) ** 2 - np.log(spread * np.sqrt(2 * np.pi))
    return float(np.logaddexp.reduce(regime + predictive) - np.logaddexp.reduce(regime))


# --- initial and given values -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class InitialValues:
    """Initial values by name: the string, the felt, hammer mass and velocity, strike position and contact window."""

    values: dict[str, float]
    initial: dict[str, float]  # reported as initial: `values`, or the user's initial value
    fixed: dict[str, str]  # name -> "fixed" (measured, given) or "assumed"
    assumptions: dict[str, tuple[str, ...]]  # name -> the assumed quantities its SI value rests on
    bounds: dict[str, tuple[float, float]]
    geometry: Geometry
    assumed: tuple[str, ...]  # of length, mass, width
    quantity: str
    scale: float | None  # units at digital full scale; None when uncalibrated
    reference_hammer: Any  # the literature's for the key, with given values; sets the scale of contacts
    user_given: tuple[str, ...] = ()  # parameters of the felt and hammer mass for which the user gave a value
    law: Excitation = DEFAULT_LAW
    # Standard deviations of the logarithms of given values, by name; without exact ones. L, M_S, pickup and scale are
    # sizes.
    relative_sd: dict[str, float] = field(default_factory=dict)

    def size_value(self, name: str) -> float:
        """The given value of L, M_S, pickup or scale."""
        g = self.geometry
        return float(self.scale or 1.0) if name == "scale" else float(getattr(g, GEOMETRY_FIELDS[name]))

    @property
    def unknown_path(self) -> bool:
        """True if an unknown path lies between the bridge and the file."""
        return self.scale is None and TRANSDUCERS[self.quantity].unknown_path


def starting_values(analysis: Analysis, setup: Setup, velocity: float | None = None) -> InitialValues:
    """Combine analysis, setup and literature.

    Parameters
    ----------
    velocity : measured hammer velocity of the reference recording, m/s.
    """
    spread, setup = setup.relative_sds, setup.exact
    key = float(np.clip(midi_of(analysis.f0), 21, 108))
    preset, law = typical(key), setup.law
    geometry, assumed = _geometry(setup, preset.geometry)
    values = _string_values(analysis, geometry.length)
    _check_pitch(analysis, setup, geometry.length)
    given = {k: v for k, v in setup.initial.items() if k not in values} | setup.fixed
    values |= {"x0": geometry.strike_position, "width": geometry.width, "pickup": geometry.pickup}
    if law.has_contact:
        values |= {name: float(value) for name, value in preset.hammer._asdict().items()} | {"v_H0": ASSUMED_VELOCITY}
    values |= {name: parameter.prior_median(key) for name, parameter in law.parameters.items()} | given
    fixed = dict.fromkeys(setup.fixed, "fixed") | {"width": "assumed" if "width" in assumed else "fixed"}
    fixed |= _fixed_stroke(setup, velocity, values) if law.has_contact else {}
    fixed |= {} if setup.strike_position is None else {"x0": "fixed"}
    fixed |= {} if setup.pickup_position is None else {"pickup": "fixed"}
    absent = {*ALL_PARAMETERS} & {*law.columns} - {*law.parameters, *COMMON_PARAMETERS}
    fixed |= {name: "fixed" for name in ALL_PARAMETERS if name in absent}
    ranges = ALL_PARAMETERS | law.hammer_parameters
    for name in set(values) & set(ranges):
        low, high = setup.bounds.get(name, (ranges[name].lower, ranges[name].upper))
        values[name] = min(max(values[name], low), high)
    return InitialValues(
        values=values,
        initial=values | setup.initial,
        fixed=fixed,
        assumptions=_assumptions(assumed, law),
        bounds=dict(setup.bounds),
        geometry=geometry,
        assumed=assumed,
        quantity=setup.pickup_quantity,
        scale=setup.pickup_scale,
        reference_hammer=_reference_hammer(preset.hammer, law, values),
        user_given=tuple(name for name in (*law.parameters, "M_H") if name in setup.initial | setup.fixed),
        law=law,
        relative_sd=spread,
    )


def _fixed_stroke(setup: Setup, velocity: float | None, values: dict[str, float]) -> dict[str, str]:
    """Status of the hammer velocity; a measured one is added to `values`."""
    if velocity is not None:
        values["v_H0"] = float(velocity)
        return {"v_H0": "fixed"}
    return {} if setup.pickup_scale is not None or "v_H0" in setup.fixed else {"v_H0": "assumed"}


def _reference_hammer(hammer: Hammer, law: Excitation, values: dict[str, float]) -> Any:
    """The literature's hammer with given values; for another excitation, its own object."""
    if not law.has_contact:
        return law.make_hammer(values)
    # A user's law may use the literature's names for other quantities.
    shared = COMMON_PARAMETERS if law.hammers is None else HAMMER_NAMES
    own = {name: values[name] for name in shared}
    return Hammer(**{**hammer._asdict(), "v_H0": ASSUMED_VELOCITY, **own})


def _geometry(setup: Setup, preset: Geometry) -> tuple[Geometry, tuple[str, ...]]:
    """Length, mass and strike position of the setup, completed from the literature's string for the key."""
    geometry = setup.law.typical(preset, setup.length)
    given = {"length": setup.length, "mass": setup.mass, "width": setup.strike_width}
    own = given | {"strike_position": setup.strike_position, "pickup": setup.pickup_position}
    assumed = tuple(name for name, value in given.items() if value is None)
    geometry = geometry._replace(**{name: value for name, value in own.items() if value is not None})
    if setup.strike_width is None and 0 < geometry.strike_position < geometry.length:
        geometry = geometry.with_window_on_string()
    half, at = 0.5 * geometry.width, geometry.strike_position
    if setup.law.has_contact and not half <= at <= geometry.length - half:
        source = "the literature's" if setup.strike_position is None else "the given"
        raise SetupError(
            f"[strike] width = {geometry.width:g} m does not fit on the string at {source} strike position, {at:.3g} m "
            f"of {geometry.length:.3g} m; correct width, position or [string] length"
        )
    if not setup.law.has_contact:
        _check_nearer_end("strike", setup.strike_position, geometry.length)
        _check_nearer_end("pickup", setup.pickup_position, geometry.length)
    return geometry, assumed


def _check_nearer_end(table: str, position: float | None, length: float) -> None:
    """Reject a position that is not given from the nearer end of the string, as the search of plucks has it."""
    if position is not None and position > 0.5 * length:
        raise SetupError(
            f"[{table}] position = {position:g} m lies beyond the middle of {length:.3g} m; give the distance from the "
            f"nearer end, {length - position:.3g} m, or correct [string] length"
        )


def _check_pitch(analysis: Analysis, setup: Setup, length: float) -> None:
    """Reject a length, or a length and a wave speed, that contradict the measured pitch."""
    parameter, measured = PARAMETERS["c"], f"the pitch of the recordings is {analysis.f0:.1f} Hz"
    given = f"length = {length:g} m" + ("" if setup.length else ", the literature's,")
    c = setup.fixed.get("c")
    if c is None:
        needed = 2 * length * analysis.f0
        if not parameter.lower <= needed <= parameter.upper:
            raise SetupError(
                f"[string] {given} needs a wave speed of {needed:.3g} m/s, because {measured}. The range is "
                f"{parameter.lower:g} to {parameter.upper:g} m/s; correct the length"
            )
    elif abs(cents_above(c / (2 * length), analysis.f0)) > ANOTHER_PITCH:
        raise SetupError(
            f"[fixed] c = {c:g} m/s and [string] {given} make {c / (2 * length):.1f} Hz, but {measured}; "
            "correct one of them"
        )


def _string_values(analysis: Analysis, length: float) -> dict[str, float]:
    """c = 2 L f0, κ = c L √B/π, b1, and b2 = d2 L²/π² of the decay law α = b1 + d2 k²."""
    c = 2 * length * analysis.f0
    return {
        "c": c,
        "kappa": c * length * math.sqrt(max(analysis.B, 1e-9)) / math.pi,
        "b1": analysis.b1,
        # A d2 below its standard error carries no information: start where it would just be detectable.
        "b2": max(analysis.d2, 0.1 * analysis.d2_error, 1e-9) * (length / math.pi) ** 2,
    }


def _assumptions(assumed: tuple[str, ...], law: Excitation) -> dict[str, tuple[str, ...]]:
    hammer = (*law.parameters_with_unit("N"), "M_H") if law.has_contact else ()
    contact = ("x0",) if law.has_contact else ("x0", *law.columns)
    scaled = {"length": ("c", "kappa", "b2", *contact), "mass": hammer}
    return {name: (size,) for size, names in scaled.items() if size in assumed for name in names}
