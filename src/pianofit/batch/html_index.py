"""Results of a batch as a page and as a table: `index.html` and `keys.csv` in its folder.

Both are computed from the folders of the keys and the ledger, so they can be deleted. They are written again while the
batch runs, and at its end. The page plays a recording next to its fit if the file is unchanged and in its place.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Sequence
from typing import Any
from urllib.parse import quote

from ..analysis.note_names import note_to_midi
from ..errors import AnalysisError, PianofitError
from ..io.files import FIT_SCHEMA, printable, reference_row
from ..io.number_format import with_interval
from ..io.table_output import write_csv
from ..recording.recording import load_recording
from ..report import html
from ..report.sound import LIGHT_RATE, Clip, make_clips, seconds_each
from ..report.text import SYMBOLS
from .job_records import Entry, read_records
from .state import summary
from .store import Store
from .traffic_lights import LIGHTS, MATCH_LIMITS, RING_LIMITS, TUNING_LIMITS, lights

__all__ = ["CSV_FILE", "INDEX_FILE", "Index"]

INDEX_FILE, CSV_FILE = "index.html", "keys.csv"
# s, between two writes while a batch is running.
WRITE_INTERVAL_S = 60.0
# Files of a key to which its row links; the first that exists is used.
LINKED_FILES = ("report.html", "fit.json")
# Columns of the page, and the first columns of the table. By name in fit.json: description and unit.
INVARIANTS = {
    "f0": ("fundamental frequency without stiffness", "Hz"), "B": ("inharmonicity", ""),
    "M_H/M_S": ("hammer mass over string mass", ""), "x0/L": ("strike position over string length", ""),
    "F/M_S": ("static force of the felt at one compression, over string mass", "N/kg"),
}  # fmt: skip
MAX_TOTAL_SAMPLES = 4_000_000  # of all sounds of the page together: 8 MB
MAX_SECONDS = 3.0  # s, of each sound
MIN_SECONDS = 1.0  # s, for any number of sounds


class Index:
    """Page and table in the folder of a batch, written after changes."""

    def __init__(self, store: Store) -> None:
        self.store, self._stale, self._written = store, False, time.monotonic()
        self._clips: dict[str, tuple[tuple, list[Clip]]] = {}

    def changed(self) -> None:
        """Record that a key has ended."""
        self._stale = True

    def write_if_due(self) -> None:
        """Write both files if a key has ended and the last write is more than `WRITE_INTERVAL_S` seconds ago."""
        if self._stale and time.monotonic() - self._written > WRITE_INTERVAL_S:
            self.write()

    def close(self) -> None:
        """Write both files if a key has ended or a file is missing."""
        if self._stale or not all((self.store.folder / name).is_file() for name in (INDEX_FILE, CSV_FILE)):
            self.write()

    def write(self) -> None:
        """Write both files.

        Raises `OutputError` if the folder cannot be written to.
        """
        entries = sorted(read_records(self.store), key=_order)
        done = {e.key: (e, self._fit(e.key)) for e in entries if e.state == "done"}
        write_csv(self.store.folder / CSV_FILE, *table(entries, {key: fit for key, (_, fit) in done.items()}))
        seconds = seconds_each(len(entries), MAX_TOTAL_SAMPLES, MAX_SECONDS, MIN_SECONDS)
        html.write_page(
            self.store.folder / INDEX_FILE, "index.html.j2", package="pianofit.batch", styles=("index.css",),
            scripts=("audio.js", "player.js", "index.js"), strict=False,
            title=printable(self.store.folder.resolve().name), batch=summary(self.store.folder, entries),
            columns=[(SYMBOLS.get(name, name), *about) for name, about in INVARIANTS.items()],
            lights=LIGHTS, limits={"match": MATCH_LIMITS, "tuning": TUNING_LIMITS, "ring": RING_LIMITS},
            left_out=[(e.key, recording["reason"]) for e, _ in done.values() for recording in e.left_out],
            rows=[_row(self.store, entry, fit) | {"clips": self._sounds(entry, fit, seconds)}
                  for entry, fit in done.values()],
            failed=[e for e in entries if e.state == "failed"],
        )  # fmt: skip
        self._stale, self._written = False, time.monotonic()

    def _fit(self, key: str) -> dict[str, Any]:
        """Content of the fit.json of a key; empty if the file was changed or has another schema."""
        fit = json.loads(self.store.verified_content(key, "fit.json") or b"{}")
        return fit if fit.get("schema") == FIT_SCHEMA else {}

    def _sounds(self, entry: Entry, fit: dict[str, Any], seconds: float) -> list[Clip]:
        """The reference recording and its fit, cached until the key is fitted again."""
        version = (entry.hash, seconds)
        if self._clips.get(entry.key, (None,))[0] != version:
            self._clips[entry.key] = version, _recording_and_fit(self.store, entry.key, fit, seconds)
        return self._clips[entry.key][1]


def _order(entry: Entry) -> tuple[str, int]:
    """Sort key: instrument, then pitch."""
    try:
        midi = note_to_midi(entry.note)
    except AnalysisError:  # a damaged record
        midi = 0
    return entry.key.removesuffix(entry.note.replace("#", "s")), midi


def _recording_and_fit(store: Store, key: str, fit: dict[str, Any], seconds: float) -> list[Clip]:
    """Excerpts of recording and fit, equally loud. Empty if one of the files is missing or was changed."""
    (_, row), settings = reference_row(fit.get("recordings")), (store.read_record(key) or {}).get("settings", {})
    try:
        recording = load_recording(row.get("file", ""), channel=settings.get("channel", "average"))
        fitted = load_recording(store.keys / key / "fitted.wav")
    except PianofitError:
        return []
    if recording.sha256 != row["sha256"] or fitted.rate != recording.rate:
        return []
    sounds, rate = {"original": recording.samples, "fitted": fitted.samples}, recording.rate
    return make_clips(sounds, rate, recording.onset / rate, seconds=seconds, highest_rate=LIGHT_RATE)


def _row(store: Store, entry: Entry, fit: dict[str, Any]) -> dict[str, Any]:
    """Row of a key in the page."""
    folder, invariants = store.keys / entry.key, fit.get("invariants", {})
    cells = [invariants.get(name, {}) for name in INVARIANTS]
    measured = [(cell.get("value"), *with_interval(cell.get("value"), cell.get("interval"))) for cell in cells]
    statuses = {name: parameter.get("status") for name, parameter in fit.get("parameters", {}).items()}
    return {
        "key": entry.key, "recordings": entry.recordings, "messages": len(fit.get("messages", ())),
        "link": next((f"keys/{quote(entry.key)}/{n}" for n in LINKED_FILES if (folder / n).is_file()), ""),
        "lights": lights(entry, fit), "measured": measured,
        "not_identifiable": [SYMBOLS.get(n, n) for n, status in statuses.items() if status == "not-identifiable"],
    }  # fmt: skip


def _fitted_db(fit: dict[str, Any]) -> float | None:
    """Difference between the levels of the partials in fit and recordings, rms, dB."""
    return fit.get("levels", {}).get("fitted_db")


def _left_out_db(fit: dict[str, Any]) -> float | None:
    """Difference between layers that were left out and their prediction, dB."""
    ringing = fit.get("ringing", {})
    return (ringing.get("left_out_db") or {}).get(ringing.get("by"))


def table(entries: Sequence[Entry], fits: dict[str, dict[str, Any]]) -> tuple[list[str], Iterator[list[Any]]]:
    """Header and one row for every key. Every number has its 95 % interval and is in SI units."""
    names = dict.fromkeys(name for fit in fits.values() for name in fit.get("parameters", {}))
    columns = [f"{name}{end}" for name in (*INVARIANTS, *names) for end in ("", " low", " high")]
    about = ["key", "note", "state", "reason", "recordings", "recordings left out", "converged", "levels dB",
             "layers left out dB", "rings by", "seconds"]  # fmt: skip

    def row(entry: Entry) -> list[Any]:
        fit = fits.get(entry.key, {})
        values = fit.get("invariants", {}) | fit.get("parameters", {})
        cells = [values.get(name, {}) for name in (*INVARIANTS, *names)]
        return [
            entry.key, entry.note, entry.state, printable(entry.reason), entry.recordings, len(entry.left_out),
            fit.get("converged", ""), _fitted_db(fit), _left_out_db(fit),
            fit.get("ringing", {}).get("by", "law") if fit else "", entry.seconds or None,
            *(x for cell in cells for x in (cell.get("value"), *(cell.get("interval") or (None, None)))),
            *(values.get(name, {}).get("status", "") for name in names),
        ]  # fmt: skip

    return [*about, *columns, *(f"{name} status" for name in names)], map(row, entries)
