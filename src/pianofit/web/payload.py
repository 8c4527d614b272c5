"""The payload of a page: an instrument for its scripts, with arrays in base64.

Knocks take most of the size. They share the room that is left, see `knock_encoding`.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..analysis.note_names import midi_to_note
from ..conversions import hertz_of
from ..errors import ParameterError
from ..felt import law_of
from ..felt.soft_skin import SOFT_SKIN, SoftHammer
from ..instrument import Instrument
from ..literature import reference_compression, typical_strings
from ..model.modal_response import ModalResponse
from ..model.note import Note
from ..parameters import Hammer
from ..playback.cached_strike import strike_string, string_tables
from ..playback.voice import CHANNELS
from ..schema.dampers import LAST_DAMPER, Dampers
from ..schema.decode import builtins_of
from ..schema.instrument import KeyValue
from .knock_encoding import (
    BEST,
    EncodedSound,
    KnockEncoding,
    choose_encodings,
    encode_array,
    encoded_knock,
    pack,
    reduce_rate,
)

# Significant digits of values and intervals, which are only displayed.
DIGITS = 6
# Sliders of the page that multiply the value of one keyboard law, and the laws of losses.
SLIDERS = {"force": "F/M_S", "mu": "mu", "mass": "M_H/M_S", "strike": "x0/L", "inharmonicity": "B"}
LOSSES = ("b1", "d2")


# Characters by which the steps of two channels can be longer than those of an empty sound.
SOUND_BYTES = 10
# Velocity of the strokes by which errors of knocks are measured, MIDI: loud ones, whose contacts are short.
LOUD = 100


def encode_instrument(instrument: Instrument, most_bytes: int) -> tuple[dict[str, Any], float | None]:
    """Encode an instrument for the scripts of the page; also return the largest error of its knocks, dB, if it has any.

    The error is relative to the energy of the note.

    Raises
    ------
    ParameterError
        If a felt law cannot be played, or the payload exceeds `most_bytes`.
    """
    knocks = {midi: sound for midi in instrument.keys if (sound := _knock(instrument.note(midi, LOUD), midi))}
    noises = _noises(instrument)
    sounds, error = [*knocks.values(), *noises.values()], None
    chosen: Sequence[KnockEncoding | None] = [None] * len(sounds)
    if sounds:
        empty = _encode(instrument, dict.fromkeys(knocks), dict.fromkeys(noises))
        chosen, error = choose_encodings(sounds, most_bytes - SOUND_BYTES * len(sounds) - len(json.dumps(empty)))
    of_keys, of_noises = chosen[: len(knocks)], chosen[len(knocks) :]
    payload = _encode(instrument, dict(zip(knocks, of_keys, strict=True)), dict(zip(noises, of_noises, strict=True)))
    size = len(json.dumps(payload))
    if size > most_bytes:
        raise ParameterError(
            f"the instrument's tables take {size / 1e6:.2f} MB, and the page has room for {most_bytes / 1e6:.2f} MB; "
            "choose fewer keys"
        )
    return payload, error


def _knock(note: Note, midi: int) -> EncodedSound | None:
    """Return the knock of a key, struck as `note`; None without a knock."""
    response = note.modal_response
    if response is None or not response.knock.size:
        return None
    table = string_tables(note._replace(path=None), response.rate)
    _, force = strike_string(table, note.hammer, f"key {midi_to_note(midi)}")
    return encoded_knock(response.scale_gain(float(note.gain)), force)


def _noises(instrument: Instrument) -> dict[int, EncodedSound]:
    """Return the release noises, with errors relative to their own energy."""
    release = instrument.release
    if release is None:
        return {}
    sounds = {midi: sound[: min(instrument.channels, CHANNELS)] for midi, sound in release.sounds.items()}
    return {
        midi: EncodedSound(sound, release.rate, np.ones(1), float((np.diff(sound) ** 2).sum()))
        for midi, sound in sounds.items()
    }


def _encode(
    instrument: Instrument,
    knocks: Mapping[int, KnockEncoding | None],
    noises: Mapping[int, KnockEncoding | None],
) -> dict[str, Any]:
    """Encode an instrument with these encodings of the knocks and release noises of its keys; None for an empty one."""
    shown = {*SLIDERS.values(), *LOSSES, "p"}
    return {
        "name": instrument.name,
        "velocity": {"at_64": instrument.velocity.at_64, "rise": instrument.velocity.rise},
        "even": instrument.even,
        "bridge": builtins_of(instrument.bridge) if instrument.resonates else None,
        "dampers": builtins_of(instrument.dampers),
        "releases": _releases(instrument, noises),
        "noise": _noise(instrument),
        "keys": [
            {
                "midi": midi,
                "note": midi_to_note(midi),
                "recorded": key.fit is not None,
                "state": key.state,
                **encode_note(key.note, midi, knocks.get(midi, BEST), instrument.dampers),
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


def _releases(instrument: Instrument, noises: Mapping[int, KnockEncoding | None]) -> list[dict[str, Any]]:
    """Encode the release noises as knocks, in as many channels as the page plays of the keys."""
    release = instrument.release
    if release is None:
        return []
    channels = min(instrument.channels, CHANNELS)
    entries = []
    for midi, sound in release.sounds.items():
        knock = _encode_sound(sound[:channels], release.rate, noises[midi])
        entries.append({"midi": midi, "rate": knock["rate"], "sound": knock["knock"]})
    return entries


def _encode_sound(sound: np.ndarray, rate: int, encoding: KnockEncoding | None) -> dict[str, Any]:
    """Encode the channels of a knock, with their rate."""
    if encoding is None:
        sound, encoding = sound[:, :0], BEST
    sound, rate = reduce_rate(sound, rate, encoding.rate)
    return {"rate": rate, "knock": [pack(row, encoding.step) for row in sound]}


def _noise(instrument: Instrument) -> dict[str, Any] | None:
    """Return the noise floor, which the page does not play but saves."""
    noise = instrument.noise
    return None if noise is None else builtins_of(replace(noise, density=noise.density[:CHANNELS]))


def encode_note(
    note: Note, midi: int, knock: KnockEncoding | None = BEST, dampers: Dampers | None = None
) -> dict[str, Any]:
    """Encode one key for `prepare.js`. Without `dampers` it has that of the literature, without `knock` an empty one.

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
        entry["modal_response"] = _modal_response(note.modal_response.scale_gain(float(note.gain)), knock)
    elif note.path is not None:
        f = note.path.frequency
        entry["path"] = {"frequency": encode_array(f, "<f4"), "db": encode_array(note.path.db, "<f4")}
    return entry


def _damper(midi: int, dampers: Dampers) -> dict[str, float] | None:
    """Return the rate of a damper at the fundamental of its key, and its exponent over frequency."""
    if midi > LAST_DAMPER:
        return None
    return {"rate": dampers.rate(midi), "hertz": hertz_of(midi), "slope": dampers.slope}


def _modal_response(response: ModalResponse, knock: KnockEncoding | None) -> dict[str, Any]:
    """Encode a modal response. Frequencies have 64 bits: 32 bits drift by 0.1 rad per minute in the treble."""
    return {
        "partial": encode_array(response.partial, "<u1" if response.partial.max(initial=0) < 256 else "<u2"),
        "decay": encode_array(-np.real(response.pole), "<f4"),
        "omega": encode_array(np.imag(response.pole), "<f8"),
        "modal_amplitudes": _rows(response.pattern[:CHANNELS]),
        "velocity_gain": _velocity_gain(response),
        **_encode_sound(response.continuous_knock()[:CHANNELS], response.rate, knock),
    }


def _velocity_gain(response: ModalResponse) -> dict[str, Any] | None:
    """Encode velocity gains as 16-bit integers with a scale. With many strokes they dominate the size of the modes."""
    gain = response.velocity_gain
    if gain is None:
        return None
    scale = max(float(np.abs([np.real(gain.factor), np.imag(gain.factor)]).max()), 1e-30) / (2**15 - 1)
    return {"velocity": gain.velocity.tolist(), "scale": scale, "strokes": _rows(gain.factor / scale, "<i2")}


def _rows(values: np.ndarray, kind: str = "<f4") -> list[dict[str, str]]:
    return [{"re": encode_array(np.real(row), kind), "im": encode_array(np.imag(row), kind)} for row in values]
