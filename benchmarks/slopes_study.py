"""Compare the decays that `analyse` reports with slopes of the band-filtered envelope, for all partials of recordings.

    python benchmarks/slopes_study.py ../shared/recordings ../shared/pianos ../shared/keyboard

A folder has a `recordings.csv` with the columns `file` and `note`, as those of the tests do. Recordings of key releases
are left out. Each file is read anew. A partial is filtered by a Butterworth band of order 4, 0.35 f0 (at most 35 Hz) to
either side, run forwards and backwards, and its envelope is the modulus of the analytic signal. The measured slope is
that of the least-squares line through the envelope in dB, over the times that the analysis reports for the early and
the late part. It shares no code with the analysis.

The envelope is clear if it lies 20 dB above the noise at the end of the line, falls by 3 dB or more, and stays within
1.5 dB rms of the line. The noise is the median power of the recording's last 0.2 s in bands halfway between partials.
The table has the ratio of the reported to the measured rate: median, and the share within a factor of 1.25.

With `--fixed` the times are 0.05 s to the first time that the measured envelope, averaged over 0.1 s, has fallen by
10 dB (at most 2 s), and only the early rates are compared: that also works for an analysis that reports no times. The
envelope is then clear only if it does not rise again to within 10 dB, as one does that beats.
"""

from __future__ import annotations

import argparse
import csv
import sys
from pathlib import Path

import numpy as np
import soundfile
from scipy.signal import butter, hilbert, sosfiltfilt

from pianofit import PianofitError, analyse

WIDEST = 35.0  # Hz, half the width of a band: more than any beat
HALF_WIDTH = 0.35  # of f0
CLEAR_NOISE, CLEAR_FALL, CLEAR_RMS = 20.0, 3.0, 1.5  # dB
RANGE, LONGEST = 10.0, 2.0  # dB and s of `--fixed`
WITHIN = 1.25
NEPER = 20 / np.log(10)  # dB


def recordings(folder: Path) -> list[tuple[Path, str]]:
    """Files of notes in a folder, and their notes."""
    with (folder / "recordings.csv").open(newline="", encoding="utf-8") as lines:
        rows = list(csv.DictReader(lines))
    return [(folder / row["file"], row["note"]) for row in rows if "release" not in row["file"]]


def envelope(samples: np.ndarray, rate: int, frequency: float, half: float) -> np.ndarray:
    """Envelope of a band, dB [samples]."""
    band = butter(4, [max(frequency - half, 1.0), frequency + half], "bandpass", fs=rate, output="sos")
    return 20 * np.log10(np.abs(np.asarray(hilbert(sosfiltfilt(band, samples)))) + 1e-15)


def measured(level: np.ndarray, rate: int, start: float, stop: float, noise: float) -> tuple[float, bool]:
    """Decay rate of the line through an envelope within `start`..`stop` s, 1/s, and whether the envelope is clear."""
    part = level[round(start * rate) : round(stop * rate) + 1]
    if len(part) < 3:
        return np.nan, False
    time = np.arange(len(part)) / rate
    slope, first = np.polyfit(time, part, 1)
    rms = np.sqrt(np.mean((part - first - slope * time) ** 2))
    fall = -slope * time[-1]
    clear = first - fall > noise + CLEAR_NOISE and fall > CLEAR_FALL and rms < CLEAR_RMS
    return -slope / NEPER, bool(clear)


def early_end(level: np.ndarray, rate: int) -> tuple[float, bool]:
    """First time at which the averaged envelope has fallen by `RANGE`, s, and whether it stays below."""
    size = round(0.1 * rate)
    total = np.cumsum(np.insert(10 ** (level[: round((LONGEST + 0.1) * rate)] / 10), 0, 0.0))
    power = 10 * np.log10((total[size:] - total[:-size]) / size)
    below = np.flatnonzero(power < power[0] - RANGE)
    end = below[0] if len(below) else len(power)
    return end / rate, bool(np.all(power[end:] < power[0] - RANGE))


def compare(file: Path, note: str, fixed: bool) -> list[tuple[str, int, float, float, bool]]:
    """Part, partial, reported rate, measured rate and clearness, for all partials and parts of a recording."""
    found = analyse(file, note=note)
    sound, rate = soundfile.read(file, always_2d=True)
    samples = sound.mean(axis=1)
    onset, table = _onset(file), found.partials
    half = min(HALF_WIDTH * found.f0, WIDEST)
    rows = []
    for i, (number, frequency) in enumerate(zip(table.number, table.frequency, strict=True)):
        if frequency + half > 0.49 * rate:
            continue
        level = envelope(samples, rate, frequency, half)[onset:]
        between = envelope(samples, rate, frequency + found.f0 / 2, half)[-rate // 5 :]
        noise = float(np.median(between))
        stays = True
        if fixed:
            fallen, stays = early_end(level, rate)
            parts = [("early", table.decay[i], 0.05, fallen)]
        else:
            start, bend, stop = table.slope_times[i]
            parts = [("early", table.decay[i], start, bend), ("late", table.late_decay[i], bend, stop)]
        for name, reported, begin, end in parts:
            if np.isfinite([reported, begin, end]).all():
                slope, clear = measured(level, rate, begin, end, noise)
                rows.append((name, int(number), float(reported), slope, clear and stays))
    return rows


def _onset(file: Path) -> int:
    """Sample of the onset of a recording."""
    from pianofit.recording.recording import load_recording

    return load_recording(file).onset


def summary(rows: list[tuple[str, int, float, float, bool]], part: str) -> str:
    """One line of the table."""
    of_part = [row for row in rows if row[0] == part]
    ratio = np.array([reported / rate for _, _, reported, rate, clear in of_part if clear])
    if not len(ratio):
        return f"{part:6} no clear envelope among {len(of_part)}"
    within = np.mean((ratio > 1 / WITHIN) & (ratio < WITHIN))
    low, high = np.quantile(ratio, [0.05, 0.95])
    return (
        f"{part:6} {len(of_part):6} lines, {len(ratio):5} clear: median ratio {np.median(ratio):.3f}, "
        f"{within:.1%} within a factor of {WITHIN}, 5 to 95 %: {low:.2f} to {high:.2f}"
    )


def main() -> None:
    """Print a line for each folder and part."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--every", type=int, default=1, help="only every Nth recording")
    parser.add_argument("--fixed", action="store_true", help="choose the times without the analysis")
    options = parser.parse_args()
    everything = []
    for folder in options.folders:
        rows = []
        for file, note in recordings(folder)[:: options.every]:
            try:
                rows += compare(file, note, options.fixed)
            except PianofitError as error:
                print(error, file=sys.stderr)
        print(f"{folder.name}:", *(summary(rows, part) for part in ("early", "late")), sep="\n  ", flush=True)
        everything += rows
    print("all:", *(summary(everything, part) for part in ("early", "late")), sep="\n  ")


if __name__ == "__main__":
    main()
