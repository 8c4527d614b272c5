"""Do the layers of a key share one output path? The two channels of stereo recordings, compared from layer to layer.

    python benchmarks/balance_study.py ../shared/pianos ../shared/recordings
    python benchmarks/balance_study.py --keys splendid-A1,splendid-E4 ../shared/pianos

One stroke moves one string, so both channels show the same change of a partial's level from one layer to another,
whatever the hammer did. If the change differs between the channels, the two layers did not reach at least one channel
through the same microphone, room and processing. Beats, another fader setting and the hammer cannot cause this.

Each channel is analysed by itself. The table has, for neighbouring layers, the rms over partials of the difference
between the two changes, its median removed, dB. The roughness of a change in each channel is the rms of its second
differences over partial number, divided by √6: white scatter of 1 dB has a roughness of 1. A hammer changes
neighbouring partials alike, so the rougher channel is the one whose path changed. Partials count with an SNR of at
least 40 dB in all four tables, and within 40 dB of the loudest, so noise is not a cause.
"""

from __future__ import annotations

import argparse
import csv
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import soundfile

from pianofit import analyse, recording_from_samples
from pianofit.analysis import Partials

LEAST_SNR, REACH = 40.0, 40.0  # dB
FEWEST = 5  # partials
# From soft to loud, as libraries name their layers.
DYNAMICS = ("PP", "MP", "MF", "F", "FF")


class Comparison(NamedTuple):
    """Two layers of a key."""

    partials: int
    balance: float  # dB rms, change of the level difference between the channels
    roughness: tuple[float, float]  # dB, of each channel


def layers(folder: Path) -> dict[str, tuple[str, list[Path]]]:
    """Notes and files of the keys of a folder, by instrument, key and microphone; from soft to loud."""
    with (folder / "recordings.csv").open(newline="", encoding="utf-8") as lines:
        rows = [row for row in csv.DictReader(lines) if "release" not in row["file"]]
    keys: dict[str, tuple[str, list[Path]]] = {}
    for row in rows:
        instrument, note, _, *microphone = Path(row["file"]).stem.split("-")
        keys.setdefault("-".join([instrument, note, *microphone]), (row["note"], []))[1].append(folder / row["file"])
    return {key: (note, sorted(files, key=_dynamic)) for key, (note, files) in keys.items()}


def _dynamic(file: Path) -> tuple[int, str]:
    name = file.stem.split("-")[2]
    return (DYNAMICS.index(name) if name in DYNAMICS else 0, name)


def channels(file: Path, note: str) -> tuple[Partials, Partials] | None:
    """Partials of both channels; None if the recording has one channel, or two equal ones."""
    sound, rate = soundfile.read(file, always_2d=True)
    if sound.shape[1] < 2 or np.allclose(sound[:, 0], sound[:, 1]):
        return None
    left, right = (analyse(recording_from_samples(x, rate, name=file.name), note=note).partials for x in sound.T[:2])
    return left, right


def compare(soft: tuple[Partials, Partials], loud: tuple[Partials, Partials]) -> Comparison | None:
    """Compare two layers; None if they share too few clear partials."""
    clear = [t.number[(t.snr > LEAST_SNR) & (t.level > t.level.max() - REACH)] for t in (*soft, *loud)]
    number = np.array(sorted(set.intersection(*(set(x.tolist()) for x in clear))))
    if len(number) < FEWEST:
        return None
    change = [
        a.level[np.searchsorted(a.number, number)] - b.level[np.searchsorted(b.number, number)]
        for a, b in zip(soft, loud, strict=True)
    ]
    difference = change[0] - change[1]
    left, right = (float(np.sqrt(np.mean(np.diff(x, 2) ** 2) / 6)) for x in change)
    balance = float(np.sqrt(np.mean((difference - np.median(difference)) ** 2)))
    return Comparison(len(number), balance, (left, right))


def main() -> None:
    """Print a line for every two neighbouring layers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--keys", default="", help="only keys that contain one of these, separated by commas")
    options = parser.parse_args()
    wanted = options.keys.split(",")
    print("key                  layers          partials  balance, dB  roughness left, right, dB")
    for folder in options.folders:
        for key, (note, files) in layers(folder).items():
            if not any(name in key for name in wanted):
                continue
            tables = [channels(file, note) for file in files]
            for (soft, first), (loud, second) in pairwise(zip(files, tables, strict=True)):
                found = compare(first, second) if first and second else None
                names = f"{soft.stem.split('-')[2]} to {loud.stem.split('-')[2]}"
                if found:
                    print(
                        f"{key:20} {names:15} {found.partials:8d}  {found.balance:11.1f}  "
                        f"{found.roughness[0]:15.1f} {found.roughness[1]:6.1f}",
                        flush=True,
                    )


if __name__ == "__main__":
    main()
