"""One fit as a problem: which recordings, what they share, what is known beforehand, and what the model is run at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..analysis import SAME_KEY, Analysis, cents_above
from ..errors import FitError
from ..felt import BOXES
from ..io.files import printable
from ..io.number_format import counted
from ..model import Simulation, simulate
from ..parameters import STRING_NAMES, String
from ..recording.recording import Recording
from ..setup import RecordingInfo, Setup, recording_info_for
from . import priors
from .batched_model import ModelInputs, StaticConfig
from .initial_values import InitialValues, starting_values
from .observation_tables import Observations, RecordingStructure, observe, string_residuals
from .parametrisation import ABSENT, STRING_SIZE, Parametrisation, names_of

__all__ = ["FitProblem", "simulation_grid", "build_problem"]

# A recording with fewer partials above its noise says nothing of the hammer.
FEWEST = 3
# A search's contacts may last a whole number of times this many steps: of a bound no more need be known.
STEPS = 256
# Directions in which a compiled program differentiates come in whole multiples of this, so that fits of which more or
# less is known share them: one too many costs a tenth of the derivatives' time.
DIRECTIONS = 2
# A contact has this many times as long as that of the literature's hammer at 2 m/s (softer, heavier and slower hammers
# stay longer), and until the reflection from the agraffe has come back twice, which in the bass throws it off.
LONGEST = 2.5
RETURNS = 2.0
# Rows of partials in a compiled program come in whole multiples of this.
ROWS = 64
# Where the strike may lie, as a share of the string: on its first part, on no node of the second partial.
STRIKE = (0.04, 0.33)
# An effective width of the contact lies within these factors of the given one.
WIDTHS = (0.3, 2.0)


@dataclass(frozen=True)
class FitProblem:
    """Everything that stays while a fit searches."""

    recordings: tuple[Recording, ...]
    analyses: tuple[Analysis, ...]
    start: InitialValues
    layout: RecordingStructure
    reference: int  # the recording whose pitch is the string's, and whose stroke is shown first
    measured_velocity: tuple[float | None, ...]  # measured velocity of every stroke, m/s
    assumed_velocity_of: bool  # that the reference's is the one in [fixed], which names no recording
    unmatched_entries: tuple[
        tuple[str, str], ...
    ]  # files of [[recording]] that are a recording's but for their kind, and it
    unknowns: Parametrisation
    observed: Observations
    scene: ModelInputs
    cfg: StaticConfig

    @property
    def path(self) -> bool:
        """Whether an unknown path lies between the bridge and the file."""
        return self.start.scale is None and self.start.quantity == "pressure"

    @property
    def calibrated(self) -> bool:
        """Whether levels are in the pickup's own unit."""
        return self.start.scale is not None

    @property
    def velocity_scale_free(self) -> bool:
        """Whether one common scale of the velocities is open: neither a unit of the levels nor a velocity is known."""
        return not self.calibrated and all(v is None for v in self.measured_velocity)

    @property
    def velocity(self) -> int:
        """Where the velocity of the reference's stroke stands among the unknowns."""
        return self.unknowns.shared + self.layout.stroke[self.reference]

    def string_residuals(self, string: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Of frequencies and decays residuals [1, K] and their laws' derivatives [1, K, 4] at a `string` [4]."""
        o = self.observed
        measured = o.frequency.value[0], o.decay.value[0]
        return string_residuals(string, measured, o.string_number, o.law, float(self.start.geometry.length))


def build_problem(
    recordings: Sequence[Recording], analyses: Sequence[Analysis], setup: Setup, velocity: float | None = None
) -> FitProblem:
    """Pose the problem of one or more recordings of a key.

    Parameters
    ----------
    velocity : measured hammer velocity, m/s, of a single recording; overrides the setup's.

    Raises
    ------
    FitError
        Naming the file that is given twice, of another key, or all noise.
    """
    _refuse(recordings, analyses)
    entries = [recording_info_for(setup, recording.path, len(recordings) == 1) for recording in recordings]
    layout = _layout(entries)
    measured = [velocity if velocity is not None else entry.v_H0 for entry in entries]
    speed: list[float | None] = [None] * layout.strokes
    for stroke, v in zip(layout.stroke, measured, strict=True):
        speed[stroke] = speed[stroke] if v is None else v
    reference = _reference(analyses, layout, speed)
    analyses = tuple(analysis.with_decay_law(analyses[reference]) for analysis in analyses)
    start = starting_values(analyses[reference], replace(setup, recordings=()), speed[layout.stroke[reference]])
    nameless = "v_H0" in setup.fixed and speed[layout.stroke[reference]] is None
    if nameless:
        speed[layout.stroke[reference]] = setup.fixed["v_H0"]
    scale = 0.0 if start.scale is None else 20 * np.log10(start.scale)
    path = start.scale is None and start.quantity == "pressure"
    observed = observe(analyses, layout, reference, scale, path, start.scale is None)
    unknowns, scene, cfg = _model(start, speed, observed, max(r.rate for r in recordings), path)
    if not unknowns.free.any():
        raise FitError("nothing is left to fit: [fixed] holds everything; leave out what is to be found")
    return FitProblem(
        tuple(recordings), analyses, start, layout, reference, tuple(speed), nameless and layout.strokes > 1,
        _unmatched(setup, recordings), unknowns, observed, scene, cfg,
    )  # fmt: skip


def _refuse(recordings: Sequence[Recording], analyses: Sequence[Analysis]) -> None:
    names = [printable(Path(r.path).name) for r in recordings]
    for i, (name, recording, analysis) in enumerate(zip(names, recordings, analyses, strict=True)):
        for other in range(i):
            if recording.sha256 == recordings[other].sha256:
                raise FitError(f"{name} and {names[other]} are the same recording; give it once")
        if len(recordings) > 1 and len(analysis.partials) < FEWEST:
            raise FitError(f"{name}: only {counted(len(analysis.partials), 'partial')} above its noise; leave it out")
        cents = cents_above(analysis.f0, float(np.median([a.f0 for a in analyses])))
        if abs(cents) > SAME_KEY:
            raise FitError(
                f"{name}: its pitch, {analysis.f0:.2f} Hz, is {abs(cents):.0f} cents from that of the other "
                "recordings; all must be of one key"
            )


def _unmatched(setup: Setup, recordings: Sequence[Recording]) -> tuple[tuple[str, str], ...]:
    """A setup may know more recordings than one fit has; of one misspelt what was measured would be lost."""
    said = {Path(entry.file).name for entry in setup.recordings if entry.file}
    names = {Path(recording.path).name for recording in recordings}
    # L1 for L2 is another recording, .wav for .flac is not.
    stems = {Path(name).stem.lower(): name for name in names - said}
    near = [(one, stems.get(Path(one).stem.lower())) for one in sorted(said - names)]
    return tuple((one, name) for one, name in near if name)


def _layout(entries: Sequence[RecordingInfo]) -> RecordingStructure:
    def index(names: list) -> tuple[int, ...]:
        known = list(dict.fromkeys(names))
        return tuple(known.index(name) for name in names)

    alone = [("", i) for i in range(len(entries))]
    return RecordingStructure(
        index([own if e.stroke is None else e.stroke for e, own in zip(entries, alone, strict=True)]),
        index([e.group or "" for e in entries]),
        index([own if e.gain_group is None else e.gain_group for e, own in zip(entries, alone, strict=True)]),
    )


def _reference(analyses: Sequence[Analysis], layout: RecordingStructure, speed: Sequence[float | None]) -> int:
    """The fastest recording whose velocity was measured, else the brightest."""

    def order(i: int) -> tuple[float, float]:
        p = analyses[i].partials
        amplitude = 10 ** (p.level / 20)
        return speed[layout.stroke[i]] or 0.0, float((p.number * amplitude).sum() / amplitude.sum())

    return max(range(len(analyses)), key=order)


def _model(
    start: InitialValues, speed: Sequence[float | None], observed: Observations, rate: float, path: bool
) -> tuple[Parametrisation, ModelInputs, StaticConfig]:
    """Priors and boxes of the unknowns, and what the model is run at."""
    geometry = start.geometry
    string = String(*(start.values[n] for n in STRING_NAMES))
    first = simulate(string, start.reference_hammer._replace(v_H0=2.0), geometry, rate=rate, quantity=start.quantity)
    # A stiffness that is known is held as it is: at 1 m it is the force.
    held = start.law.power is None or start.law.power[0] in start.fixed
    log_u = 0.0 if held else float(np.log(0.5 * first.pulse.compression.max()))
    unknowns = _unknowns(start, speed, log_u, path)
    contact_rate, steps, rows = simulation_grid(
        first, 2 * geometry.strike_position / string.c, int(observed.number.max()), LONGEST
    )
    size = tuple(map(np.float64, geometry))
    free = np.append(np.flatnonzero(unknowns.free[STRING_SIZE : unknowns.shared]), unknowns.shared - STRING_SIZE)
    free = np.pad(free, (0, -len(free) % DIRECTIONS), constant_values=-1)
    scene = ModelInputs(type(geometry)(*size), np.float64(contact_rate), np.float64(log_u), np.int64(steps), free)  # pyright: ignore[reportArgumentType]
    return unknowns, scene, StaticConfig(max(first.modes.pole.shape[0], rows), rows, start.quantity, start.law)


def simulation_grid(first: Simulation, round_trip: float, last: int, longest: float) -> tuple[float, int, int]:
    """The contact's rate, Hz, its steps, and rows of partials, in the multiples by which notes share programs.

    Parameters
    ----------
    first : a stroke; contacts may be so many times as long as its own (`longest`).
    round_trip : of a wave, from the hammer to the agraffe and back, s.
    last : number of the last partial.
    """
    rate = 1.0 / float(first.modes.step)
    steps = STEPS * int(np.ceil(max(longest * first.last_touch, RETURNS * round_trip) * rate / STEPS))
    return rate, steps, ROWS * int(np.ceil(last / ROWS))


def _unknowns(start: InitialValues, speed: Sequence[float | None], log_u: float, path: bool) -> Parametrisation:
    values, geometry, law = start.values, start.geometry, start.law
    names, boxes = names_of(law), BOXES | law.boxes
    spread = priors.STRING_SPREAD | priors.HAMMER_SPREAD | {n: p.prior_sd for n, p in law.parameters.items()}
    # A loss that the law does not have has no spread, and is held.
    mean = np.array([np.log(max(values[n], 1e-300)) if n in spread else ABSENT for n in names])
    sd = np.array([0.0 if n != "width" and start.fixed.get(n) == "fixed" else spread.get(n, 0.0) for n in names])
    if path:  # through a path the width tells nothing: what it does, the path would
        sd[names.index("width")] = 0.0
    length, width = geometry.length, geometry.width
    edges = {n: (float(np.log(box.lower)), float(np.log(box.upper))) for n, box in boxes.items()}
    edges["x0"] = float(np.log(max(STRIKE[0] * length, 0.51 * width))), float(np.log(STRIKE[1] * length))
    edges["width"] = tuple(np.log(np.array(WIDTHS) * width).tolist())
    edges |= {n: tuple(np.log(pair).tolist()) for n, pair in start.bounds.items()}
    stiffness = (-np.inf, np.inf)
    if law.power is not None:  # it is the force that is searched, and K_H that has bounds
        stiff, exponent = law.power
        mean[names.index(stiff)] += values[exponent] * log_u
        stiffness, edges[stiff] = edges[stiff], stiffness
    known = [v is not None for v in speed]
    velocities = [np.log(priors.VELOCITY if v is None else v) for v in speed]
    lower, upper = np.array([edges[n] for n in names] + [edges["v_H0"]] * len(speed)).T
    mean = np.append(mean, velocities)
    sd = np.append(sd, [0.0 if k else priors.VELOCITY_SPREAD for k in known])
    mean = np.where(sd > 0, np.clip(mean, lower, upper), mean)
    return Parametrisation(mean, sd, lower, upper, log_u, stiffness, geometry, law)
