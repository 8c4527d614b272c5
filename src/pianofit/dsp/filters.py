"""Filters of sampled sounds: resampling, convolution, delay and its measurement, removal of drift, moving average.

They use NumPy alone. `scipy.signal` has them too, but its import takes longer than the analysis of a recording.
"""

import functools
import math

import numpy as np

from .bands import fast_length
from .damped_sums import powers

LOWEST_HZ = 20.0  # a piano has no partial below it, only offset, drift or rumble
# Order of the Butterworth filter at `LOWEST_HZ`.
ORDER = 4
# Samples of a block of the recursive filter.
BLOCK = 128
# Zero crossings of the resampling filter on each side, and the β of its Kaiser window, as in `scipy.signal`.
ZERO_CROSSINGS = 10
KAISER_BETA = 5.0


def convolve(x: np.ndarray, response: np.ndarray) -> np.ndarray:
    """Full convolution of a sound [..., samples] with a response [samples]."""
    count = x.shape[-1] + len(response) - 1
    size = fast_length(count)
    return np.fft.irfft(np.fft.rfft(x, size) * np.fft.rfft(response, size), size)[..., :count]


def resample(x: np.ndarray, old: int, new: int) -> np.ndarray:
    """Resample a sound [..., samples] from the rate `old` to the rate `new`, Hz, by a polyphase filter.

    Output n lies at the input sample n down/up. Every up-th output has the same filter, so each such group is a product
    of windows of the input with one row of coefficients.
    """
    divisor = math.gcd(old, new)
    up, down = new // divisor, old // divisor
    if up == down:
        return x
    response = _low_pass(up, down)
    reach, count = len(response) // 2, -(-x.shape[-1] * up // down)
    out = np.empty((*x.shape[:-1], count))
    taps = 2 * reach // up + 1
    padded = np.pad(x, [(0, 0)] * (x.ndim - 1) + [(taps, taps + down)])
    windows = np.lib.stride_tricks.sliding_window_view(padded, taps, axis=-1)
    for first in range(min(up, count)):
        begin = -((reach - first * down) // up)  # the first input sample within reach of output `first`
        row = response[first * down + reach - begin * up :: -up][:taps]
        group = out[..., first::up]
        group[...] = windows[..., begin + taps :: down, : len(row)][..., : group.shape[-1], :] @ row
    return out


@functools.lru_cache(maxsize=8)
def _low_pass(up: int, down: int) -> np.ndarray:
    """Impulse response of the resampling filter at `up` times the old rate; its cutoff is half of the lower rate."""
    ratio = max(up, down)
    reach = ZERO_CROSSINGS * ratio
    response = np.sinc(np.arange(-reach, reach + 1) / ratio) * np.kaiser(2 * reach + 1, KAISER_BETA)
    return response * (up / response.sum())


def reduce_rate(x: np.ndarray, factor: int) -> np.ndarray:
    """Divide the rate of a sound [channels, samples] by an integer. It keeps all frequencies below half the new rate.

    This uses one Fourier transform. So both ends must be silent, because they wrap around.
    """
    if factor == 1:
        return x
    size = -(-x.shape[-1] // factor)
    spectrum = np.fft.rfft(x, size * factor)[..., : size // 2 + 1]
    if size % 2 == 0:  # the highest bin holds the components at plus and minus half the rate
        spectrum[..., -1] *= 2
    return np.fft.irfft(spectrum / factor, size)


def delayed(x: np.ndarray, samples: float) -> np.ndarray:
    """Delay a sound [..., samples] by a real number of samples, at most about 1000."""
    size = x.shape[-1] + 2048
    turn = np.exp(-2j * np.pi * np.fft.rfftfreq(size) * samples)
    return np.fft.irfft(np.fft.rfft(x, size) * turn, size)[..., : x.shape[-1]]


def fractional_lag(model: np.ndarray, sound: np.ndarray) -> float:
    """Delay of `sound` relative to `model`, in samples, accurate to a hundredth; both [samples]."""
    size = 2 ** int(np.ceil(np.log2(2 * len(model))))
    oversampling = 16
    cross = np.fft.rfft(sound, size) * np.fft.rfft(model, size).conj()
    correlation = np.fft.irfft(cross, oversampling * size)
    peak = int(np.argmax(correlation))
    before, top, after = correlation[peak - 1], correlation[peak], correlation[(peak + 1) % len(correlation)]
    lag = peak + 0.5 * (before - after) / (before - 2 * top + after)
    return float((lag if lag < len(correlation) / 2 else lag - len(correlation)) / oversampling)


def locate_template(model: np.ndarray, sound: np.ndarray) -> tuple[int, float]:
    """Position of `model` in the longer `sound` with the least residual energy, and its sign; both [samples], one unit.

    Unlike the peak of a correlation, the residual counts the silence before an attack. A position one period late
    leaves the first period unexplained. The sign is -1 for a pickup of opposite polarity.
    """
    energy = np.concatenate([[0.0], np.cumsum(sound**2)])
    cross = convolve(sound, model[::-1])[len(model) - 1 : len(sound)]
    start = int(np.argmin(energy[len(model) :] - energy[: -len(model)] - 2 * np.abs(cross)))
    return start, float(np.sign(cross[start]))


def forward_mean(values: np.ndarray, width: int) -> np.ndarray:
    """Mean of the `width` values from each one on [samples - width + 1]."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    width = min(max(width, 1), len(values))
    return np.maximum(total[width:] - total[:-width], 0) / width


def without_drift(x: np.ndarray, rate: int) -> np.ndarray:
    """Return the part of `x` [samples] above `LOWEST_HZ`.

    The filter is causal: a sample does not affect earlier ones. `x` is extended before its beginning by a point
    reflection, so that an offset or a drift does not cause a step.
    """
    lead = min(round(0.02 * rate), len(x) - 1)
    extended = np.append(2 * x[0] - x[lead:0:-1], x) - (2 * x[0] - x[lead])
    log_pole, residue, direct = _highpass(rate)
    return (direct * extended + 2 * _decaying_sum(extended, log_pole, residue))[lead:]


def _highpass(rate: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Logarithms of the upper poles, their residues, and the direct term of the filter at `LOWEST_HZ`.

    The impulse response is the direct term at n = 0 plus twice the real part of Σ residue pole^n. The Butterworth poles
    a are mapped by the bilinear transform to (1 + a)/(1 - a), all close to 1, with all zeros at 1. Differences of poles
    are therefore written in a.
    """
    angle = np.pi * (np.arange(ORDER) + 0.5) / ORDER  # of the analogue poles from the imaginary axis
    a = 1j * np.tan(np.pi * LOWEST_HZ / rate) * np.exp(1j * angle)
    gain = 1 / float(np.prod(1 - a).real)  # 1 at half the rate
    ratio = 2 * (a[:, None] - a) / ((1 + a[:, None]) * (1 - a))  # 1 - pole / pole
    residue = gain * (2 * a / (1 + a)) ** ORDER / np.where(np.eye(ORDER, dtype=bool), 1.0, ratio).prod(axis=1)
    upper = a.imag > 0
    return 2 * np.arctanh(a[upper]), residue[upper], 1 / float(np.prod(1 + a).real)


def _decaying_sum(x: np.ndarray, log_pole: np.ndarray, residue: np.ndarray) -> np.ndarray:
    """Re Σ_m residue pole^m x[n - m], summed over poles [samples]: products of blocks, and one state per block."""
    rows = np.pad(x, (0, -len(x) % BLOCK)).reshape(-1, BLOCK)
    power = powers(log_pole, BLOCK + 1)
    response = np.append((residue @ power[:, :BLOCK]).real, np.zeros(BLOCK))
    out = rows @ np.stack([np.roll(response, i)[:BLOCK] for i in range(BLOCK)])
    reverse = power[:, BLOCK - 1 :: -1]
    states = np.zeros((len(rows) + 1, len(residue)), complex)
    states[1:] = rows @ reverse.real.T + 1j * (rows @ reverse.imag.T)
    # A state is the sum of the ends of all earlier blocks, each decayed: sums over 2, 4, 8 and so on blocks.
    decay, reach = power[:, BLOCK], 1
    while reach < len(states):
        states[reach:] += decay * states[:-reach]
        decay, reach = decay**2, 2 * reach
    out += ((states[:-1] * residue) @ power[:, 1:]).real
    return out.reshape(-1)[: len(x)]
