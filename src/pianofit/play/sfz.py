"""An instrument as a sampler's: a folder with one `.sfz` text and a sample for every key and velocity layer asked for.

All samples share one gain, so that soft and loud, bass and treble keep their levels, and the player is told to change
none (`amp_veltrack=0`). A layer is played at the hammer velocity of the middle of its MIDI range. Keys that have no
sample of their own are played from the nearest one, transposed.
"""

from __future__ import annotations

import io
import math
import os
import re
import shutil
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..analysis.notes import midi_to_note, note_to_midi
from ..errors import AnalysisError, OutputError, ParameterError
from ..io import interrupted_by, one_line
from ..keyboard.document import Instrument
from ..keyboard.gather import HIGHEST_KEY, LOWEST_KEY
from ..model.note import arrival
from ..recording import RATES
from ..render import CEILING
from ..threads import one_blas_thread
from .strings import PlayedString, damper_rate

__all__ = ["FORMATS", "Layer", "export_sfz", "layers_of", "parse_keys", "spans_of"]

FORMATS = {"flac": ("FLAC", "PCM_24"), "wav": ("WAV", "PCM_24")}
MOST_LAYERS = 127
MOST_SAMPLE_SECONDS = 40_000.0  # all samples together: some 5 GB
# A sample ends when it is this far below its peak, dB, or after the seconds asked for, with a fade of this part of it.
SILENT_DB, FADE = 110.0, 0.05
# A sample begins just before it first reaches this level below its peak, dB: stiff strings send their treble ahead.
BEGINS_DB, BEFORE = 80.0, 16
# The loudest moment of a note lies within this time, s.
LOUDEST_WITHIN = 1.0
# No sample is transposed further than this, semitones.
FARTHEST = 6


class Layer(NamedTuple):
    """One velocity layer."""

    low: int
    high: int

    @property
    def middle(self) -> float:
        """The MIDI velocity at which it is played."""
        return (self.low + self.high) / 2


def parse_keys(text: str) -> list[int]:
    """Keys named on a command line: A0-C8, C2,E2,G2, "every 3" (semitones from A0), or a mixture by commas.

    Raises
    ------
    ParameterError
        Naming the part that is no key.
    """
    keys: set[int] = set()
    for part in (piece.strip() for piece in text.split(",")):
        every = re.fullmatch(r"every\s+([1-9]\d?)", part)
        ends = part.split("-")
        try:
            if every:
                keys.update(range(LOWEST_KEY, HIGHEST_KEY + 1, int(every[1])))
                continue
            low, high = (note_to_midi(end) for end in (ends if len(ends) == 2 else [part, part]))
        except AnalysisError:
            raise ParameterError(f"--keys {text!r}: {part!r} is no key; write C2,E2 or A0-C8 or 'every 3'") from None
        if not LOWEST_KEY <= low <= high <= HIGHEST_KEY:
            raise ParameterError(f"--keys {text!r}: {part!r} must lie from A0 to C8, the lower first")
        keys.update(range(low, high + 1))
    return sorted(keys)


def layers_of(count: int) -> list[Layer]:
    """MIDI velocities 1 to 127 in `count` parts, as equal as whole numbers allow."""
    edges = [1 + 127 * i // count for i in range(count + 1)]
    return [Layer(low, high - 1) for low, high in pairwise(edges)]


def spans_of(keys: Sequence[int]) -> list[tuple[int, int]]:
    """Which keys each sampled key plays: up to half-way to its neighbours, and as far at the two ends."""
    gaps = [b - a for a, b in pairwise(keys)]
    below = [gaps[0] if gaps else 1, *gaps]
    above = [*gaps, gaps[-1] if gaps else 1]
    spans = []
    for key, down, up in zip(keys, below, above, strict=True):
        low, high = key - min((down - 1) // 2, FARTHEST), key + min(up // 2, FARTHEST)
        spans.append((max(low, LOWEST_KEY), min(high, HIGHEST_KEY)))
    return spans


@one_blas_thread()
def export_sfz(
    instrument: Instrument, out: Path, keys: Sequence[int], layers: int, *, rate: int = 48_000, seconds: float = 8.0,
    kind: str = "flac", force: bool = False, progress: Callable[[str, float], None] = lambda *_: None,
) -> dict[str, float]:  # fmt: skip
    """Write the folder `out`, whole or not at all; what was written, in numbers.

    Raises
    ------
    ParameterError
        For layers, seconds, a rate or a kind out of range, or a key the instrument does not have.
    OutputError
        If `out` exists and is no earlier export, or `force` is not given, or cannot be written.
    """
    _check(instrument, keys, layers, rate, seconds, kind)
    try:
        out = out.resolve()
        _check_target(out, force)
        work = out.with_name(f".{out.name}.{os.getpid()}.tmp")
        with interrupted_by(lambda: shutil.rmtree(work, ignore_errors=True)):
            try:
                (work / "samples").mkdir(parents=True)
                report = _write(instrument, work, keys, layers_of(layers), rate, seconds, kind, progress)
                _put(work, out)
            finally:
                shutil.rmtree(work, ignore_errors=True)
    except OSError as error:
        reason = error.strerror or error
        raise OutputError(f"{one_line(out)}: cannot be written ({reason}); choose another --out") from error
    return report


def _check(instrument: Instrument, keys: Sequence[int], layers: int, rate: int, seconds: float, kind: str) -> None:
    if not 1 <= layers <= MOST_LAYERS:
        raise ParameterError(f"layers={layers} must be from 1 to {MOST_LAYERS}")
    if not RATES[0] <= rate <= min(RATES[1], 192_000):
        raise ParameterError(f"rate={rate} Hz must be from {RATES[0]} to 192000")
    if not 0.1 <= seconds <= 120:
        raise ParameterError(f"seconds={seconds} must be from 0.1 to 120")
    if kind not in FORMATS:
        raise ParameterError(f"samples={kind!r} must be one of {', '.join(FORMATS)}")
    if len(keys) * layers * seconds > MOST_SAMPLE_SECONDS:
        raise ParameterError(
            f"{len(keys)} keys × {layers} layers × {seconds:g} s are more than {MOST_SAMPLE_SECONDS:,.0f} s; "
            "ask for fewer --layers, --keys or --seconds"
        )
    for key in keys:
        instrument.note(key, 64)


def _check_target(out: Path, force: bool) -> None:
    """An export may replace an export, and nothing else."""
    name = one_line(out)
    if not out.parent.is_dir():
        raise OutputError(f"{name}: there is no folder {one_line(out.parent)}; make it, or give another --out")
    if not out.exists():
        return
    held = sorted(path.name for path in out.iterdir()) if out.is_dir() else None
    if held is None or not all(entry == "samples" or entry.endswith(".sfz") for entry in held):
        raise OutputError(f"{name}: is there and is no earlier export; give another --out")
    if held and not force:
        raise OutputError(f"{name}: the folder is not empty; give another --out, or --force to replace an export in it")


def _put(work: Path, out: Path) -> None:
    old = out.with_name(f".{out.name}.{os.getpid()}.old")
    if out.exists():
        out.rename(old)
    try:
        work.rename(out)
    except OSError:
        if old.exists():
            old.rename(out)
        raise
    shutil.rmtree(old, ignore_errors=True)


def _write(
    instrument: Instrument, work: Path, keys: Sequence[int], layers: list[Layer], rate: int, seconds: float, kind: str,
    progress: Callable[[str, float], None],
) -> dict[str, float]:  # fmt: skip
    import soundfile

    jobs = [(key, layer) for key in keys for layer in layers]
    peak = 0.0
    for i, (_, string, layer) in enumerate(_strings(instrument, jobs, rate)):
        peak = max(peak, float(np.abs(_note(instrument, string, layer, min(seconds, LOUDEST_WITHIN))).max()))
        progress("levels", 0.3 * i / len(jobs))
    gain = CEILING / peak if peak > 0 else 1.0
    total = size = 0
    form, subtype = FORMATS[kind]
    for i, (key, string, layer) in enumerate(_strings(instrument, jobs, rate)):
        sound = np.clip(gain * _faded(_note(instrument, string, layer, seconds), rate), -1.0, 1.0)
        stream = io.BytesIO()
        soundfile.write(stream, sound.T, rate, format=form, subtype=subtype)
        total, size = total + sound.shape[-1], size + (work / _sample(key, layer, kind)).write_bytes(stream.getvalue())
        progress("samples", 0.3 + 0.7 * i / len(jobs))
    (work / f"{_file_name(instrument.name)}.sfz").write_text(_text(instrument, keys, layers, kind), encoding="utf-8")
    return {"samples": len(jobs), "seconds": total / rate, "bytes": size, "gain_db": 20 * math.log10(gain)}


def _strings(instrument: Instrument, jobs: Sequence[tuple[int, Layer]], rate: int):
    """(key, string, layer) of every job; the layers of a key share their string."""
    string = None
    for key, layer in jobs:
        if string is None or string.midi != key:
            string = PlayedString(instrument.note(key, 64), key, rate)
        yield key, string, layer


def _note(instrument: Instrument, string: PlayedString, layer: Layer, seconds: float) -> np.ndarray:
    """One stroke on the string at rest, from just before its sound arrives [channels, samples].

    What begins before the contact begins so long before it in every sample: layers and keys stay together.
    """
    note = instrument.note(string.midi, layer.middle)
    string.still()
    # The way to the pickup comes on top.
    samples = round((seconds + arrival(note.string, note.geometry, note.quantity)) * string.rate)
    head = string.strike(note.hammer.v_H0)
    sound = np.concatenate([head, string.ring(max(samples - head.shape[-1], 0))], axis=-1)
    sound = string.heard(sound)[:, : max(samples, head.shape[-1])]
    level = np.abs(sound).max(axis=0)
    first = max(int(np.argmax(level > level.max() * 10 ** (-BEGINS_DB / 20))) - BEFORE, 0)
    first = 0 if string.lead else first
    return sound[:, first : first + round(seconds * string.rate)]


def _faded(sound: np.ndarray, rate: int) -> np.ndarray:
    """Cut where it has become silent, and faded out to its end."""
    level = np.abs(sound).max(axis=0)
    loud = np.flatnonzero(level > level.max() * 10 ** (-SILENT_DB / 20))
    sound = sound[:, : max(int(loud[-1]) + 1 if loud.size else 1, rate // 20)].copy()
    fade = max(int(FADE * sound.shape[-1]), 2)
    sound[:, -fade:] *= 0.5 * (1 + np.cos(np.pi * np.arange(1, fade + 1) / fade))
    return sound


def _file_name(name: str) -> str:
    """A name of plain letters: whatever the instrument is called, the file stays in its folder."""
    return re.sub(r"[^A-Za-z0-9_-]+", "-", name).strip("-")[:64] or "instrument"


def _sample(key: int, layer: Layer, kind: str) -> str:
    # "#" begins a directive in SFZ.
    return f"samples/{key:03}-{midi_to_note(key).replace('#', 's')}-v{layer.high:03}.{kind}"


def _text(instrument: Instrument, keys: Sequence[int], layers: Sequence[Layer], kind: str) -> str:
    """The `.sfz`: a group for each key, a region for each layer."""
    lines = [
        f"// {_file_name(instrument.name)}: strings and hammers, played by pianofit",
        "<global>", "amp_veltrack=0", "ampeg_attack=0", "",
    ]  # fmt: skip
    for key, (low, high) in zip(keys, spans_of(keys), strict=True):
        decay = damper_rate(key)
        # The time in which the damper takes 60 dB; without one the note rings on.
        end = f"ampeg_release={math.log(1000) / decay:.4f}" if decay else "loop_mode=one_shot"
        lines.append(f"<group> lokey={low} hikey={high} pitch_keycenter={key} {end}")
        lines += [f"<region> lovel={x.low} hivel={x.high} sample={_sample(key, x, kind)}" for x in layers]
    return "\n".join(lines) + "\n"
