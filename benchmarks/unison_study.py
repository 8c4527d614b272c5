"""Test whether a recorded note determines the number and the mistunings of the strings of a unison.

    python benchmarks/unison_study.py                      all parts, some eight minutes of one processor
    python benchmarks/unison_study.py --only synthetic --seeds 20

The model and its fit are in `unison.py`. Synthetic recordings have 8 partials, three strokes and white noise 50 to 70
dB below the peak. There are unisons of the model, with outer strings 0.2 to 3 cents apart, and one string with two
polarisations, whose poles and amplitudes are drawn for each partial. A third kind are the two strings with two
polarisations of `tests/coupled_strings.py`, 3.5 cents apart in one polarisation and 2.4 in the other. `right` counts
recordings with the correct N. The errors of mistunings between neighbouring strings at the correct N are their rms,
cents, the rms of the standard errors, and the coverage of the 95 % intervals. `left` and `one` are explained below.

The notes of ../shared/recordings, or of the folder PIANOFIT_RECORDINGS, were recorded by two microphones at once. Each
microphone is fitted alone (all partials, lower half, upper half), and then both together. `agree` counts the starts
that end within 3 of the largest log likelihood. `left` is the residual share of a partial's weighted power, median in
%, for N = 1, 2 and 3, for free modes with one pattern for all layers and channels (`one`), and for free modes with
individual amplitudes (`own`).
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from unison import STARTS, Bands, Unison, bands_of, log_uniform, matrices, unison

from pianofit import load_recording
from pianofit.recording.recording import recording_from_samples

ROOT = Path(__file__).parents[1]
RECORDINGS = Path(os.environ.get("PIANOFIT_RECORDINGS", ROOT.parent / "shared" / "recordings"))
NOTES = {"A0": ("L2", "L4"), "C4": ("L4",)}
MICROPHONES = ("close", "decca")
STRINGS = (1, 2, 3)
# Synthetic recordings: sampling rate, Hz; length, s; silence before the stroke, s; partials; strokes.
RATE = 22_050
SECONDS = 4.0
LEAD = 0.1
PARTIALS = 8
STROKES = 3
# Ranges: f0, Hz; cents between the outer strings; noise, dB; N |g|, 1/s, and phase; second polarisation, relative.
KEYS = 60.0, 500.0
APART = 0.2, 3.0
NOISE = 50.0, 70.0
COUPLING = 0.3, 5.0
PHASE = 1.3
OTHER = 0.05, 0.5
# f0 of the coupled strings, Hz, and their noise below the peak, dB.
COUPLED_KEYS = (165.0, 220.0, 330.0)
COUPLED_NOISE = 65.0


def drawn(random: np.random.Generator, strings: int, *, polarised: bool) -> tuple[float, np.ndarray, np.ndarray]:
    """Draw f0, sounds [strokes, samples] and cents between neighbouring strings of a synthetic recording."""
    f0 = float(log_uniform(random, KEYS))
    cents = np.sort(random.normal(size=strings))
    if strings > 1:
        cents = (cents - cents.mean()) * log_uniform(random, APART) / np.ptp(cents)
    time = np.arange(round(SECONDS * RATE)) / RATE
    sound = np.zeros((STROKES, len(time)))
    for k in range(1, PARTIALS + 1):
        p = -0.3 - 0.02 * k**1.5
        g = log_uniform(random, COUPLING, (2,)) * np.exp(1j * random.uniform(-PHASE, PHASE, 2))
        pole, vector = np.linalg.eig(matrices(np.array([p + 0j]), g[:1] / strings, cents[None], np.array([k * f0]))[0])
        share = vector.sum(axis=0) * np.linalg.solve(vector, np.ones(strings) + 0j)
        if polarised:
            pole = p - g
            share = np.array([1.0, log_uniform(random, OTHER) * np.exp(2j * np.pi * random.uniform())])
        stroke = np.exp(0.3 * random.normal(size=(STROKES, 1)) + 2j * np.pi * random.uniform(size=(STROKES, 1)))
        sound += (stroke / k * (share @ np.exp(np.outer(pole + 2j * np.pi * k * f0, time)))).real
    return f0, sound, np.diff(cents)


def recorded(sounds: Sequence[np.ndarray], noise: float, random: np.random.Generator) -> list:
    """Return recordings of sounds with `noise`, dB below the peak of the loudest."""
    peak, recordings = max(np.abs(x).max() for x in sounds), []
    for x in sounds:
        x = np.pad(x / peak, (round(LEAD * RATE), 0))
        recordings.append(recording_from_samples(0.5 * (x + 10 ** (-noise / 20) * random.normal(size=len(x))), RATE))
    return recordings


def coupled(f0: float) -> tuple[Bands, np.ndarray]:
    """Return three strokes of coupled strings by finite differences, and their transverse mistuning, cents [1]."""
    sys.path.insert(0, str(ROOT / "tests"))
    from coupled_strings import LINES, Unison, stroke

    impulse = Unison(f0).response(RATE, round(SECONDS * RATE))
    sounds = [stroke(impulse, RATE, velocity) for velocity in (0.6, 1.0, 1.7)]
    return bands_of(recorded(sounds, COUPLED_NOISE, np.random.default_rng(0)), f0), 1200 * np.log2([LINES[1][0]])


def fits(bands: Bands) -> dict[int, Unison]:
    """Return the fits by N."""
    return {n: unison(bands, n) for n in STRINGS}


def best(by_number: dict[int, Unison]) -> int:
    """Return the N with the most evidence."""
    return max(by_number, key=lambda n: by_number[n].evidence)


def study_synthetic(strings: int, seeds: int, *, polarised: bool = False) -> None:
    """Print counts of the correct N, errors of mistunings, and residuals for one kind of synthetic recordings."""
    numbers, rows, agree, left = [], [], [], []
    for seed in range(seeds):
        random = np.random.default_rng([seed, strings, polarised])
        f0, sounds, gap = drawn(random, strings, polarised=polarised)
        bands = bands_of(recorded([*sounds], random.uniform(*NOISE), random), f0)
        by_number = fits(bands)
        numbers.append(best(by_number))
        agree.append(by_number[max(numbers[-1], 2)].agree)
        left.append([by_number[numbers[-1]].left, np.median(bands.free[:, 0])])
        if numbers[-1] == strings > 1:
            rows += zip(by_number[strings].gap - gap, by_number[strings].error, strict=True)
    count = [numbers.count(n) for n in STRINGS]
    name = f"{strings}, two polarisations" if polarised else str(strings)
    line = f"{name:>24}{seeds:6}{numbers.count(strings):7}{count[0]:8}{count[1]:4}{count[2]:4}{errors(rows):26}"
    unison_left, one = 100 * np.median(left, axis=0)
    print(f"{line}{np.median(agree):6.1f}/{STARTS}{unison_left:9.2g}{one:7.2g}", flush=True)


def errors(rows: list[tuple[float, float]]) -> str:
    """Format the rms of errors and of standard errors, cents, and the coverage of the 95 % intervals."""
    if not rows:
        return ""
    off, error = np.array(rows).T
    return f"{np.sqrt(np.mean(off**2)):9.5f}{np.sqrt(np.mean(error**2)):9.5f}{np.mean(np.abs(off) < 1.96 * error):8.0%}"


def study_coupled() -> None:
    """Print the fits of two strings with two polarisations."""
    print_head()
    for f0 in COUPLED_KEYS:
        bands, gap = coupled(f0)
        print_note(f"coupled, {f0:.0f} Hz, {gap[0]:.2f}", bands)


def study_notes() -> None:
    """Print the fits of two microphones: each alone, by halves of its partials, and together."""
    print_head()
    for note, layers in NOTES.items():
        everything = []
        for microphone in MICROPHONES:
            files = [RECORDINGS / f"headroom-{note}-{layer}-{microphone}.flac" for layer in layers]
            recordings = [load_recording(file) for file in files]
            everything += recordings
            bands = bands_of(recordings, note)
            print_note(f"{note} {microphone}", bands)
            half = np.arange(len(bands.step)) < len(bands.step) // 2
            print_note("lower half", bands.some(half))
            print_note("upper half", bands.some(~half))
        print_note(f"{note} both", bands_of(everything, note))


def print_head() -> None:
    """Print the header of `print_note`."""
    print(f"\n{'':>24}{'N':>4}{'evidence':>10}{'agree':>9}{'cents between strings':>28}   left by 1, 2, 3, one, own: %")


def print_note(name: str, bands: Bands) -> None:
    """Print evidence, agreeing starts, mistunings with 95 % intervals for two and three strings, and residuals."""
    by_number = fits(bands)
    more = [by_number[n].evidence - by_number[1].evidence for n in (2, 3)]
    left = [*(by_number[n].left for n in STRINGS), *np.median(bands.free, axis=0)]
    for n in (2, 3):
        gaps = ", ".join(f"{g:.2f} ± {1.96 * e:.2f}" for g, e in zip(by_number[n].gap, by_number[n].error, strict=True))
        row = f"{name if n == 2 else '':>24}{n:4}{'*' if best(by_number) == n else ' '}{more[n - 2]:+9.0f}"
        row += f"{by_number[n].agree:6}/{STARTS}{gaps:>28}"
        print(row + ("   " + " ".join(f"{100 * x:.2g}" for x in left) if n == 2 else ""), flush=True)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=6, help="synthetic recordings of each kind")
    parser.add_argument("--only", choices=("synthetic", "coupled", "notes"))
    options = parser.parse_args()
    if options.only in (None, "synthetic"):
        print(f"{'strings':>24}{'made':>6}{'right':>7}{'N = 1':>8}{'2':>4}{'3':>4}", end="")
        print(f"{'off':>9}{'stated':>9}{'within':>8}{'agree':>8}{'left':>9}{'one':>7} %")
        for strings in STRINGS:
            study_synthetic(strings, options.seeds)
        study_synthetic(1, options.seeds, polarised=True)
    if options.only in (None, "coupled"):
        study_coupled()
    if options.only in (None, "notes"):
        study_notes()


if __name__ == "__main__":
    main()
