"""Results of a batch as a page and as a table: `index.html` and `keys.csv` in its folder.

Both are computed from the folders of the keys and the ledger, so they can be deleted. They are written again while the
batch runs, and at its end. The page plays a recording next to its fit if the file is unchanged and in its place.
"""

import contextlib
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any
from urllib.parse import quote

from ..analysis.note_names import note_to_midi
from ..errors import AnalysisError, FitError, PianofitError
from ..io.files import printable
from ..io.number_format import with_interval
from ..io.table_output import write_csv
from ..recording.recording import load_recording
from ..report import html
from ..report.sound import LIGHT_RATE, Clip, make_clips, seconds_each
from ..report.text import SYMBOLS
from ..schema.fit import Fit, read_fit
from ..schema.modal_response import RENDER_MODELS
from ..schema.quantities import MEANINGS
from .records import Entry, Store, summary
from .traffic_lights import LIGHTS, MATCH_LIMITS, RING_LIMITS, TUNING_LIMITS, lights

WRITE_INTERVAL_S = 60.0  # s, between two writes while a batch is running
# Columns of the page, and the first columns of the table: names in fit.json, and units.
INVARIANTS = {"f0": "Hz", "B": "", "M_H/M_S": "", "x0/L": "", "F/M_S": "N/kg"}
MAX_TOTAL_SAMPLES = 4_000_000  # of all sounds of the page together: 8 MB
MAX_SECONDS = 3.0  # s, of each sound
MIN_SECONDS = 1.0  # s, for any number of sounds


class Index:
    """Page and table in the folder of a batch, written after changes."""

    def __init__(self, store: Store) -> None:
        self.store, self._stale, self._written = store, False, time.monotonic()
        self._page, self._table = store.folder / "index.html", store.folder / "keys.csv"
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
        if self._stale or not (self._page.is_file() and self._table.is_file()):
            self.write()

    def write(self) -> None:
        """Write both files.

        Raises `OutputError` if the folder cannot be written to.
        """
        entries = sorted(self.store.entries(), key=_order)
        done = [entry for entry in entries if entry.state == "done"]
        fits = {entry.key: self._fit(entry) for entry in done}
        table = [*_table_rows(entries, fits)]
        write_csv(self._table, [*table[0]] if table else [], [[*row.values()] for row in table])
        seconds = seconds_each(len(entries), MAX_TOTAL_SAMPLES, MAX_SECONDS, MIN_SECONDS)
        html.write_page(
            self._page,
            "index.html.j2",
            package="pianofit.batch",
            styles=("index.css",),
            scripts=("audio.js", "player.js", "index.js"),
            title=printable(self.store.folder.resolve().name),
            batch=summary(self.store.folder, entries),
            columns=[(SYMBOLS.get(name, name), MEANINGS[name], unit) for name, unit in INVARIANTS.items()],
            lights=LIGHTS,
            limits={"match": MATCH_LIMITS, "tuning": TUNING_LIMITS, "ring": RING_LIMITS},
            left_out=[(entry.key, recording.reason) for entry in done for recording in entry.left_out],
            rows=[self._row(entry, fits[entry.key], seconds) for entry in done],
            failed=[entry for entry in entries if entry.state == "failed"],
        )
        self._stale, self._written = False, time.monotonic()

    def _fit(self, entry: Entry) -> Fit | None:
        """The fit of a key; None if its file was changed or has another schema."""
        with contextlib.suppress(FitError):
            if self.store.verified_content(entry, "fit.json") is not None:
                return read_fit(self.store.keys / entry.key / "fit.json")
        return None

    def _row(self, entry: Entry, fit: Fit | None, seconds: float) -> dict[str, Any]:
        """Row of a key in the page."""
        folder = self.store.keys / entry.key
        invariants, parameters = ({}, {}) if fit is None else (fit.invariants, fit.parameters)
        cells = [(q.value, q.interval) if (q := invariants.get(name)) else (None, None) for name in INVARIANTS]
        files = (name for name in ("report.html", "fit.json") if (folder / name).is_file())
        return {
            "key": entry.key,
            "recordings": len(entry.recordings),
            "warnings": 0 if fit is None else len(fit.warnings),
            "link": next((f"keys/{quote(entry.key)}/{name}" for name in files), ""),
            "lights": lights(entry, fit),
            "measured": [(value, *with_interval(value, interval)) for value, interval in cells],
            "not_identifiable": [SYMBOLS.get(n, n) for n, q in parameters.items() if q.status == "not-identifiable"],
            "clips": self._sounds(entry, fit, seconds),
        }

    def _sounds(self, entry: Entry, fit: Fit | None, seconds: float) -> list[Clip]:
        """The reference recording and its fit, cached until the key is fitted again."""
        version = (entry.hash, seconds)
        if self._clips.get(entry.key, (None,))[0] != version:
            self._clips[entry.key] = version, _recording_and_fit(self.store, entry, fit, seconds)
        return self._clips[entry.key][1]


def _order(entry: Entry) -> tuple[str, int]:
    """Sort key: instrument, then pitch."""
    try:
        midi = note_to_midi(entry.note)
    except AnalysisError:  # a damaged record
        midi = 0
    return entry.key.removesuffix(entry.note.replace("#", "s")), midi


def _recording_and_fit(store: Store, entry: Entry, fit: Fit | None, seconds: float) -> list[Clip]:
    """Excerpts of recording and fit, equally loud. Empty if one of the files is missing or was changed."""
    if fit is None:
        return []
    try:
        recording = load_recording(fit.reference.file, channel=entry.settings.channel)
        fitted = load_recording(store.keys / entry.key / "fitted.wav")
    except PianofitError:
        return []
    if recording.sha256 != fit.reference.sha256 or fitted.rate != recording.rate:
        return []
    sounds, rate = {"original": recording.samples, "fitted": fitted.samples}, recording.rate
    return make_clips(sounds, rate, recording.onset / rate, seconds=seconds, highest_rate=LIGHT_RATE, of=entry.key)


def _table_rows(entries: Sequence[Entry], fits: Mapping[str, Fit | None]) -> Iterator[dict[str, Any]]:
    """One row of the table for every key, by column. Every number has its 95 % interval and is in SI units."""
    names = dict.fromkeys(name for fit in fits.values() if fit is not None for name in fit.parameters)
    for entry in entries:
        fit = fits.get(entry.key)
        response = None if fit is None else fit.modal_response
        values = {} if fit is None else {**fit.invariants, **fit.parameters}
        cells = {
            "key": entry.key,
            "note": entry.note,
            "state": entry.state,
            "reason": printable(entry.reason),
            "recordings": len(entry.recordings),
            "recordings left out": len(entry.left_out),
            "converged": "" if fit is None else fit.converged,
            "levels dB": None if fit is None else fit.levels.fitted_db,
            "layers left out dB": None if response is None else response.prediction_error_db,
            "render model": "" if fit is None else RENDER_MODELS[0] if response is None else response.render_model,
            "seconds": entry.seconds or None,
        }
        for name in (*INVARIANTS, *names):
            quantity = values.get(name)
            low, high = (quantity and quantity.interval) or (None, None)
            cells |= {name: quantity and quantity.value, f"{name} low": low, f"{name} high": high}
        yield cells | {f"{name} status": values[name].status if name in values else "" for name in names}
