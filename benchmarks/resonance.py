"""How an instrument rings under the pedal: decay of struck notes, and sound between their partials.

    python benchmarks/resonance.py INSTRUMENT.JSON

Each key is struck once at MIDI velocity 64 and held for 4 s, with the right pedal up and down. "decay" is the rate of
the energy of the lowest eight partials, in bands of ± 3 % about them, from 0.2 s to 2.2 s. "between" is the energy
outside these bands and below 5 kHz from 0.5 s to 1.5 s, relative to the energy in the bands from 0 to 0.5 s. The table
has each with the pedal up and down. Then the speed of a dense piece: twenty notes a second for 20 s under a moving
pedal. `--noise` instead plays 250 and 1,000 bars of 0.5 s, at 16 kHz, under random values of all three pedals a hundred
times a second, and prints speed and memory.

Lehtonen, Penttinen, Rauhala and Välimäki (J. Acoust. Soc. Am. 122, 1787, 2007) found with the pedal down longer decays
in the middle of the keyboard, not in bass and treble, and more sound between the partials.
"""

from __future__ import annotations

import argparse
import resource
import time

import numpy as np

from pianofit import PlayOptions, Song, load_instrument, render_song
from pianofit.instrument import Instrument

RATE = 48_000
KEYS = (24, 33, 43, 55, 62, 69, 79, 88)  # those of the source, C1 to A4, and two in the treble
BAND = 0.03  # half-width of a band, relative
PARTIALS = 8
HIGHEST = 5000.0  # Hz
SONG_SECONDS, NOTES_A_SECOND = 20, 20
BAR = 0.5  # s


def strike(instrument: Instrument, key: int, pedal: int, resonance: float) -> np.ndarray:
    """One stroke under a pedal, mean of the channels [samples]."""
    song = Song({key: [(0.5, 64), (4.5, 0)]}, [(0.0, pedal)], 4.5, 1)
    samples = render_song(instrument, song, RATE, options=PlayOptions(resonance=resonance)).samples.mean(axis=0)
    return np.pad(samples, (0, 6 * RATE))[round((0.5 + instrument.pre_onset_s) * RATE) :][: 4 * RATE]


def powers(samples: np.ndarray, f0: float, partials: np.ndarray, start: float, stop: float) -> tuple[float, float]:
    """Energy in the bands and between them, of a span, s."""
    part = samples[round(start * RATE) : round(stop * RATE)]
    power = np.abs(np.fft.rfft(part * np.hanning(len(part)))) ** 2 / len(part) ** 2
    hz = np.fft.rfftfreq(len(part), 1 / RATE)
    ratio = np.abs(hz[:, None] / partials - 1).min(axis=1)
    low = (hz < min(HIGHEST, partials[-1] + f0 / 2)) & (hz > 20)
    return float(power[low & (ratio < BAND)].sum()), float(power[low & (ratio >= BAND)].sum())


def row(instrument: Instrument, key: int, resonance: float) -> str:
    """Decay and sound between partials with the pedal up and down."""
    note, cells = instrument.note(key, 64), []
    partials = note.frequencies(PARTIALS)
    for pedal in (0, 127):
        sound = strike(instrument, key, pedal, resonance)
        spans = [powers(sound, float(note.f0), partials, t, t + 0.5)[0] for t in (0.2, 1.7)]
        between = (
            powers(sound, float(note.f0), partials, 0.5, 1.5)[1] / powers(sound, float(note.f0), partials, 0.0, 0.5)[0]
        )
        cells.append((10 * np.log10(spans[0] / spans[1]) / 1.5, 10 * np.log10(between)))
    (up, up_between), (down, down_between) = cells
    return f"{key:>4}{up:>9.1f}{down:>7.1f}{down / up:>7.2f}{up_between:>12.1f}{down_between:>7.1f}"


def dense_song() -> Song:
    """Twenty notes a second over the keyboard; the pedal is changed every second."""
    random, keys = np.random.default_rng(0), {}
    count = SONG_SECONDS * NOTES_A_SECOND
    for i in range(count):
        key, at = int(random.integers(30, 90)), i / NOTES_A_SECOND
        keys.setdefault(key, []).extend([(at, int(random.integers(30, 110))), (at + 0.15, 0)])
    pedal = [move for t in range(SONG_SECONDS) for move in ((t + 0.05, 127), (t + 0.95, 0))]
    return Song({key: sorted(events) for key, events in keys.items()}, pedal, SONG_SECONDS, count)


def controller_noise(instrument: Instrument, bars: int) -> str:
    """Play random controllers; speed, level at the end, and growth of the largest memory."""
    random, seconds = np.random.default_rng(0), BAR * bars
    moves = [[(0.01 * i, int(x)) for i, x in enumerate(random.integers(0, 128, 100 * int(seconds)))] for _ in range(3)]
    keys: dict[int, list[tuple[float, int]]] = {}
    for bar in range(bars):
        keys.setdefault(int(random.integers(30, 90)), []).extend([(BAR * bar, 80), (BAR * bar + 0.3, 0)])
    song = Song(keys, moves[0], seconds, bars, sostenuto=moves[1], una_corda=moves[2])
    before, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.perf_counter()
    sound = render_song(instrument, song, 16_000).samples
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    took = time.perf_counter() - start
    level = 20 * np.log10(np.abs(sound[:, -8000:]).max() + 1e-12)
    return (
        f"{bars} bars of controller noise: {seconds / took:.1f} x real time, {grown:.0f} MB more, "
        f"sound {sound.nbytes / 2**20:.0f} MB, last half second {level:.0f} dB"
    )


def main() -> None:
    """Print the table and the speed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("instrument")
    parser.add_argument("--noise", action="store_true")
    parser.add_argument("--resonance", type=float, default=PlayOptions().resonance)
    options = parser.parse_args()
    instrument = load_instrument(options.instrument)
    if options.noise:
        for bars in (250, 1000):
            print(controller_noise(instrument, bars), flush=True)
        return
    print(f"{'':4}{'decay, dB/s':>16}{'ratio':>7}{'between, dB':>19}")
    print(f"{'key':>4}{'up':>9}{'down':>7}{'':7}{'up':>12}{'down':>7}")
    for key in KEYS:
        print(row(instrument, key, options.resonance), flush=True)
    song = dense_song()
    for play in (PlayOptions(resonance=0.0), PlayOptions()):
        render_song(instrument, song, RATE, options=play)
        start, cpu = time.perf_counter(), time.process_time()
        sound = render_song(instrument, song, RATE, options=play).samples
        seconds = sound.shape[-1] / RATE
        wall, cpu = time.perf_counter() - start, time.process_time() - cpu
        speeds = f"{seconds / wall:.1f} x real time, {seconds / cpu:.1f} x by CPU"
        print(f"dense song, resonance {play.resonance:g}: {speeds}")


if __name__ == "__main__":
    main()
