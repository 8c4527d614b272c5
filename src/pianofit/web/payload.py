"""The payload of a page: an instrument for its scripts, with arrays in base64.

Knocks take most of the size. They get the highest sample rate and the most bits that the size of the page allows.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from ..analysis.note_names import midi_to_note
from ..conversions import hertz_of
from ..dsp.filters import resample
from ..errors import ParameterError
from ..felt import law_of
from ..felt.soft_skin import SOFT_SKIN, SoftHammer
from ..instrument import Instrument
from ..instrument.noise_floor import noise_entry
from ..literature import reference_compression, typical_strings
from ..model.modal_response import ModalResponse
from ..model.note import Note
from ..parameters import Hammer
from ..playback.voice import CHANNELS, KNOCK_RATES
from ..schema.dampers import LAST_DAMPER, Dampers
from ..schema.decode import builtins_of
from ..schema.instrument import KeyValue

# Samples of a knock that share a scale.
SCALE_BLOCK = 256
# Significant digits of values and intervals, which are only displayed.
DIGITS = 6
# Sliders of the page that multiply the value of one keyboard law, and the laws of losses.
SLIDERS = {"force": "F/M_S", "mu": "mu", "mass": "M_H/M_S", "strike": "x0/L", "inharmonicity": "B"}
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

    Raises
    ------
    ParameterError
        If a felt law cannot be played, or the payload exceeds `most_bytes`.
    """
    responses = [key.note.modal_response for key in instrument.keys.values()]
    rates = [response.rate for response in responses if response is not None and response.knock.size]
    rates += [] if instrument.release is None else [instrument.release.rate]
    size = 0
    for knocks in KNOCK_ENCODINGS if rates else KNOCK_ENCODINGS[:1]:
        payload = _encode(instrument, knocks)
        size = len(json.dumps(payload))
        if size <= most_bytes:
            return payload, knocks._replace(rate=min(knocks.rate, max(rates))) if rates else None
    raise ParameterError(
        f"the instrument's tables take {size / 1e6:.2f} MB, and the page has room for {most_bytes / 1e6:.2f} MB; "
        "choose fewer keys"
    )


def _encode(instrument: Instrument, knocks: KnockEncoding) -> dict[str, Any]:
    shown = {*SLIDERS.values(), *LOSSES, "p"}
    return {
        "name": instrument.name,
        "velocity": {"at_64": instrument.velocity.at_64, "rise": instrument.velocity.rise},
        "even": instrument.even,
        "bridge": builtins_of(instrument.bridge) if instrument.resonates else None,
        "dampers": builtins_of(instrument.dampers),
        "releases": _releases(instrument, knocks),
        "noise": _noise(instrument),
        "keys": [
            {
                "midi": midi,
                "note": midi_to_note(midi),
                "recorded": key.fit is not None,
                "state": key.state,
                **encode_note(key.note, midi, knocks, instrument.dampers),
                "intervals": {name: _rounded(*span) for name, span in slider_intervals(key.values).items()},
                "values": {name: _rounded(x.value, *x.interval) for name, x in key.values.items() if name in shown},
            }
            for midi, key in sorted(instrument.keys.items())
        ],
    }


def _rounded(*numbers: float) -> list[float]:
    return [float(f"{x:.{DIGITS}g}") for x in numbers]


def slider_intervals(values: Mapping[str, KeyValue]) -> dict[str, tuple[float, float]]:
    """Return the 95 % intervals of the sliders in their units: factors, and differences of p.

    The interval of the losses is that of the decay rate of partial 1, b1 + d2, with independent errors of both.
    """
    intervals = {}
    for slider, law in SLIDERS.items():
        if law in values and _is_positive(values[law]):
            low, high = values[law].interval
            intervals[slider] = (low / values[law].value, high / values[law].value)
    if "p" in values:
        low, high = values["p"].interval
        intervals["p"] = (low - values["p"].value, high - values["p"].value)
    losses = [values[law] for law in LOSSES if law in values]
    if len(losses) == len(LOSSES) and all(map(_is_positive, losses)):
        errors = (loss.value * math.log(loss.interval[1] / loss.interval[0]) / 2 for loss in losses)
        spread = math.exp(math.hypot(*errors) / sum(loss.value for loss in losses))
        intervals["loss"] = (1 / spread, spread)
    return intervals


def _is_positive(value: KeyValue) -> bool:
    """Return whether a value lies in its interval, and all are above zero."""
    return 0 < value.interval[0] <= value.value <= value.interval[1]


def _releases(instrument: Instrument, knocks: KnockEncoding) -> list[dict[str, Any]]:
    """Encode the release noises as knocks, in as many channels as the page plays of the keys."""
    release = instrument.release
    if release is None:
        return []
    channels = min(instrument.channels, CHANNELS)
    encoded = [(midi, *_reduced(sound[:channels], release.rate, knocks)) for midi, sound in release.sounds.items()]
    return [
        {"midi": midi, "rate": rate, "bits": knocks.bits, "sound": [_quantise(row, knocks.bits) for row in sound]}
        for midi, sound, rate in encoded
    ]


def _noise(instrument: Instrument) -> dict[str, Any] | None:
    """Return the noise floor, which the page does not play but saves."""
    entry = noise_entry(instrument.noise)
    return None if entry is None else builtins_of(replace(entry, density=entry.density[:CHANNELS]))


def _reduced(sound: np.ndarray, rate: int, knocks: KnockEncoding) -> tuple[np.ndarray, int]:
    """Reduce the rate of a sound [channels, samples] to that of knocks; also return its rate."""
    if not sound.shape[-1] or rate <= knocks.rate:
        return sound, rate
    return resample(sound, rate, int(knocks.rate)), int(knocks.rate)


def encode_note(
    note: Note, midi: int, knocks: KnockEncoding = KNOCK_ENCODINGS[0], dampers: Dampers | None = None
) -> dict[str, Any]:
    """Encode one key for `prepare.js`. Without `dampers` it has that of the literature.

    Raises
    ------
    ParameterError
        For a relaxing felt and a felt law that is not built in.
    """
    law = law_of(note.hammer)
    if law.key_quantities and not isinstance(note.hammer, Hammer | SoftHammer):
        raise ParameterError(
            f"key {midi_to_note(midi)}: a page does not play a {type(note.hammer).__name__}; fit the key with "
            f"--felt {SOFT_SKIN.name}"
        )
    entry: dict[str, Any] = {
        part: {name: float(x) for name, x in getattr(note, part)._asdict().items() if name != law.size}
        for part in ("string", "hammer", "geometry")
    }
    entry["hammer"] = entry["hammer"] or None  # a pluck has its size only
    entry |= {"quantity": note.quantity, "gain": float(note.gain)}
    entry |= {"damper": _damper(midi, dampers or Dampers()), "strings": typical_strings(midi)}
    entry |= {"compression": reference_compression(midi)}
    if note.modal_response is not None:
        entry["modal_response"] = _modal_response(note.modal_response.scale_gain(float(note.gain)), knocks)
    elif note.path is not None:
        f = note.path.frequency
        entry["path"] = {"frequency": _base64(f), "db": _base64(note.path.db)}
    return entry


def _damper(midi: int, dampers: Dampers) -> dict[str, float] | None:
    """Return the rate of a damper at the fundamental of its key, and its exponent over frequency."""
    hertz = hertz_of(midi)
    rate = float(dampers.rates(midi, np.array([hertz]))[0])
    return None if midi > LAST_DAMPER else {"rate": rate, "hertz": hertz, "slope": dampers.slope}


def _modal_response(response: ModalResponse, knocks: KnockEncoding) -> dict[str, Any]:
    """Encode a modal response. Frequencies have 64 bits: 32 bits drift by 0.1 rad per minute in the treble."""
    knock, rate = _reduced(response.knock[:CHANNELS], response.rate, knocks)
    return {
        "partial": _base64(response.partial, "<u1" if response.partial.max(initial=0) < 256 else "<u2"),
        "decay": _base64(-np.real(response.pole)),
        "omega": _base64(np.imag(response.pole), "<f8"),
        "modal_amplitudes": _rows(response.pattern[:CHANNELS]),
        "velocity_gain": _velocity_gain(response),
        "rate": rate,
        "bits": knocks.bits,
        "knock": [_quantise(row, knocks.bits) for row in knock],
    }


def _velocity_gain(response: ModalResponse) -> dict[str, Any] | None:
    """Encode velocity gains as 16-bit integers with a scale. With many strokes they dominate the size of the modes."""
    gain = response.velocity_gain
    if gain is None:
        return None
    scale = max(float(np.abs([np.real(gain.factor), np.imag(gain.factor)]).max()), 1e-30) / (2**15 - 1)
    return {"velocity": gain.velocity.tolist(), "scale": scale, "strokes": _rows(gain.factor / scale, "<i2")}


def _rows(values: np.ndarray, kind: str = "<f4") -> list[dict[str, str]]:
    return [{"re": _base64(np.real(row), kind), "im": _base64(np.imag(row), kind)} for row in values]


def _quantise(samples: np.ndarray, bits: int) -> dict[str, str]:
    """Encode samples as integers, with a scale for every `SCALE_BLOCK` of them."""
    rows = np.pad(samples, (0, -len(samples) % SCALE_BLOCK)).reshape(-1, SCALE_BLOCK)
    scale = (np.abs(rows).max(axis=1) / (2 ** (bits - 1) - 1)).astype("<f4")
    integers = (rows / np.where(scale > 0, scale, 1.0)[:, None]).ravel()[: len(samples)]
    return {"scale": _base64(scale), "whole": _base64(integers, f"<i{bits // 8}")}


def _base64(values: np.ndarray, kind: str = "<f4") -> str:
    values = np.round(values) if kind[1] in "iu" else values
    return base64.b64encode(np.ascontiguousarray(values, kind).tobytes()).decode()
