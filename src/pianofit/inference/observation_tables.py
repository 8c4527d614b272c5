"""From analyses of one key to the tables that the likelihood compares: levels, frequencies and decays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..analysis import Analysis, law_frequency
from . import priors
from .likelihood import ObservationTable

__all__ = ["RecordingStructure", "Observations", "observe", "scatter_by_number", "string_law", "string_residuals"]

# Levels of partials above this, Hz, stand in no table: few hammers and fewer microphones reach them.
HIGHEST = 10_000.0
# A τ that is not there, log dB.
NONE = -50.0
CENTS = 1200 / np.log(2)


@dataclass(frozen=True)
class RecordingStructure:
    """What recordings share: for each, which stroke it is of, and whose path and whose gain it has [recordings]."""

    stroke: tuple[int, ...]
    group: tuple[int, ...]
    gain: tuple[int, ...]

    @property
    def strokes(self) -> int:
        """How many."""
        return max(self.stroke) + 1

    @property
    def groups(self) -> int:
        """How many paths."""
        return max(self.group) + 1

    def velocities(self, group: int) -> int:
        """How many strokes a path was heard with."""
        return len({s for s, g in zip(self.stroke, self.group, strict=True) if g == group})

    @property
    def path_identifiable(self) -> bool:
        """Whether any path was heard with two velocities: only then it and the hammer can be told apart."""
        return any(self.velocities(g) > 1 for g in range(self.groups))


@dataclass(frozen=True)
class Observations:
    """The tables, and what their columns are."""

    number: np.ndarray  # int, k of the levels' columns [K]
    level: ObservationTable
    frequency: ObservationTable  # of one virtual recording, cents over the reference's law
    decay: ObservationTable  # likewise, logarithms over that law's
    string_number: np.ndarray  # int, k of their columns
    law: np.ndarray  # the reference's law: Hz and 1/s [2, columns]
    cents: np.ndarray  # of every recording's string over the reference's when it was struck [R]


def string_law(string, number: np.ndarray, length: float, xp=np):
    """Frequency, Hz, and decay, 1/s, of partials k [2, K], and their derivatives by `string` [2, K, 4].

    `string` holds the logarithms of c, κ, b1 and b2. Derivatives are of the logarithm of the frequency and of
    the decay. `xp` is NumPy, or JAX's.
    """
    c, kappa, b1, b2 = xp.exp(string)
    s = (number * xp.pi / length) ** 2
    omega2, alpha = c**2 * s + kappa**2 * s**2, b1 + b2 * s
    frequency = xp.sqrt(omega2 - xp.minimum(alpha, 0.9 * xp.sqrt(omega2)) ** 2) / (2 * xp.pi)
    zero = xp.zeros_like(s)
    pitch = xp.stack([c**2 * s / omega2, kappa**2 * s**2 / omega2, zero, zero], axis=-1)
    loss = xp.stack([zero, zero, b1 + zero, b2 * s], axis=-1)
    return xp.stack([frequency, alpha]), xp.stack([pitch, loss])


def string_residuals(string, measured, number, law, length, xp=np):
    """Residuals [1, K], of frequencies, cents, and of log decays, and their laws' derivatives [1, K, 4].

    Parameters
    ----------
    string : logarithms of c, κ, b1 and b2.
    measured : what the tables hold, over `law` [K] each.
    number, law : partials k [K] and the reference's law [2, K]; `length` of the string, m.
    """
    value, slope = string_law(string, number, length, xp)
    laws = CENTS * xp.log(value[0] / law[0]), xp.log(value[1] / law[1])
    slopes = CENTS * slope[0], slope[1] / value[1][:, None]
    return [(y - own)[None] for y, own in zip(measured, laws, strict=True)], [s[None] for s in slopes]


def observe(
    analyses: Sequence[Analysis], layout: RecordingStructure, reference: int, unit: float, path: bool, gains: bool
) -> Observations:
    """The tables of recordings of one key.

    Parameters
    ----------
    reference : which recording's pitch is the string's.
    unit : dB, of the pickup's unit over full scale.
    path, gains : whether what lies between pickup and file is unknown, and how loud.
    """
    ref = analyses[reference]
    cents = np.array([CENTS * np.log(a.f0 / ref.f0) + a.glide_start for a in analyses])
    heard = np.unique(np.concatenate([a.partials.number for a in analyses]))
    # Of levels also those between that were found nowhere; through an unknown path they say nothing.
    number = heard if path else np.arange(1, heard.max() + 1)
    number = number[law_frequency(ref.f0, ref.B, number) < HIGHEST]
    level = _levels(analyses, layout, number, ref, unit, path, gains)
    law = np.stack([law_frequency(ref.f0, ref.B, heard), ref.b1 + ref.d2 * heard**2])
    frequency, decay = _string_tables(analyses, heard, law, ref)
    return Observations(number, level, frequency, decay, heard, law, cents)


def scatter_by_number(table: np.ndarray, numbers: np.ndarray, number: np.ndarray, fill: float) -> np.ndarray:
    """Values `table` of partials `numbers`, where `number` has them [K]."""
    by_number = np.full(max(numbers.max(initial=0), number.max()) + 1, fill)
    by_number[numbers] = table
    return by_number[number]


def _covariance(matrices: Sequence[np.ndarray], numbers: Sequence[np.ndarray], number: np.ndarray) -> np.ndarray:
    """Mean of the recordings' systematic covariances [K, K]; each entry of those that have it."""
    total, count = np.zeros((len(number), len(number))), np.zeros(len(number))
    for matrix, own in zip(matrices, numbers, strict=True):
        at, inside = np.searchsorted(number, own), np.isin(own, number)
        total[np.ix_(at[inside], at[inside])] += matrix[np.ix_(inside, inside)]
        count[at[inside]] += 1
    scale = 1 / np.sqrt(np.maximum(count, 1))
    return total * np.outer(scale, scale)


def _apart(frequency: np.ndarray) -> np.ndarray:
    """Octaves between partials [K, K]."""
    x = np.log2(frequency)
    return np.abs(x[:, None] - x)


def _one_hot(index: Sequence[int]) -> np.ndarray:
    return np.eye(max(index) + 1)[list(index)]


def _levels(
    analyses: Sequence[Analysis],
    layout: RecordingStructure,
    number: np.ndarray,
    ref: Analysis,
    unit: float,
    path: bool,
    gains: bool,
) -> ObservationTable:
    tables = [a.partials for a in analyses]
    frequency = law_frequency(ref.f0, ref.B, number)
    value = np.stack([scatter_by_number(t.level, t.number, number, np.nan) for t in tables])
    bound = np.stack([scatter_by_number(t.absent_bound, t.absent, number, np.nan) for t in tables])
    error = np.stack([scatter_by_number(t.level_error, t.number, number, 1.0) for t in tables])
    found, absent = np.isfinite(value), np.isfinite(bound) & ~np.isfinite(value)
    if path:  # a partial that was found nowhere says nothing through a path that is not known
        absent &= found.any(axis=0)
    level = np.where(found, value, np.where(absent, bound, np.nan))
    loudest = np.nanmax(level, axis=1, keepdims=True)
    nodes, weight = _path_nodes(layout.groups, path)
    alpha = ref.b1 + ref.d2 * number.astype(float) ** 2
    columns, scale = _columns(layout, alpha, gains, ref.f0)
    hyper = priors.LEVEL
    return ObservationTable(
        value=np.nan_to_num(level + unit),
        variance=np.where(found, error**2, priors.ABSENT_MARGIN**2),
        detected=found.astype(float),
        censored=np.argwhere(absent),
        group=_one_hot(layout.group),
        columns=columns,
        scale=scale,
        systematic=_covariance([t.level_systematic for t in tables], [t.number for t in tables], number),
        distance_octaves=_apart(frequency),
        has_unknown_path=np.full(layout.groups, float(path)),
        log_tau=nodes,
        log_weight=np.log(weight[:, None] * np.full(len(scale), 1 / len(scale))),
        variance_profile=np.ones(len(number)),
        ratio=np.nan_to_num(10 ** ((loudest - level) / 20)),
        prior=(hyper.log_median, np.array(hyper.spread)),
        degrees_of_freedom=np.float64(priors.STUDENT),
    )


def _columns(layout: RecordingStructure, alpha: np.ndarray, gains: bool, f0: float) -> tuple[np.ndarray, np.ndarray]:
    """Columns [Q, R, K] and prior standard deviations of their coefficients at every node of the gains [nodes, Q].

    Every recording's onset, in s; if gains are unknown, each path's, and how far apart those of its recordings are, dB.
    """
    recordings = len(layout.stroke)
    onset = np.eye(recordings)[:, :, None] * (20 / np.log(10) * alpha)
    late = np.full((1, recordings), np.hypot(priors.ONSET, priors.ONSET_PERIODS / f0))
    if not gains:
        return onset, late
    path, own = _one_hot(layout.group).T, _one_hot(layout.gain).T
    several = [len({g for g, p in zip(layout.gain, layout.group, strict=True) if p == q}) > 1 for q in layout.group]
    own = own[(own * several).any(axis=1)]
    apart = np.array(priors.GAINS_APART if len(own) else [0.0])[:, None]
    wide = np.concatenate([path, own])[:, :, None] * np.ones_like(alpha)
    one = np.ones_like(apart)
    return np.concatenate([wide, onset]), np.concatenate(
        [one * np.full(len(path), priors.GAIN), apart * np.ones(len(own)), one * late], axis=1
    )


def _path_nodes(groups: int, path: bool) -> tuple[np.ndarray, np.ndarray]:
    """log τ at the nodes of its prior, the same for every group [T, G], and their weights."""
    if not path:
        return np.full((1, groups), NONE), np.ones(1)
    nodes, weight = priors.path_nodes()
    return np.repeat(nodes[:, None], groups, axis=1), weight


def _string_tables(
    analyses: Sequence[Analysis], number: np.ndarray, law: np.ndarray, ref: Analysis
) -> tuple[ObservationTable, ObservationTable]:
    """Frequencies, cents, and logarithms of decays, both over the reference's law, of all recordings as of one.

    Real strings leave their law in all recordings alike: together they say no more of it than one.
    """
    pitch, loss = [], []
    for a in analyses:
        t = a.partials
        own, shared = (law_frequency(x.f0, x.B, t.number) for x in (a, ref))
        # Every recording over its own pitch, and the reference's own inharmonicity.
        cents = CENTS * np.log(t.frequency / own) + CENTS * np.log(own / a.f0 / (shared / ref.f0))
        per_hertz, decay = CENTS / t.frequency, ref.b1 + ref.d2 * t.number**2
        pitch.append((
            t.number, cents, t.frequency_error * per_hertz, t.frequency_systematic * np.outer(per_hertz, per_hertz),
        ))  # fmt: skip
        loss.append((
            t.number, np.log(t.decay / decay), t.decay_error / t.decay, t.decay_systematic / np.outer(decay, decay),
        ))  # fmt: skip
    growth = 1 + (number / priors.LAW_REACH) ** 6
    known = np.full((1, 1, len(number)), max(ref.glide_error, 1e-9))
    return (
        _string_table(law, *_pool_recordings(number, pitch), growth, known, priors.FREQUENCY),
        _string_table(law, *_pool_recordings(number, loss), np.ones(len(number)), 0 * known, priors.DECAY),
    )


def _pool_recordings(number: np.ndarray, recordings: Sequence[tuple]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weighted means over recordings, their variances from noise [K], and the systematic covariance [K, K].

    Of each recording: its partials' numbers, their values, standard errors, and systematic covariance.
    """
    weight, total, noise = np.zeros((3, len(number)))
    for own, value, error, systematic in recordings:
        at = np.searchsorted(number, own)
        w = 1 / (error**2 + np.diag(systematic))
        weight[at] += w
        total[at] += w * value
        noise[at] += w**2 * error**2
    numbers, _, _, systematics = zip(*recordings, strict=True)
    return total / weight, noise / weight**2, _covariance(systematics, numbers, number)


def _string_table(law, value, variance, systematic, growth, columns, hyper: priors.Hyperprior) -> ObservationTable:
    # Of the four hyperparameters only the excess means something here; the others rest at their priors.
    mean = np.append(hyper.log_median[0], [0.0, 0.0, NONE])
    one = np.ones((1, len(value)))
    return ObservationTable(
        value=value[None],
        variance=variance[None],
        detected=one,
        censored=np.zeros((0, 2), int),
        group=np.ones((1, 1)),
        columns=columns,
        scale=np.ones((1, 1)),
        systematic=systematic,
        distance_octaves=_apart(law[0]),
        has_unknown_path=np.zeros(1),
        log_tau=np.full((1, 1), NONE),
        log_weight=np.zeros((1, 1)),
        variance_profile=growth,
        ratio=0 * one,
        prior=(mean, np.array([hyper.spread[0], 1.0, 1.0, 1.0])),
        degrees_of_freedom=np.float64(priors.STUDENT),
    )
