"""A piece on an instrument: how fast `pianofit play` computes it, and how near the page's engine comes to it.

    python benchmarks/song.py [INSTRUMENT.JSON]                two minutes, ten notes a second
    python benchmarks/song.py [INSTRUMENT.JSON] --page         and the page's engine, under node
    python benchmarks/song.py --page --controllers             with all three pedals in continuous motion

Without an instrument it is that of `synthetic_piano.py`, whose 88 keys have some hundred modes and a knock in stereo.
The piece is drawn by --seed: notes over seven octaves at all velocities, held for 0.1 to 2 s, with a pedal that is
raised half of the time, so that strings are struck again while they sound. Its events lie on the blocks of 128 samples
at whose begins the page's take effect. Its first note begins at 0, where both engines begin their steps of resonance.
Printed are the song's length over the processor's time, and with --page the largest difference of any sample before
the limiter, over the largest sample, with knocks as they are (16 bits) and as the page of this instrument holds them.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from synthetic_piano import piano

from pianofit.analysis.note_names import parse_keys
from pianofit.instrument import Instrument, load_instrument
from pianofit.playback import Song, render_song
from pianofit.program_folder import enable_program_cache

RATE, BLOCK = 48_000, 128
LOWEST, HIGHEST = 24, 108  # keys
SOFTEST, LOUDEST = 20, 120  # MIDI velocities
SHORTEST, LONGEST = 0.1, 2.0  # of notes, s
# Of a key, s: a stroke within the last one's contact would wait, here for its end and there for the block after it.
APART = 0.1
PEDAL = 2.0  # between its movements, s
# Between movements of a controller with --controllers, s.
MOTION = 0.05
# So quiet that nothing is limited.
QUIET = 0.1


def drawn(seconds: float, rate: float, keys: list[int], seed: int, controllers: bool = False) -> Song:
    """A piece of so many notes a second. `controllers`: all pedals move continuously."""
    random = np.random.default_rng(seed)

    def on_block(t: float) -> float:
        return round(t * RATE / BLOCK) * BLOCK / RATE

    notes: dict[int, list[tuple[float, float, int]]] = {}
    times = np.sort(random.uniform(0, seconds - LONGEST, round(seconds * rate)))
    for t in times - times[0]:
        key, velocity = int(random.choice(keys)), int(random.integers(SOFTEST, LOUDEST))
        begin, end = on_block(t), on_block(t + random.uniform(SHORTEST, LONGEST))
        before = notes.setdefault(key, [])
        if before and before[-1][0] + APART > begin:
            continue
        if before and before[-1][1] > begin - APART / 2:  # the finger leaves the key before it strikes again
            first, _, force = before[-1]
            before[-1] = first, on_block(begin - APART / 2), force
        before.append((begin, end, velocity))
    events = {k: [e for a, b, v in each for e in ((a, v), (b, 0))] for k, each in notes.items()}
    pedal = [(on_block(t), 127 * (i % 2 == 0)) for i, t in enumerate(np.arange(0.0, seconds, PEDAL))]
    song = Song(events, pedal, seconds, sum(map(len, notes.values())))
    if not controllers:
        return song
    from page_cases import CONTROLLERS, walk

    return song._replace(
        **{name: walk(seed + i, MOTION * (i + 1), seconds) for i, name in enumerate(CONTROLLERS.values())}
    )


def by_page(instrument: Instrument, song: Song, whole: bool, most: int) -> np.ndarray:
    """What the page's engine makes of it [2, samples], with knocks as they are or as the page holds them."""
    from page_cases import early, page_job, play

    from pianofit.web.write import PAGE_BYTES, SCRIPT_BYTES

    room = 10**9 if whole else PAGE_BYTES - SCRIPT_BYTES
    (sound,) = play([page_job(instrument, song, True, room, **({"most": most} if most else {}))])
    return sound[:, max(early(key.note) for key in instrument.keys.values()) :]


def main() -> None:
    """Print a line each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("instrument", type=Path, nargs="?")
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--notes", type=float, default=10.0, help="a second")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--page", action="store_true", help="compare with the page's engine")
    parser.add_argument("--controllers", action="store_true", help="all pedals move continuously")
    parser.add_argument("--most", type=int, default=0, help="free modes of the page, if not its own number")
    asked = parser.parse_args()
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    enable_program_cache()
    given = load_instrument(asked.instrument) if asked.instrument else piano(parse_keys("A0-C8"))
    notes = {midi: key.note._replace(gain=QUIET * key.note.gain) for midi, key in given.keys.items()}
    quiet = replace(given, keys={midi: replace(key, note=notes[midi]) for midi, key in given.keys.items()})
    keys = [k for k in given.keys if LOWEST <= k < HIGHEST]
    song = drawn(asked.seconds, asked.notes, keys, asked.seed, asked.controllers)
    render_song(quiet, song, RATE)  # compiles what an earlier run has not
    begin = time.process_time()
    played = render_song(quiet, song, RATE)
    took = time.process_time() - begin
    print(
        f"{song.seconds:.0f} s, {song.notes} notes, {played.restrikes} of them on a string that sounds, "
        f"{len(played.samples)} channels: {song.seconds / took:.1f} times faster than real time"
    )
    for whole in (True, False) if asked.page else ():
        sound = by_page(quiet, song, whole, asked.most)
        size = min(sound.shape[-1], played.samples.shape[-1])
        away = np.abs(sound[:, :size] - played.samples[:, :size]).max() / np.abs(played.samples).max()
        print(f"the page, knocks {'as they are' if whole else 'as it holds them'}: {20 * np.log10(away):.1f} dB")


if __name__ == "__main__":
    main()
