"""The payload of a page: an instrument as JSON, with arrays in base64.

Knocks take most of the size. They get the highest sample rate and the most bits that the size of the page allows.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from ..analysis.note_names import midi_to_note
from ..dsp.filters import resample
from ..errors import ParameterError
from ..instrument.collect_fits import reference_compression
from ..instrument.document import Instrument
from ..model.modal_response import ModalResponse
from ..model.note import Note
from ..parameters import Hammer
from ..playback.voice import CHANNELS, KNOCK_RATES, damper_rate

__all__ = ["KnockEncoding", "encode_note", "intervals", "encode_instrument"]

# Samples of a knock that share a scale.
SCALE_BLOCK = 256
# Significant digits of values and intervals, which are only displayed.
DIGITS = 6
# Sliders of the page that multiply the value of one keyboard law (`instrument.collect_fits`), and the laws of losses.
SLIDERS = {"force": "K/M_S", "mu": "mu", "mass": "M_H/M_S", "strike": "x0/L", "inharmonicity": "B"}
LOSSES = ("b1", "d2")


class KnockEncoding(NamedTuple):
    """Encoding of knocks."""

    rate: float  # highest sample rate, Hz
    bits: int  # 8 or 16, of the largest sample within `SCALE_BLOCK`


# From the best to the smallest. The rate of a knock is never raised.
KNOCK_ENCODINGS = (
    KnockEncoding(math.inf, 16),
    KnockEncoding(KNOCK_RATES[0], 16),
    *(KnockEncoding(rate, 8) for rate in KNOCK_RATES),
)


def encode_instrument(instrument: Instrument, most_bytes: int) -> tuple[dict[str, Any], KnockEncoding | None]:
    """Encode an instrument for the scripts of the page; also return the encoding of its knocks, if it has any.

    Raises `ParameterError` if a felt law cannot be played, or the document exceeds `most_bytes`.
    """
    rates = [n.ringing.rate for n in instrument.notes.values() if n.ringing is not None and n.ringing.knock.size]
    size = 0
    for kept in KNOCK_ENCODINGS if rates else KNOCK_ENCODINGS[:1]:
        document = _document(instrument, kept)
        size = len(json.dumps(document))
        if size <= most_bytes:
            return document, kept._replace(rate=min(kept.rate, max(rates))) if rates else None
    raise ParameterError(
        f"the instrument's tables take {size / 1e6:.2f} MB, and the page has room for {most_bytes / 1e6:.2f} MB; "
        "choose fewer keys"
    )


def _document(instrument: Instrument, knocks: KnockEncoding) -> dict[str, Any]:
    return {
        "name": instrument.name,
        "velocity": {"at_64": instrument.velocity_at_64, "rise": instrument.velocity_slope},
        "keys": [
            {"midi": midi, "note": midi_to_note(midi), "recorded": midi in instrument.recorded,
             "state": instrument.states.get(midi)}
            | encode_note(note, midi, knocks)
            | _values_and_intervals(instrument.values.get(midi, {}))
            for midi, note in sorted(instrument.notes.items())
        ],
    }  # fmt: skip


def _values_and_intervals(laws: Mapping[str, tuple[float, float, float]]) -> dict[str, dict[str, list[float]]]:
    """Intervals of the sliders, and the values of their laws, which the page writes into a saved instrument."""
    values = {law: row for law, row in laws.items() if law in (*SLIDERS.values(), *LOSSES, "p")}
    return {"intervals": _round_digits(intervals(laws)), "values": _round_digits(values)}


def _round_digits(table: Mapping[str, Iterable[float]]) -> dict[str, list[float]]:
    return {name: [float(f"{x:.{DIGITS}g}") for x in row] for name, row in table.items()}


def intervals(laws: Mapping[str, tuple[float, float, float]]) -> dict[str, list[float]]:
    """95 % intervals of the sliders in their units: factors, and differences of p.

    The interval of the losses is that of the decay rate of partial 1, b1 + d2, with independent errors of both.
    """
    by_slider = {slider: [low / value, high / value] for slider, law in SLIDERS.items() if law in laws
                 for value, low, high in [laws[law]] if 0 < low <= value <= high}  # fmt: skip
    if "p" in laws:
        value, low, high = laws["p"]
        by_slider["p"] = [low - value, high - value]
    parts = [laws[law] for law in LOSSES if law in laws]
    if len(parts) == len(LOSSES) and all(0 < low <= value <= high for value, low, high in parts):
        size = math.hypot(*(value * math.log(high / low) / 2 for value, low, high in parts))
        spread = math.exp(size / sum(value for value, _, _ in parts))
        by_slider["loss"] = [1 / spread, spread]
    return by_slider


def encode_note(note: Note, midi: int, knocks: KnockEncoding = KNOCK_ENCODINGS[0]) -> dict[str, Any]:
    """Encode one key for `prepare.js`.

    Raises `ParameterError` for a felt law other than Hunt-Crossley and the power law.
    """
    if type(note.hammer) is not Hammer:
        raise ParameterError(
            f"key {midi_to_note(midi)}: a page plays the Hunt-Crossley felt law, not "
            f"{type(note.hammer).__name__}; fit the key with --felt hunt-crossley"
        )
    entry: dict[str, Any] = {
        part: {name: float(x) for name, x in getattr(note, part)._asdict().items() if name != "v_H0"}
        for part in ("string", "hammer", "geometry")
    } | {
        "quantity": note.quantity, "gain": float(note.gain), "damper": damper_rate(midi),
        "compression": reference_compression(midi),
    }  # fmt: skip
    if note.ringing is not None:
        entry["ringing"] = _ringing(note.ringing.scale_gain(float(note.gain)), knocks)
    elif note.path is not None:
        f = note.path.frequency
        entry["path"] = {"frequency": _base64(f), "db": _base64(note.path.db), "decay": _base64(note.path.decay_at(f))}
    return entry


def _ringing(ringing: ModalResponse, knocks: KnockEncoding) -> dict[str, Any]:
    """Encode a modal response. Frequencies have 64 bits: 32 bits drift by 0.1 rad per minute in the treble."""
    knock, rate = ringing.knock[:CHANNELS], ringing.rate
    if knock.shape[-1] and rate > knocks.rate:
        rate = int(knocks.rate)
        knock = resample(knock, ringing.rate, rate)
    return {
        "decay": _base64(-np.real(ringing.pole)), "omega": _base64(np.imag(ringing.pole), "<f8"),
        "pattern": _rows(ringing.pattern[:CHANNELS]),
        "participation": _participation(ringing),
        "rate": rate, "bits": knocks.bits, "knock": [_quantise(row, knocks.bits) for row in knock],
    }  # fmt: skip


def _participation(ringing: ModalResponse) -> dict[str, Any] | None:
    """Encode velocity gains as 16-bit integers with a scale. With many strokes they dominate the size of the modes."""
    part = ringing.velocity_gain
    if part is None:
        return None
    scale = max(float(np.abs([np.real(part.factor), np.imag(part.factor)]).max()), 1e-30) / (2**15 - 1)
    return {"velocity": part.velocity.tolist(), "scale": scale, "strokes": _rows(part.factor / scale, "<i2")}


def _rows(values: np.ndarray, kind: str = "<f4") -> list[dict[str, str]]:
    return [{"re": _base64(np.real(row), kind), "im": _base64(np.imag(row), kind)} for row in values]


def _quantise(samples: np.ndarray, bits: int) -> dict[str, str]:
    """Encode samples as integers, with a scale for every `SCALE_BLOCK` of them."""
    rows = np.pad(samples, (0, -len(samples) % SCALE_BLOCK)).reshape(-1, SCALE_BLOCK)
    scale = (np.abs(rows).max(axis=1) / (2 ** (bits - 1) - 1)).astype("<f4")
    integers = (rows / np.where(scale > 0, scale, 1.0)[:, None]).ravel()[: len(samples)]
    return {"scale": _base64(scale), "whole": _base64(integers, f"<i{bits // 8}")}


def _base64(values: np.ndarray, kind: str = "<f4") -> str:
    values = np.round(values) if "i" in kind else values
    return base64.b64encode(np.ascontiguousarray(values, kind).tobytes()).decode()
