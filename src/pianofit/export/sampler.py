"""An instrument as a sampler's: a folder with one text, a readme, and a sample for every key and layer asked for.

All samples share one gain, so that soft and loud, bass and treble keep their levels. Keys that have no sample of their
own are played from the nearest one, transposed.
"""

from __future__ import annotations

import math
import os
import re
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..analysis.note_names import midi_to_note
from ..errors import OutputError, ParameterError, check_range
from ..instrument.document import Instrument
from ..io.audio import RATES
from ..io.files import PEAK_LIMIT, cleanup_on_interrupt, encode_pcm, printable, write_error
from ..playback.voice import StringVoice, damper_rate
from ..threads import one_blas_thread
from .formats import SAMPLERS
from .layers import SampledKey, key_ranges, silent_keys, velocities_of
from .readme import MARK, readme_text
from .samples import KeySamples, measure_layers, sample

__all__ = ["ExportOptions", "ExportSummary", "export_sampler"]

# Kinds of samples.
KINDS = ("flac", "wav")


README = "README.txt"
# Names of samples: key, note, velocity.
SAMPLE = re.compile(r"\d{3}-[A-G]s?-?\d-v\d{3}\.(flac|wav)")
MOST_LAYERS = 127
HIGHEST_RATE = 192_000  # Hz: samplers read no higher
MOST_SAMPLE_SECONDS = 40_000.0  # all samples together: some 5 GB
# Of the time an export takes, that to strike all keys for their levels.
LEVELS_SHARE = 0.5


class ExportSummary(NamedTuple):
    """What was written."""

    keys: int  # with samples of their own
    guesses: int  # of them, never recorded
    transposed: int  # keys played from another's samples
    samples: int
    seconds: float  # of all samples
    bytes: int  # of all samples
    gain_db: float  # of all samples
    silent: list[int]  # MIDI keys that no sample plays


class ExportOptions(NamedTuple):
    """Which samples are wanted."""

    layers: int = 8  # of velocity
    seconds: float = 8.0  # at the most
    rate: int = 48_000  # Hz
    kind: str = "flac"


@one_blas_thread()
def export_sampler(
    instrument: Instrument, out: Path, keys: Sequence[int], asked: ExportOptions, *, to: str = "sfz",
    licence: str | None = None, force: bool = False, progress: Callable[[str, float], None] = lambda *_: None,
) -> ExportSummary:  # fmt: skip
    """Write the folder `out`, whole or not at all.

    Parameters
    ----------
    keys : MIDI keys that have samples of their own, ascending.
    to : one of `SAMPLERS`.
    licence : of the source, in the user's words, for the readme.

    Raises `ParameterError` for layers, seconds, a rate or a kind out of range, or a key the instrument does not have;
    `OutputError` if `out` exists and is no earlier export, or `force` is not given, or cannot be written.
    """
    if to not in SAMPLERS:
        raise ParameterError(f"to={to!r} must be one of {', '.join(SAMPLERS)}")
    _check(instrument, keys, asked)
    try:
        out = out.resolve()
        _check_target(out, force)
        work = out.with_name(f".{out.name}.{os.getpid()}.tmp")
        old = work.with_suffix(".old")

        def tidy() -> None:
            shutil.rmtree(work, ignore_errors=True)
            if old.exists() and not out.exists():  # interrupted between two names
                old.rename(out)
            shutil.rmtree(old, ignore_errors=True)

        with cleanup_on_interrupt(tidy):
            try:
                (work / "samples").mkdir(parents=True)
                done, written = _samples(instrument, work, keys, asked, progress)
                file = _file_name(instrument.name) + SAMPLERS[to].ending
                (work / file).write_text(SAMPLERS[to].text(Path(file).stem, written), encoding="utf-8")
                (work / README).write_text(readme_text(instrument, file, written, licence), encoding="utf-8")
                if out.exists():
                    out.rename(old)
                work.rename(out)
            finally:
                tidy()
    except OSError as error:
        raise write_error(out, error, "choose another --out") from error
    return done


def _check(instrument: Instrument, keys: Sequence[int], asked: ExportOptions) -> None:
    check_range("layers=", asked.layers, 1, MOST_LAYERS)
    check_range("rate=", asked.rate, RATES[0], HIGHEST_RATE, " Hz")
    check_range("seconds=", asked.seconds, 0.1, 120)
    if asked.kind not in KINDS:
        raise ParameterError(f"samples={asked.kind!r} must be one of {', '.join(KINDS)}")
    if len(keys) * asked.layers * asked.seconds > MOST_SAMPLE_SECONDS:
        raise ParameterError(
            f"{len(keys)} keys × {asked.layers} layers × {asked.seconds:g} s are more than {MOST_SAMPLE_SECONDS:,.0f} "
            "s; ask for fewer --layers, --keys or --seconds"
        )
    if not keys:
        raise ParameterError("keys=[]: give the MIDI keys that are to have samples of their own")
    for key in keys:
        instrument.note(key, 64)


def _check_target(out: Path, force: bool) -> None:
    """An export may replace an export, and nothing else."""
    name = printable(out)
    if not out.parent.is_dir():
        raise OutputError(f"{name}: there is no folder {printable(out.parent)}; make it, or give another --out")
    if not out.exists():
        return
    held = out.is_dir() and any(out.iterdir())
    if not out.is_dir() or (held and not _earlier(out)):
        raise OutputError(f"{name}: is there and is no earlier export; give another --out")
    if held and not force:
        raise OutputError(f"{name}: the folder is not empty; give another --out, or --force to replace an export in it")


def _earlier(folder: Path) -> bool:
    """Whether a folder holds an export and nothing else: its own readme, one text, and samples."""
    names = {path.name for path in folder.iterdir()} - {"samples"}
    endings = tuple(sampler.ending for sampler in SAMPLERS.values())
    if not (folder / "samples").is_dir() or README not in names or len(names) != 2:
        return False
    return (
        (names - {README}).pop().endswith(endings)
        and MARK in (folder / README).read_text(encoding="utf-8", errors="replace")
        and all(SAMPLE.fullmatch(path.name) for path in (folder / "samples").iterdir())
    )


def _samples(
    instrument: Instrument,
    work: Path,
    keys: Sequence[int],
    asked: ExportOptions,
    progress: Callable[[str, float], None],
) -> tuple[ExportSummary, list[SampledKey]]:
    """Write the samples, all with one gain."""
    known: list[KeySamples] = []
    for i, key in enumerate(keys):
        string = StringVoice(instrument.note(key, 64), key, asked.rate)
        known.append(measure_layers(instrument, string, velocities_of(asked.layers), asked.seconds))
        progress("levels", LEVELS_SHARE * (i + 1) / len(keys))
    peak = max(key.peak for key in known)
    gain = PEAK_LIMIT / peak if peak > 0 else 1.0
    written, frames, size = [], 0, 0
    for i, (key, (low, high), found) in enumerate(zip(keys, key_ranges(keys), known, strict=True)):
        string, files = StringVoice(instrument.note(key, 64), key, asked.rate), []
        for zone, begin in zip(found.zones, found.begin, strict=True):
            loud = gain * zone.loudest
            sound = np.clip(loud * sample(instrument, string, zone.velocity, begin, asked.seconds), -1.0, 1.0)
            files.append(f"samples/{_sample_name(key, zone.velocity)}.{asked.kind}")
            size += (work / files[-1]).write_bytes(encode_pcm(sound, asked.rate, asked.kind))
            frames += sound.shape[-1]
        written.append(SampledKey(key, low, high, damper_rate(key), found.zones, files))
        progress("samples", LEVELS_SHARE + (1 - LEVELS_SHARE) * (i + 1) / len(keys))
    done = ExportSummary(
        len(keys), len(instrument.unrecorded_keys(keys)), sum(k.high - k.low for k in written),
        len(keys) * asked.layers, frames / asked.rate, size, 20 * math.log10(gain), silent_keys(written),
    )  # fmt: skip
    return done, written


def _file_name(name: str) -> str:
    """A name of plain letters: whatever the instrument is called, the file stays in its folder."""
    return re.sub(r"[^A-Za-z0-9_]+", "-", name).strip("-")[:64] or "instrument"


def _sample_name(key: int, velocity: int) -> str:
    # "#" begins a directive in SFZ.
    return f"{key:03}-{midi_to_note(key).replace('#', 's')}-v{velocity:03}"
