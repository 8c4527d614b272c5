"""Whether strokes of one key differ in pitch by tension, decided by the frequencies of real keys.

    python benchmarks/tension_study.py [--keys cp80-Ds1,headroom-A0-close]

A tension moves partial k by the share 1/(1 + B k²) of the cents of f0, because the stiffness does not change. Another
speed of playback would move all partials alike. Every key of `crossval.py` and of ../shared/pianos is analysed. A row
has the layer that differs most from the faintest one: the median of its cents over shared partials of low (share above
0.95), middle and high number (share below 0.7), and the robust scatter of all about one shift and about one tension.
"""

from __future__ import annotations

import argparse
import os

import numpy as np
from crossval import FOLDERS, folders, notes

PIANOS = "../shared/pianos"
# Shares of the tension between low, middle and high partials.
BOUNDS = (0.7, 0.95)
# Standard deviation of a normal distribution over its median absolute deviation.
NORMAL = 1.4826
# Fewest shared partials of two layers.
FEWEST = 8


def compare(one, other) -> dict | None:
    """Differences of frequency between two analyses, cents; None with too few shared partials."""
    from pianofit.analysis import tension_share
    from pianofit.conversions import CENTS

    number, i, j = np.intersect1d(one.partials.number, other.partials.number, return_indices=True)
    if len(number) < FEWEST:
        return None
    cents = CENTS * np.log(other.partials.frequency[j] / one.partials.frequency[i])
    share = tension_share(one.B, number)
    groups = np.digitize(share, BOUNDS)
    tension = np.quantile(cents / share, 0.5, weights=share, method="inverted_cdf")
    scatter = [NORMAL * np.median(np.abs(cents - shift)) for shift in (np.median(cents), tension * share)]
    medians = [np.median(cents[groups == g]) if np.any(groups == g) else np.nan for g in (2, 1, 0)]
    return {"partials": len(number), "tension": tension, "medians": medians, "scatter": scatter}


def main() -> None:
    """Print the table."""
    from pianofit.analysis import analyse
    from pianofit.recording.recording import load_recording

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keys", help="only these keys, separated by commas")
    options = parser.parse_args()
    os.environ.setdefault("PIANOFIT_RECORDINGS", f"{FOLDERS}:{PIANOS}")
    wanted, rows = options.keys and options.keys.split(","), []
    print(f"{'':20}{'partials':>9}{'f0':>8}{'low':>8}{'middle':>8}{'high':>8}{'one shift':>11}{'tension':>9}   cents")
    for folder in folders():
        for key, (note, files, _) in notes(folder).items():
            if wanted and key not in wanted:
                continue
            faintest, *others = sorted(
                (analyse(load_recording(file), note=note) for file in files), key=lambda a: a.partials.level.max()
            )
            found = [row for other in others if (row := compare(faintest, other))]
            if found:
                row = max(found, key=lambda row: abs(row["tension"]))
                rows.append(row["scatter"])
                cells = "".join(f"{x:8.2f}" for x in (row["tension"], *row["medians"]))
                print(f"{key:20}{row['partials']:9d}{cells}{rows[-1][0]:11.3f}{rows[-1][1]:9.3f}", flush=True)
    one, tension = np.array(rows).T
    print(f"{'median':20}{'':41}{np.median(one):11.3f}{np.median(tension):9.3f}")
    print(f"a tension scatters less in {np.sum(tension < one)} of {len(rows)} keys")


if __name__ == "__main__":
    main()
