"""How a key rings that was never recorded: its own law's partials, which decay as those of the nearest recorded key.

What neighbouring keys share is how a partial's energy decays, a prompt part and an aftersound, which changes slowly
with frequency. Where its partials lie, how loud they are and which of them a stroke does not reach is the key's own,
and the laws over the keyboard say it. So a partial of a key has

    frequency   its law's
    decay       the mean decay curve, dB over time in units of the law's decay, of the neighbour's partials about that
                frequency, as a sum of exponentials with positive amplitudes: the beats of single partials go, the
                shape stays
    level       its law's through the path
    phases      in every channel those of the neighbour's nearest partial

The neighbour's knock is left out, and keys farther from a recorded one than `REACH` ring by their law:
`benchmarks/unrecorded.py` finds recordings farther away otherwise (docs/instrument.md).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls

from ..model.free_response import level_energy
from ..model.modal_response import ModalResponse
from ..model.modes import mode_frequencies, raised_cosine_weights
from ..model.note import Note
from .collect_fits import of_force

__all__ = ["REACH", "interpolate_keys"]

# Semitones.
REACH = 12
# Standard deviation of the window over frequency in which decay curves are averaged, octaves, and between its centres.
WIDTH, BETWEEN = 1 / 3, 1 / 6
# Decays over the law's that a curve is made of, and times, in units of 1/(the law's decay), at which it is compared.
RATIOS = np.geomspace(0.02, 20, 16)
TIMES = np.concatenate([[0.0], np.geomspace(2e-3, 60, 48)])
# Curves are compared down to so far below their begin, dB, and their smallest parts left out, amplitude.
DOWN = 60.0
LEAST = 1e-5
# Channels that cancel one another may make a partial louder than its mean by no more than 1 over this.
CANCELLED = 0.3
# A law's partials at the most.
MOST_PARTIALS = 512


class _Law(NamedTuple):
    """The partials of a note by its law [partials]."""

    frequency: np.ndarray  # Hz
    decay: np.ndarray  # 1/s
    impulse: np.ndarray  # what 1 N s makes heard, file units over the gain, through the path


class _DonorKey(NamedTuple):
    """What a recorded key lends."""

    rate: int  # Hz
    frequency: np.ndarray  # of its partials by its law, ascending, Hz [partials]
    phase: np.ndarray  # of its partials, complex of size 1, over the law's sign [partials, channels]
    centre: np.ndarray  # of windows, Hz [windows]
    share: np.ndarray  # amplitudes of the `RATIOS` [windows, ratios]


def interpolate_keys(notes: Mapping[int, Note], wanted: Iterable[int]) -> dict[int, Note]:
    """The wanted keys of an instrument, by MIDI number, with the ringing that the nearest keys with one lend them."""
    known = {midi: note.ringing for midi, note in notes.items() if note.ringing is not None}
    lent: dict[int, _DonorKey] = {}
    found = {}
    for midi in wanted:
        near = min(known, key=lambda other: abs(other - midi), default=None)
        if near is not None and abs(near - midi) <= REACH:
            if near not in lent:
                lent[near] = _neighbour(known[near], _law(notes[near]))
            found[midi] = notes[midi]._replace(ringing=_transfer_response(_law(notes[midi]), lent[near]))
    return found


def _law(note: Note) -> _Law:
    g, s = note.geometry, note.string
    beta = np.arange(1, MOST_PARTIALS + 1) * (np.pi / g.length)
    frequency = mode_frequencies(s, g.length, MOST_PARTIALS)
    omega, weight = 2 * np.pi * frequency, raised_cosine_weights(g, MOST_PARTIALS, np)
    if of_force(note.quantity):  # 2 Φ/M_S, over ω, times the tension's (-1)^(k+1) M_S/L ω²/β
        sign = np.where(np.arange(MOST_PARTIALS) % 2, -1.0, 1.0)
        impulse = sign * 2 * weight * omega / (beta * g.length)
    else:
        impulse = 2 * weight / g.mass * np.sin(beta * g.pickup) / (1.0 if note.quantity == "velocity" else omega)
    level = 0.0 if note.path is None else note.path.at(frequency)
    return _Law(frequency, s.b1 + s.b2 * beta**2, impulse * 10 ** (level / 20))


def _neighbour(ringing: ModalResponse, law: _Law) -> _DonorKey:
    numbers = np.unique(ringing.number)
    numbers = numbers[(numbers > 0) & (numbers <= MOST_PARTIALS)]
    curves, phase = [], []
    for number in numbers:
        at = ringing.number == number
        pattern, ratio = ringing.pattern[:, at], -np.real(ringing.pole[at]) / law.decay[number - 1]
        power = (np.abs(pattern) ** 2).mean(axis=0) @ np.exp(-2 * np.outer(ratio, TIMES))
        curves.append(10 * np.log10(np.maximum(power / power[0], 1e-30)))
        strongest = pattern[:, np.argmax(np.abs(pattern).sum(axis=0))]
        phase.append(np.exp(1j * np.angle(strongest)) * np.sign(law.impulse[number - 1]))
    frequency = law.frequency[numbers - 1]
    octave = np.log2(frequency)
    centre = np.arange(octave[0], octave[-1] + BETWEEN, BETWEEN)
    away = np.abs(centre[:, None] - octave)
    # Where no partial is near, the nearest counts.
    weight = np.exp(-0.5 * (away / WIDTH) ** 2) + 1e-9 * np.exp(-away / WIDTH)
    share = np.stack([_exponentials(curve) for curve in weight @ curves / weight.sum(axis=1, keepdims=True)])
    return _DonorKey(ringing.rate, frequency, np.array(phase), 2**centre, share)


def _exponentials(curve: np.ndarray) -> np.ndarray:
    """Amplitudes [ratios], none negative, whose sum of decays is next to a curve, dB [times], in relative terms."""
    seen = curve > curve[0] - DOWN
    amplitude = 10 ** (curve[seen] / 20)
    parts = np.exp(-np.outer(TIMES[seen], RATIOS)) / amplitude[:, None]
    found, _ = nnls(parts, np.ones(len(amplitude)), maxiter=100 * len(RATIOS))
    return np.where(found > LEAST * found.max(), found, 0.0)


def _transfer_response(law: _Law, near: _DonorKey) -> ModalResponse:
    """The ringing of a key by its law and its neighbour."""
    count = int(np.searchsorted(law.frequency, near.frequency[-1] * 2 ** (0.5 / 12)))
    frequency, decay = law.frequency[:count], law.decay[:count]
    share = near.share[_nearest(frequency, near.centre)]
    phase = near.phase[_nearest(frequency, near.frequency)]
    both = decay[:, None, None] * (RATIOS[:, None] + RATIOS)
    energy = np.einsum("ki,kij,kj->k", share, level_energy(both), share)
    wanted = law.impulse[:count] * np.sqrt(level_energy(2 * decay) / energy)
    mean = np.maximum(np.abs(phase.mean(axis=1)), CANCELLED)
    k, i = np.nonzero(share)
    pattern = (phase / mean[:, None])[k].T * (wanted[k] * share[k, i])
    pole = -RATIOS[i] * decay[k] + 2j * np.pi * frequency[k]
    nothing = np.zeros((len(pattern), 0))
    return ModalResponse(k + 1, pole, np.zeros(len(pole)), pattern, nothing, near.rate)


def _nearest(frequency: np.ndarray, among: np.ndarray) -> np.ndarray:
    return np.abs(np.log(frequency[:, None] / among)).argmin(axis=1)
