"""Definition of one fit: its recordings, their structure, given values and priors, and the settings of the model."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..analysis import SAME_KEY_CENTS, Analysis, cents_above
from ..conversions import midi_of
from ..errors import FitError
from ..excitation import Excitation
from ..felt import ALL_PARAMETERS
from ..io.files import printable
from ..io.number_format import counted
from ..key_prior import KeyPrior
from ..literature import reference_compression
from ..model import Simulation, simulate
from ..parameters import STRING_NAMES, Geometry, String
from ..recording.recording import Recording
from ..setup import RecordingInfo, Setup, recording_info_for, relative_sd
from ..transducer import TRANSDUCERS
from . import priors
from .joint_prior import with_key_prior
from .observation_tables import KNOCK, Observations, RecordingStructure, observe
from .parametrisation import LOG_ABSENT_LOSS, STRING_SIZE, Parametrisation, names_of
from .priors import InitialValues, starting_values

# A recording with fewer partials above its noise does not constrain the hammer.
FEWEST = 3
# The maximum steps of a contact are a multiple of this: a bound need not be finer.
STEPS = 256
# The number of directions of differentiation is a multiple of this, so that fits with different given values share
# compiled programs. One direction too many costs a tenth of the derivatives' time.
DIRECTIONS = 2
# Maximum duration of a contact, relative to the literature's hammer at 2 m/s: softer, heavier and slower hammers stay
# longer. The limit is at least the time of these reflections from the agraffe, which end a contact in the bass.
LONGEST = 2.5
RETURNS = 2.0
# The rows of partials of a compiled program are a multiple of this.
ROWS = 64
# Sizes that can have a standard deviation and are not entries of the model: string length and mass, position and scale
# of the pickup.
SIZES = ("L", "M_S", "pickup", "scale")
# Range of the strike position, as a fraction of the string: on its first part, on no node of the second partial.
STRIKE = (0.04, 0.33)
# Range of the effective width of the contact, relative to the given one.
WIDTHS = (0.3, 2.0)


class StaticConfig(NamedTuple):
    """Static arguments of a compiled program of the model."""

    n_modes: int
    rows: int  # partials with levels, 1 to rows
    quantity: str
    law: Excitation
    knock: bool = False  # True if the last row is the knock


class ModelInputs(NamedTuple):
    """Inputs of the model that all strokes share."""

    geometry: Geometry  # strike position and width are those of the stroke
    rate: Any  # of the contact, Hz
    reference_compression: Any  # of the searched force, m; 0 if the stiffness is an entry itself
    steps: Any  # maximum steps of a contact, a multiple of `STEPS`
    free: Any  # int, entries of a stroke for derivatives; -1 for a direction without effect [directions]


@dataclass(frozen=True)
class FitProblem:
    """Everything that is constant during a fit."""

    recordings: tuple[Recording, ...]
    analyses: tuple[Analysis, ...]
    initial_values: InitialValues
    structure: RecordingStructure
    reference: int  # the recording that sets the string's pitch and whose stroke is reported first
    measured_velocity: tuple[float | None, ...]  # measured velocity of every stroke, m/s
    midi_velocity: tuple[float | None, ...]  # of every recording, if the setup gives it; no part of F
    velocity_without_file: bool  # whether [fixed] gives the reference's velocity without naming a recording
    # Files of [[recording]] that differ from a recording only in their kind, and that recording.
    unmatched_entries: tuple[tuple[str, str], ...]
    parametrisation: Parametrisation
    observed: Observations
    model_inputs: ModelInputs
    cfg: StaticConfig

    @property
    def has_unknown_path(self) -> bool:
        """True if an unknown path lies between the bridge and the file."""
        return self.initial_values.unknown_path

    @property
    def calibrated(self) -> bool:
        """True if levels are in the pickup's own unit."""
        return self.initial_values.scale is not None

    @property
    def key_prior(self) -> KeyPrior | None:
        """The prior of the other keys of a keyboard; None if the literature's is used."""
        return None if self.parametrisation.joint is None else self.parametrisation.joint.record

    @property
    def velocity_scale_open(self) -> bool:
        """True if one common scale of the velocities is free: neither the levels' unit nor a velocity is given."""
        is_open = self.initial_values.law.stroke.scale_is_open
        return is_open and not self.calibrated and all(v is None for v in self.measured_velocity)

    @property
    def reference_velocity_index(self) -> int:
        """Index of the reference stroke's velocity in θ."""
        return self.parametrisation.shared + self.structure.stroke[self.reference]

    @property
    def reported_parameters(self) -> dict[str, int]:
        """Indices in θ, by name, of the free shared parameters, the reference stroke's velocity and uncertain sizes."""
        u = self.parametrisation
        named = (*enumerate(u.names), (self.reference_velocity_index, u.law.stroke.name))
        return {name: i for i, name in named if u.free[i]} | self._size_indices

    @property
    def _size_indices(self) -> dict[str, int]:
        """Indices in θ, by name, of the sizes that were given with a standard deviation."""
        return {name: self.parametrisation.index_of(name) for name in self.parametrisation.sizes}

    @property
    def parameter_indices(self) -> dict[str, int]:
        """Indices in θ, by name, of the parameters of the felt law, of every velocity, and of uncertain sizes.

        `v_H0` is the velocity of the reference stroke, `v_H0 N` that of stroke N. A pluck has `x0` in its place.
        """
        u, name = self.parametrisation, self.parametrisation.law.stroke.name
        shared = {own: u.index_of(own) for own in u.reported if u.mean[u.index_of(own)] > LOG_ABSENT_LOSS}
        strokes = range(u.size)[u.velocities]
        velocities = {
            name if at == self.reference_velocity_index else f"{name} {at - u.shared + 1}": at for at in strokes
        }
        return shared | velocities | self._size_indices


def build_problem(
    recordings: Sequence[Recording], analyses: Sequence[Analysis], setup: Setup, velocity: float | None = None
) -> FitProblem:
    """Build the problem of one or more recordings of a key.

    Parameters
    ----------
    velocity : measured hammer velocity, m/s, of a single recording. It overrides the setup's.

    Raises
    ------
    FitError
        Naming the file that is given twice, is of another key, or contains only noise.
    """
    _check_recordings(recordings, analyses)
    entries = [recording_info_for(setup, recording.path, len(recordings) == 1) for recording in recordings]
    structure = _structure(entries)
    given: list[float | None] = [None] * structure.strokes
    for stroke, entry in zip(structure.stroke, entries, strict=True):
        v = setup.law.stroke.given(entry, setup) if velocity is None else velocity
        given[stroke] = given[stroke] if v is None else v
    measured = [None if v is None else float(v) for v in given]
    # The fastest recording with a measured velocity, or else the brightest.
    order = [(measured[s] or 0.0, brightness(a)) for s, a in zip(structure.stroke, analyses, strict=True)]
    reference = order.index(max(order))
    stroke = structure.stroke[reference]
    analyses = tuple(analysis.with_decay_law(analyses[reference]) for analysis in analyses)
    start = starting_values(analyses[reference], setup, measured[stroke])
    unnamed = "v_H0" in setup.fixed and measured[stroke] is None
    if unnamed:
        given[stroke] = setup.fixed["v_H0"]
        measured[stroke] = float(setup.fixed["v_H0"])
    observed = observe(analyses, structure, reference, start)
    unknowns, inputs, cfg = _model(start, given, observed, max(r.rate for r in recordings))
    if setup.prior is not None:
        scale_free = start.scale is None and all(v is None for v in given)
        unknowns = with_key_prior(unknowns, setup.prior, unknowns.shared + stroke if scale_free else None)
    observed = observed.with_velocities(unknowns.velocities.start + np.array(structure.stroke), unknowns.size)
    if not unknowns.free.any():
        raise FitError("nothing is left to fit: [fixed] fixes all parameters; remove those that the fit should find")
    return FitProblem(
        tuple(recordings),
        analyses,
        start,
        structure,
        reference,
        tuple(measured),
        tuple(entry.midi_velocity for entry in entries),
        unnamed and structure.strokes > 1,
        _unmatched(setup, recordings),
        unknowns,
        observed,
        inputs,
        cfg,
    )


def _check_recordings(recordings: Sequence[Recording], analyses: Sequence[Analysis]) -> None:
    names = [printable(Path(r.path).name) for r in recordings]
    for i, (name, recording, analysis) in enumerate(zip(names, recordings, analyses, strict=True)):
        for other in range(i):
            if recording.has_sound_of(recordings[other]):
                raise FitError(f"{name} and {names[other]} are the same recording; give it once")
        if len(recordings) > 1 and len(analysis.partials) < FEWEST:
            raise FitError(f"{name}: only {counted(len(analysis.partials), 'partial')} above its noise; leave it out")
        cents = cents_above(analysis.f0, float(np.median([a.f0 for a in analyses])))
        if abs(cents) > SAME_KEY_CENTS:
            raise FitError(
                f"{name}: its pitch, {analysis.f0:.2f} Hz, is {abs(cents):.0f} cents from that of the other "
                "recordings; all must be of one key"
            )


def _unmatched(setup: Setup, recordings: Sequence[Recording]) -> tuple[tuple[str, str], ...]:
    """Files of the setup that are probably misspelt, whose measured values are not used, and the similar file.

    A setup may name more recordings than one fit uses. If it names none of them, all its files are returned; the
    similar file is empty if there is none.
    """
    listed = {Path(entry.file).name for entry in setup.recordings if entry.file}
    names = {Path(recording.path).name for recording in recordings}
    # L1 instead of L2 is another recording, .wav instead of .flac is not.
    stems = {Path(name).stem.lower(): name for name in names - listed}
    similar = [(file, stems.get(Path(file).stem.lower())) for file in sorted(listed - names)]
    return tuple((file, name or "") for file, name in similar if name or not listed & names)


def _structure(entries: Sequence[RecordingInfo]) -> RecordingStructure:
    """Without a name, a recording has its own stroke and gain, and the path of all others without one."""

    def index(names: list) -> tuple[int, ...]:
        distinct = list(dict.fromkeys(names))
        return tuple(distinct.index(name) for name in names)

    return RecordingStructure(
        index([("", i) if e.stroke is None else e.stroke for i, e in enumerate(entries)]),
        index([e.group or "" for e in entries]),
        index([("", i) if e.gain_group is None else e.gain_group for i, e in enumerate(entries)]),
    )


def brightness(analysis: Analysis) -> float:
    """Mean number of the partials, weighted by amplitude."""
    number, amplitude = analysis.partials.number, 10 ** (analysis.partials.level / 20)
    return float((number * amplitude).sum() / amplitude.sum())


def _model(
    start: InitialValues, measured: Sequence[float | None], observed: Observations, rate: float
) -> tuple[Parametrisation, ModelInputs, StaticConfig]:
    """Priors and bounds of the parameters, and the settings of the model."""
    geometry, law = start.geometry, start.law
    string = String(*(start.values[n] for n in STRING_NAMES))
    nominal = law.nominal(start.reference_hammer)
    first = simulate(string, nominal, geometry, rate=rate, quantity=start.quantity)
    # A given stiffness is fixed as it is.
    fixed = law.power is None or law.power[0] in start.fixed
    u_ref = None if fixed else reference_compression(midi_of(string.c / (2 * geometry.length)))
    unknowns = prior_parametrisation(start, measured, u_ref)
    round_trip = 2 * geometry.strike_position / string.c
    contact_rate, steps, rows = simulation_grid(first, round_trip, int(observed.number.max()), LONGEST)
    free = np.append(np.flatnonzero(unknowns.moving[STRING_SIZE : unknowns.shared]), unknowns.shared - STRING_SIZE)
    free = np.pad(free, (0, -len(free) % DIRECTIONS), constant_values=-1)
    sizes = Geometry(*map(np.float64, geometry))  # pyright: ignore[reportArgumentType]
    inputs = ModelInputs(sizes, np.float64(contact_rate), np.float64(u_ref or 0.0), np.int64(steps), free)
    # Without contact, modes above the highest partial have no effect.
    modes = max(first.modes.pole.shape[0] if law.has_contact else 0, rows)
    knock = KNOCK in observed.number
    return unknowns, inputs, StaticConfig(modes, rows, start.quantity, law, knock)


def simulation_grid(first: Simulation, round_trip: float, last: int, longest: float) -> tuple[float, int, int]:
    """The contact's rate, Hz, its maximum steps, and rows of partials, in multiples by which notes share programs.

    Parameters
    ----------
    first : a stroke; contacts may be longer than its own by the factor `longest`.
    round_trip : time of a wave from the hammer to the agraffe and back, s.
    last : number of the last partial.
    """
    rate = 1.0 / float(first.modes.step)
    steps = STEPS * int(np.ceil(max(longest * first.last_touch, RETURNS * round_trip) * rate / STEPS))
    return rate, steps, ROWS * int(np.ceil(last / ROWS))


def prior_parametrisation(
    start: InitialValues, measured: Sequence[float | None], u_ref: float | None
) -> Parametrisation:
    """Return priors and bounds of all parameters.

    Parameters
    ----------
    measured : measured velocity of every stroke, m/s, or None.
    u_ref : reference compression of the searched force, m; None if the stiffness itself is searched.
    """
    values, geometry, law = start.values, start.geometry, start.law
    names = names_of(law)
    sizes = tuple(name for name in SIZES if name in start.relative_sd and name not in names)
    spread = priors.STRING_SD | priors.HAMMER_SD | {n: p.prior_sd for n, p in law.parameters.items()}
    spread |= law.spreads
    if not TRANSDUCERS[start.quantity].on_string:
        spread.pop("pickup", None)
    # A loss that the law does not have gets no spread, so it is fixed.
    mean = [np.log(max(values[n], 1e-300)) if n in spread else LOG_ABSENT_LOSS for n in names]
    sd = [0.0 if _is_exact(start, n) else spread.get(n, 0.0) for n in names]
    if start.unknown_path and law.has_contact:  # it absorbs the effect of the width
        sd[names.index("width")] = 0.0
    sd = [float(np.hypot(own, start.relative_sd.get(n, 0.0))) for n, own in zip(names, sd, strict=True)]
    median, stroke_sd = law.stroke.prior(geometry)
    mean += [np.log(median if v is None else float(v)) for v in measured]
    sd += [stroke_sd if v is None else relative_sd(v) for v in measured]
    mean = np.array(mean + [np.log(start.size_value(name)) for name in sizes])
    sd = np.array(sd + [start.relative_sd[name] for name in sizes])
    lower, upper = _bounds(start, names, len(measured), len(sizes))
    mean = np.where(sd > 0, np.clip(mean, lower, upper), mean)
    if law.power is not None and u_ref is not None:  # the force is searched
        mean[names.index(law.power[0])] += law.log_power(u_ref, values)
    # A fitted width is an effective one, with the given width only as the centre of its prior.
    given = [_is_exact(start, n) or (n == "width" and _is_fixed(start, n) and start.unknown_path) for n in names]
    given = np.array([*given, *(v is not None for v in measured)])
    given = np.append(given, np.zeros(len(sizes), bool))
    scaling = {"L": priors.LENGTH_EXPONENTS, "M_S": {"M_H": 1.0, **{n: law.force_exponent(n) for n in law.parameters}}}
    exponents = np.zeros((len(sizes), len(mean)))
    for row, size in enumerate(sizes):
        exponents[row, : len(names)] = [scaling.get(size, {}).get(name, 0.0) for name in names]
    exponents *= given | (sd > 0)  # an assumed value, such as the contact width, is fixed as it is
    return Parametrisation(mean, sd, lower, upper, u_ref, geometry, law, sizes, exponents, given)


def _is_fixed(start: InitialValues, name: str) -> bool:
    return start.fixed.get(name) == "fixed"


def _is_exact(start: InitialValues, name: str) -> bool:
    """True if the given value is that of the model. The width of a hammer's contact is an effective one."""
    return _is_fixed(start, name) and not (name == "width" and start.law.has_contact)


def _bounds(start: InitialValues, names: Sequence[str], strokes: int, sizes: int) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of the logarithms of all values [size]. Values given with a standard deviation have only their prior."""
    geometry = start.geometry
    bounds = {n: (box.lower, box.upper) for n, box in (ALL_PARAMETERS | start.law.hammer_parameters).items()}
    bounds["x0"] = max(STRIKE[0] * geometry.length, 0.51 * geometry.width), STRIKE[1] * geometry.length
    bounds["width"] = WIDTHS[0] * geometry.width, WIDTHS[1] * geometry.width
    stroke = start.law.stroke
    own = {name: (low * geometry.length, high * geometry.length) for name, (low, high) in start.law.ranges.items()}
    bounds |= own | {stroke.name: stroke.bounds(geometry)} | start.bounds
    logs = np.log([bounds[n] for n in names] + [bounds[stroke.name]] * strokes)
    for name in {"x0", "pickup"} & {*names} & {*start.relative_sd}:
        logs[names.index(name)] = -np.inf, np.inf
    lower, upper = np.concatenate([logs, np.tile([-np.inf, np.inf], (sizes, 1))]).T
    return lower, upper
