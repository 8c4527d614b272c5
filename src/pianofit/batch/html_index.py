"""What a batch found, to look at and to compute with: `index.html` and `keys.csv` in its folder.

Both are made of the keys' folders and the ledger, and can be lost. They are written anew while the batch goes on, and
at its end. A recording is heard beside its fit as long as it lies where it was fitted, and is the same.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Sequence
from typing import Any
from urllib.parse import quote

from ..analysis.note_names import note_to_midi
from ..errors import AnalysisError, PianofitError
from ..io.files import FIT_SCHEMA, printable, reference_of
from ..io.number_format import with_interval
from ..io.table_output import write_csv
from ..recording.recording import load_recording
from ..report import html
from ..report.sound import LIGHT_RATE, Clip, make_clips, seconds_each
from ..report.text import SYMBOLS
from .job_records import Entry, read_records
from .state import document
from .store import Store
from .traffic_lights import LIGHTS, MATCH, RING, TUNING, lights

__all__ = ["CSV_FILE", "INDEX_FILE", "Index"]

INDEX_FILE, CSV_FILE = "index.html", "keys.csv"
# Between two writings while a batch is at work, s.
EVERY = 60.0
# What of a key leads on, where it is there.
PAGES = ("report.html", "fit.json")
# What needs no assumed size: the page's columns, the table's first. By name in fit.json: words for a column, unit
INVARIANTS = {
    "f0": ("fundamental frequency without stiffness", "Hz"), "B": ("inharmonicity", ""),
    "M_H/M_S": ("hammer mass over string mass", ""), "x0/L": ("strike position over string length", ""),
    "F/M_S": ("static force of the felt at one compression, over string mass", "N/kg"),
}  # fmt: skip
# Of the page's sounds all together: 8 MB.
SAMPLES = 4_000_000
LONGEST = 3.0  # s, of each of them,
SHORTEST = 1.0  # s, however many there are


class Index:
    """The two files of a batch's folder, written when something has changed."""

    def __init__(self, store: Store) -> None:
        self.store, self._stale, self._written = store, False, time.monotonic()
        self._clips: dict[str, tuple[tuple, list[Clip]]] = {}

    def changed(self) -> None:
        """Note that a key has ended."""
        self._stale = True

    def show(self) -> None:
        """Write, if something has changed and the last time is a while ago."""
        if self._stale and time.monotonic() - self._written > EVERY:
            self.write()

    def close(self) -> None:
        """Write, if something has changed or nothing is there."""
        if self._stale or not all((self.store.folder / name).is_file() for name in (INDEX_FILE, CSV_FILE)):
            self.write()

    def write(self) -> None:
        """Write both; an `OutputError` if the folder cannot be written to."""
        entries = sorted(read_records(self.store), key=_order)
        found = {e.key: (e, self._fit(e.key)) for e in entries if e.state == "done"}
        write_csv(self.store.folder / CSV_FILE, *table(entries, {key: fit for key, (_, fit) in found.items()}))
        seconds = seconds_each(len(entries), SAMPLES, LONGEST, SHORTEST)
        html.write_page(
            self.store.folder / INDEX_FILE, "index.html.j2", package="pianofit.batch", styles=("index.css",),
            scripts=("audio.js", "player.js", "index.js"), strict=False,
            title=printable(self.store.folder.resolve().name), told=document(self.store.folder, entries),
            columns=[(SYMBOLS.get(name, name), *about) for name, about in INVARIANTS.items()],
            lights=LIGHTS, limits={"match": MATCH, "tuning": TUNING, "ring": RING},
            left_out=[(e.key, one["reason"]) for e, _ in found.values() for one in e.left_out],
            rows=[_row(self.store, entry, fit) | {"clips": self._sounds(entry, fit, seconds)}
                  for entry, fit in found.values()],
            failed=[e for e in entries if e.state == "failed"],
        )  # fmt: skip
        self._stale, self._written = False, time.monotonic()

    def _fit(self, key: str) -> dict[str, Any]:
        """What a key's fit.json says; nothing of one that was changed since, or is of another schema."""
        fit = json.loads(self.store.content(key, "fit.json") or b"{}")
        return fit if fit.get("schema") == FIT_SCHEMA else {}

    def _sounds(self, entry: Entry, fit: dict[str, Any], seconds: float) -> list[Clip]:
        """The reference recording and its fit, kept until the key is fitted anew."""
        what = (entry.hash, seconds)
        if self._clips.get(entry.key, (None,))[0] != what:
            self._clips[entry.key] = what, _heard(self.store, entry.key, fit, seconds)
        return self._clips[entry.key][1]


def _order(entry: Entry) -> tuple[str, int]:
    """By instrument, then by pitch."""
    try:
        midi = note_to_midi(entry.note)
    except AnalysisError:  # a damaged record
        midi = 0
    return entry.key.removesuffix(entry.note.replace("#", "s")), midi


def _heard(store: Store, key: str, fit: dict[str, Any], seconds: float) -> list[Clip]:
    """Recording and fit, cut and equally loud; nothing where one of them is not there any more."""
    (_, row), settings = reference_of(fit.get("recordings")), (store.read_record(key) or {}).get("settings", {})
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
    """What the page says of a key."""
    folder, invariants = store.keys / entry.key, fit.get("invariants", {})
    cells = [invariants.get(name, {}) for name in INVARIANTS]
    measured = [(cell.get("value"), *with_interval(cell.get("value"), cell.get("interval"))) for cell in cells]
    states = {name: one.get("status") for name, one in fit.get("parameters", {}).items()}
    return {
        "key": entry.key, "recordings": entry.recordings, "messages": len(fit.get("messages", ())),
        "link": next((f"keys/{quote(entry.key)}/{n}" for n in PAGES if (folder / n).is_file()), ""),
        "lights": lights(entry, fit), "measured": measured,
        "lost": [SYMBOLS.get(name, name) for name, state in states.items() if state == "not-identifiable"],
    }  # fmt: skip


def _fitted_db(fit: dict[str, Any]) -> float | None:
    """How far the levels of the partials are from the recordings', dB."""
    return fit.get("levels", {}).get("fitted_db")


def _left_out_db(fit: dict[str, Any]) -> float | None:
    """How far layers that took no part are from their recordings, as the key is played, dB."""
    ringing = fit.get("ringing", {})
    return (ringing.get("left_out_db") or {}).get(ringing.get("by"))


def table(entries: Sequence[Entry], fits: dict[str, dict[str, Any]]) -> tuple[list[str], Iterator[list[Any]]]:
    """The header and a row for every key, every number with its 95 % interval, in SI units."""
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
