"""Robust fits of the frequency law f_k = k f0 √(1 + B k²) and the decay law α_k = b1 + d2 k².

Both are straight lines in k² after a change of variable, fitted by iteratively reweighted least squares with Huber's
weights (Huber 1964). Scatter beyond the noise (soundboard, windings, coupled strings) is estimated from the residuals
and added to each error. A partial with a relative error of one millionth therefore does not outweigh the others.

Beyond some twenty partials, windings and shear make real strings deviate smoothly from the law: partial 32 of a C1 lies
14 cents below it, partial 45 of an A0 a whole spacing. `local_deviation` predicts this deviation from the neighbours.
"""

import math
from dataclasses import dataclass
from statistics import median

import numpy as np

from ..conversions import CENTS

B_RANGE = (1e-6, 2e-2)  # searched range of B; piano strings have 5e-5 to 2e-2
# From about this partial on, real strings deviate from the law by cents. A smooth deviation counts here as independent
# errors. If they grow as the cube of the number, low partials decide, and B scatters least over the layers of a key. F
# has the deviations as a Gaussian process, with the growth that they have (`priors.DEVIATION_GROWTH`).
LAST_TRUSTED_PARTIAL = 10.0
# Partials that predict the deviation of the next one: fewer are sensitive to beats, more do not follow the curve.
NEIGHBOURS = 9


@dataclass(frozen=True)
class FrequencyLaw:
    """f_k = k f0 √(1 + B k²), with standard errors."""

    f0: float
    f0_error: float
    B: float
    B_error: float
    scatter: float  # cents, robust, beyond noise
    excess: float  # cents, the same for low partials

    def __call__(self, k: np.ndarray | float) -> np.ndarray:
        """Frequencies of partials `k`, Hz."""
        return law_frequency(self.f0, self.B, k)

    def deviation(self, k: np.ndarray, frequency: np.ndarray) -> np.ndarray:
        """Deviation of partials `k` with this `frequency`, Hz, from the law, cents."""
        return CENTS * np.log(frequency / self(k))

    def deviation_sd(self, k: np.ndarray) -> np.ndarray:
        """Standard deviation of partials `k` from the law beyond their noise, cents."""
        return self.excess * _growth(k)


@dataclass(frozen=True)
class DecayLaw:
    """α_k = b1 + d2 k², with standard errors, 1/s."""

    b1: float
    b1_error: float
    d2: float
    d2_error: float
    scatter: float  # relative, robust, beyond noise

    def __call__(self, k: np.ndarray | float) -> np.ndarray:
        """Decay rates of partials `k`, 1/s."""
        return self.b1 + self.d2 * np.asarray(k, float) ** 2


def law_frequency(f0: float | np.ndarray, B: float | np.ndarray, k: np.ndarray | float) -> np.ndarray:
    """Frequencies k f0 √(1 + B k²) of partials `k`, Hz."""
    k = np.asarray(k, float)
    return k * f0 * np.sqrt(1 + B * k**2)


def tension_share(B: float, k: np.ndarray | float) -> np.ndarray:
    """Share of the tension in the restoring force of partials `k`, 1/(1 + B k²): d log f over d log f0 at one κ.

    A tension that changes moves high partials by less, because their stiffness does not change.
    """
    return 1 / (1 + B * np.asarray(k, float) ** 2)


def local_deviation(detected: np.ndarray, deviation: np.ndarray, k: np.ndarray) -> np.ndarray:
    """Deviation of partials `k` [n] from the law, cents, predicted from the `deviation` of partials `detected`.

    A line through the nearest `NEIGHBOURS`, with the median of the slopes between them (Theil 1950, Sen 1968). It is
    extrapolated by at most the range of these. With fewer partials the result is zero.
    """
    if len(detected) < NEIGHBOURS:
        return np.zeros(len(k))
    near = np.argsort(np.abs(detected - k[:, None]), axis=1, kind="stable")[:, :NEIGHBOURS]
    rows = zip(detected[near].tolist(), deviation[near].tolist(), k.tolist(), strict=True)
    return np.array([median_line(x, y, at) for x, y, at in rows])


def median_line(x: list[float], y: list[float], at: float) -> float:
    """Value at `at` of a line through a few points, with the median of their slopes, and extrapolated by their range.

    For so few numbers the standard library is faster than NumPy.
    """
    points = list(zip(x, y, strict=True))
    slope = median([(y2 - y1) / (x2 - x1) for i, (x1, y1) in enumerate(points) for x2, y2 in points[i + 1 :]])
    low, high = min(x), max(x)
    at = min(max(at, 2 * low - high), 2 * high - low)
    return median([y1 + slope * (at - x1) for x1, y1 in points])


def robust_scatter(residual: np.ndarray, error: np.ndarray, dof: int) -> float:
    """Scatter s that makes the median of |residual|/√(error² + s²) that of a normal variable, 0.6745.

    That median exceeds 0.6745 as long as residual²/0.6745² − error² exceeds s² for more than half of the residuals, so
    s² is the median of that difference. Residuals are scaled up for the `dof` fitted parameters.
    """
    n = len(residual)
    if n <= dof:
        return 0.0
    return math.sqrt(max(median((residual**2 * (n / (n - dof)) / 0.6745**2 - error**2).tolist()), 0.0))


def _huber(standardised: np.ndarray) -> np.ndarray:
    """Huber's weights, which fall beyond 1.5 standard deviations."""
    return np.minimum(1.0, 1.5 / np.maximum(np.abs(standardised), 1e-12))


def _line(x: np.ndarray, value: np.ndarray, weight: np.ndarray) -> tuple[float, float, np.ndarray]:
    """Weighted straight line a + b x: a, b and their covariance (weights are inverse variances)."""
    total = float(np.sum(weight))
    middle = float(weight @ x) / total
    lever = weight * (x - middle)
    spread = float(lever @ (x - middle))
    b = float(lever @ value) / spread
    a = float(weight @ value) / total - b * middle
    return a, b, np.array([[1 / total + middle**2 / spread, -middle / spread], [-middle / spread, 1 / spread]])


def frequency_law(k: np.ndarray, frequency: np.ndarray, error: np.ndarray, *, B: float | None = None) -> FrequencyLaw:
    """Robust f0 and B through partials `k` of `frequency` with standard `error` (Hz), [partials].

    Beyond `LAST_TRUSTED_PARTIAL` the error of the law grows as the cube of the number, because windings and the shear
    of a stiff string make real partials deviate from it. A given `B` is fixed, with an infinite error; a single partial
    requires it.
    """
    k = np.asarray(k, float)
    value = (frequency / k) ** 2  # f0² + f0² B k², a straight line in k²
    noise = np.maximum(error / frequency, 1e-12)
    growth = _growth(k)
    dof = 1 if B is not None else 2
    scatter, robust, sigma = 10.0 / CENTS, np.ones(len(k)), value
    f0, slope = float(np.median(frequency / k)), B or 0.0
    a, cov = f0**2, np.zeros((2, 2))
    for _ in range(30):
        sigma = 2 * value * np.hypot(noise, scatter * growth)
        a, slope, cov = _stiff_line(k**2, value, robust / sigma**2, B)
        residual = np.log(frequency / law_frequency(np.sqrt(a), slope, k))
        previous, scatter = scatter, robust_scatter(residual / growth, noise / growth, dof)
        robust = _huber(residual / np.hypot(noise, scatter * growth))
        if abs(scatter - previous) < 1e-6 * previous:
            break
    f0 = float(np.sqrt(a))
    gradient = np.array([-slope / a, 1 / a])
    f0_error = float(np.sqrt(cov[0, 0])) / (2 * f0)
    B_error = float("inf") if B is not None else float(np.sqrt(max(gradient @ cov @ gradient, 0.0)))
    if B is None and slope in B_RANGE:
        f0_error, B_error = _errors_at_bound(k**2, value, robust / sigma**2, f0, slope)
    residual = np.log(frequency / law_frequency(f0, slope, k))
    spread = CENTS * robust_scatter(residual, noise, dof)
    return FrequencyLaw(f0, f0_error, slope, B_error, spread, CENTS * scatter)


def _growth(k: np.ndarray) -> np.ndarray:
    """Growth of the deviation from the law at partials `k`, relative to low partials."""
    return np.sqrt(1 + (k / LAST_TRUSTED_PARTIAL) ** 6)


def _stiff_line(
    x: np.ndarray, value: np.ndarray, weight: np.ndarray, B: float | None
) -> tuple[float, float, np.ndarray]:
    """Weighted fit of a (1 + B x): a, B within its range (or fixed), and the covariance of (a, a B)."""
    if B is None:
        a, b, cov = _line(x, value, weight)
        if a > 0 and B_RANGE[0] <= b / a <= B_RANGE[1]:
            return a, b / a, cov
        B = float(np.clip(b / a, *B_RANGE)) if a > 0 else B_RANGE[1]
    base = 1 + B * x
    inverse = 1 / float(np.sum(weight * base**2))
    return inverse * float(np.sum(weight * base * value)), B, np.diag([inverse, 0.0])


def _errors_at_bound(x: np.ndarray, value: np.ndarray, weight: np.ndarray, f0: float, B: float) -> tuple[float, float]:
    """Standard errors of f0 and of a B at its bound: those of the free line, or the distance to it if that is larger.

    At the lower bound the error of B is at least B, because a harmonic sound does not distinguish B from 0.
    """
    a, b, cov = _line(x, value, weight)
    gradient = np.array([-b / a, 1.0]) / a
    least = B if B_RANGE[0] == B else 0.0
    f0_error = max(float(np.sqrt(cov[0, 0] / max(a, 1e-300))) / 2, abs(float(np.sqrt(max(a, 0.0))) - f0))
    return f0_error, max(float(np.sqrt(max(gradient @ cov @ gradient, 0.0))), abs(b / a - B), least)


def decay_law(k: np.ndarray, decay: np.ndarray, error: np.ndarray) -> DecayLaw:
    """Robust b1 > 0 and d2 >= 0 through decay rates `decay` with standard `error` (1/s), [partials]."""
    k = np.asarray(k, float)
    scatter, robust = 0.5, np.ones(len(k))
    middle = max(float(np.median(decay)), 1e-3)
    model, spread, b1, d2 = np.full(len(k), middle), float(np.ptp(k**2)), middle, 0.0
    cov = np.eye(2)
    for _ in range(40):
        sigma = np.sqrt(error**2 + (scatter * model) ** 2)
        weight = robust / np.maximum(sigma, 1e-12 * middle) ** 2
        if spread > 0:
            b1, d2, cov = _line(k**2, decay, weight)
        if spread == 0 or d2 < 0:
            b1, d2 = float(np.sum(weight * decay) / np.sum(weight)), 0.0
        if b1 <= 0.02 * middle:
            b1 = 0.02 * middle
            d2 = max(float(np.sum(weight * k**2 * (decay - b1)) / np.sum(weight * k**4)), 0.0)
        model = b1 + d2 * k**2
        residual = (decay - model) / model
        previous, scatter = scatter, robust_scatter(residual, error / model, 2 if spread > 0 else 1)
        robust = _huber(residual / np.sqrt((error / model) ** 2 + scatter**2 + 1e-24))
        if abs(scatter - previous) < 1e-6 * previous:
            break
    b1_error, d2_error = np.sqrt(np.diag(cov))
    if spread == 0:
        b1_error, d2_error = float(error[0]), float("inf")
    return DecayLaw(float(b1), float(b1_error), float(d2), float(d2_error), float(scatter))
