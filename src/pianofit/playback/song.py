"""A song on an instrument: every key by itself, from event to event, summed; then what a file can hold.

Strings do not hear one another: a raised pedal lets ring what was struck, and sets nothing else ringing. A damper falls
with the key, or with the pedal, and not during a contact; a key struck again within a contact waits for its end.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from ..errors import ParameterError, check_range
from ..instrument.document import Instrument
from ..io.audio import RATES
from ..io.files import PEAK_LIMIT
from ..model.note import MOST_SAMPLES
from ..threads import one_blas_thread
from .midi import Song
from .voice import StringVoice

__all__ = ["MOST_LIMITED_DB", "Performance", "limit", "render_song"]

# What is still held after the song's last event rings for this long, s, then its dampers fall; later all is over.
LAST_HELD, LAST_RING, LAST_FADE = 3.0, 5.0, 0.5
# The part of a too loud passage that the limiter takes; what is more is taken from the whole song.
MOST_LIMITED_DB = 3.0
# Samples of a string that rings by itself, at once.
PIECE = 2**16
# The limiter looks this far ahead and behind, s.
LOOK = 0.02


class Performance(NamedTuple):
    """What was played."""

    samples: np.ndarray  # within ± `CEILING` [channels, samples]
    gain_db: float  # given to the whole song, never above 0
    limited_db: float  # the most that the limiter took anywhere, beside that
    strikes: int
    restrikes: int  # of them on a string that still sounded


class _Event(NamedTuple):
    sample: int
    velocity: int  # of a stroke; 0 for a damper that moves
    damped: bool


@one_blas_thread()
def render_song(
    instrument: Instrument, song: Song, rate: int = 48_000,
    progress: Callable[[str, float], None] = lambda *_: None,
) -> Performance:  # fmt: skip
    """Play a song.

    A knock may begin before its stroke: the song begins so much after the first sample as the instrument needs.

    Raises `ParameterError` for a rate out of range, a song too long for it, or a key the instrument does not have.
    """
    check_range("rate=", rate, *RATES, " Hz")
    lead = round(instrument.lead * rate)
    size = int((song.seconds + LAST_RING) * rate) + lead
    if size > MOST_SAMPLES:
        raise ParameterError(
            f"{song.seconds:.0f} s at rate={rate} Hz is too long; cut the song to "
            f"{MOST_SAMPLES / rate - LAST_RING:.0f} s, or ask for a lower --rate"
        )
    for key in song.keys:
        instrument.note(key, 64)  # refused before anything is computed
    total, strikes, moving, last = np.zeros((instrument.channels, size)), 0, 0, 0
    for key in sorted(song.keys):
        string = StringVoice(instrument.note(key, 64), key, rate)
        for at, sound, met_moving in _phrases(string, instrument, _events(song, key, rate), size):
            begin = at + lead - string.lead
            sound = string.heard(sound)[:, : size - begin]
            end = begin + sound.shape[-1]
            total[:, begin:end] += sound  # one channel is heard in all
            last = max(last, end)
            strikes += len(met_moving)
            moving += sum(met_moving)
            progress("playing", 0.98 * strikes / song.notes)
    fade = round(LAST_FADE * rate)  # the treble has no dampers
    total[:, -fade:] *= 0.5 * (1 + np.cos(np.pi * np.arange(1, fade + 1) / fade))
    samples, gain_db, limited_db = limit(total[:, :last], rate)
    return Performance(samples, gain_db, limited_db, strikes, moving)


def _events(song: Song, key: int, rate: int) -> list[_Event]:
    """Strokes of a key and movements of its damper, in time."""
    merged = sorted(
        [(t, 1, v, False) for t, v in song.keys[key]] + [(t, 0, 0, down) for t, down in song.pedal],
        key=lambda event: event[:2],
    )
    events: list[_Event] = []
    held = pedal = damped = False
    merged += [(song.seconds + LAST_HELD, 0, 0, False), (song.seconds + LAST_HELD, 1, 0, False)]
    for t, finger, velocity, down in merged:
        held, pedal = (velocity > 0, pedal) if finger else (held, down)
        now = not (held or pedal)
        if velocity > 0 or now != damped:
            events.append(_Event(round(t * rate), velocity, now))
        damped = now
    return events


def _phrases(
    string: StringVoice, instrument: Instrument, events: list[_Event], size: int
) -> Iterator[tuple[int, np.ndarray, list[bool]]]:
    """(First sample, sound, of each stroke whether it met a moving string), from silence to silence, until `size`.

    In one piece: a path rings on after every piece that goes through it, which is most of the work.
    """
    at, begin, sounds, moving = 0, 0, [], []
    for event in [*events, _Event(size, velocity=0, damped=False)]:
        end = min(event.sample, size)
        while at < end and string.is_audible:
            sounds.append(string.ring(min(PIECE, end - at)))
            at += sounds[-1].shape[-1]
        if sounds and (at < end or at >= size):
            yield begin, np.concatenate(sounds, axis=-1), moving
            sounds, moving = [], []
        at = max(at, end)
        if at >= size:
            return
        string.damped = event.damped
        if event.velocity:
            begin = begin if sounds else at
            moving.append(string.in_motion)
            sounds.append(string.strike(instrument.note(string.midi, event.velocity).hammer.v_H0)[:, : size - at])
            at += sounds[-1].shape[-1]


def limit(samples: np.ndarray, rate: int) -> tuple[np.ndarray, float, float]:
    """Sound [channels, samples] within ± `CEILING`; the gain given to all of it, dB, and the most limited, dB.

    A sound that is too loud by more than `MOST_LIMITED_DB` is first turned down as a whole. What peaks are left are
    taken by a gain that looks ahead: the smallest gain any sample within `LOOK` needs, averaged twice over half of
    that; an average holds only gains that the sample itself may have, so nothing can pass. All channels have one gain.
    The same in, the same out.
    """
    from scipy.ndimage import minimum_filter1d, uniform_filter1d

    peak = float(np.abs(samples).max(initial=0.0))
    allowed = PEAK_LIMIT * 10 ** (MOST_LIMITED_DB / 20)
    gain = min(1.0, allowed / peak) if peak > 0 else 1.0
    samples = gain * samples
    if peak * gain <= PEAK_LIMIT:
        return samples, 0.0, 0.0
    needed = np.minimum(1.0, PEAK_LIMIT / np.maximum(np.abs(samples).max(axis=0), 1e-30))
    half = max(int(LOOK * rate / 2), 1)
    smooth = minimum_filter1d(needed, 4 * half + 1, mode="nearest")
    for _ in range(2):
        smooth = uniform_filter1d(smooth, 2 * half + 1, mode="nearest")
    # Averages may round up by an ulp or so.
    smooth = np.minimum(smooth, needed)
    return np.clip(samples * smooth, -PEAK_LIMIT, PEAK_LIMIT), 20 * np.log10(gain), -20 * float(np.log10(smooth.min()))
