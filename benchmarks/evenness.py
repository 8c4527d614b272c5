"""How even a chromatic scale over the 88 keys of an instrument is.

    python benchmarks/evenness.py FITS|INSTRUMENT.JSON [--prefix headroom] [--keys A0,D#1,F#1,C4,A6]
        [--even 0...1] [--plot FILE.png]

Every key is struck at one MIDI velocity. Three quantities of its sound are compared between neighbouring keys:

    loudness   K-weighted level of the first second, dB
    decay      slope of the K-weighted level from 0.05 s to 0.65 s after the contact, or until it has fallen by 40 dB,
               dB/s
    low        energy below 0.8 f0 over the whole energy of the first second, dB

The table has rms and worst steps between two guessed keys, and from a guessed to a recorded key.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

RATE = 44_100
DECAY = (0.05, 0.6)  # s
FRAME = 0.05  # s
FALL = 40.0  # dB
LOW = 0.8
QUANTITIES = (("loudness", "dB"), ("decay", "dB/s"), ("low", "dB"))


def quantities(note, velocity: float) -> tuple[float, float, float]:
    """Loudness, decay and low energy of a stroke."""
    from pianofit.dsp.loudness import k_weighted_mean_square

    sound = note.render(velocity, seconds=1.0, rate=RATE, mono=False)
    level = 10 * np.log10(k_weighted_mean_square(sound, RATE))
    time = np.arange(DECAY[0], DECAY[1] + FRAME / 2, FRAME)
    begin = [round((note.pre_onset_s + t) * RATE) for t in time]
    curve = np.array([k_weighted_mean_square(sound[:, i : i + round(FRAME * RATE)], RATE) for i in begin])
    curve = 10 * np.log10(np.maximum(curve, 1e-30))
    used = curve > curve[0] - FALL
    used[:2] = True
    slope = -float(np.polyfit(time[used], curve[used], 1)[0])
    fade = np.hanning(sound.shape[-1])  # its second half: a whole window would leave out the attack
    fade[: len(fade) // 2] = 1.0
    power = (np.abs(np.fft.rfft(sound * fade)) ** 2).sum(axis=0)
    below = np.fft.rfftfreq(sound.shape[-1], 1 / RATE) < LOW * note.f0
    return level, slope, 10 * np.log10(power[below].sum() / power.sum())


def steps(values: np.ndarray, recorded: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Steps between two guessed keys, and between a guessed and a recorded one."""
    step, kinds = np.abs(np.diff(values)), recorded[1:].astype(int) + recorded[:-1]
    return step[kinds == 0], step[kinds == 1]


def main() -> None:
    """Print the table."""
    from pianofit.analysis.note_names import note_to_midi
    from pianofit.instrument import build_instrument, find_fits, load_instrument, load_keys

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("instrument", type=Path)
    parser.add_argument("--prefix")
    parser.add_argument("--keys", help="only the fits of these keys, separated by commas")
    parser.add_argument("--even", type=float, default=0.0, help="how far recorded keys move towards the laws")
    parser.add_argument("--velocity", type=int, default=100, help="MIDI velocity")
    parser.add_argument("--plot", type=Path)
    options = parser.parse_args()
    if options.keys:
        wanted = {note_to_midi(name) for name in options.keys.split(",")}
        keys = load_keys(find_fits([options.instrument], options.prefix))
        piano = build_instrument([key for key in keys if key.midi in wanted], even=options.even)
    else:
        piano = load_instrument(options.instrument, options.prefix, options.even)
    velocity = piano.velocity.at(options.velocity)
    midi = np.array(sorted(piano.keys))
    values = np.array([quantities(piano.keys[m].note, velocity) for m in midi])
    recorded = np.isin(midi, piano.recorded)
    print(f"{'':10}{'guessed to guessed':>24}{'guessed to recorded':>24}   rms and worst step")
    for i, (name, unit) in enumerate(QUANTITIES):
        cells = [
            f"{np.sqrt(np.mean(step**2)):.2f} {step.max():.2f}" if len(step) else "-"
            for step in steps(values[:, i], recorded)
        ]
        print(f"{name:10}" + "".join(f"{cell:>24}" for cell in cells) + f"   {unit}")
    if options.plot:
        plot(options.plot, midi, values, recorded)


def plot(path: Path, midi: np.ndarray, values: np.ndarray, recorded: np.ndarray) -> None:
    """Draw the three quantities over the keys."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(len(QUANTITIES), 1, figsize=(9, 8), sharex=True)
    for i, (axis, (name, unit)) in enumerate(zip(axes, QUANTITIES, strict=True)):
        axis.plot(midi, values[:, i], ".-", lw=0.8)
        axis.plot(midi[recorded], values[recorded, i], "o", label="recorded")
        axis.set_ylabel(f"{name}, {unit}")
    axes[0].legend()
    axes[-1].set_xlabel("key, MIDI")
    figure.savefig(path, dpi=100)


if __name__ == "__main__":
    main()
