"""Sounds of a page: cut to the note, equally loud, 16 bits, encoded as text that a browser can play.

Listeners compare the sounds and prefer the louder of two. Therefore all get the same loudness: the mean square over the
channels and the first second, after the K-weighting of ITU-R BS.1770 (`dsp/loudness.py`). A common gain keeps the
highest peak 1 dB below full scale, so that sounds do not clip, also during a crossfade. Sounds whose loudness is to be
compared get the common gain only.
"""

from __future__ import annotations

import base64
import math
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..dsp.filters import reduce_rate
from ..dsp.loudness import k_weighted_mean_square
from ..errors import FitError, ParameterError
from ..io.files import PEAK_LIMIT, encode_pcm, safe_name
from ..io.number_format import number
from .html import data_uri

if TYPE_CHECKING:
    from ..result import Result

SECONDS = 8.0  # of each sound; three mono sounds at 48 kHz have 3 MB
LEAD_IN = 0.05  # s, before the onset
FADE = 0.05  # s, at the end, because many recordings are cut off
HIGHEST_RATE = 96_000  # Hz; every browser must support it in Web Audio
LIGHT_RATE = 32_000  # Hz, for pages with many sounds; its bandwidth is 16 kHz
# Length of the sounds of the reference recording in stereo, s; in mono it is `SECONDS`.
STEREO_SECONDS = 5.0
# Samples of the sounds of all other recordings together: 2 MB.
OTHER_SAMPLES = 1_000_000
LONGEST_OTHER, SHORTEST_OTHER = 4.0, 1.5  # s, of each of these sounds
STROKES = 7  # velocities of the slider
STROKE_SECONDS = 2.5
# Recordings whose velocities differ by less than this ratio do not define a range of velocities. The slider then goes
# down and up by the second ratio.
SMALLEST_RANGE, DEFAULT_RANGE = 1.3, 2.0


@dataclass(frozen=True)
class Clip:
    """One sound of the page: a WAV file of 16 bits, and its gain in dB."""

    name: str
    wav: bytes
    gain_db: float
    seconds: float
    file: str  # name for saving

    @property
    def uri(self) -> str:
        """The file as a data URI."""
        return data_uri("audio/wav", self.wav)

    @property
    def text(self) -> str:
        """The file as base64."""
        return base64.b64encode(self.wav).decode()


def make_clips(
    sounds: dict[str, np.ndarray],
    rate: int,
    onset: float = 0.0,
    *,
    lead_in: float = LEAD_IN,
    seconds: float = SECONDS,
    highest_rate: int = HIGHEST_RATE,
    matched: bool = True,
    of: str = "",
) -> list[Clip]:
    """Cut, match and encode `sounds`: name -> [samples] or [channels, samples], at `rate` Hz and aligned; `onset` in s.

    Parameters
    ----------
    lead_in, seconds : length before the onset, and total length, s.
    highest_rate : Hz. Sounds of higher rates are resampled to the rate divided by an integer.
    matched : True for equal loudness, False to keep the differences. A silent sound keeps its level.
    of : name of the recording or the key, with which the names of saved files begin.
    """
    factor = math.ceil(rate / highest_rate)
    excerpts = {name: excerpt(samples, rate, onset - lead_in, seconds, factor) for name, samples in sounds.items()}
    rate = round(rate / factor)
    powers = {
        name: k_weighted_mean_square(samples[:, :rate], rate) if matched else 0.0 for name, samples in excerpts.items()
    }
    gains = {name: power**-0.5 if power > 0 else 1.0 for name, power in powers.items()}
    highest = max(gains[name] * np.max(np.abs(samples)) for name, samples in excerpts.items())
    common = PEAK_LIMIT / highest if highest > 0 else 1.0
    clips = []
    for name, samples in excerpts.items():
        gain = gains[name] * common
        wav = encode_pcm(np.round(samples * gains[name] * common * 2**15).astype(np.int16), rate, bits=16)
        file = "-".join(filter(None, [safe_name(of), safe_name(name), "matched" * matched]))
        clips.append(Clip(name, wav, 20 * math.log10(gain), samples.shape[-1] / rate, f"{file}.wav"))
    return clips


def seconds_each(pairs: int, samples: int, longest: float, shortest: float) -> float:
    """Return the length of each sound, s, so that all pairs together have about `samples` at `LIGHT_RATE`."""
    return max(shortest, min(longest, samples / (2 * max(pairs, 1) * LIGHT_RATE)))


def excerpt(samples: np.ndarray, rate: int, begin: float, seconds: float, factor: int) -> np.ndarray:
    """Return at most `seconds` from `begin`, s, faded out, at the rate divided by `factor` [channels, samples]."""
    samples = np.atleast_2d(np.nan_to_num(np.asarray(samples, dtype=np.float64), posinf=0.0, neginf=0.0))
    samples = samples if samples.size else np.zeros((1, 1))
    start = max(0, round(begin * rate))
    start = start if start < samples.shape[-1] else 0
    kept = samples[:, start : start + round(seconds * rate)].copy()
    fade = round(FADE * rate)
    kept[:, -fade:] *= np.linspace(1.0, 0.0, fade)[-kept.shape[-1] :]
    return reduce_rate(kept, factor)


# --- a fit ------------------------------------------------------------------------------------------------------------


def clips_of(result: Result) -> list[Clip]:
    """Return the sounds of the reference recording: recorded and two of the model."""
    reference, recording = result.reference, result.recording
    if reference.with_modes is None:
        fitted = {"initial": result.initial.samples, "fitted": reference.sound}
    else:
        fitted = {"fitted": reference.sound, "string model": result.fitted.samples}
    recorded = recording.samples if reference.final.frames is None else recording.frames
    # Few listeners can play more than two channels.
    sounds = {
        name: x if x.ndim == 1 or len(x) <= 2 else x.mean(axis=0)
        for name, x in ({"original": recorded} | fitted).items()
    }
    seconds = SECONDS if all(x.ndim == 1 for x in sounds.values()) else STEREO_SECONDS
    of = Path(result.fit.reference.file).stem
    return make_clips(sounds, recording.rate, result.fit.reference.onset_s, seconds=seconds, of=of)


def strokes_of(result: Result) -> tuple[dict[float, np.ndarray], bool]:
    """Return sounds of the reference recording's note by value of the stroke, and if these are within the recordings.

    The range is that of the recordings, or from half to twice the value of a single one. The sounds are means of the
    channels and begin `pre_onset_s` before the contact. Strokes that cannot be rendered are left out.
    """
    velocities = [row.stroke_value for row in result.fit.recordings]
    low, high = min(velocities), max(velocities)
    is_recorded_range = high / low > SMALLEST_RANGE
    if not is_recorded_range:
        middle = np.sqrt(low * high)
        lower, upper = result.draw_set.law.stroke.bounds(result.note.geometry)
        low, high = max(middle / DEFAULT_RANGE, lower), min(middle * DEFAULT_RANGE, upper)
    note, rate, sounds = result.note, result.recording.rate, {}
    for velocity in np.geomspace(low, high, STROKES).tolist():
        with suppress(FitError, ParameterError):  # a contact that does not end cannot be rendered
            stroke, onset = note.with_stroke(velocity), round(note.pre_onset_s * rate)
            sounds[velocity] = stroke.render_stroke(rate, int(STROKE_SECONDS * rate), onset)[0]
    return sounds, is_recorded_range


def slider_of(result: Result) -> dict[str, Any] | None:
    """Return the slider of the stroke: sounds with one gain, and its initial position; None without two sounds."""
    strokes, is_recorded_range = strokes_of(result)
    if len(strokes) < 2:
        return None
    unit = result.draw_set.law.stroke.unit
    sounds = {f"{number(velocity, 3)} {unit}": samples for velocity, samples in strokes.items()}
    clips = make_clips(sounds, result.recording.rate, lead_in=0.0, matched=False, highest_rate=LIGHT_RATE, of="stroke")
    first = int(np.abs(np.log(np.array([*strokes]) / result.note.stroke_value)).argmin())
    return {"clips": clips, "first": first, "is_recorded_range": is_recorded_range}


def players_of(result: Result) -> list[dict[str, Any]]:
    """Return recorded and fitted sound of every recording except the reference, which has its own player."""
    others = [i for i in range(len(result.recordings)) if i != result.reference_index]
    seconds = seconds_each(len(others), OTHER_SAMPLES, LONGEST_OTHER, SHORTEST_OTHER)
    players = []
    for i in others:
        recording, row = result.recordings[i].recording, result.fit.recordings[i]
        sounds = {"original": recording.samples, "fitted": result.recordings[i].final.samples}
        onset = recording.onset / recording.rate
        of = Path(row.file).stem
        clips = make_clips(sounds, recording.rate, onset, seconds=seconds, highest_rate=LIGHT_RATE, of=of)
        players.append({"place": i + 1, "row": row, "clips": clips})
    return players
