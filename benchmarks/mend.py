#!/usr/bin/env python
"""Tails of `pianofit mend` against the tails that were cut off, and fade-outs.

    python benchmarks/mend.py RECORDING... [--work DIR]

The recordings are of 5 s or more, of any number of keys, with names as for `pianofit batch`. They are cut at 2 s,
fitted as a library, and lengthened. The table has the difference of the level in blocks of 50 ms from 2 to 5 s, where
the recording is at least 6 dB above its noise. Then each whole recording is faded out over its last second, and the
time from the begin of the fade to the joint is printed. It is negative if the fade has no part in the tail.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
import soundfile

from pianofit.cli.program import main as pianofit
from pianofit.mend.tail import Continuation, continue_by_modes, lengthen, modes_of_key
from pianofit.recording.recording import load_recording
from pianofit.schema.notes import load_note

CUT, END = 2.0, 5.0  # s
BLOCK = 0.05  # s
ABOVE_NOISE_DB = 6.0
FADE = 1.0  # s


def level(sound: np.ndarray, rate: int) -> np.ndarray:
    """Level in blocks, dB re full scale."""
    block = round(BLOCK * rate)
    count = round(END * rate) // block
    long = np.pad(sound, ((0, 0), (0, max(count * block - sound.shape[1], 0))))[:, : count * block]
    return 10 * np.log10((long.reshape(len(long), count, block) ** 2).mean(axis=(0, 2)) + 1e-14)


def judge(file: Path, cut: Path, folder: Path) -> tuple[str, float, float]:
    """A line of the table, the difference, dB, and the time from the begin of a fade to its joint, s."""
    modes, onset = modes_of_key(load_note(folder)[0]), load_recording(cut).onset
    (short, rate), (whole, _) = (soundfile.read(x, always_2d=True) for x in (cut, file))
    found = continue_by_modes(short.T, rate, onset, modes)
    faded = whole.T.copy()
    faded[:, -round(FADE * rate) :] *= np.linspace(1, 0, round(FADE * rate))
    joint = continue_by_modes(faded, rate, load_recording(file).onset, modes)
    late = joint.joint / rate - (len(whole) / rate - FADE) if isinstance(joint, Continuation) else np.nan
    if isinstance(found, str):
        return f"{file.stem:24} {found}", np.nan, late
    mended = lengthen(short.T, rate, onset, END + 1, found)
    true, own = level(whole.T, rate), level(mended, rate)
    time = BLOCK * (np.arange(len(true)) + 0.5)
    audible = (time > CUT) & (true > 20 * np.log10(load_recording(file).noise_rms + 1e-9) + ABOVE_NOISE_DB)
    if not audible.any():
        return f"{file.stem:24} noise after {CUT:g} s", np.nan, late
    error = float(np.median(np.abs(own - true)[audible]))
    step = f"joint {found.joint / rate:.2f} s, step {found.step_db:+.2f} dB, slope {found.slope_db:+.2f} dB/s"
    return f"{file.stem:24} {error:5.2f} dB   {step}   fade: joint {late:+.1f} s", error, late


def main() -> None:
    """Print the table and its medians."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--work", type=Path, help="folder that keeps the cut recordings and their fits")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        work = options.work or Path(temporary)
        (work / "cut").mkdir(parents=True, exist_ok=True)
        files = [file for file in options.recordings if soundfile.info(file).duration >= END]
        for file in files:
            sound, rate = soundfile.read(file, always_2d=True)
            soundfile.write(work / "cut" / f"{file.stem}.wav", sound[: round(CUT * rate)], rate, subtype="PCM_24")
        pianofit(["batch", str(work / "cut"), "--out", str(work / "fits"), "--no-page"])
        errors, fades = [], []
        for folder in sorted((work / "fits" / "keys").iterdir()):
            for file in (file for file in files if file.stem.startswith(f"{folder.name}-")):
                line, error, late = judge(file, work / "cut" / f"{file.stem}.wav", folder)
                print(line, flush=True)
                errors.append(error)
                fades.append(late)
    known, seen = np.array(errors)[np.isfinite(errors)], np.array(fades)[np.isfinite(fades)]
    print(
        f"{len(errors)} recordings, {len(known)} lengthened: median {np.median(known):.2f} dB, worst {known.max():.1f}"
    )
    print(f"fades: joint after their begin by {np.median(seen):+.1f} s in the median, {seen.max():+.1f} s at most")


if __name__ == "__main__":
    main()
