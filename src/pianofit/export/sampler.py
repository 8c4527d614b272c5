"""Export to a sampler: a folder with one text, a readme, and a sample for every requested key and layer.

All samples share one gain, so that levels over velocity and keys are preserved. A key without its own sample is
transposed from the nearest sampled key.
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
from ..instrument import Instrument
from ..instrument.dampers import damper_rate
from ..io.audio import RATES
from ..io.files import PEAK_LIMIT, cleanup_on_interrupt, encode_pcm, printable, write_error
from ..playback.voice import StringVoice
from ..threads import one_blas_thread
from .formats import EXPORT_MARK, SAMPLERS, readme_text
from .layers import LOUDEST, SampledKey, key_ranges, layer_velocities, silent_keys
from .samples import measure_layers, render_sample

# Audio formats of samples.
KINDS = ("flac", "wav")
README = "README.txt"
# File names of samples: key, note, velocity.
SAMPLE = re.compile(r"\d{3}-[A-G]s?-?\d-v\d{3}\.(flac|wav)")
HIGHEST_RATE = 192_000  # Hz, limit of most samplers
MOST_SAMPLE_SECONDS = 40_000.0  # all samples together, about 5 GB
# Share of the measurement of levels in the progress of an export.
LEVELS_SHARE = 0.5


class ExportSummary(NamedTuple):
    """Contents of the written folder."""

    keys: int  # sampled keys
    unrecorded: int  # sampled keys that were never recorded
    transposed: int  # keys that play the samples of another key
    samples: int
    seconds: float  # of all samples
    bytes: int  # of all samples
    gain_db: float  # of all samples
    silent_keys: list[int]  # MIDI keys without a sample in reach


class ExportOptions(NamedTuple):
    """Number, length and format of the samples."""

    layers: int = 8  # per key
    seconds: float = 8.0  # largest length of a sample
    rate: int = 48_000  # Hz
    kind: str = "flac"


@one_blas_thread()
def export_sampler(
    instrument: Instrument,
    out: Path,
    keys: Sequence[int],
    options: ExportOptions,
    *,
    to: str = "sfz",
    licence: str | None = None,
    force: bool = False,
    progress: Callable[[str, float], None] = lambda *_: None,
) -> ExportSummary:
    """Write a folder for a sampler, completely or not at all.

    Parameters
    ----------
    instrument : as `load_instrument` returns it.
    out : folder to write.
    keys : MIDI keys to sample, ascending.
    options : number, length and format of the samples.
    to : one of `SAMPLERS`.
    licence : licence of the source for the readme, in the words of the user.
    force : replace an earlier export.
    progress : called with the name of the step and the finished fraction.

    Returns
    -------
    Numbers of keys and samples, and the common gain.

    Raises
    ------
    ParameterError
        For layers, seconds, rate or kind out of range, or a key that the instrument lacks.
    OutputError
        If `out` cannot be written, exists and is not an export, or is an export and `force` is not set.

    Examples
    --------
    >>> from pathlib import Path
    >>> import pianofit
    >>> piano, options = pianofit.load_instrument("batch", prefix="cp80"), pianofit.ExportOptions(2, seconds=0.2)
    >>> pianofit.export_sampler(piano, Path("sampler"), [60, 64], options).samples
    4
    """
    if to not in SAMPLERS:
        raise ParameterError(f"to={to!r} must be one of {', '.join(SAMPLERS)}")
    _check(instrument, keys, options)
    try:
        out = out.resolve()
        _check_target(out, force)
        work = out.with_name(f".{out.name}.{os.getpid()}.tmp")
        old = work.with_suffix(".old")

        def clean_up() -> None:
            shutil.rmtree(work, ignore_errors=True)
            if old.exists() and not out.exists():  # interrupted between the two renames
                old.rename(out)
            shutil.rmtree(old, ignore_errors=True)

        with cleanup_on_interrupt(clean_up):
            try:
                (work / "samples").mkdir(parents=True)
                summary, sampled_keys = _write_samples(instrument, work, keys, options, progress)
                file = _file_name(instrument.name) + SAMPLERS[to].ending
                (work / file).write_text(SAMPLERS[to].text(Path(file).stem, sampled_keys), encoding="utf-8")
                (work / README).write_text(readme_text(instrument, file, sampled_keys, licence), encoding="utf-8")
                if out.exists():
                    out.rename(old)
                work.rename(out)
            finally:
                clean_up()
    except OSError as error:
        raise write_error(out, error, "choose another --out") from error
    return summary


def _check(instrument: Instrument, keys: Sequence[int], options: ExportOptions) -> None:
    check_range("layers=", options.layers, 1, LOUDEST)
    check_range("rate=", options.rate, RATES[0], HIGHEST_RATE, " Hz")
    check_range("seconds=", options.seconds, 0.1, 120)
    if options.kind not in KINDS:
        raise ParameterError(f"samples={options.kind!r} must be one of {', '.join(KINDS)}")
    if len(keys) * options.layers * options.seconds > MOST_SAMPLE_SECONDS:
        raise ParameterError(
            f"{len(keys)} keys × {options.layers} layers × {options.seconds:g} s "
            f"are more than {MOST_SAMPLE_SECONDS:,.0f} s; ask for fewer --layers, --keys or --seconds"
        )
    if not keys:
        raise ParameterError("keys=[]: give the MIDI keys to sample")
    for key in keys:
        instrument.note(key, 64)


def _check_target(out: Path, force: bool) -> None:
    """Reject a target that is not empty, unless it is an export and `force` is set."""
    name = printable(out)
    if not out.parent.is_dir():
        raise OutputError(f"{name}: folder {printable(out.parent)} does not exist; create it, or choose another --out")
    if not out.exists():
        return
    has_files = out.is_dir() and any(out.iterdir())
    if not out.is_dir() or (has_files and not _is_export(out)):
        raise OutputError(f"{name}: exists and is not an export; choose another --out")
    if has_files and not force:
        raise OutputError(f"{name}: the folder is not empty; choose another --out, or replace the export with --force")


def _is_export(folder: Path) -> bool:
    """Return whether a folder contains an export and nothing else: its readme, one text, and samples."""
    names = {path.name for path in folder.iterdir()} - {"samples"}
    endings = tuple(sampler.ending for sampler in SAMPLERS.values())
    if not (folder / "samples").is_dir() or README not in names or len(names) != 2:
        return False
    return (
        (names - {README}).pop().endswith(endings)
        and EXPORT_MARK in (folder / README).read_text(encoding="utf-8", errors="replace")
        and all(SAMPLE.fullmatch(path.name) for path in (folder / "samples").iterdir())
    )


def _write_samples(
    instrument: Instrument,
    work: Path,
    keys: Sequence[int],
    options: ExportOptions,
    progress: Callable[[str, float], None],
) -> tuple[ExportSummary, list[SampledKey]]:
    """Write all samples with one gain."""
    _, seconds, rate, kind = options
    measured = []
    for i, key in enumerate(keys):
        string = StringVoice(instrument.note(key, 64), key, rate)
        measured.append(measure_layers(instrument, string, layer_velocities(options.layers), seconds))
        progress("levels", LEVELS_SHARE * (i + 1) / len(keys))
    peak = max(key.peak for key in measured)
    gain = PEAK_LIMIT / peak if peak > 0 else 1.0
    sampled_keys, frames, size = [], 0, 0
    for i, (key, (low, high), layers) in enumerate(zip(keys, key_ranges(keys), measured, strict=True)):
        string, files = StringVoice(instrument.note(key, 64), key, rate), []
        name = midi_to_note(key).replace("#", "s")  # SFZ reads "#" as the start of a directive
        for zone, begin in zip(layers.zones, layers.begin, strict=True):
            sound = render_sample(instrument, string, zone.velocity, begin, seconds)
            sound = np.clip(gain * zone.sample_gain * sound, -1.0, 1.0)
            files.append(f"samples/{key:03}-{name}-v{zone.velocity:03}.{kind}")
            size += (work / files[-1]).write_bytes(encode_pcm(sound, rate, kind))
            frames += sound.shape[-1]
        sampled_keys.append(SampledKey(key, low, high, damper_rate(key), layers.zones, files))
        progress("samples", LEVELS_SHARE + (1 - LEVELS_SHARE) * (i + 1) / len(keys))
    summary = ExportSummary(
        keys=len(keys),
        unrecorded=len(instrument.unrecorded(keys)),
        transposed=sum(key.high - key.low for key in sampled_keys),
        samples=len(keys) * options.layers,
        seconds=frames / rate,
        bytes=size,
        gain_db=20 * math.log10(gain),
        silent_keys=silent_keys(sampled_keys),
    )
    return summary, sampled_keys


def _file_name(name: str) -> str:
    """A file name of plain letters, which cannot leave its folder whatever the instrument is called."""
    return re.sub(r"[^A-Za-z0-9_]+", "-", name).strip("-")[:64] or "instrument"
