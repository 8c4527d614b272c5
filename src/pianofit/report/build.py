"""From a fit's result to what the page draws: arrays only, all computed before."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..analysis import law_frequency
from ..inference import Result
from .build_felt import felt_of, known_of
from .build_recordings import paths_of, recordings_of, strokes_of
from .build_ringing import ringing_curves
from .curves import Curves

__all__ = ["curves_of", "reference_curves", "spectrum_db"]

ATTACK = 0.03  # s
SPECTRUM_SIGMA = 8.0  # 1/s: lines fine enough to tell partials apart, wide enough to see
TOP = 12_000.0  # Hz


def curves_of(result: Result) -> Curves:
    """Everything the page shows of one fit."""
    return replace(
        reference_curves(result), recordings=recordings_of(result), first=result.first, paths=paths_of(result),
        felt=felt_of(result), known=known_of(result), strokes=strokes_of(result), ringing=ringing_curves(result),
    )  # fmt: skip


def reference_curves(result: Result) -> Curves:
    """What is shown of the reference recording alone.

    Raises `FitError` if the fit was read back from a file, which holds no recordings.
    """
    r, a, heard = result.recording, result.analysis, result.reference
    rate, onset, p, k = r.rate, r.onset, heard.partials, heard.partials.number
    top = min(0.5 * rate, TOP, float(law_frequency(a.f0, a.B, k.max() + 2)))
    spectra = [spectrum_db(x[onset:], rate, top) for x in (r.samples, result.initial.samples, result.fitted.samples)]
    attack = slice(onset, onset + int(ATTACK * rate))
    v = result.note
    f0 = v.string.c / (2 * v.geometry.length)
    B = (v.string.kappa * np.pi / (v.string.c * v.geometry.length)) ** 2
    first, last = result.initial.simulation, result.fitted.simulation
    steps = 1e3 * float(last.modes.step) * np.arange(_contact_steps(first, last))
    path = None if v.path is None else v.path.at(p.frequency)
    return Curves(
        frequency=spectra[0][0], measured_db=spectra[0][1], initial_db=spectra[1][1], fitted_db=spectra[2][1],
        borders=tuple(result.document["criterion"]["borders"]),
        attack_ms=1e3 * np.arange(len(r.samples[attack])) / rate, attack_measured=r.samples[attack],
        attack_initial=result.initial.samples[attack], attack_fitted=heard.played.samples[attack],
        number=k,
        frequency_cents=_cents(p.frequency, k * f0),
        frequency_cents_error=1200 / np.log(2) * p.frequency_error / p.frequency,
        frequency_cents_law=_cents(law_frequency(f0, B, k), k * f0),
        decay=p.decay, decay_error=p.decay_error,
        decay_law=v.string.b1 + v.string.b2 * (k * np.pi / v.geometry.length) ** 2,
        level=heard.level, level_error=p.level_error,
        level_initial=result.initial.level, level_fitted=result.fitted.level, path=path,
        force_ms=steps,
        force_initial=_pad(first.pulse.force, len(steps)), force_fitted=_pad(last.pulse.force, len(steps)),
        compression_initial=1e3 * _pad(first.pulse.compression, len(steps)),
        compression_fitted=1e3 * _pad(last.pulse.compression, len(steps)),
        sound_rate=rate, sound_original=r.samples if heard.played.frames is None else r.frames,
        sound_initial=result.initial.samples, sound_fitted=heard.sound,
        sound_law=None if heard.ringing is None else heard.fitted.samples,
    )  # fmt: skip


def spectrum_db(samples: np.ndarray, rate: int, top: float) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies, Hz, and levels, dB, of the spectrum under exp(-σt), up to `top`, Hz, as pages show it."""
    n = min(len(samples), int(14 / SPECTRUM_SIGMA * rate))
    size = 2 ** int(np.ceil(np.log2(n)))
    value = np.abs(np.fft.rfft(samples[:n] * np.exp(-SPECTRUM_SIGMA * np.arange(n) / rate), size)) / rate
    keep = slice(1, int(top * size / rate))
    return np.fft.rfftfreq(size, 1 / rate)[keep], 20 * np.log10(np.maximum(value[keep], 1e-15))


def _cents(frequency: np.ndarray, reference: np.ndarray) -> np.ndarray:
    return 1200 * np.log2(frequency / reference)


def _contact_steps(*simulations) -> int:
    """Steps until the last of the contacts is over, and a tenth more."""
    return max(int(1.1 * s.last_touch / float(s.modes.step)) + 2 for s in simulations)


def _pad(values, size: int) -> np.ndarray:
    """`values` [size]: cut, or filled with what nothing looks like."""
    values = np.asarray(values)[:size]
    return np.pad(values, (0, size - len(values)), constant_values=np.nan)
