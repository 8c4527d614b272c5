"""Synthetic recordings for the tests of the fit.

Brute-force simulations use another window, rate and step than the fit. Recordings by the model itself, at another rate
and a much finer step, test the statistics alone.
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np
import scipy.signal
from brute_force import make_synthetic_recording, matched_width

from pianofit.analysis import Analysis, analyse
from pianofit.fitting import fit
from pianofit.inference import InferenceResult, run_inference
from pianofit.model import simulate
from pianofit.parameters import FIT_NAMES, Geometry, Hammer, String
from pianofit.recording.recording import Recording, recording_from_samples
from pianofit.result import Result, build_result
from pianofit.schema.fit import Fit
from pianofit.setup import RecordingInfo, Setup

RATE = 48_000
LEAD = 0.03  # s
# Allowed relative errors, and that of the felt force from 20 to 100 % of the largest compression.
ALLOWED = {"c": 2e-4, "kappa": 0.01, "b1": 0.03, "M_H": 0.03, "v_H0": 0.03}
FELT = 0.05


class Truth(NamedTuple):
    """True parameters of one recorded string and hammer."""

    string: String
    hammer: Hammer
    geometry: Geometry
    scale: float  # m/s at full scale

    @property
    def f0(self) -> float:
        """Fundamental frequency of the string without stiffness, Hz."""
        return self.string.c / (2 * self.geometry.length)

    @property
    def values(self) -> dict[str, float]:
        """The nine parameters by name."""
        return dict(zip(FIT_NAMES, (*self.string, *self.hammer), strict=True))


# Differs from the string of the demo in every parameter.
FIRST = Truth(
    String(c=352.0, kappa=1.15, b1=0.42, b2=4e-5),
    Hammer(K_H=5e10, mu=0.25, p=2.9, M_H=4.9e-3, v_H0=1.4),
    Geometry(length=0.88, mass=7.2e-3, strike_position=0.11, width=0.015, pickup=0.31),
    scale=4.0,
)


def random_truth(seed: int) -> Truth:
    """A string from A2 to A3 with a random piano hammer, struck from piano to forte."""
    random = np.random.default_rng(seed)

    def between(low: float, high: float) -> float:
        return float(np.exp(random.uniform(math.log(low), math.log(high))))

    length, f0 = between(0.8, 1.2), between(110, 220)
    c, mass = 2 * length * f0, between(4e-3, 10e-3)
    kappa = c * length * math.sqrt(between(5e-5, 4e-4)) / math.pi
    string = String(c, kappa, between(0.2, 0.8), between(5e-6, 1e-4))
    p, velocity, hammer_mass = random.uniform(2.2, 3.0), between(1.0, 2.5), mass * between(0.4, 1.5)
    # Compression of 0.5 to 1.2 mm if the felt stores all of the hammer's energy.
    stiffness = 0.5 * (p + 1) * hammer_mass * velocity**2 / between(0.5e-3, 1.2e-3) ** (p + 1)
    hammer = Hammer(stiffness, between(0.05, 0.3), p, hammer_mass, velocity)
    width = between(0.01, 0.025)
    geometry = Geometry(length, mass, between(0.1, 0.14) * length, width, random.uniform(0.28, 0.45) * length)
    return Truth(string, hammer, geometry, 4.0)


def setup_of(truth: Truth, **more: dict) -> Setup:
    """The setup of a laboratory for `truth`: sizes and pickup, with `more` tables."""
    g = truth.geometry
    data = {
        "string": {"length": g.length, "mass": g.mass},
        "strike": {"position": g.strike_position, "width": g.width},
        "pickup": {"quantity": "velocity", "position": g.pickup, "scale": truth.scale},
        "felt": {"law": "hunt-crossley"},
    }
    return Setup.from_dict(data | more, "synthetic")


def record(
    truth: Truth, *, quantity: str = "velocity", noise_db: float | None = -60.0, seconds: float = 3.0, seed: int = 0,
    window: str = "parabola", rate: int = RATE, **effects: float,
) -> Recording:  # fmt: skip
    """A recording of `truth` with another contact window of equal variance; `effects` go to the simulation."""
    geometry = truth.geometry._replace(width=matched_width(window, truth.geometry.width))
    samples = make_synthetic_recording(
        truth.string, truth.hammer, geometry, seconds=seconds, rate=rate, quantity=quantity, noise_db=noise_db,
        seed=seed, lead_in=LEAD, window=window, **effects,
    )  # fmt: skip
    unit = truth.scale if quantity == "velocity" else 2 * float(np.abs(samples).max())
    return recording_from_samples(samples / unit, rate, name="synthetic")


def fit_recordings(*given, **more) -> Result:
    """Inference on recordings, as a `Result`."""
    return build_result(run_inference(*given, **more))


def fit_twin(recording: Recording, setup: Setup, *, seed: int = 0) -> Result:
    return fit_recordings([recording], [analyse(recording)], setup, seed=seed)


def errors(fit: Fit, truth: Truth) -> dict[str, float]:
    """Relative errors of a calibrated fit; `felt` is the largest error of the force over compression."""
    found = {name: fit.parameters[name].value for name in FIT_NAMES}
    off = {name: abs(found[name] / truth.values[name] - 1) for name in ALLOWED}
    u = np.linspace(0.2, 1.0, 33) * fit.derived.quantities.peak_compression.value / 1e3
    force = found["K_H"] * u ** found["p"] / (truth.hammer.K_H * u**truth.hammer.p)
    return off | {"felt": float(np.abs(force - 1).max())}


def misses(fit: Fit, truth: Truth) -> dict[str, float]:
    """Errors that are larger than allowed."""
    return {name: x for name, x in errors(fit, truth).items() if x > ALLOWED.get(name, FELT)}


# --- cases shared by all tests of whole fits --------------------------------------------------------------------------

VELOCITIES = (0.8, 1.6, 3.2)  # m/s
ROUGH = 5.0  # dB
# Strokes and microphones. Each microphone has a random output path with its own seed.
ALONE = ((2, "close"),)
SEVERAL = ((0, "close"), (1, "close"), (2, "close"))
MICROPHONES = (*SEVERAL, (1, "room"))
ROOMS = {"close": 7, "room": 8}
# A step sixteen times as fine, with the compiled programs of the other cases.
MODEL_RATE, FINE = 96_000, 16


def record_model(
    truth: Truth, *, quantity: str = "velocity", noise_db: float = -60.0, seconds: float = 3.0, seed: int = 0
) -> Recording:
    """Like `record`, but simulated by the model itself."""
    sound = simulate(
        truth.string, truth.hammer, truth.geometry, rate=MODEL_RATE, oversampling=FINE, quantity=quantity, n_modes=256
    )
    samples = np.pad(sound.waveform(MODEL_RATE, int(seconds * MODEL_RATE)), (int(LEAD * MODEL_RATE), 0))
    rms = math.sqrt(float(np.mean(samples[int(LEAD * MODEL_RATE) :][:MODEL_RATE] ** 2)))
    samples = samples + np.random.default_rng(seed).normal(0.0, rms * 10 ** (noise_db / 20), samples.size)
    unit = truth.scale if quantity == "velocity" else 2 * float(np.abs(samples).max())
    return recording_from_samples(samples / unit, MODEL_RATE, name="synthetic")


def through_a_room(recording: Recording, name: str, seed: int = ROOMS["close"], rough: float = ROUGH) -> Recording:
    """Filter a recording with an output path that varies by `rough` dB from partial to partial, fixed by `seed`.

    The filter is minimum phase, hence causal.
    """
    grid = np.arange(0, 48_000.0 / 2 + 60, 60.0)
    db = np.random.default_rng(seed).normal(0.0, rough, len(grid))
    size = 2**15
    cepstrum = np.fft.irfft(np.interp(np.fft.rfftfreq(size, 1 / recording.rate), grid, db) / 20 * math.log(10))
    cepstrum[1 : size // 2] *= 2
    cepstrum[size // 2 + 1 :] = 0
    path = np.fft.irfft(np.exp(np.fft.rfft(cepstrum)))
    shaped = scipy.signal.oaconvolve(recording.samples, path)[: len(recording.samples)]
    shaped *= 0.5 / np.abs(shaped).max()
    return recording_from_samples(shaped, recording.rate, name=name)


@functools.cache
def _one_through(stroke: int, microphone: str, by: str) -> tuple[Recording, Analysis]:
    truth = FIRST._replace(hammer=FIRST.hammer._replace(v_H0=VELOCITIES[stroke]))
    sounded = record if by == "brute-force" else record_model
    sound = sounded(truth, quantity="bridge-force", seed=10 * stroke + ROOMS[microphone])
    made = through_a_room(sound, f"{stroke}-{microphone}.wav", ROOMS[microphone])
    return made, analyse(made, f0=FIRST.f0)


@functools.cache
def through(strokes: tuple[tuple[int, str], ...], by: str = "brute-force") -> tuple[list[Recording], list[Analysis]]:
    """Strokes of `FIRST` at microphones, normalised to the same peak, and their analyses."""
    made = [_one_through(*stroke, by) for stroke in strokes]
    return [recording for recording, _ in made], [analysis for _, analysis in made]


def strokes_of(strokes: tuple[tuple[int, str], ...], *more: RecordingInfo, measured: bool = True) -> Setup:
    """The setup of these strokes: sizes, stroke names, and the velocity of the fastest stroke."""
    g = FIRST.geometry
    entries = [
        RecordingInfo(f"{s}-{m}.wav", VELOCITIES[2] if s == 2 and measured else None, m, None, str(s))
        for s, m in strokes
    ]
    return Setup(
        length=g.length,
        mass=g.mass,
        strike_position=g.strike_position,
        strike_width=g.width,
        recordings=more or tuple(entries),
        felt="hunt-crossley",
    )


@functools.cache
def inferred(by: str = "brute-force") -> InferenceResult:
    """The inference on a calibrated recording, started from the literature hammer."""
    recording = (record if by == "brute-force" else record_model)(FIRST)
    return run_inference([recording], [analyse(recording)], setup_of(FIRST))


@functools.cache
def calibrated(by: str = "brute-force") -> Result:
    """The result of `inferred`."""
    return build_result(inferred(by))


@functools.cache
def short_fit() -> Result:
    """The fit of 1.5 s of the calibrated recording by the model."""
    return fit(record_model(FIRST, seconds=1.5), setup=setup_of(FIRST), progress=False)


@functools.cache
def uncalibrated() -> Result:
    """The fit of the same stroke as a microphone recording without a setup."""
    return fit_twin(record(FIRST, quantity="pressure"), Setup())


@functools.cache
def path_fit(strokes: tuple[tuple[int, str], ...], by: str = "brute-force") -> Result:
    """The fit of strokes at microphones."""
    return fit_recordings(*through(strokes, by), strokes_of(strokes))


def standard_errors(fit: Fit, truth: dict[str, float]) -> dict[str, tuple[float, float]]:
    """Relative error, and error in standard errors, of every fitted parameter by name."""
    found = {}
    for name, true in truth.items():
        quantity = fit.parameters[name]
        if quantity.status == "fitted" and quantity.interval is not None:
            low, high = quantity.interval
            error = math.log(quantity.value / true)
            found[name] = math.expm1(error), error * 3.92 / math.log(high / low)
    return found
