"""Cases for `interval_coverage.py`: synthetic recordings of strings, hammers and paths that are drawn at random.

A case is one of five keys from A0 to C6, struck one to five times. Its hammer is drawn from the prior of a fit, centred
at the literature value of the key (`literature.typical`). Its string is drawn with some scatter. Correct
intervals then hold 95 % of the true values for any recordings (Talts and others 2018). The kinds differ only in the
program that computes the sound:

- `model`: the program's own string and hammer, at a contact rate that no fit uses. These cases test the statistics.
- `brute-force`: `tests/brute_force.py`, which steps the wave equation on a fine grid with another window, and
  shares no line with the program. Half of these cases glide: the tension of the free string falls, and the pitch by
  some cents with a time constant, more after a harder stroke. Half of them beat: the
  stroke excites two axes, the second fainter and detuned by up to three cents. Each is simulated, and
  the sound is their sum. Every fourth case has both.
- `same-window`: the same cases with the program's window. The difference is the effect of the window.

Every second case is calibrated: a velocity pickup of known place and scale. The others are observed at the bridge
through an unknown path: a minimum-phase filter whose level varies smoothly, and more from one partial to the next. Both
variations are drawn from their priors. Every recording has its own gain. White noise lies 40 to 70 dB below
each recording's first second.

The setup has the values that a laboratory would know: length, mass, strike position and, with a path, the velocity of
the hardest stroke, since no recording through a path determines it. Every second case with a path lacks the strike
position. So no value rests on an assumption, and each has a true value.
"""

from __future__ import annotations

import math
import sys
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.signal

from pianofit.felt import DEFAULT_LAW
from pianofit.inference import priors
from pianofit.literature import typical
from pianofit.parameters import Geometry, Hammer, String
from pianofit.recording.recording import Recording, recording_from_samples
from pianofit.setup import Setup

__all__ = ["KINDS", "Design", "Truth", "Twin", "design_of", "draw", "make", "output_path", "values_of"]
# The window of the contact of each kind that `tests/brute_force.py` makes.
WINDOWS = {"brute-force": "parabola", "same-window": "raised-cosine"}
KINDS = ("model", *WINDOWS)
Values = dict[str, float | tuple[float, float]]  # by name; a range where there is no one truth
MOST_RECORDINGS = 5
# MIDI: A0, D2, F#3, A#4, C6. Compiled programs depend on the key and the number of recordings: few keys, few programs.
KEYS = (21, 38, 54, 70, 84)
SLOWEST, FASTEST = 0.5, 5.0  # m/s
HAMMER_SPREAD = priors.HAMMER_SD | {name: p.prior_sd for name, p in DEFAULT_LAW.parameters.items()}
STRING_SCATTER = {"length": 0.1, "B": 0.3, "b1": 0.3, "b2": 0.3}  # of logarithms
FARTHEST = 2.0  # standard deviations: what lies beyond may be no hammer at all
NOISE = (40.0, 70.0)  # dB
GLIDE, GLIDE_SECONDS = (1.0, 6.0), (0.3, 0.9)  # cents at the hardest stroke, s
BEAT, BEAT_LEVEL = (0.5, 3.0), (0.1, 0.4)  # cents, of the first polarisation's amplitude
SECONDS, LEAD = 3.0, 0.05  # s
RATE = 44_100  # Hz; the witness steps at 706 kHz and filters
OVERSAMPLING = 32  # of the model's contact
# Taps of a path. Levels may differ from one partial of A0 to the next, 27.5 Hz away, so it must last longer than 36 ms.
TAPS = 16384
# Pitch is that of 0.2 to 1.0 s, as in an analysis.
HEARD = (0.2, 1.0)
CONTACT = 0.01  # s, at most
# ω dt to which the witness' Runge-Kutta scheme is stable, with room to spare.
STABLE, MOST_POINTS = 2.0, 240


class Design(NamedTuple):
    """The cell of the study that a case is in. Consecutive cases fill all cells evenly."""

    key: int  # MIDI
    recordings: int
    calibrated: bool
    glide: bool
    beats: bool
    strike_known: bool


class Truth(NamedTuple):
    """What was drawn."""

    string: String
    hammer: Hammer  # with the velocity of the hardest stroke
    geometry: Geometry
    velocities: tuple[float, ...]  # m/s, rising
    noise_db: float  # below each recording's first second
    gains: tuple[float, ...]  # of the recordings through a path
    smooth_db: float  # of the path, rms
    rough_db: float
    glide_cents: float  # at the hardest stroke
    glide_seconds: float
    beat_cents: float
    beat_level: float

    @property
    def f0(self) -> float:
        """Hz, of the string without stiffness."""
        return self.string.c / (2 * self.geometry.length)


class Twin(NamedTuple):
    """Recordings, what was known beforehand, and the truth by name, with the velocity of each recording."""

    kind: str
    seed: int
    design: Design
    truth: Truth
    recordings: list[Recording]
    setup: Setup
    values: Values  # of the hardest stroke


def design_of(kind: str, seed: int) -> Design:
    """The cell of a case: ten in a row hold every number of recordings, calibrated and not; fifty, every key."""
    block, column = divmod(seed // 2, MOST_RECORDINGS)
    effects = kind in WINDOWS
    # From block to block, and shifted along the recordings, lest five recordings glide only where they beat.
    odd, second = (block + column) % 2 == 1, (block // 2 + column // 2) % 2 == 1
    return Design(
        key=KEYS[(block + seed) % len(KEYS)],
        recordings=1 + column,
        calibrated=seed % 2 == 0,
        glide=effects and odd,
        beats=effects and second,
        strike_known=seed % 2 == 0 or not odd,
    )


def draw(kind: str, seed: int) -> Truth:
    """String, hammer, strokes and path of case number `seed`."""
    random = np.random.default_rng([int(kind in WINDOWS), seed])
    design = design_of(kind, seed)
    usual = typical(design.key)
    scattered = partial(_scattered, random)
    string, geometry = _drawn_string(usual.string, usual.geometry, scattered)
    velocities = _velocities(random, design.recordings)
    return Truth(
        string, _drawn_hammer(usual.hammer, velocities[-1], scattered), geometry, velocities,
        noise_db=random.uniform(*NOISE),
        gains=tuple(np.exp(random.normal(0, 0.5, design.recordings)).tolist()),
        smooth_db=scattered(priors.LEVEL.median[1], priors.LEVEL.spread[1]),
        rough_db=scattered(*priors.PATH),
        glide_cents=random.uniform(*GLIDE) * design.glide,
        glide_seconds=random.uniform(*GLIDE_SECONDS),
        beat_cents=random.uniform(*BEAT) * random.choice([-1, 1]) * design.beats,
        beat_level=random.uniform(*BEAT_LEVEL),
    )  # fmt: skip


def _scattered(random: np.random.Generator, value: float, spread: float) -> float:
    """Around `value`, by `spread` on a log scale, and by no more than `FARTHEST` of it."""
    return float(value * np.exp(spread * np.clip(random.normal(), -FARTHEST, FARTHEST)))


def _drawn_string(usual: String, size: Geometry, scattered) -> tuple[String, Geometry]:
    f0 = usual.c / (2 * size.length)
    B = scattered((usual.kappa * math.pi / (usual.c * size.length)) ** 2, STRING_SCATTER["B"])
    length = scattered(size.length, STRING_SCATTER["length"])
    c = 2 * length * f0
    string = String(
        c, c * length * math.sqrt(B) / math.pi,
        scattered(usual.b1, STRING_SCATTER["b1"]), scattered(usual.b2, STRING_SCATTER["b2"]),
    )  # fmt: skip
    strike = scattered(0.12, HAMMER_SPREAD["x0"]) * length
    pickup = scattered(0.3, 0.2) * length
    return string, Geometry(length, size.mass * length / size.length, strike, size.width, pickup)


def _drawn_hammer(usual: Hammer, velocity: float, scattered) -> Hammer:
    """The force at half a millimetre scatters, not K_H itself: with another p that is another quantity."""
    p, mass = scattered(usual.p, HAMMER_SPREAD["p"]), scattered(usual.M_H, HAMMER_SPREAD["M_H"])
    pressed = 0.5e-3
    force = scattered(usual.K_H * pressed**usual.p, HAMMER_SPREAD["K_H"])
    return Hammer(force / pressed**p, scattered(usual.mu, HAMMER_SPREAD["mu"]), p, mass, velocity)


def _velocities(random: np.random.Generator, count: int) -> tuple[float, ...]:
    """Rising velocities over the usual range, m/s; a single one anywhere in its middle."""
    if count == 1:
        return (float(np.exp(random.uniform(math.log(0.8), math.log(4.0)))),)
    ends = random.uniform(SLOWEST, 2 * SLOWEST), random.uniform(0.5 * FASTEST, FASTEST)
    inner = np.geomspace(*ends, count)
    apart = math.log(ends[1] / ends[0]) / (count - 1)
    inner[1:-1] *= np.exp(random.uniform(-0.25, 0.25, count - 2) * apart)
    return tuple(inner.tolist())


def make(kind: str, seed: int) -> Twin:
    """Twin number `seed`; the same number gives the same samples."""
    design, truth = design_of(kind, seed), draw(kind, seed)
    sounds = [_sounded(kind, truth, v, design.calibrated) for v in truth.velocities]
    if design.calibrated:
        scale = 1.25 * max(float(np.abs(x).max()) for x in sounds)
        sounds = [x / scale for x in sounds]
    else:
        scale, path = None, output_path(truth, RATE, seed)
        sounds = [scipy.signal.oaconvolve(x, path)[: x.size] for x in sounds]
        loudest = max(float(np.abs(x).max()) for x in sounds)
        sounds = [g * x / (5 * loudest) for g, x in zip(truth.gains, sounds, strict=True)]
    noise = np.random.default_rng([int(kind in WINDOWS), seed, 1])
    recordings = [
        recording_from_samples(_noisy(x, truth.noise_db, RATE, noise), RATE, name=f"layer-{n}")
        for n, x in enumerate(sounds, 1)
    ]
    return Twin(kind, seed, design, truth, recordings, _setup(design, truth, scale), values_of(kind, truth))


def _sounded(kind: str, truth: Truth, velocity: float, calibrated: bool) -> np.ndarray:
    """One recording at the pickup (m/s) or at the bridge (N), with the silence before it."""
    quantity = "velocity" if calibrated else "bridge-force"
    hammer, rate = truth.hammer._replace(v_H0=velocity), RATE
    if kind == "model":
        from pianofit.model import simulate

        hit = simulate(truth.string, hammer, truth.geometry, rate=rate, oversampling=OVERSAMPLING, quantity=quantity)
        return np.pad(hit.waveform(rate, int(SECONDS * rate)), (int(LEAD * rate), 0))
    brute_force = _witness()
    window = WINDOWS[kind]
    geometry = truth.geometry._replace(width=brute_force.matched_width(window, truth.geometry.width))
    # One stroke is shared out between two axes: together they are the one string that was struck.
    share = 1 + truth.beat_level * (truth.beat_cents != 0)
    sound = brute_force.make_synthetic_recording(
        truth.string, hammer, geometry, seconds=SECONDS + LEAD, rate=rate, quantity=quantity, lead_in=LEAD,
        glide_cents=truth.glide_cents * (velocity / truth.velocities[-1]) ** 2, glide_seconds=truth.glide_seconds,
        beating_cents=truth.beat_cents, beating_level=truth.beat_level, window=window,
        points=_points(truth, rate * brute_force.OVERSAMPLING),
    )  # fmt: skip
    return sound / share


def _witness():
    """`tests/brute_force.py`."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    import brute_force

    return brute_force


def _points(truth: Truth, steps: float) -> int:
    """Points of the witness' grid, as many as are stable at so many `steps` a second: stiff strings allow few."""
    string, length = truth.string, truth.geometry.length
    for points in range(MOST_POINTS, 40, -4):
        beta = 1.06 * math.pi * (points + 1) / length
        if math.hypot(string.c * beta, string.kappa * beta**2) < STABLE * steps:
            return points
    raise ValueError(f"no grid of the witness is stable for {string}")


def output_path(truth: Truth, rate: float, seed: int) -> np.ndarray:
    """A minimum-phase filter [TAPS] whose level wanders smoothly by `smooth_db`, and by `rough_db` at each partial."""
    f = np.fft.rfftfreq(2 * TAPS, 1 / rate)
    cepstrum = np.fft.irfft(_path_db(truth, seed, f) / 20 * math.log(10))
    cepstrum[1:TAPS] *= 2
    cepstrum[TAPS + 1 :] = 0
    return np.fft.irfft(np.exp(np.fft.rfft(cepstrum)))[:TAPS]


def _path_db(truth: Truth, seed: int, f: np.ndarray) -> np.ndarray:
    """Its level at frequencies `f`, Hz: cosines over the octaves from 20 Hz, and straight lines between partials."""
    random = np.random.default_rng([7, seed])
    octaves = np.log2(np.maximum(f, 20.0) / 20.0)
    terms = [random.normal() * np.cos(2 * np.pi * (n * octaves / 10 + random.random())) for n in range(1, 7)]
    smooth = np.sum(terms, axis=0)
    k = np.arange(1, 1 + int(f[-1] / truth.f0))
    B = (truth.string.kappa * math.pi / (truth.string.c * truth.geometry.length)) ** 2
    partials = k * truth.f0 * np.sqrt(1 + B * k**2)
    rough = np.interp(f, partials, truth.rough_db * random.normal(size=k.size))
    return truth.smooth_db * (smooth - smooth.mean()) / smooth.std() + rough


def _noisy(samples: np.ndarray, noise_db: float, rate: int, random: np.random.Generator) -> np.ndarray:
    onset = int(LEAD * rate)
    rms = math.sqrt(float(np.mean(samples[onset : onset + rate] ** 2)))
    return samples + random.normal(0.0, rms * 10 ** (-noise_db / 20), samples.size)


def _setup(design: Design, truth: Truth, scale: float | None) -> Setup:
    g, hardest = truth.geometry, len(truth.velocities)
    strike = {"width": g.width} | ({"position": g.strike_position} if design.strike_known else {})
    tables = {"string": {"length": g.length, "mass": g.mass}, "strike": strike}
    if design.calibrated:
        tables["pickup"] = {"quantity": "velocity", "position": g.pickup, "scale": scale}
        return Setup.from_dict(tables, "twin")
    known = {"file": f"layer-{hardest}", "v_H0": truth.velocities[-1]}
    return Setup.from_dict(tables | {"recording": [known]}, "twin")


def values_of(kind: str, truth: Truth, recording: int = -1) -> Values:
    """The truth by name, of one recording's stroke: the hardest's by default.

    A gliding string's c is that of the mean pitch over `HEARD`. The witness' fall begins when the hammer has left, a
    few milliseconds after the stroke: c lies in a range. Two axes have two pitches. A note far shorter
    than their beat sounds at the mean of the two by their shares, one far longer at that of the stronger, so between
    these the truth of c and κ lies. The witness' window has no width of the model's own kind, so the effective width
    has no truth there.
    """
    start, stop = HEARD
    velocity = truth.velocities[recording]
    tau, cents = truth.glide_seconds, truth.glide_cents * (velocity / truth.velocities[-1]) ** 2
    sharp = 2 ** (cents / 1200) - 1
    mean = sharp * tau * (math.exp(-start / tau) - math.exp(-stop / tau)) / (stop - start)
    share = truth.beat_level / (1 + truth.beat_level)
    pulled = sorted((1.0, 2 ** (share * truth.beat_cents / 1200)))
    tensions = 1 + mean, 1 + mean * math.exp(CONTACT / tau)
    values = {
        **truth.string._asdict(),
        **truth.hammer._asdict(),
        "v_H0": velocity,
        "x0": truth.geometry.strike_position,
    }
    values |= {"width": truth.geometry.width} if WINDOWS.get(kind) != "parabola" else {}
    values = {name: float(value) for name, value in values.items()}
    c = values["c"] * tensions[0] * pulled[0], values["c"] * tensions[1] * pulled[1]
    return values | {"c": c, "kappa": (values["kappa"] * pulled[0], values["kappa"] * pulled[1])}
