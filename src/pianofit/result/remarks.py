"""The warnings of several recordings in few lines: what many of them share is one line that names them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..analysis import Analysis, beating_warning, count_beating
from ..conversions import BEAT
from ..io.files import printable
from ..recording.recording import Recording

__all__ = ["remarks"]


def remarks(recordings: Sequence[Recording], analyses: Sequence[Analysis]) -> list[str]:
    """The warnings of all recordings.

    Parameters
    ----------
    recordings, analyses
        Of one key, in the same order.

    Returns
    -------
    list of str
        One line a warning, however many recordings it concerns. The line of beats comes last. A single recording has
        its warnings in one line and is not named.
    """
    warnings = [(*r.warnings, *a.warnings) for r, a in zip(recordings, analyses, strict=True)]
    if len(recordings) == 1:
        return ["; ".join(warnings[0])] if warnings[0] else []
    names = [printable(Path(recording.path).name) for recording in recordings]
    concerned: dict[str, list[str]] = {}
    for name, own, analysis in zip(names, warnings, analyses, strict=True):
        for warning in own:
            if warning != beating_warning(analysis.partials):
                concerned.setdefault(warning, []).append(name)
    shared = [f"{_listed(found, len(names))}: {warning}" for warning, found in concerned.items()]
    return shared + _beats(names, analyses)


def _listed(names: Sequence[str], count: int) -> str:
    return f"all {count} recordings" if len(names) == count else ", ".join(names)


def _beats(names: Sequence[str], analyses: Sequence[Analysis]) -> list[str]:
    """One line for the recordings that beat, with how many of their partials do."""
    counts = [(name, count_beating(one.partials), len(one.partials)) for name, one in zip(names, analyses, strict=True)]
    found = [f"{name} ({deep} of {partials} partials)" for name, deep, partials in counts if deep]
    if not found:
        return []
    return [
        f"Beats in {len(found)} of {len(names)} recordings: {', '.join(found)}. These partials leave an even decay by "
        f"more than {BEAT:g} dB: more than one string or polarisation, or a note that was damped or cut."
    ]
