"""Warnings of several recordings, with one line for a warning that many of them share."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..analysis import Analysis, beating_warning, count_beating
from ..conversions import BEATING_DB
from ..io.files import printable
from ..recording.recording import Recording

__all__ = ["mixed_format_warnings", "recording_warnings"]


def recording_warnings(recordings: Sequence[Recording], analyses: Sequence[Analysis]) -> list[str]:
    """The warnings of all recordings.

    Parameters
    ----------
    recordings, analyses
        The recordings of one key and their analyses, in the same order.

    Returns
    -------
    list of str
        One line for each warning, with the names of its recordings. The line on beating comes last. The warnings of a
        single recording form one line without its name.
    """
    warnings = [(*r.warnings, *a.warnings) for r, a in zip(recordings, analyses, strict=True)]
    if len(recordings) == 1:
        return ["; ".join(warnings[0])] if warnings[0] else []
    names = [printable(Path(recording.path).name) for recording in recordings]
    files: dict[str, list[str]] = {}
    for name, own, analysis in zip(names, warnings, analyses, strict=True):
        for warning in own:
            if warning != beating_warning(analysis.partials):
                files.setdefault(warning, []).append(name)
    shared = [f"{_listed(own, len(names))}: {warning}" for warning, own in files.items()]
    return shared + _beating(names, analyses)


def _listed(names: Sequence[str], count: int) -> str:
    return f"all {count} recordings" if len(names) == count else ", ".join(names)


def _beating(names: Sequence[str], analyses: Sequence[Analysis]) -> list[str]:
    """One line with the recordings that beat, and how many of their partials do."""
    counts = [(name, count_beating(one.partials), len(one.partials)) for name, one in zip(names, analyses, strict=True)]
    beating = [f"{name} ({deep} of {partials} partials)" for name, deep, partials in counts if deep]
    if not beating:
        return []
    return [
        f"Beating in {len(beating)} of {len(names)} recordings: {', '.join(beating)}. These partials deviate from an "
        f"exponential decay by more than {BEATING_DB:g} dB. Possible causes are several strings, two polarisations, or "
        "a note that was damped or cut."
    ]


def mixed_format_warnings(recordings: Sequence[Recording]) -> list[str]:
    """Warnings about recordings of a key that differ in their channels or sample rates."""
    properties = (
        ("channels", lambda recording: len(recording.frames), "The sound of the key is mono"),
        ("sample rates", lambda recording: recording.rate, "All are resampled to the highest"),
    )
    lines = []
    for name, value_of, consequence in properties:
        values = {printable(Path(recording.path).name): value_of(recording) for recording in recordings}
        if len({*values.values()}) > 1:
            listed = ", ".join(f"{file} {value}" for file, value in values.items())
            lines.append(f"The recordings differ in their {name} ({listed}). {consequence}.")
    return lines
