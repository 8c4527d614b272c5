"""Whether the strings of a unison can be read off a note: how many, and how they are tuned.

    python benchmarks/unison_study.py                      all of it, some eight minutes of one processor
    python benchmarks/unison_study.py --only twins --seeds 20

The model and its fit are in `unison.py`. Twins have 8 partials, three strokes and white noise 50 to 70 dB below the
peak: unisons of that model, whose outer strings are 0.2 to 3 cents apart; one string with two polarisations, whose
poles and shares are drawn partial by partial; and the two strings with two polarisations of `tests/coupled_strings.py`,
which are 3.5 cents apart in one of them and 2.4 in the other. `right` is how many got the N that they have. Errors are
of mistunings between neighbouring strings where N is right: rms, cents; rms of what was stated; how many truths lie in
their 95 % intervals. `left` and `one` are as below.

Notes of ../shared/recordings, or where PIANOFIT_RECORDINGS says, were recorded by two microphones at once. Each is
fitted alone, by its partials and by the lower and the upper half of them, and then both together. `agree` is how many
starts end within 3 of the largest log likelihood; `left` the share of a partial's weighted power, % in the median, that
N = 1, 2 and 3 leave, free modes with one pattern for all layers and channels, and with amplitudes of each one's own.
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
# Twins: Hz, s, and s before a stroke.
RATE = 22_050
SECONDS = 4.0
LEAD = 0.1
PARTIALS = 8
STROKES = 3
# Drawn: f0, Hz; cents between the outer strings; dB; N |g|, 1/s, and its phase; share of the other polarisation.
KEYS = 60.0, 500.0
APART = 0.2, 3.0
NOISE = 50.0, 70.0
COUPLING = 0.3, 5.0
PHASE = 1.3
OTHER = 0.05, 0.5
# f0 of the coupled strings, Hz, and how far below the peak their noise is, dB.
COUPLED_KEYS = (165.0, 220.0, 330.0)
COUPLED_NOISE = 65.0


def drawn(random: np.random.Generator, strings: int, *, polarised: bool) -> tuple[float, np.ndarray, np.ndarray]:
    """f0, sounds [strokes, samples] and cents between neighbouring strings of a twin."""
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
    """Recordings of sounds with noise so many dB below the peak of the loudest."""
    peak, made = max(np.abs(x).max() for x in sounds), []
    for x in sounds:
        x = np.pad(x / peak, (round(LEAD * RATE), 0))
        made.append(recording_from_samples(0.5 * (x + 10 ** (-noise / 20) * random.normal(size=len(x))), RATE))
    return made


def coupled(f0: float) -> tuple[Bands, np.ndarray]:
    """Three strokes of the finite differences' strings; their mistuning across the soundboard, cents [1]."""
    sys.path.insert(0, str(ROOT / "tests"))
    from coupled_strings import LINES, Unison, stroke

    impulse = Unison(f0).response(RATE, round(SECONDS * RATE))
    sounds = [stroke(impulse, RATE, velocity) for velocity in (0.6, 1.0, 1.7)]
    return bands_of(recorded(sounds, COUPLED_NOISE, np.random.default_rng(0)), f0), 1200 * np.log2([LINES[1][0]])


def fits(bands: Bands) -> dict[int, Unison]:
    """By N."""
    return {n: unison(bands, n) for n in STRINGS}


def best(found: dict[int, Unison]) -> int:
    """The N with the most evidence."""
    return max(found, key=lambda n: found[n].evidence)


def study_twins(strings: int, seeds: int, *, polarised: bool = False) -> None:
    """Print how often N is right of one kind of twins, how far mistunings are off, and what is left."""
    said, rows, agree, left = [], [], [], []
    for seed in range(seeds):
        random = np.random.default_rng([seed, strings, polarised])
        f0, sounds, gap = drawn(random, strings, polarised=polarised)
        bands = bands_of(recorded([*sounds], random.uniform(*NOISE), random), f0)
        found = fits(bands)
        said.append(best(found))
        agree.append(found[max(said[-1], 2)].agree)
        left.append([found[said[-1]].left, np.median(bands.free[:, 0])])
        if said[-1] == strings > 1:
            rows += zip(found[strings].gap - gap, found[strings].error, strict=True)
    count = [said.count(n) for n in STRINGS]
    name = f"{strings}, two polarisations" if polarised else str(strings)
    line = f"{name:>24}{seeds:6}{said.count(strings):7}{count[0]:8}{count[1]:4}{count[2]:4}{errors(rows):26}"
    unison_left, one = 100 * np.median(left, axis=0)
    print(f"{line}{np.median(agree):6.1f}/{STARTS}{unison_left:9.2g}{one:7.2g}", flush=True)


def errors(rows: list[tuple[float, float]]) -> str:
    """Of mistunings with their standard errors: rms of both, cents, and how many are within 95 %."""
    if not rows:
        return ""
    off, error = np.array(rows).T
    return f"{np.sqrt(np.mean(off**2)):9.5f}{np.sqrt(np.mean(error**2)):9.5f}{np.mean(np.abs(off) < 1.96 * error):8.0%}"


def study_coupled() -> None:
    """Print what is said of two strings with two polarisations."""
    print_head()
    for f0 in COUPLED_KEYS:
        bands, gap = coupled(f0)
        print_note(f"coupled, {f0:.0f} Hz, {gap[0]:.2f}", bands)


def study_notes() -> None:
    """Print what two microphones say, each alone, by halves of its partials, and together."""
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
    """Of `print_note`."""
    print(f"\n{'':>24}{'N':>4}{'evidence':>10}{'agree':>9}{'cents between strings':>28}   left by 1, 2, 3, one, own: %")


def print_note(name: str, bands: Bands) -> None:
    """Evidence, agreement of starts, mistunings with 95 % intervals for two and for three strings, and what is left."""
    found = fits(bands)
    more = [found[n].evidence - found[1].evidence for n in (2, 3)]
    left = [*(found[n].left for n in STRINGS), *np.median(bands.free, axis=0)]
    for n in (2, 3):
        gaps = ", ".join(f"{g:.2f} ± {1.96 * e:.2f}" for g, e in zip(found[n].gap, found[n].error, strict=True))
        row = f"{name if n == 2 else '':>24}{n:4}{'*' if best(found) == n else ' '}{more[n - 2]:+9.0f}"
        row += f"{found[n].agree:6}/{STARTS}{gaps:>28}"
        print(row + ("   " + " ".join(f"{100 * x:.2g}" for x in left) if n == 2 else ""), flush=True)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=6, help="twins of every kind")
    parser.add_argument("--only", choices=("twins", "coupled", "notes"))
    options = parser.parse_args()
    if options.only in (None, "twins"):
        print(f"{'strings':>24}{'twins':>6}{'right':>7}{'N = 1':>8}{'2':>4}{'3':>4}", end="")
        print(f"{'off':>9}{'stated':>9}{'within':>8}{'agree':>8}{'left':>9}{'one':>7} %")
        for strings in STRINGS:
            study_twins(strings, options.seeds)
        study_twins(1, options.seeds, polarised=True)
    if options.only in (None, "coupled"):
        study_coupled()
    if options.only in (None, "notes"):
        study_notes()


if __name__ == "__main__":
    main()
