"""What the paper's recipes search: one recording, the nine parameters' box, and how the contact is computed.

A point `x` [9] holds the felt's log force at a reference compression, losses as they are, and the logarithms of the
rest: K_H and p trade off along equal force at the compressions that a stroke really reaches.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import jax
import numpy as np

from ..analysis import Analysis
from ..criterion import band_of, line_sigma
from ..inference.align import lag, placed
from ..inference.start import Start
from ..model import simulate
from ..model.note import arrival
from ..parameters import FIT_NAMES, PARAMETERS, Geometry, Hammer, String
from ..recording import Recording
from .spectral import Goal, spectral_goal
from .struck import Cfg, Scene

__all__ = ["LINEAR", "Problem", "logs", "pose", "split"]

# Which of the nine are searched as they are, not by their logarithm.
LINEAR = np.isin(FIT_NAMES, ("b1", "b2"))
K = FIT_NAMES.index("K_H")
P = FIT_NAMES.index("p")
# A loss coefficient that the felt's law does not have is held at this on its log scale, s/m.
ABSENT = 1e-12
# The contact may last this many times as long as that of the literature's hammer,
CONTACTS = 1.6
# and until so many reflections came back from the agraffe: in the bass they throw the hammer off.
RETURNS = 2.0
# Steps of a contact and rows of the table come in whole multiples of these, so that notes share compiled programs.
STEPS = 256
ROWS = 64
# How much of the attack shows when the hammer touched, s.
ATTACK = 0.05
# σ of the string's steps in units of the criterion's.
SIGMAS = np.array([1.0, 1 / 3, 0.1, 1 / 30, 0.01])
# The least σ in units of 1/s over the recording's length,
LEAST_SIGMA = 1.0
# and in units of the glide, 1/s: what a glide blurs is not resolved.
GLIDES = 8.0
CENT = math.log(2.0) / 1200
# A parameter is on an edge of the box within this part of the box's logarithmic width.
EDGE = 1e-6


@dataclass(frozen=True)
class Problem:
    """One recording, and the box in which string and hammer are searched; arrays are [9], in the order of `FIT_NAMES`.

    `start` holds quantity, scale and geometry; the strike position is held.
    """

    recording: Recording
    analysis: Analysis
    start: Start
    values: np.ndarray  # natural units: where the search starts
    lower: np.ndarray
    upper: np.ndarray
    free: np.ndarray  # bool
    rate: float  # of the contact, Hz
    log_u: float  # log of the reference compression, m; of 1 m where the stiffness is known, which is then the force
    delay: float  # s, from the first contact to the recording's onset
    cfg: Cfg

    @property
    def calibrated(self) -> bool:
        """Whether the recording is in the pickup's own unit."""
        return self.start.scale is not None

    @property
    def last(self) -> int:
        """Number of the last partial found."""
        return int(self.analysis.partials.number.max())

    @property
    def sigma(self) -> float:
        """σ of the reported criterion, 1/s."""
        return line_sigma(self.analysis.f0)

    @property
    def sigmas(self) -> list[float]:
        """σ of the string's steps, 1/s, falling: no finer than the recording's length or its glide allow."""
        seconds = (len(self.recording.samples) - self.recording.onset) / self.recording.rate
        glide = 2 * np.pi * abs(self.analysis.glide_cents) * CENT * self.analysis.f0
        least = min(max(LEAST_SIGMA / seconds, GLIDES * glide), self.sigma)
        return [*(s for s in self.sigma * SIGMAS if s > least), least]

    def band(self, wanted: int) -> int:
        """The band wanted, or the next with a partial in it."""
        occupied = np.unique(band_of(self.analysis.partials.number)).tolist()
        return next((b for b in occupied if b >= wanted), max(occupied))

    def goal(self, bands: Sequence[int], sigma: float) -> Goal:
        """Eq. 19 on some bands."""
        r, a = self.recording, self.analysis
        return spectral_goal(
            r.samples[r.onset :], r.rate, a.f0, a.B, self.last, sigma, bands=bands, delay=self.delay,
            unit=self.start.scale or 1.0, calibrated=self.calibrated,
        )  # fmt: skip

    def scene(self) -> Scene:
        """What stays while parameters are searched; a stiffness that is known needs no bounds."""
        geometry = Geometry(*map(np.float64, self.start.geometry))
        stiff = np.log([self.lower[K], self.upper[K]]) if self.free[K] else np.array([-np.inf, np.inf])
        return Scene(*jax.tree.map(np.asarray, (geometry, self.rate, self.log_u, stiff)))

    def x(self, values: np.ndarray) -> np.ndarray:
        """The point [9] of natural `values` [9]."""
        x = np.where(LINEAR, values, np.log(values))
        x[K] += values[P] * self.log_u
        return x

    def natural(self, x: np.ndarray) -> np.ndarray:
        """Natural values [9] of the point `x`, within the box to the last digit; what is held is exactly as given."""
        values = np.exp(logs(x))
        values[K] = np.exp(x[K] - values[P] * self.log_u)
        return np.where(self.free, np.clip(values, self.lower, self.upper), self.values)

    def box(self, x: np.ndarray, reach: np.ndarray, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        """Edges [9], [9] no farther than `reach` [9] from `x` between which the free ones of `names` may move."""
        lower, upper = (np.where(LINEAR, edge, np.log(edge)) for edge in (self.lower, self.upper))
        # The force has no bounds of its own; the scene has the stiffness's.
        lower[K], upper[K] = -np.inf, np.inf
        moves = np.isin(FIT_NAMES, names) & self.free
        return np.where(moves, np.maximum(lower, x - reach), x), np.where(moves, np.minimum(upper, x + reach), x)

    def at_bound(self, values: np.ndarray) -> tuple[str, ...]:
        """Names of the free parameters whose `values` [9] lie on an edge of the box."""
        value, low, high = np.log([values, self.lower, self.upper])
        on = self.free & (np.minimum(value - low, high - value) <= EDGE * (high - low))
        return tuple(name for name, here in zip(FIT_NAMES, on, strict=True) if here)

    def first_contact(self, values: np.ndarray) -> float:
        """Time from the first contact to the onset, s: the attack of `values` [9] is laid on the recorded one.

        The onset is where a sound is first seen; the attack says when the hammer touched. For calibrated recordings.
        """
        rate, onset, samples = self.recording.rate, self.recording.onset, int(ATTACK * self.recording.rate)
        sound = simulate(*split(values), self.start.geometry, rate=rate, quantity=self.start.quantity)
        model, recorded = sound.waveform(rate, samples), self.recording.samples * (self.start.scale or 1.0)
        # From one length of the attack before the guess to one after it.
        first = onset - round(self.delay * rate) - samples
        near = np.pad(recorded, (max(-first, 0), 3 * samples))[max(first, 0) :][: 3 * samples]
        at, sign = placed(model, near)
        late = first + at + lag(model, sign * near[at:][:samples])
        return (onset - late) / rate


def pose(recording: Recording, analysis: Analysis, start: Start) -> Problem:
    """The problem from the user's initial values; the contact's rate and length are from a stroke with these.

    Raises
    ------
    FitError
        If that contact does not end.
    """
    values, lower, upper, free = _box(start)
    string, hammer = split(values)
    first = simulate(string, hammer, start.geometry, rate=recording.rate, quantity=start.quantity)
    rate = 1.0 / float(first.modes.step)
    longest = max(CONTACTS * first.last_touch, 2 * RETURNS * start.geometry.strike / string.c)
    steps = STEPS * math.ceil(longest * rate / STEPS)
    rows = ROWS * math.ceil(int(analysis.partials.number.max()) / ROWS)
    log_u = float(np.log(0.5 * first.pulse.compression.max())) if free[K] else 0.0
    return Problem(
        recording, analysis, start, values, lower, upper, free, rate, log_u,
        arrival(string, start.geometry, start.quantity),
        Cfg(max(first.modes.pole.shape[0], rows), steps, start.quantity),
    )  # fmt: skip


def logs(x: np.ndarray) -> np.ndarray:
    """Search coordinates of `struck` [..., 9], logarithms throughout, of points `x` [..., 9]."""
    return np.where(LINEAR, np.log(np.where(LINEAR, x, 1.0)), x)


def split(values: np.ndarray) -> tuple[String, Hammer]:
    """String and hammer of natural `values` [9]."""
    string, hammer = String(*map(float, values[: len(String._fields)])), Hammer(*map(float, values[K:]))
    return string, hammer._replace(mu=hammer.mu if hammer.mu > ABSENT else 0.0)


def _box(start: Start) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Values, edges and what is free, each [9]; what is held has no width."""
    absent = np.array([name == "mu" and name not in start.law.parameters for name in FIT_NAMES])
    free = np.array([name not in start.fixed for name in FIT_NAMES]) & ~absent
    bounds = np.array([start.bounds.get(n, (PARAMETERS[n].lower, PARAMETERS[n].upper)) for n in FIT_NAMES])
    given = np.array([(start.values if n in start.fixed else start.initial)[n] for n in FIT_NAMES], float)
    held = np.where(absent, ABSENT, given)
    lower, upper = np.where(free, bounds.T, held)
    return np.clip(held, lower, upper), lower, upper, free
