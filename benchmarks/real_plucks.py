"""Real plucks: one pluck at microphone and pickup, and repetitions that were left out.

    python benchmarks/real_plucks.py [--folder ../shared/guitar]

The recordings are an archtop guitar, A2 and A3, two dynamics, two repetitions, each by a microphone and a magnetic
pickup at once. The first table compares both recordings of each pluck, fitted separately: whether their 95 % intervals
overlap, and the difference over its standard deviation. The second predicts each pluck by a fit of its repetition
alone. The third predicts it by a fit of the three other plucks of its string through the same path. Both state the
difference of the two repetitions, one gain removed.
"""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path

import numpy as np

from pianofit import Setup, analyse, cross_validate, fit, load_recording
from pianofit.conversions import HALF_WIDTH_95
from pianofit.program_folder import enable_program_cache
from pianofit.schema.fit import LEVEL_RANGE

QUANTITIES = {"microphone": "pressure", "pickup": "magnetic-pickup"}
NAMES = ("c", "kappa", "b1", "b2", "x0/L", "width/L")


def intervals(file: Path, role: str) -> dict[str, tuple[float, float]]:
    """Return the intervals of one recording by name."""
    result = fit(file, setup=Setup(excitation="pluck", pickup_quantity=QUANTITIES[role]), progress=False)
    table = {**result.parameters, **result.invariants}
    found = {name: table[name].interval for name in NAMES}
    return {name: interval for name, interval in found.items() if interval is not None}


def compare(folder: Path) -> None:
    """Print how many intervals of the two recordings of a pluck overlap, by quantity."""
    overlaps: dict[str, list[bool]] = {name: [] for name in NAMES}
    z: dict[str, list[float]] = {name: [] for name in NAMES}
    for key, layer, repetition in itertools.product(("A2", "A3"), ("v2", "v4"), (1, 2)):
        files = {role: folder / f"guitar-{key}-{layer}-rr{repetition}-{role}.flac" for role in QUANTITIES}
        first, second = (intervals(file, role) for role, file in files.items())
        for name in NAMES:
            (a, b), (c, d) = np.log(first[name]), np.log(second[name])
            overlaps[name].append(max(a, c) <= min(b, d))
            z[name].append(abs((a + b - c - d) / np.hypot(b - a, d - c)) * HALF_WIDTH_95)
        print(f"  {key} {layer} rr{repetition}: " + ", ".join(f"{n} {z[n][-1]:.1f}" for n in NAMES), flush=True)
    print(f"{'':10}{'overlap':>10}{'median z':>10}{'worst z':>9}")
    for name in NAMES:
        print(f"{name:10}{sum(overlaps[name]):5d} of {len(z[name])}{np.median(z[name]):10.1f}{max(z[name]):9.1f}")


def repeat(folder: Path) -> None:
    """Print the error of each pluck that its repetition predicts, next to the difference of the two."""
    for (role, quantity), key, layer in itertools.product(QUANTITIES.items(), ("A2", "A3"), ("v2", "v4")):
        files = [folder / f"guitar-{key}-{layer}-rr{n}-{role}.flac" for n in (1, 2)]
        setup = Setup(excitation="pluck", pickup_quantity=quantity)
        errors = [fit(one, setup=setup, progress=False).predict(two).error_db for one, two in (files, files[::-1])]
        analyses = [analyse(load_recording(file)) for file in files]
        levels = [dict(zip(a.partials.number.tolist(), a.partials.level, strict=True)) for a in analyses]
        top = [max(level.values()) - LEVEL_RANGE for level in levels]
        common = [k for k in levels[0] if k in levels[1] and levels[0][k] > top[0] and levels[1][k] > top[1]]
        change = np.std([levels[0][k] - levels[1][k] for k in common])
        predicted = f"predicted {errors[1]:5.2f} and {errors[0]:5.2f} dB"
        print(f"  {key} {layer} {role:11} {predicted}, repetitions {change:5.2f} dB")


def leave_out(folder: Path) -> None:
    """Print the error of each left-out pluck next to the difference of its two repetitions."""
    for key, (role, quantity) in itertools.product(("A2", "A3"), QUANTITIES.items()):
        files = [folder / f"guitar-{key}-{v}-rr{n}-{role}.flac" for v in ("v2", "v4") for n in (1, 2)]
        setup = Setup(excitation="pluck", pickup_quantity=quantity)
        found = cross_validate(*files, setup=setup, progress=False)
        for row in sorted(found.recordings, key=lambda row: row.file):
            print(
                f"  {Path(row.file).name:36} predicted {row.predicted_db:5.2f} dB, nearest recording "
                f"{row.nearest_db:5.2f} dB, x0 {row.stroke_value:.4f} m, predicted {row.predicted_stroke_value:.4f} m",
                flush=True,
            )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, default=Path(__file__).parents[2] / "shared" / "guitar")
    options = parser.parse_args()
    enable_program_cache()
    compare(options.folder)
    repeat(options.folder)
    leave_out(options.folder)


if __name__ == "__main__":
    main()
