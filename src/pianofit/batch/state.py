"""How far a batch is, as folders and ledger say it: also from outside, while it is at work."""

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

__all__ = ["document", "status", "suggestions", "time_left"]


def status(folder: Path) -> dict[str, Any]:
    """What folders and ledger in `folder` say; whether a batch is at work there, and for how long still.

    Raises `OutputError` if it is no batch's.
    """
    entries, at_work = read_records(Store(folder)), is_locked(folder)
    if not at_work:  # what a killed batch was at is not running any more
        entries = [e._replace(state="waiting", stage="", began=0.0) if e.state == "running" else e for e in entries]
    return document(folder, entries) | {"at_work": at_work, "seconds_left": _left(entries)}


def document(folder: Path, entries: Sequence[Entry]) -> dict[str, Any]:
    """What is told of a batch with these entries."""
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


def _left(entries: Sequence[Entry]) -> float | None:
    """Seconds left, if keys go on being fitted by as many workers as are running."""
    running = [max(time.time() - e.began, 0.0) for e in entries if e.state == "running"]
    done = [e.seconds for e in entries if e.state == "done" and e.seconds]
    return time_left(done, sum(e.state == "waiting" for e in entries), running, len(running))


def time_left(seconds: Sequence[float], waiting: int, running: Sequence[float], slots: int) -> float | None:
    """Seconds until all is done: the median of finished units for each that waits, shared among the workers.

    `seconds` are of the units that are done, `running` what each at work has taken so far. Such a unit is given what
    it lacks of the median, and never less than a quarter of what it has taken: one that is over its time is not about
    to end.
    """
    if not seconds or not slots:
        return None
    each = statistics.median(seconds)
    rest = [max(each - r, r / 4) for r in running]
    return max((waiting * each + sum(rest)) / slots, max(rest, default=0.0))


def suggestions(entries: Sequence[Entry]) -> list[str]:
    """What the pitches say about the names of the notes."""
    from ..analysis.note_names import note_to_midi

    wrong = [e for e in entries if e.detected_note]
    offset = Counter(note_to_midi(e.detected_note) - note_to_midi(e.note) for e in wrong)
    if not offset:
        return []
    semitones, times = offset.most_common(1)[0]
    if times > 2 and 2 * times > len(entries):
        return [
            f"{times} of {len(entries)} keys sound {counted(abs(semitones), 'semitone')} "
            f"{'above' if semitones > 0 else 'below'} their names: the library counts otherwise; run with "
            f"--transpose {semitones} and another --out"
        ]
    return [f"{e.key}: its name says {e.note}, its pitch {e.detected_note}; correct its note" for e in wrong]
