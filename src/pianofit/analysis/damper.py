"""The decay rate that a damper adds, measured on a note that is let go within its recording.

The logarithm of the envelope of partial k (`dsp/bands.py`) is

    log |z_k(t)| = a_k − α_k t − R(t; t0, r_k) + beats + noise.

Before the release at t0, which all partials share, the ramp R is 0. Afterwards it is r_k (t − t0). The window of a band
smooths its corner, exactly as it smooths exp(-R). Beats of the partial are a Gaussian process. Its size and length
maximise the likelihood of the envelope before the release, so a beat is continued across the release, with its
uncertainty. For each t0 the other parameters follow from generalised least squares, and t0 maximises the likelihood of
all partials. The rates then determine rate and slope of the key: r_k = r_1 (f_k/f_1)^s, up to a scatter of partials.
"""

from dataclasses import dataclass

import numpy as np

from ..conversions import DB
from ..dsp.bands import BETA, Bands, kaiser_bands
from ..errors import AnalysisError
from ..recording.recording import Source, to_recording
from .envelope_slopes import CLEAR
from .note_names import note_to_hz
from .numbering import number_partials
from .pitch import check_length, find_pitch
from .spectrum import noise_between

WIDEST = 100.0  # Hz, largest width of a band
# Spans of the envelope around a possible release in the search for it, s, and before the release in its fit. Longer
# ones show more of the beats; a note is seldom held for longer.
SEARCH_BEFORE, SEARCH_AFTER, BEFORE = 0.3, 0.2, 1.0
# Fall of an envelope that is used after the release, dB. The sound of room and free strings bends a longer fall.
RANGE = 20.0
# Standard deviation of beats in the search for the release, Np.
SEARCH_BEATS = 0.1
# Sizes, Np, and lengths, s, of beats that are tried: from hardly visible to deep, and from fast to slower than a note.
SIZES, LENGTHS = np.array([0.003, 0.01, 0.03, 0.1, 0.3, 1.0]), np.array([0.03, 0.1, 0.3, 1.0])
# Least frames after the release of a partial, and partials of a note.
FEWEST_FRAMES, FEWEST_PARTIALS = 3, 3
# Nodes of the window of a band.
NODES = 65
# Standard deviation of what the model leaves out of the log envelope of a frame, Np: the leakage of neighbours, whose
# spectrum a release widens, and a damper that lands within some milliseconds.
MODEL_ERROR = 0.01
# Degrees of freedom of Student's t distribution of the rates of partials about the law of their key.
STUDENT = 4.0
# Precision of the prior of level, decay and rate, which is felt only where a release time leaves no frame after it.
RIDGE = 1e-6
# Newton steps for the rates at one release time, and points of its profile on each side of the coarse time.
STEPS, PROFILE = 4, 12
# Rate at which the Newton steps start, and the range of its steps, 1/s.
START_RATE, RATES = 30.0, (-20.0, 1000.0)
# Precision of the release time, s.
PRECISION = 1e-5
# Standard errors that the rate of a key must exceed. Otherwise no damper is in the recording.
LEAST_Z = 4.0


@dataclass(frozen=True, eq=False)
class DamperFit:
    """The damper of one key."""

    release_s: float  # time of the release after the onset, s
    f1: float  # Hz
    frequency: np.ndarray  # Hz [partials]
    rate: np.ndarray  # added decay rates, 1/s [partials]
    rate_error: np.ndarray  # standard errors, 1/s [partials]
    log_rate: float  # logarithm of the rate at f1, in 1/s
    slope: float  # exponent of the rate over frequency
    covariance: np.ndarray  # of both [2, 2]


@dataclass(frozen=True, eq=False)
class _Envelopes:
    """Log envelopes on nearly independent frames."""

    time: np.ndarray  # s [frames]
    log: np.ndarray  # Np [partials, frames]
    variance: np.ndarray  # due to noise [partials, frames]
    clear: np.ndarray  # bool [partials, frames]
    node: np.ndarray  # times of the nodes of the window, s [nodes]
    weight: np.ndarray  # their weights, of sum 1 [nodes]


def fit_damper(recording: Source, note: str) -> DamperFit:
    """Measure the added decay rates of a note that is let go within its recording.

    Parameters
    ----------
    recording : a path, a `Recording`, or (samples, rate), as for `fit`.
    note : name of the key, such as "F#2".

    Returns
    -------
    Release time, rates of all partials, and rate and slope of the key, with standard errors.

    Raises
    ------
    RecordingError
        If the recording cannot be used.
    AnalysisError
        If no pitch, no release, or fewer than three damped partials are detected.
    """
    recording = to_recording(recording)
    samples = np.asarray(recording.samples, float)[recording.onset :]
    try:
        bands, noise, f1 = _bands(samples, recording.rate, note)
        envelopes = _envelopes(bands, noise)
        return _fit(envelopes, bands.centre, f1)
    except AnalysisError as error:
        raise AnalysisError(f"{recording.path}: {error}") from None


def _bands(samples: np.ndarray, rate: int, note: str) -> tuple[Bands, np.ndarray, float]:
    """Bands of the partials, the noise variance of their frames [partials], and the lowest partial, Hz."""
    f0, B = find_pitch(samples, rate, note=note)
    check_length(len(samples) / rate, f0)
    number, frequency, law = number_partials(samples, rate, f0, B)
    if len(number) < FEWEST_PARTIALS:
        raise AnalysisError(f"only {len(number)} partials of {note} ({note_to_hz(note):.1f} Hz); check the note")
    bands = kaiser_bands(samples, rate, frequency, min(0.97 * law.f0, WIDEST), 0.005)
    expected = law(np.arange(1, int(number.max()) + 6))
    density = noise_between(samples, rate, expected, frequency, law.f0, 0.05)
    # A release spreads the spectrum of a partial. The quietest frames, if the file is long enough, hold noise alone.
    quiet = np.quantile(np.abs(bands.z) ** 2, 0.1, axis=1) / -np.log(0.9)
    noise = np.minimum(density / 2 * bands.noise_width, quiet)
    return bands, np.maximum(noise, 1e-16 * np.abs(bands.z).max() ** 2), float(law(np.array([1]))[0])


def _envelopes(bands: Bands, noise: np.ndarray) -> _Envelopes:
    stride = max(round(bands.rate / bands.noise_width / 2), 1)
    power = np.maximum(np.abs(bands.z[:, ::stride]) ** 2, noise[:, None])
    correlated = max(bands.rate / stride / bands.noise_width, 1.0)  # frames with the noise of one
    variance = correlated * noise[:, None] / (2 * power) + MODEL_ERROR**2
    clear = power > 10 ** (CLEAR / 10) * noise[:, None]
    u = np.linspace(-1, 1, NODES)
    weight = np.i0(BETA * np.sqrt(1 - u**2))
    return _Envelopes(
        bands.time[::stride], 0.5 * np.log(power), variance, clear, u * bands.window / 2, weight / weight.sum()
    )


def _coarse_release(envelopes: _Envelopes) -> float:
    """Time at which a steeper line improves the likelihood of the surrounding envelopes most, s."""
    weight = envelopes.clear / (envelopes.variance + SEARCH_BEATS**2)
    gains, candidates = [], envelopes.time[FEWEST_FRAMES:-FEWEST_FRAMES]
    if not len(candidates):
        raise AnalysisError("is too short for a release; give a file that goes on after the key is let go")
    for t0 in candidates:
        near = (envelopes.time > t0 - SEARCH_BEFORE) & (envelopes.time < t0 + SEARCH_AFTER)
        u = envelopes.time[near] - t0
        basis = np.stack([np.ones(len(u)), u, np.maximum(u, 0.0)])
        w = weight[:, near]
        normal = np.einsum("in,kn,jn->kij", basis, w, basis) + 1e-6 * np.eye(3)
        right = np.einsum("in,kn,kn->ki", basis, w, envelopes.log[:, near])
        bend = np.linalg.solve(normal, right[:, :, None])[:, 2, 0]
        variance = np.linalg.inv(normal)[:, 2, 2]
        enough = (w[:, u > 0] > 0).sum(axis=1) >= FEWEST_FRAMES
        gains.append(float(np.sum(np.where(enough & (bend < 0), bend**2 / variance, 0.0))))
    return float(candidates[int(np.argmax(gains))])


def _fit(envelopes: _Envelopes, frequency: np.ndarray, f1: float) -> DamperFit:
    coarse = _coarse_release(envelopes)
    partials, used = [], []
    for k in range(len(frequency)):
        if (partial := _partial(envelopes, k, coarse)) is not None:
            partials.append(partial)
            used.append(k)
    if len(partials) < FEWEST_PARTIALS:
        raise AnalysisError("fewer than three partials are damped; give the whole note, until it is silent")
    release, release_error, rates, errors, shift = _profile(partials, coarse, envelopes.time[1] - envelopes.time[0])
    log_rate, slope, covariance = _key_law(np.log(frequency[used] / f1), rates, errors, shift * release_error)
    if not np.sqrt(covariance[0, 0]) < 1 / LEAST_Z:
        raise AnalysisError("no release was detected; a note that rings to its end has the role note")
    error = np.hypot(errors, shift * release_error)
    return DamperFit(release, f1, frequency[used], rates, error, log_rate, slope, covariance)


@dataclass(frozen=True, eq=False)
class _Partial:
    """The part of one envelope around the release."""

    time: np.ndarray  # s [frames]
    log: np.ndarray  # Np [frames]
    root: np.ndarray  # inverse Cholesky factor of the covariance of beats and noise [frames, frames]
    node: np.ndarray
    weight: np.ndarray

    def ramp(self, t0: float, rate: float) -> tuple[np.ndarray, np.ndarray]:
        """The smoothed ramp and its derivative by the rate [frames]."""
        after = np.maximum(self.time[:, None] + self.node - t0, 0.0)
        damped = self.weight * np.exp(-rate * after)
        total = damped.sum(axis=1)
        return -np.log(total), (damped * after).sum(axis=1) / total

    def solve(self, t0: float) -> tuple[float, float, float]:
        """Rate, its variance, and minus twice the log likelihood at a release time."""
        rate, variance, cost = START_RATE, 0.0, 0.0
        for _ in range(STEPS):
            ramp, gradient = self.ramp(t0, rate)
            basis = self.root @ np.stack([np.ones(len(ramp)), t0 - self.time, -gradient], axis=1)
            rest = self.root @ (self.log + ramp - rate * gradient)
            inverse = np.linalg.inv(basis.T @ basis + RIDGE * np.eye(3))
            solution = inverse @ (basis.T @ rest)
            residual = rest - basis @ solution
            rate = float(np.clip(solution[2], *RATES))
            variance, cost = float(inverse[2, 2]), float(residual @ residual)
        return rate, variance, cost


def _partial(envelopes: _Envelopes, k: int, coarse: float) -> _Partial | None:
    """The envelope of partial k around the release; None if too little of it is visible."""
    time, log = envelopes.time, envelopes.log[k]
    first = int(np.searchsorted(time, max(coarse - BEFORE, time[0])))
    corner = int(np.searchsorted(time, coarse))
    visible = envelopes.clear[k] & (log > log[corner] - RANGE / DB)
    hidden = np.flatnonzero(~visible[corner:])
    last = corner + int(hidden[0]) if len(hidden) else len(time)
    if last - corner < FEWEST_FRAMES or corner - first < FEWEST_FRAMES or not visible[first:corner].all():
        return None
    reach = envelopes.node[-1]
    before = slice(first, max(int(np.searchsorted(time, coarse - reach)), first + FEWEST_FRAMES))
    size, length = _beats(time[before], log[before], envelopes.variance[k, before])
    part = slice(first, last)
    covariance = _beat_covariance(time[part], size, length) + np.diag(envelopes.variance[k, part])
    root = np.linalg.inv(np.linalg.cholesky(covariance))
    return _Partial(time[part], log[part], root, envelopes.node, envelopes.weight)


def _beat_covariance(time: np.ndarray, size: float, length: float) -> np.ndarray:
    """Covariance of a Matérn process of order 3/2 [frames, frames]: beats are smooth and may turn quickly at a null."""
    lag = np.sqrt(3) * np.abs(time[:, None] - time) / length
    return size**2 * ((1 + lag) * np.exp(-lag) + 1e-6 * np.eye(len(time)))


def _beats(time: np.ndarray, log: np.ndarray, variance: np.ndarray) -> tuple[float, float]:
    """Size, Np, and length, s, of the beats of greatest likelihood, with the line through the envelope unknown."""
    basis, best = np.stack([np.ones(len(time)), time], axis=1), (np.inf, SIZES[-1], LENGTHS[-1])
    for size in SIZES:
        for length in LENGTHS:
            factor = np.linalg.cholesky(_beat_covariance(time, size, length) + np.diag(variance))
            white, columns = np.linalg.solve(factor, log), np.linalg.solve(factor, basis)
            normal = columns.T @ columns
            rest = white - columns @ np.linalg.solve(normal, columns.T @ white)
            cost = rest @ rest + 2 * np.log(np.diag(factor)).sum() + np.linalg.slogdet(normal)[1]
            best = min(best, (float(cost), float(size), float(length)))
    return best[1], best[2]


def _profile(
    partials: list[_Partial], coarse: float, step: float
) -> tuple[float, float, np.ndarray, np.ndarray, np.ndarray]:
    """Release time and its standard error, s, rates and their errors at that time, and their change with it."""

    def cost(t0: float) -> float:
        return sum(partial.solve(t0)[2] for partial in partials)

    t0, width, points = coarse, step / 2, np.arange(-PROFILE, PROFILE + 1)
    while width > PRECISION:
        times = t0 + width * points
        t0 = float(times[int(np.argmin([cost(t) for t in times]))])
        width, points = width / 3, np.arange(-3, 4)
    h = step / 8
    curvature = (cost(t0 + h) - 2 * cost(t0) + cost(t0 - h)) / h**2
    error = np.sqrt(2 / curvature) if curvature > 0 else step
    rate, variance, _ = np.array([partial.solve(t0) for partial in partials]).T
    later, earlier = (np.array([partial.solve(t)[0] for partial in partials]) for t in (t0 + h, t0 - h))
    return t0, float(error), rate, np.sqrt(variance), (later - earlier) / (2 * h)


def _key_law(x: np.ndarray, rate: np.ndarray, error: np.ndarray, common: np.ndarray) -> tuple[float, float, np.ndarray]:
    """Logarithm of the rate at x = 0, the slope over x, and their covariance.

    Partials scatter by a factor beyond their errors if the sum of squares exceeds its expectation. An envelope that
    passes a null of its beats at the release is an outlier, which Student's t distribution gives a small weight.

    Parameters
    ----------
    x : logarithm of frequency over that of partial 1 [partials].
    common : errors that all partials share [partials], 1/s.
    """
    theta, scatter = np.array([np.log(max(np.average(rate, weights=error**-2), 1.0)), 0.0]), 0.0
    basis, share, covariance = np.stack([np.ones(len(x)), x], axis=1), np.ones(len(x)), np.eye(2)
    for _ in range(30):
        law = np.exp(basis @ theta)
        jacobian = law[:, None] * basis
        variance = error**2 + (scatter * law) ** 2
        inverse = np.linalg.inv(np.diag(variance / share) + np.outer(common, common))
        covariance = np.linalg.inv(jacobian.T @ inverse @ jacobian)
        theta = theta + np.clip(covariance @ (jacobian.T @ (inverse @ (rate - law))), -1.0, 1.0)
        z2 = (rate - np.exp(basis @ theta)) ** 2 / variance
        share = (STUDENT + 1) / (STUDENT + z2)
        excess = float(share @ z2) - (len(x) - 2)
        scatter = float(np.sqrt(max(scatter**2 + excess / float(np.sum(share * law**2 / variance)), 0.0)))
    return float(theta[0]), float(theta[1]), covariance
