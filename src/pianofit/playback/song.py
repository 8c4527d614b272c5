"""A song on an instrument: every key is rendered as if it were alone, the strings' effect on each other is added.

Dampers follow keys and pedals (`pedals`), but no damper falls during a contact. A stroke that begins during a contact
waits for the end of the contact. Free strings resonate (`resonance`). Keys that are let go make the noise that was
recorded of them. The sum is limited to the range of a file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from ..errors import ParameterError, check_range
from ..instrument import Instrument
from ..instrument.release_noise import RECORDED_VELOCITY
from ..io.containers import RATES
from ..io.files import PEAK_LIMIT
from ..model.note import MAX_SAMPLES
from ..parameters import check_seed
from ..threads import numerical_settings
from .midi import Song
from .pedals import KeyMotion, PedalRange, key_motions, releases
from .resonance import RESONANCE, SILENCE, Stroke, hop_count, mean_contact, render_resonance
from .voice import StringVoice

# After the last event, s: dampers of keys still held fall, the sound ends, and the length of the final fade.
LAST_HELD, LAST_RING, LAST_FADE = 3.0, 5.0, 0.5
# Level below the peak of the song at which its sound ends, dB.
INAUDIBLE_DB = -110.0
# Largest gain reduction by the limiter. Any further reduction applies to the whole song.
MOST_LIMITED_DB = 3.0
# Free vibration that is computed at once, s: a string falls silent at the end of such a part.
CHUNK_SECONDS = 0.5
# Span of the limiter before and after a sample, s.
LOOKAHEAD = 0.02


class Performance(NamedTuple):
    """The rendered sound and its levels."""

    samples: np.ndarray  # within ± `PEAK_LIMIT` [channels, samples]
    gain_db: float  # of the whole song, never above 0
    limited_db: float  # largest additional gain reduction by the limiter
    strikes: int
    restrikes: int  # strikes on a string that was still sounding


class PlayOptions(NamedTuple):
    """How a song is played.

    Parameters
    ----------
    pedal_range : values of controller 64 for half pedal.
    resonance : how much free strings sound when others excite them, from 0 (not at all) to 1 (as if all strings stood
        at one point of the bridge). Plucked strings do not resonate, see `Instrument.resonates`.
    noise : whether to add the noise floor of the recordings.
    seed : seed of the noise floor.
    gain_db : gain before the limiter, dB.
    tempo : speed of the song over that of the file.
    touch : exponent of the MIDI velocities, see `Song.with_touch`.

    Examples
    --------
    >>> import pianofit
    >>> pianofit.PlayOptions(pianofit.PedalRange(40, 90), resonance=0.5).pedal_range.contact(40)
    1.0
    """

    pedal_range: PedalRange = PedalRange()
    resonance: float = RESONANCE
    noise: bool = False
    seed: int = 0
    gain_db: float = 0.0
    tempo: float = 1.0
    touch: float = 1.0

    def check(self) -> PlayOptions:
        """Return the options, or raise a `ParameterError` for one out of range."""
        check_range("resonance=", self.resonance, 0.0, 1.0)
        check_range("gain_db=", self.gain_db, -60.0, 60.0, " dB")
        check_range("tempo=", self.tempo, 0.1, 10.0)
        check_range("touch=", self.touch, 0.2, 5.0)
        check_seed(self.seed)
        self.pedal_range.check()
        return self


AS_RECORDED = PlayOptions()


@numerical_settings()
def render_song(
    instrument: Instrument,
    song: Song,
    rate: int = 48_000,
    progress: Callable[[str, float], None] = lambda *_: None,
    options: PlayOptions = AS_RECORDED,
) -> Performance:
    """Render a song on an instrument.

    A knock may begin before its stroke, so the song begins `Instrument.pre_onset_s` after the first sample.

    Parameters
    ----------
    instrument : as `load_instrument` returns it.
    song : as `load_song` returns it.
    rate : sample rate, Hz.
    progress : called with the name of the step and the finished fraction.
    options : pedals, resonance, noise, gain, tempo and touch; see `PlayOptions`.

    Returns
    -------
    The sound of all channels, within -1 dBFS, and its levels.

    Raises
    ------
    ParameterError
        For a rate or an option out of range, a song that is too long, a key that the instrument lacks, or a noise
        floor that it lacks.
    FitError
        If a hammer stays on its string.

    Examples
    --------
    >>> import pianofit
    >>> sound = pianofit.render_song(pianofit.load_instrument("instrument.json"), pianofit.load_song("melody.mid"))
    >>> len(sound.samples), sound.strikes
    (1, 4)
    """
    check_range("rate=", rate, *RATES, " Hz")
    song = song.at_tempo(options.check().tempo).with_touch(options.touch)
    lead = round(instrument.pre_onset_s * rate)
    size = int((song.seconds + LAST_RING) * rate) + lead
    if size > MAX_SAMPLES:
        raise ParameterError(
            f"{song.seconds:.0f} s at rate={rate} Hz is too long; cut the song to "
            f"{MAX_SAMPLES / rate - LAST_RING:.0f} s, or ask for a lower --rate"
        )
    for key in song.keys:
        instrument.note(key, 64)  # reject a missing key before the computation starts
    if options.noise and instrument.noise is None:
        raise ParameterError("noise=True, but no noise floor is known of this instrument; play without it")
    resonance = options.resonance if instrument.resonates else 0.0
    pedal_range, end = options.pedal_range, song.seconds + LAST_HELD
    unplayed = key_motions(song, -1, pedal_range, end)
    contact = np.empty((len(instrument.keys), hop_count(size - lead, rate)))
    total, strokes, hits = np.zeros((instrument.channels, size)), list[Stroke](), list[bool]()
    for row, key in zip(contact, sorted(instrument.keys), strict=True):
        motions = key_motions(song, key, pedal_range, end) if key in song.keys else unplayed
        row[:] = mean_contact([(round(m.seconds * rate), m.contact) for m in motions], len(row), rate)
        if key not in song.keys:
            continue
        string = StringVoice(instrument.note(key, 64), key, rate, instrument.dampers)
        for at, sound, struck in _phrases(string, instrument, motions, size):
            begin = at + lead - string.lead
            sound = string.through_path(sound)[:, : size - begin]
            stop = begin + sound.shape[-1]
            total[:, begin:stop] += sound  # a single channel is added to all
            strokes += [stroke for stroke, _ in struck]
            hits += [was_moving for _, was_moving in struck]
            progress("playing", (0.7 if resonance else 0.98) * len(hits) / song.notes)
    if resonance and strokes:
        added = render_resonance(
            instrument,
            strokes,
            contact,
            rate,
            size - lead,
            resonance,
            lambda share: progress("playing", 0.7 + 0.28 * share),
        )
        total[:, lead:] += added
    _add_releases(total, instrument, song, rate, lead)
    # The last fade follows the sound. Only what rings on at the end of the song, such as the treble, is faded itself.
    sound = np.abs(total).max(axis=0)
    audible = np.flatnonzero(sound > max(10 ** (INAUDIBLE_DB / 20) * sound.max(), SILENCE))
    if not len(audible):
        raise ParameterError("the song is silent on this instrument; check the gains of its keys")
    last = min(audible[-1] + 1 + round(LAST_FADE * rate), size)
    if options.noise and instrument.noise is not None:
        total[:, :last] += instrument.noise.sound(last, rate, options.seed)
    fade = min(round(LAST_FADE * rate), last)
    total[:, last - fade : last] *= 0.5 * (1 + np.cos(np.pi * np.arange(1, fade + 1) / fade))
    samples, gain_db, limited_db = limit(10 ** (options.gain_db / 20) * total[:, :last], rate)
    return Performance(samples, gain_db, limited_db, len(hits), sum(hits))


def _add_releases(total: np.ndarray, instrument: Instrument, song: Song, rate: int, lead: int) -> None:
    """Add the noises of keys that are let go."""
    if instrument.release is None:
        return
    for key in song.keys:
        for at, held in releases(song, key):
            velocity = song.release_velocities.get((key, at), RECORDED_VELOCITY)
            begin = round(at * rate) + lead
            sound = instrument.release.sound(key, velocity, held, rate)[:, : total.shape[-1] - begin]
            end = begin + sound.shape[-1]
            total[:, begin:end] += sound[: len(total)] if len(sound) >= len(total) else sound.mean(axis=0)


def _phrases(
    string: StringVoice, instrument: Instrument, motions: list[KeyMotion], size: int
) -> Iterator[tuple[int, np.ndarray, list[tuple[Stroke, bool]]]]:
    """Yield (first sample, sound, strokes and whether the string was moving), from silence to silence, up to `size`.

    A phrase is not divided further, because the convolution with the output path is most of the work and adds a tail
    to every piece.
    """
    at, begin, sounds, struck = 0, 0, [], []
    for motion in [*motions, KeyMotion(size / string.rate, velocity=0, contact=0.0)]:
        end = min(round(motion.seconds * string.rate), size)
        while at < end and string.is_audible:
            sounds.append(string.ring(min(round(CHUNK_SECONDS * string.rate), end - at)))
            at += sounds[-1].shape[-1]
        if sounds and (at < end or at >= size):
            yield begin, np.concatenate(sounds, axis=-1), struck
            sounds, struck = [], []
        at = max(at, end)
        if at >= size:
            return
        string.contact = motion.contact
        if motion.velocity:
            begin = begin if sounds else at
            was_moving, touch = string.in_motion, at
            strength = instrument.note(string.midi, motion.velocity).size
            sounds.append(string.strike(strength, motion.soft)[:, : size - at])
            at += sounds[-1].shape[-1]
            struck.append((Stroke(string.midi, touch, at, string.modes.state, string.force), was_moving))


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
