"""A stand-in for the laboratory: a calibrated "measurement" whose true parameters are known.

The paper's setup (a 1 m string, its Tables II and III, final values) with a velocity pickup and white measurement
noise. The contact is computed at a far higher rate than any fit uses.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..published import preset

__all__ = ["INITIAL", "SCALE", "TRUE", "Twin", "make_twin", "setup_text"]

TRUE = "bensa-final"
INITIAL = "bensa-initial"
RATE = 44_100
SECONDS = 3.0
# Velocity at digital full scale, m/s.
SCALE = 2.0
OVERSAMPLING = 32
LEAD = 0.05


class Twin(NamedTuple):
    """Samples as a file holds them, full scale = 1, and the values behind them by name."""

    samples: np.ndarray
    rate: int
    true: dict[str, float]


def make_twin(noise_db: float | None = 60.0, seed: int = 0) -> Twin:
    """The measurement.

    Parameters
    ----------
    noise_db : how far the noise's rms lies below that of the first second after the strike; None for no noise.
    """
    from ..model import simulate

    it = preset(TRUE)
    strike = simulate(it.string, it.hammer, it.geometry, rate=RATE, oversampling=OVERSAMPLING, quantity="velocity")
    samples = np.pad(strike.waveform(RATE, int(SECONDS * RATE)) / SCALE, (int(LEAD * RATE), 0))
    if noise_db is not None:
        rms = np.sqrt(np.mean(samples[int(LEAD * RATE) :][:RATE] ** 2))
        samples = samples + np.random.default_rng(seed).normal(0.0, rms * 10 ** (-noise_db / 20), len(samples))
    true = {k: float(v) for part in (it.string, it.hammer) for k, v in part._asdict().items()}
    return Twin(samples, RATE, true)


def setup_text(scale: float = SCALE, **initial: float | None) -> str:
    """The `setup.toml` of a measurement: what the laboratory knew, and the paper's initial values.

    Parameters
    ----------
    scale : m/s at digital full scale.
    initial : other initial values than the paper's, by name; None leaves one out.
    """
    g, first = preset(TRUE).geometry, preset(INITIAL)
    values = first.string._asdict() | first.hammer._asdict() | initial
    lines = [
        "[string]", f"length = {g.length}", f"mass = {g.mass}", "",
        "[strike]", f"position = {g.strike}", f"width = {g.width}", "",
        "[pickup]", 'quantity = "velocity"', f"position = {g.pickup}", f"scale = {scale}  # m/s at full scale", "",
        "[initial]  # Bensa et al. (2005), Tables II and III, initial values",
        *(f"{name} = {value!r}" for name, value in values.items() if value is not None),
    ]  # fmt: skip
    return "\n".join(lines) + "\n"
