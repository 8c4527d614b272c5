"""All files of a tuning: page, table, JSON and the file of Entropy Piano Tuner."""

import os
from collections.abc import Iterator
from typing import Any

from ..errors import check_type
from ..io.files import as_path, replace_file
from ..io.number_format import counted, number
from ..io.table_output import write_csv
from ..schema.decode import encode_json
from ..schema.tuning import TunedKey, Tuning
from .curves import OCTAVE_TYPES
from .entropy_piano_tuner import entropy_piano_tuner_file
from .page import span_text, write_page

JSON_FILE, PAGE_FILE, TABLE_FILE, EPT_FILE = "tuning.json", "tuning.html", "tuning.csv", "tuning.ept"
# Columns of the table with a value and both ends of its interval, and the fields of a key.
COLUMNS = {
    "f0_hz": "f0",
    "B": "B",
    "as_found_hz": "first_partial",
    "as_found_cents": "as_found",
    "law_cents": "law",
    "target_hz": "target",
    "change_cents": "change",
    "deviation_cents": "deviation",
    "unison_cents": "unison_cents",
}
# Keys whose numbers stand in the summary.
SHOWN = ("A0", "C2", "A3", "A4", "C6", "C8")
# Beats that the summary lists for a key, from the lowest partial on.
LISTED_BEATS = 4


def write_tuning(folder: str | os.PathLike[str], tuning: Tuning) -> None:
    """Write the page, a CSV table, all numbers as JSON, and a file for the program Entropy Piano Tuner.

    Parameters
    ----------
    folder : existing folder.
    tuning : as `pianofit.tuning` returns it.

    Returns
    -------
    None.

    Raises
    ------
    OutputError
        If a file cannot be written.

    Examples
    --------
    >>> from pathlib import Path
    >>> import pianofit
    >>> Path("tuned").mkdir()
    >>> pianofit.write_tuning("tuned", pianofit.tuning("batch", prefix="cp80"))
    >>> sorted(file.name for file in Path("tuned").iterdir())
    ['tuning.csv', 'tuning.ept', 'tuning.html', 'tuning.json']
    """
    check_type("tuning=", tuning, Tuning, "a Tuning, as pianofit.tuning returns it")
    folder = as_path(folder)
    write_csv(folder / TABLE_FILE, *_table(tuning))
    replace_file(folder / EPT_FILE, entropy_piano_tuner_file(tuning))
    replace_file(folder / JSON_FILE, encode_json(tuning))
    write_page(folder / PAGE_FILE, tuning)


def _table(tuning: Tuning) -> tuple[list[str], list[list[Any]]]:
    """Return the header and the rows of the table of all keys."""
    curves = [f"curve_{name.replace(':', '_')}_cents" for name in OCTAVE_TYPES]
    triples = [f"{name}{end}" for name in (*COLUMNS, *curves) for end in ("", "_low", "_high")]
    return ["key", "midi", "recorded", *triples], [[*_cells(key)] for key in tuning.keys]


def _cells(key: TunedKey) -> Iterator[Any]:
    yield from (key.note, key.midi, int(key.recorded))
    values = [getattr(key, field) for field in COLUMNS.values()] + [key.curves[name] for name in OCTAVE_TYPES]
    for it in values:
        yield from (None, None, None) if it is None else (it.value, *it.interval)


def tuning_summary(tuning: Tuning) -> str:
    """Return a summary in some lines: pitch and inharmonicity, target and change of some keys, and the lists."""
    keys = {key.note: key for key in tuning.keys}
    recorded = sum(key.recorded for key in tuning.keys)
    lines = [
        f"{tuning.name or 'piano'}: {counted(recorded, 'key')} recorded, {len(keys) - recorded} inferred; target "
        f"A4 = {number(tuning.a4)} Hz, {tuning.octave} octaves. Brackets are 95 % intervals.",
        f"{'':4}{'B':>38}{'as found, cents':>25}{'target, Hz':>12}{'change, cents':>25}",
    ]
    for note in SHOWN:
        key = keys[note]
        found, change = span_text(key.as_found), span_text(key.change)
        lines.append(f"{note:4}{span_text(key.B, 3):>38}{found:>25}{key.target.value:>12.3f}{change:>25}")
    lines.append(f"A4 as found: {span_text(keys['A4'].first_partial, 5)} Hz")
    lines += [f"off its law: {note} by {span_text(keys[note].deviation)} cents" for note in tuning.off]
    lines += [f"wide unison: {note}, {_beats(keys[note])}" for note in tuning.wide_unisons]
    return "\n".join([*lines, *tuning.warnings]) + "\n"


def _beats(key: TunedKey) -> str:
    rates = ", ".join(f"{beat.rate.value:.2f} Hz at partial {beat.partial}" for beat in key.beats[:LISTED_BEATS])
    return f"{span_text(key.unison_cents)} cents: {rates}"
