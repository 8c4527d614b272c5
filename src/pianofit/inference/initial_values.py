"""From what was heard and what was known to where a fit starts, and how far that may be off.

The string is read off the recording: wave speed and stiffness from the partials' frequencies, losses from their decays.
The hammer cannot be read off; it starts at the literature's value for the key. Lengths and masses that nobody measured
are the literature's too, and everything that rests on them says so.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..analysis import Analysis
from ..conversions import midi_of
from ..errors import SetupError
from ..felt import BOXES, COMMON, DEFAULT_LAW, FeltLaw
from ..literature import typical
from ..parameters import HAMMER_NAMES, PARAMETERS, Geometry, Hammer
from ..setup import Setup

__all__ = ["InitialValues", "starting_values"]

# Where nothing is known of it, a search begins at this velocity of the hammer, m/s, a moderate forte.
ASSUMED_VELOCITY = 2.0
# A wave speed and a length that were given make the pitch that is heard within half a semitone, cents: a ruler and a
# stretched octave are no farther off, and beyond it is the neighbouring key's.
ANOTHER_PITCH = 50.0


@dataclass(frozen=True)
class InitialValues:
    """Where a fit starts, by name: the string, the felt's parameters, hammer mass and velocity, strike and contact."""

    values: dict[str, float]
    initial: dict[str, float]  # what is reported as initial: `values`, save where the user gave a value
    fixed: dict[str, str]  # name -> "fixed" (measured, known) or "assumed"
    assumptions: dict[str, tuple[str, ...]]  # name -> the assumed quantities its SI value rests on
    bounds: dict[str, tuple[float, float]]
    geometry: Geometry
    assumed: tuple[str, ...]  # of length, mass, width
    quantity: str
    scale: float | None  # units at digital full scale; None when uncalibrated
    reference_hammer: Hammer  # the literature's for the key, by which contacts are measured, with what is known of it
    user_given: tuple[str, ...] = ()  # of the felt and the hammer's mass, what the user gave a value
    law: FeltLaw = DEFAULT_LAW


def starting_values(analysis: Analysis, setup: Setup, velocity: float | None = None) -> InitialValues:
    """Combine analysis, setup and literature.

    Parameters
    ----------
    velocity : measured hammer velocity, m/s, which overrides the setup's.
    """
    midi = midi_of(analysis.f0)
    key = float(np.clip(midi, 21, 108))
    usual, law = typical(key), setup.law
    geometry, assumed = _geometry(setup, usual.geometry)
    calibrated = setup.pickup_scale is not None
    values = _string_values(analysis, geometry.length)
    _check_pitch(analysis, setup, geometry.length)
    hammer = {name: float(value) for name, value in usual.hammer._asdict().items()} | {"v_H0": ASSUMED_VELOCITY}
    given = {k: v for k, v in setup.initial.items() if k not in values} | setup.fixed
    values |= hammer | {"x0": geometry.strike_position, "width": geometry.width}
    values |= {name: parameter.prior_median(key) for name, parameter in law.parameters.items()} | given
    fixed = dict.fromkeys(setup.fixed, "fixed") | {"width": "assumed" if "width" in assumed else "fixed"}
    measured = velocity if velocity is not None else next((t.v_H0 for t in setup.recordings if t.v_H0), None)
    if measured is not None:
        values["v_H0"], fixed["v_H0"] = measured, "fixed"
    elif not calibrated and "v_H0" not in fixed:
        fixed["v_H0"] = "assumed"
    if setup.strike_position is not None:
        fixed["x0"] = "fixed"
    fixed |= {name: "fixed" for name in BOXES if name in law.columns and name not in (*law.parameters, *COMMON)}
    boxes = BOXES | law.boxes
    for name in set(values) & set(boxes):
        box = boxes[name]
        low, high = setup.bounds.get(name, (box.lower, box.upper))
        values[name] = min(max(values[name], low), high)
    return InitialValues(
        values=values,
        initial=values | setup.initial,
        fixed=fixed,
        assumptions=_rests_on(assumed, law),
        bounds=dict(setup.bounds),
        geometry=geometry,
        assumed=assumed,
        quantity=setup.pickup_quantity,
        scale=setup.pickup_scale,
        # A law from outside may mean something else by the literature's names.
        reference_hammer=Hammer(
            **hammer | {name: values[name] for name in (COMMON if law.hammers is None else HAMMER_NAMES)}
        ),
        user_given=tuple(name for name in (*law.parameters, "M_H") if name in setup.initial | setup.fixed),
        law=law,
    )


def _geometry(setup: Setup, usual: Geometry) -> tuple[Geometry, tuple[str, ...]]:
    """What is known of length, mass and strike, completed from the literature's string for the key."""
    length = setup.length or usual.length
    # A string of another length than the literature's is taken to be as heavy per metre.
    mass = setup.mass or usual.mass * length / usual.length
    width = setup.strike_width or min(usual.width, 0.1 * length)
    strike = setup.strike_position or 0.12 * length
    pickup = setup.pickup_position or 0.5 * length
    given = {"length": setup.length, "mass": setup.mass, "width": setup.strike_width}
    return Geometry(length, mass, strike, width, pickup), tuple(k for k, v in given.items() if v is None)


def _check_pitch(analysis: Analysis, setup: Setup, length: float) -> None:
    """Refuse a length, or a length and a wave speed, that make no string of the pitch that is heard."""
    box, heard = PARAMETERS["c"], f"the recordings sound at {analysis.f0:.1f} Hz"
    told = f"length = {length:g} m" + ("" if setup.length else ", the literature's,")
    c = setup.fixed.get("c")
    if c is None:
        needed = 2 * length * analysis.f0
        if not box.lower <= needed <= box.upper:
            raise SetupError(
                f"[string] {told} would need a wave speed of {needed:.3g} m/s where {heard}, and {box.lower:g} to "
                f"{box.upper:g} m/s can be; correct the length"
            )
    elif abs(1200 * math.log2(c / (2 * length) / analysis.f0)) > ANOTHER_PITCH:
        raise SetupError(
            f"[fixed] c = {c:g} m/s and [string] {told} make {c / (2 * length):.1f} Hz, and {heard}; "
            "correct one of them"
        )


def _string_values(analysis: Analysis, length: float) -> dict[str, float]:
    """c = 2 L f0, κ = c L √B/π, b1, and b2 = d2 L²/π² of the decay law α = b1 + d2 k²."""
    c = 2 * length * analysis.f0
    return {
        "c": c,
        "kappa": c * length * math.sqrt(max(analysis.B, 1e-9)) / math.pi,
        "b1": analysis.b1,
        # A d2 below its own error is as good as unknown: start where it would just be seen.
        "b2": max(analysis.d2, 0.1 * analysis.d2_error, 1e-9) * (length / math.pi) ** 2,
    }


def _rests_on(assumed: tuple[str, ...], law: FeltLaw) -> dict[str, tuple[str, ...]]:
    rests: dict[str, tuple[str, ...]] = {}
    if "length" in assumed:
        rests |= dict.fromkeys(("c", "kappa", "b2", "x0"), ("length",))
    if "mass" in assumed:
        rests |= dict.fromkeys((*law.scaling("N"), "M_H"), ("mass",))
    return rests
