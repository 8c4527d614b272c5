"""Export to a sampler: a folder with one text, a readme, and a sample for every requested key and layer.

All samples share one gain, so that levels over velocity and keys are preserved. A key without its own sample is
transposed from the nearest sampled key.
"""

import math
import os
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..analysis.note_names import midi_to_note
from ..conversions import DB
from ..errors import OutputError, ParameterError, check_range
from ..instrument import Instrument
from ..instrument.release_noise import RECORDED_VELOCITY, ReleaseNoise
from ..io.containers import RATES
from ..io.files import as_path, encode_pcm, printable, temporary_path, write_error
from ..io.interrupts import cleanup_on_interrupt
from ..io.number_format import first_of
from ..playback.voice import CHANNELS, StringVoice
from ..schema.dampers import LAST_DAMPER
from ..threads import numerical_settings
from .formats import EXPORT_MARK, SAMPLERS, readme_text
from .layers import (
    LOUDEST,
    ReleaseSample,
    Sample,
    SampledKey,
    SamplerContent,
    key_ranges,
    played_keys,
    silent_keys,
)
from .samples import ExportOptions, KeySamples, measure_layers, render_resonance_sample, render_sample

# Audio formats of samples.
KINDS = ("flac", "wav")
README = "README.txt"
# File names of samples: key, note, and velocity or kind.
SAMPLE = re.compile(r"\d{3}-[A-G]s?-?\d-(v\d{3}(-soft)?|resonance|release)\.(flac|wav)")
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


@numerical_settings()
def export_sampler(
    instrument: Instrument,
    out: str | os.PathLike[str],
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
        For layers, seconds, rate or kind out of range, a blend that the format lacks, or a key that the instrument
        lacks.
    OutputError
        If `out` cannot be written, exists and is not an export, or is an export and `force` is not set.

    Examples
    --------
    >>> from pathlib import Path
    >>> import pianofit
    >>> piano, options = pianofit.load_instrument("instrument.json"), pianofit.ExportOptions(2, seconds=0.2)
    >>> pianofit.export_sampler(piano, Path("sampler"), [60, 64], options).samples
    6
    """
    if to not in SAMPLERS:
        raise ParameterError(f"to={to!r} must be one of {', '.join(SAMPLERS)}")
    _check(instrument, keys, options, to)
    options = options._replace(resonance=options.resonance and instrument.resonates)
    try:
        out = as_path(out).resolve()
        _check_target(out, force)
        work = temporary_path(out)
        old = work.with_suffix(".old")

        def clean_up() -> None:
            shutil.rmtree(work, ignore_errors=True)
            if old.exists() and not out.exists():  # interrupted between the two renames
                old.rename(out)
            shutil.rmtree(old, ignore_errors=True)

        with cleanup_on_interrupt(clean_up):
            try:
                (work / "samples").mkdir(parents=True)
                title = _file_name(instrument.name)
                file = title + SAMPLERS[to].ending
                summary, content = _write_samples(instrument, work, title, keys, options, progress)
                (work / file).write_text(SAMPLERS[to].text(content), encoding="utf-8")
                (work / README).write_text(readme_text(instrument, file, content, licence), encoding="utf-8")
                _check_target(out, force)  # something else may have written there meanwhile
                if out.exists():
                    out.rename(old)
                work.rename(out)
            finally:
                clean_up()
    except OSError as error:
        raise write_error(out, error, "choose another --out") from error
    return summary


def _check(instrument: Instrument, keys: Sequence[int], options: ExportOptions, to: str) -> None:
    if options.blend not in SAMPLERS[to].blends:
        raise ParameterError(f"blend={options.blend!r} must be one of {', '.join(SAMPLERS[to].blends)} for {to}")
    check_range("layers=", options.layers, 1, LOUDEST)
    if options.una_corda and not instrument.law.has_contact:
        raise ParameterError(f"una_corda=True needs hammers, and these strings are {instrument.law.words.verb}")
    if options.blend != "curves" and options.layers == 1:
        raise ParameterError(
            f"layers=1 with blend={options.blend!r} has one level only; give 2 or more layers, or blend='curves'"
        )
    check_range("rate=", options.rate, RATES[0], HIGHEST_RATE, " Hz")
    check_range("seconds=", options.seconds, 0.1, 120)
    check_range("peak_db=", options.peak_db, -60.0, 0.0, " dB")
    check_range("trim_db=", options.trim_db, 20.0, 200.0, " dB")
    if options.kind not in KINDS:
        raise ParameterError(f"kind={options.kind!r} must be one of {', '.join(KINDS)}")
    samples = options.layers * (1 + options.una_corda) + options.resonance
    if len(keys) * samples * options.seconds > MOST_SAMPLE_SECONDS:
        raise ParameterError(
            f"{len(keys)} keys × {samples} samples × {options.seconds:g} s "
            f"are more than {MOST_SAMPLE_SECONDS:,.0f} s; choose fewer layers= or keys=, or shorter seconds="
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
    if not os.access(out.parent, os.W_OK | os.X_OK):
        raise OutputError(f"{name}: folder {printable(out.parent)} is not writable; choose another --out")
    if not out.exists():
        return
    if os.path.ismount(out) or Path.cwd().is_relative_to(out):
        raise OutputError(f"{name}: holds the working folder or is a mount point; choose a new folder in it as --out")
    has_files = out.is_dir() and any(out.iterdir())
    if not out.is_dir() or (has_files and not _is_export(out)):
        raise OutputError(f"{name}: exists and is not an export; choose another --out")
    if has_files and (others := _other_files(out)):
        raise OutputError(f"{name}: has files that no export writes, {first_of(others)}; remove them")
    if has_files and not force:
        raise OutputError(f"{name}: the folder is not empty; choose another --out, or replace the export with --force")


def _is_export(folder: Path) -> bool:
    """Return whether a folder contains an export: its readme and samples."""
    readme = folder / README
    if not ((folder / "samples").is_dir() and readme.is_file()):
        return False
    return EXPORT_MARK in readme.read_text(encoding="utf-8", errors="replace")


def _other_files(folder: Path) -> list[str]:
    """Return the names of files in a folder that are not those of an export: readme, one text, and samples."""
    endings = tuple(sampler.ending for sampler in SAMPLERS.values())
    names = sorted({path.name for path in folder.iterdir()} - {"samples", README})
    texts = [name for name in names if name.endswith(endings)]
    samples = [path.name for path in (folder / "samples").iterdir() if not SAMPLE.fullmatch(path.name)]
    return [printable(name) for name in [*sorted({*names} - {*texts[:1]}), *samples]]


def _write_samples(
    instrument: Instrument,
    work: Path,
    title: str,
    keys: Sequence[int],
    options: ExportOptions,
    progress: Callable[[str, float], None],
) -> tuple[ExportSummary, SamplerContent]:
    """Write all samples with one gain."""
    measured = []
    for i, key in enumerate(keys):
        measured.append(_measure(instrument, key, options))
        progress("levels", LEVELS_SHARE * (i + 1) / len(keys))
    release = instrument.release
    noises = {} if release is None else _noises(release, options.rate)
    peaks = [float(np.abs(x).max(initial=0.0)) for x in noises.values()]
    peak = max([key.peak for pair in measured for key in pair] + peaks)
    writer = _Writer(instrument, work, 10 ** (options.peak_db / 20) / peak if peak > 0 else 1.0, options)
    sampled_keys = []
    for i, (key, span, pair) in enumerate(zip(keys, key_ranges(keys), measured, strict=True)):
        sampled_keys += writer.key(key, span, pair)
        progress("samples", LEVELS_SHARE + (1 - LEVELS_SHARE) * (i + 1) / len(keys))
    releases = writer.releases(release, noises, sorted(played_keys(sampled_keys))) if release else []
    summary = ExportSummary(
        keys=len(keys),
        unrecorded=len(instrument.unrecorded(keys)),
        transposed=len(played_keys(sampled_keys)) - len(keys),
        samples=writer.samples,
        seconds=writer.frames / options.rate,
        bytes=writer.bytes,
        gain_db=20 * math.log10(writer.gain),
        silent_keys=silent_keys(sampled_keys),
    )
    return summary, SamplerContent(title, sampled_keys, releases, options.blend)


def _measure(instrument: Instrument, midi: int, options: ExportOptions) -> list[KeySamples]:
    """Measure the layers of a key without and, if it is sampled, with the left pedal."""
    string = StringVoice(instrument.note(midi, 64), midi, options.rate)
    return [measure_layers(instrument, string, options, float(soft)) for soft in range(1 + options.una_corda)]


def _noises(release: ReleaseNoise, rate: int) -> dict[int, np.ndarray]:
    """Noises of the recorded keys that are let go after a long note, by key [channels, samples]."""
    return {midi: release.sound(midi, RECORDED_VELOCITY, math.inf, rate)[:CHANNELS] for midi in release.sounds}


class _Writer:
    """Writes the samples of an instrument with one gain, and counts them."""

    def __init__(self, instrument: Instrument, work: Path, gain: float, options: ExportOptions) -> None:
        self.instrument, self.work, self.gain, self.options = instrument, work, gain, options
        self.samples, self.frames, self.bytes = 0, 0, 0

    def key(self, midi: int, span: tuple[int, int], measured: Sequence[KeySamples]) -> list[SampledKey]:
        """Write the samples of a key: strokes without and with the left pedal, and the resonance.

        Keys with and without a damper that play the same samples have entries of their own.
        """
        string = StringVoice(self.instrument.note(midi, 64), midi, self.options.rate)
        strokes = [self._strokes(string, layers, float(soft)) for soft, layers in enumerate(measured)]
        resonance = self._resonance(string, measured[0]) if self.options.resonance else None
        parts = [(span[0], min(span[1], LAST_DAMPER)), (max(span[0], LAST_DAMPER + 1), span[1])]
        rate = self.instrument.dampers.rate
        return [
            SampledKey(midi, low, high, rate(min(max(midi, low), high)), *strokes, resonance=resonance)
            for low, high in parts
            if low <= high
        ]

    def releases(
        self, release: ReleaseNoise, noises: Mapping[int, np.ndarray], played: Sequence[int]
    ) -> list[ReleaseSample]:
        """Write the noises of the recorded keys that are needed, and return the noise of every key that is played."""
        files, found = dict[int, str](), []
        for midi in played:
            source = release.source(midi)
            if source not in files:
                files[source] = self._write(source, "release", noises[source])
            found.append(ReleaseSample(midi, files[source], DB * release.log_gain(midi)))
        return found

    def _strokes(self, string: StringVoice, layers: KeySamples, soft: float) -> list[Sample]:
        """Write the layers of a key at a position of the left pedal, 0 or 1."""
        samples = []
        for zone, begin in zip(layers.zones, layers.begin, strict=True):
            sound = render_sample(self.instrument, string, zone.velocity, begin, self.options, soft)
            ending = f"v{zone.velocity:03}" + ("-soft" if soft else "")
            samples.append(Sample(zone, self._write(string.midi, ending, zone.sample_gain * sound)))
        return samples

    def _resonance(self, string: StringVoice, layers: KeySamples) -> Sample | None:
        """Write what free strings add to the middle layer of a key, or nothing if they are silent."""
        zone, begin = layers.whole, layers.begin[len(layers.begin) // 2]
        sound = render_resonance_sample(self.instrument, string, zone.velocity, begin, self.options)
        if not np.abs(sound).max(initial=0.0) > 0:
            return None
        return Sample(zone, self._write(string.midi, "resonance", zone.sample_gain * sound))

    def _write(self, midi: int, ending: str, sound: np.ndarray) -> str:
        """Write a sound [channels, samples] and return its file, relative to the folder."""
        name = midi_to_note(midi).replace("#", "s")  # SFZ reads "#" as the start of a directive
        file = f"samples/{midi:03}-{name}-{ending}.{self.options.kind}"
        content = encode_pcm(np.clip(self.gain * sound, -1.0, 1.0), self.options.rate, self.options.kind)
        self.bytes += (self.work / file).write_bytes(content)
        self.samples += 1
        self.frames += sound.shape[-1]
        return file


def _file_name(name: str) -> str:
    """A file name of plain letters, which cannot leave its folder whatever the instrument is called."""
    return re.sub(r"[^A-Za-z0-9_]+", "-", name).strip("-")[:64] or "instrument"
