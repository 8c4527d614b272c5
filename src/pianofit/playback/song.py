"""A song on an instrument: all keys are rendered separately, summed, and limited to the range of a file.

Strings are not coupled: a raised pedal keeps struck strings ringing and excites no others. A damper falls with the key
or with the pedal, but not during a contact. A stroke that begins during a contact waits for the end of the contact.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from ..errors import ParameterError, check_range
from ..instrument import Instrument
from ..io.audio import RATES
from ..io.files import PEAK_LIMIT
from ..model.note import MAX_SAMPLES
from ..threads import one_blas_thread
from .midi import Song
from .voice import StringVoice

# After the last event, s: dampers of keys still held fall, the sound ends, and the length of the final fade.
LAST_HELD, LAST_RING, LAST_FADE = 3.0, 5.0, 0.5
# Largest gain reduction by the limiter. Any further reduction applies to the whole song.
MOST_LIMITED_DB = 3.0
# Samples of free vibration that are computed at once.
CHUNK_SAMPLES = 2**16
# Span of the limiter before and after a sample, s.
LOOKAHEAD = 0.02


class Performance(NamedTuple):
    """The rendered sound and its levels."""

    samples: np.ndarray  # within ± `PEAK_LIMIT` [channels, samples]
    gain_db: float  # of the whole song, never above 0
    limited_db: float  # largest additional gain reduction by the limiter
    strikes: int
    restrikes: int  # strikes on a string that was still sounding


class _Event(NamedTuple):
    sample: int
    velocity: int  # of a stroke; 0 for a movement of the damper alone
    damped: bool


@one_blas_thread()
def render_song(
    instrument: Instrument, song: Song, rate: int = 48_000, progress: Callable[[str, float], None] = lambda *_: None
) -> Performance:
    """Render a song on an instrument.

    A knock may begin before its stroke, so the song begins `Instrument.pre_onset_s` after the first sample.

    Parameters
    ----------
    instrument : as `load_instrument` returns it.
    song : as `load_song` returns it.
    rate : sample rate, Hz.
    progress : called with the name of the step and the finished fraction.

    Returns
    -------
    The sound of all channels, within -1 dBFS, and its levels.

    Raises
    ------
    ParameterError
        For a rate out of range, a song that is too long, or a key that the instrument lacks.
    FitError
        If a hammer stays on its string.

    Examples
    --------
    >>> import pianofit
    >>> sound = pianofit.render_song(pianofit.load_instrument("batch", prefix="cp80"), pianofit.load_song("melody.mid"))
    >>> len(sound.samples), sound.strikes
    (1, 4)
    """
    check_range("rate=", rate, *RATES, " Hz")
    lead = round(instrument.pre_onset_s * rate)
    size = int((song.seconds + LAST_RING) * rate) + lead
    if size > MAX_SAMPLES:
        raise ParameterError(
            f"{song.seconds:.0f} s at rate={rate} Hz is too long; cut the song to "
            f"{MAX_SAMPLES / rate - LAST_RING:.0f} s, or ask for a lower --rate"
        )
    for key in song.keys:
        instrument.note(key, 64)  # reject a missing key before the computation starts
    total, hits, last = np.zeros((instrument.channels, size)), list[bool](), 0
    for key in sorted(song.keys):
        string = StringVoice(instrument.note(key, 64), key, rate)
        for at, sound, hit_moving in _phrases(string, instrument, _events(song, key, rate), size):
            begin = at + lead - string.lead
            sound = string.through_path(sound)[:, : size - begin]
            end = begin + sound.shape[-1]
            total[:, begin:end] += sound  # a single channel is added to all
            last = max(last, end)
            hits += hit_moving
            progress("playing", 0.98 * len(hits) / song.notes)
    fade = round(LAST_FADE * rate)  # the treble has no dampers
    total[:, -fade:] *= 0.5 * (1 + np.cos(np.pi * np.arange(1, fade + 1) / fade))
    samples, gain_db, limited_db = limit(total[:, :last], rate)
    return Performance(samples, gain_db, limited_db, len(hits), sum(hits))


def _events(song: Song, key: int, rate: int) -> list[_Event]:
    """Strokes of a key and movements of its damper, in time order."""
    end = song.seconds + LAST_HELD
    moves = [(t, 0, down) for t, down in [*song.pedal, (end, 0)]]  # the pedal before the key
    moves += [(t, 1, velocity) for t, velocity in [*song.keys[key], (end, 0)]]
    events: list[_Event] = []
    is_down, is_damped = [False, False], False  # pedal and key
    for t, is_key, value in sorted(moves, key=lambda move: move[:2]):
        is_down[is_key] = bool(value)
        was_damped, is_damped = is_damped, not any(is_down)
        velocity = value if is_key else 0
        if velocity or is_damped != was_damped:
            events.append(_Event(round(t * rate), velocity, is_damped))
    return events


def _phrases(
    string: StringVoice, instrument: Instrument, events: list[_Event], size: int
) -> Iterator[tuple[int, np.ndarray, list[bool]]]:
    """Yield (first sample, sound, was the string moving at each stroke), from silence to silence, up to `size`.

    A phrase is not divided further, because the convolution with the output path is most of the work and adds a tail
    to every piece.
    """
    at, begin, sounds, hit_moving = 0, 0, [], []
    for event in [*events, _Event(size, velocity=0, damped=False)]:
        end = min(event.sample, size)
        while at < end and string.is_audible:
            sounds.append(string.ring(min(CHUNK_SAMPLES, end - at)))
            at += sounds[-1].shape[-1]
        if sounds and (at < end or at >= size):
            yield begin, np.concatenate(sounds, axis=-1), hit_moving
            sounds, hit_moving = [], []
        at = max(at, end)
        if at >= size:
            return
        string.damped = event.damped
        if event.velocity:
            begin = begin if sounds else at
            hit_moving.append(string.in_motion)
            sounds.append(string.strike(instrument.note(string.midi, event.velocity).hammer.v_H0)[:, : size - at])
            at += sounds[-1].shape[-1]


def limit(samples: np.ndarray, rate: int) -> tuple[np.ndarray, float, float]:
    """Limit a sound [channels, samples] to ± `PEAK_LIMIT`; also return its overall gain and largest reduction, dB.

    A sound that is too loud by more than `MOST_LIMITED_DB` is first attenuated as a whole. The remaining peaks are
    reduced by a look-ahead gain: the minimum of the gains that the samples within `LOOKAHEAD` need, averaged twice
    over half that span. Every value in the average is small enough for the sample itself, so no peak passes. All
    channels share one gain. The result is deterministic.
    """
    from scipy.ndimage import minimum_filter1d, uniform_filter1d

    peak = float(np.abs(samples).max(initial=0.0))
    allowed = PEAK_LIMIT * 10 ** (MOST_LIMITED_DB / 20)
    gain = min(1.0, allowed / peak) if peak > 0 else 1.0
    samples = gain * samples
    if peak * gain <= PEAK_LIMIT:
        return samples, 0.0, 0.0
    needed = np.minimum(1.0, PEAK_LIMIT / np.maximum(np.abs(samples).max(axis=0), 1e-30))
    half = max(int(LOOKAHEAD * rate / 2), 1)
    smooth = minimum_filter1d(needed, 4 * half + 1, mode="nearest")
    for _ in range(2):
        smooth = uniform_filter1d(smooth, 2 * half + 1, mode="nearest")
    # Averages may be rounded up by an ulp.
    smooth = np.minimum(smooth, needed)
    return np.clip(samples * smooth, -PEAK_LIMIT, PEAK_LIMIT), 20 * np.log10(gain), -20 * float(np.log10(smooth.min()))
