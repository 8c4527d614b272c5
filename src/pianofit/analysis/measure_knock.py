"""Measures the knock of a treble note: the energy of the attack in the band of `dsp/knock_band.py`."""

import numpy as np

from ..conversions import DB
from ..dsp.bands import fast_length
from ..dsp.knock_band import AFTER, BAND, BEFORE, has_knock
from ..recording.recording import Recording

# The noise is that of the recording from this time after the onset on, s, when the knock has decayed,
NOISE_FROM = 0.5
# of at least this duration, s.
LEAST_NOISE = 0.2
# A knock less than this above the noise, dB, is not measured.
LEAST_SNR = 10.0


def measure_knock(recording: Recording, f0: float) -> tuple[float, float]:
    """Level of the knock, dB re full scale² · s, and its standard error due to noise; NaN and infinity without one."""
    rate, onset, samples = recording.rate, recording.onset, np.asarray(recording.samples, float)
    rest = len(samples) - onset - round(NOISE_FROM * rate)
    if not has_knock(f0) or rest < LEAST_NOISE * rate:
        return np.nan, np.inf
    # Silence on both sides takes up the filter's response, which is periodic, and has the window's start within it.
    silence = round(AFTER * rate)
    size = fast_length(len(samples) + 2 * silence)
    hz = np.fft.rfftfreq(size, 1 / rate)
    inside = (hz >= BAND[0] * f0) & (hz <= BAND[1] * f0)
    spectrum = np.where(inside, np.fft.rfft(np.pad(samples, silence), size), 0.0)
    power = np.fft.irfft(spectrum, size)[: silence + len(samples)] ** 2
    start = silence + onset
    attack = power[start - round(BEFORE * rate) : start + round(AFTER * rate)]
    noise = len(attack) * float(np.mean(power[-rest:]))
    energy = float(attack.sum()) - noise
    if not energy > 10 ** (LEAST_SNR / 10) * noise:
        return np.nan, np.inf
    # Sound and noise interfere. The window holds 2 · bandwidth · duration independent values of each.
    values = 2 * (BAND[1] - BAND[0]) * f0 * len(attack) / rate
    return 10 * np.log10(energy / rate), DB * float(np.sqrt(noise / energy / values))
