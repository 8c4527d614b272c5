"""State of a batch, read from its folders and ledger. Other processes can read it while the batch runs."""

from __future__ import annotations

import statistics
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..io.number_format import counted
from .job_records import Entry, read_records
from .store import Store, is_locked

__all__ = ["summary", "status", "suggestions", "time_left"]


def status(folder: Path) -> dict[str, Any]:
    """States of all keys in `folder`, whether a batch runs there, and its remaining time.

    Raises `OutputError` if the folder does not hold a batch.
    """
    entries, at_work = read_records(Store(folder)), is_locked(folder)
    if not at_work:  # keys that a killed batch was fitting are not running any more
        entries = [e._replace(state="waiting", stage="", started=0.0) if e.state == "running" else e for e in entries]
    return summary(folder, entries) | {"at_work": at_work, "seconds_left": _seconds_left(entries)}


def summary(folder: Path, entries: Sequence[Entry]) -> dict[str, Any]:
    """Summary of a batch with these entries."""
    count = Counter(e.state for e in entries)
    seconds = [e.seconds for e in entries if e.state == "done"]
    return {
        "folder": str(folder),
        "counts": {state: count[state] for state in ("done", "failed", "running", "waiting")},
        "median_seconds": round(statistics.median(seconds), 3) if seconds else None,
        "largest_memory": max((e.memory for e in entries), default=0),
        "suggestions": suggestions(entries),
        "keys": [e._asdict() for e in entries],
    }


def _seconds_left(entries: Sequence[Entry]) -> float | None:
    """Remaining time, s, if the number of running workers stays the same."""
    running = [max(time.time() - e.started, 0.0) for e in entries if e.state == "running"]
    done = [e.seconds for e in entries if e.state == "done" and e.seconds]
    return time_left(done, sum(e.state == "waiting" for e in entries), running, len(running))


def time_left(seconds: Sequence[float], waiting: int, running: Sequence[float], slots: int) -> float | None:
    """Estimated remaining time of a batch, s. None before the first job is done, or without workers.

    A waiting job takes the median time of the finished jobs. A running job takes the rest of that median, but at least
    a quarter of its elapsed time. A job past the median is not about to end.

    Parameters
    ----------
    seconds : times of the finished jobs.
    waiting : number of waiting jobs.
    running : elapsed times of the running jobs, s.
    slots : number of workers.
    """
    if not seconds or not slots:
        return None
    median = statistics.median(seconds)
    remaining = [max(median - elapsed, elapsed / 4) for elapsed in running]
    return max((waiting * median + sum(remaining)) / slots, max(remaining, default=0.0))


def suggestions(entries: Sequence[Entry]) -> list[str]:
    """Corrections of note names that the detected pitches suggest."""
    from ..analysis.note_names import note_to_midi

    wrong = [e for e in entries if e.detected_note]
    offset = Counter(note_to_midi(e.detected_note) - note_to_midi(e.note) for e in wrong)
    if not offset:
        return []
    semitones, times = offset.most_common(1)[0]
    if times > 2 and 2 * times > len(entries):
        return [
            f"{times} of {len(entries)} keys sound {counted(abs(semitones), 'semitone')} "
            f"{'above' if semitones > 0 else 'below'} their names: the library numbers octaves differently; run with "
            f"--transpose {semitones} and another --out"
        ]
    return [f"{e.key}: its name says {e.note}, its pitch {e.detected_note}; correct its note" for e in wrong]
