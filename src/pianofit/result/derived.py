"""Derived quantities: a function of the parameters, with the interval that the joint posterior gives it.

The function is evaluated at the best minimum and at draws of the posterior. The ends of the interval are quantiles.
Without a measured velocity, draws are moved along the scaling (K_H, μ, d, v) → (K_H s^(1-p), μ/s, s d, s v) to the
reference velocity shown, as for F/M_S. The sound does not change.

Probes decide the status. A parameter matters to a quantity if twice or half of its value changes the quantity. The
felt, the hammer mass and the velocities can be not identified in spite of a narrow interval, so a quantity to which one
of them matters is then not identified either. All other doubts are in the width of the draws. The scalings that change
no sound show whether the quantity scales with an assumed mass or length, or with the velocities.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ..conversions import HALF_WIDTH_95, T60_NEPERS
from ..errors import FitError, ParameterError, check_type
from ..excitation import Excitation
from ..felt import LAWS, law_of
from ..felt.law import scale_velocity
from ..inference.batched_model import run_in_batches
from ..io.number_format import format_with_interval, is_number
from ..model import Simulation
from ..model.note import Note
from ..model.strokes import BATCH_SIZE, simulations, strokes, strokes_arguments
from ..parameters import PARAMETERS
from ..schema.dependencies import combined_status
from ..schema.fit import Fit
from ..schema.quantities import Status
from .posterior import JointDraws, joint_draws

# Half the step of log u in a difference of forces: its error is below 1e-6.
STEP = 1e-3
# A parameter is changed by this factor to see whether it matters: about the uncertainty that makes it not identifiable.
PROBE = 2.0
# It matters if the quantity changes by more than this, relative. The stiffness of the felt changes a contact time by 5
# to 20 %, its loss by less than 1 %.
MATTERS = 0.01
# Factor of the scalings that change no sound, and the largest relative change that is an error of rounding or, in a
# contact, of interpolation.
SCALE, SAME = 1.1, 1e-6
# Names of these scalings among the probes, and of the sizes that only they change.
SCALINGS, SIZES = ("mass", "length", "velocity"), ("M_S", "L", "pickup")
NOT_IDENTIFIED: Status = "not-identifiable"


@dataclass(frozen=True, eq=False, repr=False)
class ModelDraw:
    """One set of parameters from the posterior, as `Result.derived` gives it to a function.

    `values` are all parameters by name in SI units, with `v_H0 N` for the velocity of stroke N. `note` is the note of
    the reference recording with these parameters. Its gain and output path are those of the best minimum.
    """

    values: Mapping[str, float]
    note: Note
    _stroke: Callable[[], Simulation]

    def __repr__(self) -> str:
        return "ModelDraw: " + ", ".join(f"{name} {value:.5g}" for name, value in self.values.items())

    @cached_property
    def stroke(self) -> Simulation:
        """The simulated stroke of the reference recording. The strokes of all draws are computed together."""
        return self._stroke()

    def felt_force(self, compression: float) -> float:
        """Static force of the felt, N, at a compression, m. For hammers only."""
        law = law_of(self.note.hammer)
        if not law.has_contact:
            raise ParameterError(f"felt_force: {law.words.verb} strings have no felt; ask for another quantity")
        if not (is_number(compression) and compression > 0):
            raise ParameterError(f"felt_force: compression={compression!r} m must be a number above 0")
        return float(law.force(compression, 0.0, self.note.hammer))

    def local_exponent(self, compression: float) -> float:
        """Exponent of the static force of the felt, d log F/d log u, at a compression, m; p without a skin.

        For hammers only.
        """
        low, high = (self.felt_force(compression * math.exp(step)) for step in (-STEP, STEP))
        return math.log(high / low) / (2 * STEP)

    def t60(self, partial: int) -> float:
        """Time in which a partial falls by 60 dB, s, by the string model, α = b1 + b2 β²."""
        if not (is_number(partial) and partial >= 1):
            raise ParameterError(f"t60: partial={partial!r} must be a number from 1")
        string = self.note.string
        alpha = string.b1 + string.b2 * (partial * math.pi / self.note.geometry.length) ** 2
        return float(T60_NEPERS / alpha)

    @property
    def felt_loss(self) -> float:
        """Energy lost in the felt over the kinetic energy of the hammer."""
        pulse, hammer = self.stroke.pulse, self.note.hammer
        u, force = np.maximum(pulse.compression, 0.0), np.asarray(pulse.force)
        lost = 0.5 * float(((force[1:] + force[:-1]) * np.diff(u)).sum())
        return lost / (0.5 * hammer.M_H * hammer.v_H0**2)


@dataclass(frozen=True, eq=False, repr=False)
class DerivedQuantity:
    """A function of the parameters with its 95 % interval and draws, from `Result.derived`."""

    value: float  # at the best minimum
    interval: tuple[float, float] | None  # 95 %; None if nothing that the function uses was fitted
    status: Status
    draws: np.ndarray  # equally probable values [draws]
    note: str = ""  # what the quantity scales with

    def __float__(self) -> float:
        return self.value

    def __repr__(self) -> str:
        value, span = format_with_interval(self.value, self.interval)
        note = f" ({self.note})" if self.note else ""
        return f"{value}{'' if self.interval is None else ' ' + span}, {self.status}{note}"


@dataclass(frozen=True, eq=False)
class DrawSet:
    """The best minimum, probes of it, and draws of the posterior; strokes are simulated when first needed."""

    fit: Fit
    best: Note
    first: Simulation | None  # the stroke of the best minimum; simulated again if None
    sampled: Mapping[str, np.ndarray] | None = None  # draws of a sampler
    at_reference_velocity: bool = True

    @cached_property
    def law(self) -> Excitation:
        """The excitation. A felt law of this package is known by name, because several share a type of hammer."""
        return LAWS.get(self.fit.felt) or law_of(self.best.hammer)

    @cached_property
    def _best_values(self) -> dict[str, float]:
        values = {name: float(quantity.value) for name, quantity in self.fit.parameters.items()}
        own = self.fit.reference.stroke
        name = self.law.stroke.name
        return values | {f"{name} {r.stroke + 1}": r.stroke_value for r in self.fit.recordings if r.stroke != own}

    @cached_property
    def _joint(self) -> JointDraws:
        return joint_draws(self.fit, self.law, self.sampled)

    @cached_property
    def _drawn(self) -> dict[str, np.ndarray]:
        """Values of every draw by name [draws or 1]."""
        drawn = {name: np.array([value]) for name, value in self._best_values.items()}
        drawn |= self._joint.values
        if self.at_reference_velocity and self.fit.velocity_scale_open:
            return scale_velocity(drawn, self.law, self._best_values["v_H0"] / drawn["v_H0"])
        return drawn

    @cached_property
    def _probes(self) -> dict[str, dict[str, float]]:
        """Changed values by what was changed: a parameter, or `mass`, `length` or `velocity` with the same sound."""
        best, probes = self._best_values, {}
        for name in (name for name in best if name not in SIZES):
            box = self.law.hammer_parameters.get(name.partition(" ")[0])
            up = best[name] * PROBE
            probes[name] = best | {name: up if box is None or up <= box.upper else best[name] / PROBE}
        scaled = {"mass": scale_mass, "length": scale_length, "velocity": scale_velocity}
        return probes | {name: scale(best, self.law, SCALE) for name, scale in scaled.items()}

    @cached_property
    def draws(self) -> list[ModelDraw]:
        """The best minimum, then the probes, then the draws."""
        count = max(map(len, self._drawn.values()))
        columns = {name: np.broadcast_to(values, count).tolist() for name, values in self._drawn.items()}
        rows = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
        values = [self._best_values, *self._probes.values(), *(rows if self.fit.has_intervals else [])]
        return [ModelDraw(one, self._note(one), lambda i=i: self._strokes[i]) for i, one in enumerate(values)]

    @cached_property
    def _strokes(self) -> list[Simulation]:
        """The strokes of all draws, simulated together when the first is asked for."""
        notes, own_rate = [draw.note for draw in self.draws], self.fit.reference.rate
        arrays, rate, cfg = strokes_arguments(notes, self.first or notes[0].strike(own_rate))
        done = simulations(run_in_batches(strokes, arrays, rate, cfg, BATCH_SIZE))
        # A contact that is much longer than the first is simulated alone.
        pairs = zip(done, notes, strict=True)
        return [one if one.pulse.contact_ended else note.strike(own_rate) for one, note in pairs]

    def _note(self, values: Mapping[str, float]) -> Note:
        """Return the best note with other values of its parameters, inside their ranges.

        Probes and another scale of the velocities can leave the ranges.
        """
        boxes, note, g = {**PARAMETERS, **self.law.parameters}, self.best, self.best.geometry
        ranged = {**values, **{n: min(max(values[n], x.lower), x.upper) for n, x in boxes.items() if n in values}}
        width = values.get("width", g.width)
        # The contact window stays on the string.
        strike = min(max(values["x0"], width / 2), values["L"] - width / 2)
        is_entry = "pickup" in self.law.columns
        pickup = values.get("pickup", g.pickup) if is_entry else g.pickup * values["L"] / g.length
        sizes = {"length": values["L"], "mass": values["M_S"], "strike_position": strike, "width": width}
        return note._replace(
            string=note.string._replace(**{name: ranged[name] for name in note.string._fields}),
            hammer=note.hammer._replace(**{name: ranged[name] for name in note.hammer._fields if name in ranged}),
            geometry=g._replace(**sizes, pickup=pickup),
        )

    def evaluate(self, function: Callable[[ModelDraw], Any]) -> DerivedQuantity:
        """Return value, interval, status and draws of a function."""
        check_type("function=", function, Callable, "a function of a draw that returns one number")
        best, *others = (_number(function, draw) for draw in self.draws)
        probed, drawn = dict(zip(self._probes, others, strict=False)), np.array(others[len(self._probes) :])
        is_free = len(drawn) > 0 and float(np.ptp(drawn)) > 0
        span = self._joint.interval(drawn) if is_free else (best, best)
        status = combined_status(*self._doubts(best, probed, _log_sd(span) if is_free else 0.0))
        scales = [*self._scales(best, probed)]
        if status == "fitted" and scales:
            status = "scaled"
        return DerivedQuantity(best, span if is_free else None, status, drawn, "; ".join(scales))

    def _doubts(self, best: float, probed: Mapping[str, float], sd: float) -> tuple[list[Status], float]:
        """Return the statuses on which a quantity rests, and the standard deviation of its logarithm."""
        parameters = {name: value for name, value in probed.items() if name not in SCALINGS}
        matters = [name for name, value in parameters.items() if not math.isclose(value, best, rel_tol=MATTERS)]
        states: dict[str, Status] = {name: self._status(name) for name in matters}
        if not self.fit.has_intervals:  # without draws, a quantity is free if one of its parameters is
            sd = float(any(state not in ("given", "assumed") for state in states.values())) * MATTERS
        felt = [name for name in matters if name in self.law.parameters]
        force = self.fit.invariants.get("F/M_S")
        if felt and len(matters) > 1 and force is not None:  # a stroke determines the force, not its parameters
            states |= dict.fromkeys(felt, force.status)
        # The doubt about a parameter of the string is in the width of the draws, unless it is all that matters.
        if len(matters) > 1:
            states = {n: s for n, s in states.items() if n in (*felt, "M_H") or n[:4] == "v_H0" or s != NOT_IDENTIFIED}
        return [*states.values()], sd

    def _status(self, name: str) -> Status:
        if name in self.fit.parameters:
            return self.fit.parameters[name].status
        stroke = int(name.rpartition(" ")[2]) - 1
        return next(own.stroke_status for own in self.fit.recordings if own.stroke == stroke)

    def _scales(self, best: float, probed: Mapping[str, float]) -> Iterable[str]:
        """Yield what a quantity scales with and was not measured."""
        for size, name in (("mass", "M_S"), ("length", "L")):
            if self.fit.parameters[name].status == "assumed" and not math.isclose(probed[size], best, rel_tol=SAME):
                yield f"scales with the assumed {size} of the string"
        if self.fit.velocity_scale_open and not math.isclose(probed["velocity"], best, rel_tol=SAME):
            yield "at the reference velocity shown" if self.at_reference_velocity else "scales with the velocities"


def _number(function: Callable[[ModelDraw], Any], draw: ModelDraw) -> float:
    value = function(draw)
    try:
        if isinstance(value, str | bytes):
            raise TypeError  # float() would read a number from it
        found = float(value)
    except (TypeError, ValueError):
        kind = type(value).__name__
        raise ParameterError(f"function=: returned {kind} for {draw!r}; it must return one number") from None
    if not is_number(found):
        raise FitError(f"function=: returned {found} for {draw!r}; it must be finite for all draws of the posterior")
    return found


def _log_sd(span: tuple[float, float]) -> float:
    """Return the standard deviation of the logarithm from a 95 % interval; infinite if it contains zero."""
    low, high = sorted(map(abs, span))
    return math.log(high / low) / (2 * HALF_WIDTH_95) if span[0] * span[1] > 0 else math.inf


# --- scalings that change no sound ------------------------------------------------------------------------------------


def scale_mass(values: Mapping[str, Any], law: Excitation, s: Any) -> dict[str, Any]:
    """Return values with all masses times `s`."""
    powers = {**{name: law.force_exponent(name) for name in law.parameters}, "M_H": 1, "M_S": 1}
    return {**values, **{name: values[name] * s**power for name, power in powers.items() if power and name in values}}


def scale_length(values: Mapping[str, Any], _: Excitation, s: Any) -> dict[str, Any]:
    """Return values with the string's lengths times `s`."""
    powers = {"L": 1, "x0": 1, "width": 1, "pickup": 1, "c": 1, "kappa": 2, "b2": 2}
    places = {name: values[name] * s for name in values if name.startswith("x0 ")}
    return {**values, **places, **{name: values[name] * s**power for name, power in powers.items() if name in values}}
