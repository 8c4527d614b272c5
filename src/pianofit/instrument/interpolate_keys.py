"""Modal response of a key that was never recorded, from its string model and the decays of the nearest recorded key.

Neighbouring keys share the shape of a partial's decay, a prompt part and an aftersound, which changes slowly with
frequency. Frequencies, levels and partials that a stroke does not excite differ from key to key. The keyboard laws
determine them. So a partial of a key has

    frequency   of the string model
    decay       the mean decay curve of the neighbour's partials about that frequency, dB over time in units of the
                string model's decay. It is a sum of exponentials with positive amplitudes: it keeps the shape without
                the beating of single partials.
    level       of the string model through the path
    phases      of the neighbour's nearest partial, for every channel

The neighbour's knock is not used. Keys farther than `REACH` from a recorded one use the string model alone. Both
choices reduce the distance to left-out recordings (`benchmarks/unrecorded.py`, docs/instrument.md).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls

from ..dsp.level import level_energy
from ..model.modal_response import ModalResponse
from ..model.modes import mode_frequencies, raised_cosine_weights
from ..model.note import Note
from .instrument import Key
from .key_quantities import is_force

# Largest distance to the recorded key, semitones.
REACH = 12
# Windows over frequency in which decay curves are averaged: standard deviation and spacing, octaves.
WIDTH, BETWEEN = 1 / 3, 1 / 6
# Decay rates of the exponentials, over that of the string model. Times at which curves are compared, times that rate.
RATIOS = np.geomspace(0.02, 20, 16)
TIMES = np.concatenate([[0.0], np.geomspace(2e-3, 60, 48)])
# Curves are compared down to this level below their start, dB. Exponentials below this amplitude ratio are discarded.
DOWN = 60.0
LEAST = 1e-5
# Least magnitude of the mean phase over channels. It limits the level of partials whose channels cancel.
CANCELLED = 0.3
# Most partials of a string model.
MOST_PARTIALS = 512


class _StringPartials(NamedTuple):
    """The partials of a note by the string model [partials]."""

    frequency: np.ndarray  # Hz
    decay: np.ndarray  # 1/s
    impulse: np.ndarray  # response to 1 N s through the path, file units over the gain


class _DonorKey(NamedTuple):
    """Decay curves and phases of a recorded key."""

    rate: int  # Hz
    frequency: np.ndarray  # of its partials by the string model, ascending, Hz [partials]
    phase: np.ndarray  # of its partials relative to the string model, magnitude 1 [partials, channels]
    centre: np.ndarray  # of windows, Hz [windows]
    share: np.ndarray  # amplitudes of the `RATIOS` [windows, ratios]


def with_interpolated_responses(keys: Mapping[int, Key]) -> dict[int, Key]:
    """Return all keys. Those that are interpolated get the modal responses of `interpolate_keys`."""
    notes = {midi: key.note for midi, key in keys.items()}
    notes |= interpolate_keys(notes, [midi for midi, key in keys.items() if key.is_interpolated])
    return {midi: replace(key, note=notes[midi]) for midi, key in keys.items()}


def interpolate_keys(notes: Mapping[int, Note], wanted: Iterable[int]) -> dict[int, Note]:
    """The wanted keys by MIDI number, with modal responses from the nearest keys that have one."""
    recorded = {midi: note.modal_response for midi, note in notes.items() if note.modal_response is not None}
    donors: dict[int, _DonorKey] = {}
    found = {}
    for midi in wanted:
        near = min(recorded, key=lambda other: abs(other - midi), default=None)
        if near is not None and abs(near - midi) <= REACH:
            if near not in donors:
                donors[near] = _donor(recorded[near], _string_partials(notes[near]))
            found[midi] = notes[midi]._replace(
                modal_response=_transfer_response(_string_partials(notes[midi]), donors[near])
            )
    return found


def _string_partials(note: Note) -> _StringPartials:
    g, s = note.geometry, note.string
    beta = np.arange(1, MOST_PARTIALS + 1) * (np.pi / g.length)
    frequency = mode_frequencies(s, g.length, MOST_PARTIALS)
    omega, weight = 2 * np.pi * frequency, raised_cosine_weights(g, MOST_PARTIALS, np)
    if is_force(note.quantity):  # 2 Φ/M_S over ω, times (-1)^(k+1) M_S/L ω²/β of the tension
        sign = np.where(np.arange(MOST_PARTIALS) % 2, -1.0, 1.0)
        impulse = sign * 2 * weight * omega / (beta * g.length)
    else:
        impulse = 2 * weight / g.mass * np.sin(beta * g.pickup) / (1.0 if note.quantity == "velocity" else omega)
    level = 0.0 if note.path is None else note.path.at(frequency)
    return _StringPartials(frequency, s.b1 + s.b2 * beta**2, impulse * 10 ** (level / 20))


def _donor(ringing: ModalResponse, string: _StringPartials) -> _DonorKey:
    numbers = np.unique(ringing.partial)
    numbers = numbers[(numbers > 0) & (numbers <= MOST_PARTIALS)]
    curves, phase = [], []
    for number in numbers:
        modes = ringing.partial == number
        pattern, ratio = ringing.pattern[:, modes], -np.real(ringing.pole[modes]) / string.decay[number - 1]
        power = (np.abs(pattern) ** 2).mean(axis=0) @ np.exp(-2 * np.outer(ratio, TIMES))
        curves.append(10 * np.log10(np.maximum(power / power[0], 1e-30)))
        strongest = pattern[:, np.argmax(np.abs(pattern).sum(axis=0))]
        phase.append(np.exp(1j * np.angle(strongest)) * np.sign(string.impulse[number - 1]))
    frequency = string.frequency[numbers - 1]
    octave = np.log2(frequency)
    centre = np.arange(octave[0], octave[-1] + BETWEEN, BETWEEN)
    distance = np.abs(centre[:, None] - octave)
    # The small term selects the nearest partial where none lies in the window.
    weight = np.exp(-0.5 * (distance / WIDTH) ** 2) + 1e-9 * np.exp(-distance / WIDTH)
    share = np.stack([_exponentials(curve) for curve in weight @ curves / weight.sum(axis=1, keepdims=True)])
    return _DonorKey(ringing.rate, frequency, np.array(phase), 2**centre, share)


def _exponentials(curve: np.ndarray) -> np.ndarray:
    """Non-negative amplitudes [ratios] of exponentials that fit a curve, dB [times], with least relative error."""
    used = curve > curve[0] - DOWN
    amplitude = 10 ** (curve[used] / 20)
    parts = np.exp(-np.outer(TIMES[used], RATIOS)) / amplitude[:, None]
    found, _ = nnls(parts, np.ones(len(amplitude)), maxiter=100 * len(RATIOS))
    return np.where(found > LEAST * found.max(), found, 0.0)


def _transfer_response(string: _StringPartials, near: _DonorKey) -> ModalResponse:
    """The modal response of a key from its string model and its neighbour."""
    count = int(np.searchsorted(string.frequency, near.frequency[-1] * 2 ** (0.5 / 12)))
    frequency, decay = string.frequency[:count], string.decay[:count]
    share = near.share[_nearest(frequency, near.centre)]
    phase = near.phase[_nearest(frequency, near.frequency)]
    rate_sums = decay[:, None, None] * (RATIOS[:, None] + RATIOS)
    energy = np.einsum("ki,kij,kj->k", share, level_energy(rate_sums), share)
    wanted = string.impulse[:count] * np.sqrt(level_energy(2 * decay) / energy)
    mean = np.maximum(np.abs(phase.mean(axis=1)), CANCELLED)
    k, i = np.nonzero(share)
    pattern = (phase / mean[:, None])[k].T * (wanted[k] * share[k, i])
    pole = -RATIOS[i] * decay[k] + 2j * np.pi * frequency[k]
    nothing = np.zeros((len(pattern), 0))
    return ModalResponse(k + 1, pole, np.zeros(len(pole)), pattern, nothing, near.rate)


def _nearest(frequency: np.ndarray, among: np.ndarray) -> np.ndarray:
    return np.abs(np.log(frequency[:, None] / among)).argmin(axis=1)
