"""Tables of levels, frequencies and decays for the likelihood, from the analyses of one key."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..analysis import Analysis, Partials, cents_above, law_frequency, tension_share
from ..conversions import CENTS, DB
from ..transducer import TRANSDUCERS
from . import priors
from .likelihood import ObservationTable
from .priors import InitialValues

# Levels of partials above this, Hz, are not used: few hammers and fewer microphones reach them.
HIGHEST_HZ = 10_000.0
# Number of the knock's column among those of the partials of the levels, which it follows.
KNOCK = 0
# log τ, dB, of a table without τ.
NONE = -50.0
# Distance of the knock from the partials, octaves: the smooth path does not connect them.
APART = 100.0


@dataclass(frozen=True)
class RecordingStructure:
    """Stroke, path group and gain group of every recording [recordings]."""

    stroke: tuple[int, ...]
    group: tuple[int, ...]
    gain: tuple[int, ...]

    @property
    def strokes(self) -> int:
        """Number of strokes."""
        return max(self.stroke) + 1

    @property
    def groups(self) -> int:
        """Number of paths."""
        return max(self.group) + 1


@dataclass(frozen=True)
class Observations:
    """The tables and their columns."""

    number: np.ndarray  # int, k of the levels' columns, `KNOCK` for that of the knock [K]
    level: ObservationTable
    frequency: ObservationTable  # of one virtual recording, cents over the reference's string model
    decay: ObservationTable  # of one virtual recording, logarithms over that model
    string_number: np.ndarray  # int, k of the columns of frequency and decay
    law: np.ndarray  # the reference's string model: Hz and 1/s [2, columns]
    pitch: np.ndarray  # of every recording over the reference's, cents [R]
    cents: np.ndarray  # the same where the glide begins, at the stroke [R]

    def with_velocities(self, entry: np.ndarray, size: int) -> Observations:
        """Set which entries of θ [R] are the log velocities of the recordings; θ has `size` entries."""
        velocity = np.eye(size)[entry]
        return replace(
            self,
            level=self.level._replace(velocity=velocity),
            frequency=self.frequency._replace(velocity=0 * velocity[:1]),
            decay=self.decay._replace(velocity=0 * velocity[:1]),
        )


def observe(
    analyses: Sequence[Analysis], layout: RecordingStructure, reference: int, start: InitialValues
) -> Observations:
    """The tables of recordings of one key.

    Parameters
    ----------
    reference : index of the reference recording.
    start : its scale, recorded quantity and excitation. Only a contact has a knock.
    """
    ref = analyses[reference]
    pitch = np.array([_pitch_over(a, ref) for a in analyses])
    cents = pitch + np.array([a.glide_start for a in analyses])
    detected = np.unique(np.concatenate([a.partials.number for a in analyses]))
    # With a known path, partials that no recording shows count too; through an unknown one they carry no information.
    number = detected if start.unknown_path else np.arange(1, detected.max() + 1)
    number = number[_string_law(ref, number)[0] < HIGHEST_HZ]
    level = _levels(analyses, layout, number, cents, start, ref)
    if start.unknown_path and start.law.has_contact and np.isfinite([a.knock for a in analyses]).any():
        level, number = _with_knock(level, analyses), np.append(number, KNOCK)
    law = _string_law(ref, detected)
    frequency, decay = _string_tables(analyses, pitch, detected, law[0], ref)
    return Observations(number, level, frequency, decay, detected, law, pitch, cents)


def _string_law(analysis: Analysis, number: np.ndarray) -> np.ndarray:
    """Frequencies, Hz, and decays, 1/s, of partials by the string model of an analysis [2, K]."""
    return np.stack([law_frequency(analysis.f0, analysis.B, number), analysis.b1 + analysis.d2 * number**2])


def pitch_above(
    partials: Partials, number: np.ndarray, frequency: np.ndarray, error: np.ndarray | float, B: float
) -> float:
    """Pitch, cents, of partials above others of `number`, `frequency` and `error`, Hz [n], of a string with this B.

    It is the median over shared partials of the difference of frequency over its share of the tension, with weights of
    its variance: strokes of one key differ in tension alone. The f0 of one recording depends on its own B, which
    scatters. NaN without shared partials.
    """
    shared, i, j = np.intersect1d(partials.number, number, return_indices=True)
    if not len(shared):
        return float("nan")
    share = tension_share(B, shared)
    cents = CENTS * np.log(partials.frequency[i] / frequency[j]) / share
    both = np.hypot(partials.total_error("frequency")[i], np.broadcast_to(error, len(number))[j])
    weight = share**2 / ((both * CENTS / frequency[j]) ** 2 + priors.FREQUENCY.median[0] ** 2)
    return float(np.quantile(cents, 0.5, weights=weight, method="inverted_cdf"))


def _pitch_over(analysis: Analysis, reference: Analysis) -> float:
    """Pitch of a recording above the reference, cents."""
    if analysis is reference:
        return 0.0
    other = reference.partials
    cents = pitch_above(analysis.partials, other.number, other.frequency, other.total_error("frequency"), reference.B)
    return cents if np.isfinite(cents) else cents_above(analysis.f0, reference.f0)


def select_partials(table: np.ndarray, numbers: np.ndarray, number: np.ndarray, fill: float) -> np.ndarray:
    """Select from values `table` of partials `numbers` those of partials `number` [K]; `fill` for missing ones."""
    by_number = np.full(max(numbers.max(initial=0), number.max()) + 1, fill)
    by_number[numbers] = table
    return by_number[number]


def _covariance(matrices: Sequence[np.ndarray], numbers: Sequence[np.ndarray], number: np.ndarray) -> np.ndarray:
    """Sum of the recordings' systematic covariances, over √(n_i n_j) for partials in n_i and n_j recordings [K, K].

    It stays positive semidefinite if the recordings have different partials.
    """
    total, count = np.zeros((len(number), len(number))), np.zeros(len(number))
    for matrix, own in zip(matrices, numbers, strict=True):
        at, inside = np.searchsorted(number, own), np.isin(own, number)
        total[np.ix_(at[inside], at[inside])] += matrix[np.ix_(inside, inside)]
        count[at[inside]] += 1
    scale = 1 / np.sqrt(np.maximum(count, 1))
    return total * np.outer(scale, scale)


def _distance_octaves(frequency: np.ndarray) -> np.ndarray:
    """Distance of partials, octaves [K, K]."""
    x = np.log2(frequency)
    return np.abs(x[:, None] - x)


def _one_hot(index: Sequence[int]) -> np.ndarray:
    return np.eye(max(index) + 1)[list(index)]


def _levels(
    analyses: Sequence[Analysis],
    layout: RecordingStructure,
    number: np.ndarray,
    cents: np.ndarray,
    start: InitialValues,
    ref: Analysis,
) -> ObservationTable:
    path, unit = start.unknown_path, 0.0 if start.scale is None else 20 * np.log10(start.scale)
    roughness = TRANSDUCERS[start.quantity].roughness or start.law.roughness
    tables = [a.partials for a in analyses]
    frequency, alpha = _string_law(ref, number)
    value = np.stack([select_partials(t.level, t.number, number, np.nan) for t in tables])
    bound = np.stack([select_partials(t.absent_bound, t.absent, number, np.nan) for t in tables])
    error = np.stack([select_partials(t.level_error, t.number, number, 1.0) for t in tables])
    detected = np.isfinite(value)
    censored = np.isfinite(bound) & ~detected
    if path:  # through an unknown path, a partial that no recording shows carries no information
        censored &= detected.any(axis=0)
    level = np.where(detected, value, np.where(censored, bound, np.nan))
    loudest = np.nanmax(level, axis=1, keepdims=True)
    # No recording shows the beats of an absent partial. They are similar to those of its nearest neighbour.
    some = np.flatnonzero(detected.any(axis=0))
    nearest = some[np.abs(number[:, None] - number[some]).argmin(axis=1)]
    systematic = _covariance([t.level_systematic for t in tables], [t.number for t in tables], number)
    # A shift by the spacing of two partials would change the path by the difference of their residuals.
    slope = np.sqrt(2) * roughness[0] * path
    nodes, weight = priors.path_nodes(roughness) if path else (np.array([NONE]), np.ones(1))
    columns, scale = _columns(layout, alpha, start.law.gain_deviations if start.scale is None else None, ref.f0)
    hyper = priors.LEVEL
    return ObservationTable(
        value=np.nan_to_num(level + unit),
        variance=np.where(detected, error**2, priors.CENSORED_MARGIN**2),
        detected=detected.astype(float),
        censored=np.argwhere(censored),
        group=_one_hot(layout.group),
        columns=columns,
        scale=scale,
        systematic=systematic[np.ix_(nearest, nearest)],
        distance_octaves=_distance_octaves(frequency),
        has_unknown_path=np.full(layout.groups, float(path)),
        log_tau=np.repeat(nodes[:, None], layout.groups, axis=1),
        log_weight=np.log(weight[:, None] * np.full(len(scale), 1 / len(scale))),
        excess_profile=np.ones(len(number)),
        smooth_profile=np.ones(len(number)),
        pitch=slope * np.outer(cents / CENTS, number * tension_share(ref.B, number)),
        ratio=np.nan_to_num(10 ** ((loudest - level) / 20)),
        prior=(hyper.log_median, np.array(hyper.spread)),
        velocity=np.zeros((len(layout.stroke), 0)),
        degrees_of_freedom=np.float64(priors.STUDENT),
    )


def _with_knock(table: ObservationTable, analyses: Sequence[Analysis]) -> ObservationTable:
    """Append the knock as a column: with a path and an error of its own, and without the excess of the partials."""
    value, error = np.array([[a.knock, a.knock_error] for a in analyses]).T[:, :, None]
    detected = np.isfinite(value)
    zero, count = np.zeros_like(value), len(table.excess_profile)
    columns = np.zeros((*table.columns.shape[:2], 1))
    gains = table.scale.shape[1] - len(analyses)
    columns[:gains] = table.columns[:gains, :, :1]  # the gains; the onset does not matter
    apart = np.pad(table.distance_octaves, (0, 1), constant_values=APART)
    apart[count, count] = 0.0
    systematic = np.pad(table.systematic, (0, 1))
    systematic[count, count] = priors.KNOCK_PATH_SD**2
    return table._replace(
        value=np.append(table.value, np.where(detected, value, 0.0), axis=1),
        variance=np.append(table.variance, np.where(detected, error, 0.0) ** 2 + priors.KNOCK_SD**2, axis=1),
        detected=np.append(table.detected, detected, axis=1),
        columns=np.append(table.columns, columns, axis=2),
        systematic=systematic,
        distance_octaves=apart,
        excess_profile=np.append(table.excess_profile, 0.0),
        smooth_profile=np.append(table.smooth_profile, 0.0),
        pitch=np.append(table.pitch, zero, axis=1),
        ratio=np.append(table.ratio, zero, axis=1),
    )


def _columns(
    layout: RecordingStructure, alpha: np.ndarray, gains: Sequence[float] | None, f0: float
) -> tuple[np.ndarray, np.ndarray]:
    """Columns [Q, R, K] and prior standard deviations of their coefficients at every node of the gains [nodes, Q].

    The columns are every recording's onset, s. With unknown gains there are also the gain of each path and the
    deviation of each gain group from it, dB. `gains` are the standard deviations of these, None if gains are known.
    """
    recordings = len(layout.stroke)
    onset = np.eye(recordings)[:, :, None] * (DB * alpha)
    onset_sd = np.full(recordings, np.hypot(priors.ONSET, priors.ONSET_PERIODS / f0))
    if gains is None:
        return onset, onset_sd[None]
    path, own = _one_hot(layout.group).T, _one_hot(layout.gain).T
    # A path with one gain group has no deviation from its gain.
    several = [len({g for g, p in zip(layout.gain, layout.group, strict=True) if p == q}) > 1 for q in layout.group]
    own = own[(own * several).any(axis=1)]
    gain = np.concatenate([path, own])[:, :, None] * np.ones_like(alpha)
    deviations = gains if len(own) else (0.0,)
    scale = [[*np.full(len(path), priors.GAIN), *np.full(len(own), sd), *onset_sd] for sd in deviations]
    return np.concatenate([gain, onset]), np.array(scale)


def _string_tables(
    analyses: Sequence[Analysis], pitches: np.ndarray, number: np.ndarray, frequency: np.ndarray, ref: Analysis
) -> tuple[ObservationTable, ObservationTable]:
    """Frequencies, cents, and log decays, both over the reference's string model, of all recordings pooled as one.

    A real string deviates from its model in the same way in all recordings, so more recordings do not reduce it.
    """
    pitch, loss = [], []
    for a, offset in zip(analyses, pitches, strict=True):
        t = a.partials
        shared, decay = _string_law(ref, t.number)
        # Over the reference's string at the tension of the recording.
        cents = CENTS * np.log(t.frequency / shared) - offset * tension_share(ref.B, t.number)
        per_hertz = CENTS / t.frequency
        systematic = t.frequency_systematic * np.outer(per_hertz, per_hertz)
        pitch.append((t.number, cents, t.frequency_error * per_hertz, systematic))
        systematic = t.decay_systematic / np.outer(decay, decay)
        ratio = np.maximum(t.decay / decay, priors.LEAST_DECAY_RATIO)
        loss.append((t.number, np.log(ratio), t.decay_error / (ratio * decay), systematic))
    profile = (number / priors.REFERENCE_PARTIAL) ** priors.DEVIATION_GROWTH
    # Error of the pitch, cents: of the glide that was removed, and scatter of the strokes' pitch, by tension and by
    # partials that beat. One recording does not show the scatter.
    scatter = np.std(pitches, ddof=1) if len(analyses) > 1 else 0.0
    common = max(np.hypot(ref.glide_error, scatter), 1e-9) * tension_share(ref.B, number)[None, None]
    return (
        _string_table(frequency, *_pool_recordings(number, pitch), profile, common, priors.FREQUENCY),
        _string_table(frequency, *_pool_recordings(number, loss), np.ones(len(number)), 0 * common, priors.DECAY),
    )


def _pool_recordings(number: np.ndarray, recordings: Sequence[tuple]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weighted means over recordings, their variances from noise [K], and the systematic covariance [K, K].

    Each recording has its partials' numbers, values, standard errors, and systematic covariance.
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


def _string_table(
    frequency, value, variance, systematic, profile, columns, hyper: priors.Hyperprior
) -> ObservationTable:
    # The first three hyperparameters are used here, excess and smooth deviation; the others stay at their priors.
    mean = np.append(hyper.log_median, [NONE, NONE])
    ones = np.ones((1, len(value)))
    return ObservationTable(
        value=value[None],
        variance=variance[None],
        detected=ones,
        censored=np.zeros((0, 2), int),
        group=np.ones((1, 1)),
        columns=columns,
        scale=np.ones((1, 1)),
        systematic=systematic,
        distance_octaves=_distance_octaves(frequency),
        has_unknown_path=np.ones(1),
        log_tau=np.full((1, 1), NONE),
        log_weight=np.zeros((1, 1)),
        excess_profile=np.ones(len(value)),
        smooth_profile=profile,
        pitch=0 * ones,
        ratio=0 * ones,
        prior=(mean, np.append(hyper.spread, [1.0, 1.0])),
        velocity=np.zeros((1, 0)),
        degrees_of_freedom=np.float64(priors.STUDENT),
    )
