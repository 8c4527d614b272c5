"""Synthetic recordings of plucked strings with known parameters, by the witness `brute_pluck`.

A case draws a string of a guitar or banjo, one to four plucks near one place, and what records them: a microphone
behind a body and a room, or a magnetic pickup behind a cable. Body and room are two random fields of many modes, so the
level of each partial has the distribution of the product of two Rayleigh variables. A cable is smooth.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.signal
from brute_pluck import pluck

from pianofit import Geometry, Recording, Setup, String, recording_from_samples

RATE, SECONDS, LEAD = 44_100, 3.0, 0.1  # Hz, s
TAPS = 16_384
WINDOWS = ("parabola", "box", "triangle", "biweight")
POINTS = 200
# Ranges of the draws: fundamental, Hz, from E2 to E4; inharmonicity; length, m; decays, 1/s; width, m.
F0, B, LENGTH = (82.0, 330.0), (2e-5, 3e-4), (0.35, 0.68)
B1, D2, WIDTH = (0.4, 3.0), (5e-3, 6e-2), (1e-3, 1.5e-2)
POSITION, PICKUP, JITTER = (0.06, 0.35), (0.08, 0.35), 0.05
NOISE_DB = (50.0, 70.0)


class Case(NamedTuple):
    """Recordings, setup, and true values by name, with x0 of the first stroke."""

    recordings: list[Recording]
    setup: Setup
    true: dict[str, float]
    positions: list[float]  # of the strokes over the length


def draw(seed: int, quantity: str = "pressure", strokes: int | None = None, pickup_known: bool = True) -> Case:
    """The case of a seed; the same seed gives the same samples."""
    random = np.random.default_rng([41, seed])
    string, g = _string(random)
    count = 1 + int(random.integers(4)) if strokes is None else strokes
    positions = [float(g.strike_position * np.exp(JITTER * random.normal())) for _ in range(count)]
    window = WINDOWS[int(random.integers(len(WINDOWS)))]
    path = _path(random, string.c / (2 * g.length), quantity)
    recordings, noise_db = [], random.uniform(*NOISE_DB)
    for n, position in enumerate(positions):
        source = "velocity" if quantity == "magnetic-pickup" else "bridge-force"
        geometry = g._replace(strike_position=position)
        sound = pluck(
            string, geometry, rate=RATE, samples=int(SECONDS * RATE), quantity=source, window=window, points=POINTS
        )
        sound = scipy.signal.oaconvolve(sound, path)[: len(sound)]
        sound *= 0.1 * np.exp(0.5 * random.normal()) / np.abs(sound).max()
        samples = np.pad(sound, (int(LEAD * RATE), 0))
        rms = np.sqrt(np.mean(sound[:RATE] ** 2)) * 10 ** (-noise_db / 20)
        recordings.append(
            recording_from_samples(samples + random.normal(0, rms, len(samples)), RATE, name=f"pluck-{n}")
        )
    given = {"pickup_position": g.pickup} if quantity == "magnetic-pickup" and pickup_known else {}
    setup = Setup(length=g.length, excitation="pluck", pickup_quantity=quantity, **given)
    true = string._asdict() | {"pickup": g.pickup, "width": g.width}
    return Case(recordings, setup, true, [position / g.length for position in positions])


def _string(random: np.random.Generator) -> tuple[String, Geometry]:
    def between(ends: tuple[float, float]) -> float:
        return float(np.exp(random.uniform(*np.log(ends))))

    length, f0 = between(LENGTH), between(F0)
    c = 2 * length * f0
    string = String(c, c * length * between(B) ** 0.5 / np.pi, between(B1), between(D2) * (length / np.pi) ** 2)
    return string, Geometry(length, 4e-3, between(POSITION) * length, between(WIDTH), between(PICKUP) * length)


def _path(random: np.random.Generator, f0: float, quantity: str) -> np.ndarray:
    """Minimum-phase filter [taps]: smooth by some 6 dB, and rough from partial to partial with a microphone."""
    f = np.fft.rfftfreq(2 * TAPS, 1 / RATE)
    octaves = np.log2(np.maximum(f, 20.0) / 20.0)
    waves = [random.normal() * np.cos(2 * np.pi * (n * octaves / 10 + random.random())) for n in range(1, 7)]
    smooth = np.sum(waves, axis=0)
    level = 6.0 * (smooth - smooth.mean()) / smooth.std()
    if quantity != "magnetic-pickup":
        count = int(f[-1] / f0)
        fields = random.rayleigh(size=(2, count))
        level = level + np.interp(f, f0 * np.arange(1, count + 1), 20 * np.log10(fields).sum(axis=0))
    cepstrum = np.fft.irfft(level / 20 * np.log(10))
    cepstrum[1:TAPS] *= 2
    cepstrum[TAPS + 1 :] = 0
    return np.fft.irfft(np.exp(np.fft.rfft(cepstrum)))[:TAPS]
