"""Levels, decays, phases and channels of the partials of recorded keys, as fields over frequency and key.

The partials of a recorded key show how the instrument passes on what its string does. Their levels are relative to the
string model struck by the hammer of the laws, and not by the hammer of the key's own fit. Otherwise the difference of
the two hammers, which the path of the key makes up for, would appear in keys that are guessed from it.

Partials are averaged in cells of frequency as wide as the bands of the ear, in decibels. A mean of powers would lie
above that by an amount that depends on the number of partials in a cell, and the low cells hold one.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.polynomial.hermite_e import hermegauss

from ..conversions import DB
from ..dsp.knock_band import BAND
from ..dsp.level import level_energy
from ..felt import law_of
from ..model.modal_response import ModalResponse, force_pulse
from ..model.modes import mode_frequencies, raised_cosine_weights
from ..model.note import Note
from ..model.output_path import OutputPath
from ..transducer import TRANSDUCERS
from .fields import NOTHING, Field, FieldPoints, field_shape
from .guessed_knocks import KnockFields, measure_knocks

# Width of the cells of frequency in which the partials of a key are averaged, octaves: a critical band.
CELL = 1 / 6
# Largest amplitude of a channel over the mean of all: channels can cancel one another.
LARGEST_SIDE = 4.0
# Times at which decay curves are compared, in units of the inverse decay rate of the laws.
TIMES = np.concatenate([[0.0], np.geomspace(5e-4, 60, 56)])
# Standard deviation of the logarithm of time over which a power is averaged: half of an e-fold. Half and twice of it
# change the mean distance of left-out keys by 0.02 dB at most (`benchmarks/unrecorded.py`).
BLUR = 0.5
# Part of these times from which the early decay follows.
EARLY = (TIMES > 0) & (TIMES <= 1.0)
# Smallest early decay over that of the laws.
LEAST_RATIO = 0.02
# Velocities at which levels are compared, m/s, or forces of plucks, N: pianissimo to fortissimo.
VELOCITIES = np.geomspace(0.25, 4.0, 5)
# Standard deviation of the logarithm of a contact time: by so much the fits of neighbouring keys differ.
DURATION_SD = 0.15
# Durations of a contact over its own, and their weights (Gauss and Hermite).
_NODES, _WEIGHTS = (np.asarray(column) for column in hermegauss(7))
DURATIONS, DURATION_WEIGHTS = np.exp(DURATION_SD * _NODES), _WEIGHTS / _WEIGHTS.sum()
# Most partials of a string model.
MOST_PARTIALS = 512
# Frequencies at which the path of a guessed key is stated, Hz: thirds of octaves.
THIRDS = 20.0 * 2 ** (np.arange(31) / 3)
# Size of the Fourier transform of a force over its own length: between its points the spectrum is linear.
OVERSAMPLED = 8
# Rate of the simulated contacts, Hz.
CONTACT_RATE = 44_100
# Smallest power of a decay curve over its largest: below it are modes that cancel, and rounding. With 1e-6 left-out
# keys are 0.2 dB farther from their recordings, and with 1e-24 as far (`benchmarks/unrecorded.py`).
LEAST_POWER = 1e-12


# Magnitude of the spectrum of a force, N s, at frequencies, Hz.
Spectrum = Callable[[np.ndarray], np.ndarray]


class StringLaw(NamedTuple):
    """Values of the keyboard laws for the string of one key."""

    b1: float  # decay rate of partial k: b1 + d2 k², 1/s
    d2: float
    strike_sd: float  # standard deviation of the strike position of one key, relative

    def decay(self, number: np.ndarray) -> np.ndarray:
        """Decay rates of partials of this `number`, 1/s."""
        return self.b1 + self.d2 * number**2


@dataclass(frozen=True)
class RecordedKey:
    """A recorded key, and what the laws say of it."""

    midi: int
    note: Note  # as recorded
    law_note: Note  # the same string, struck by the hammer of the laws
    law: StringLaw
    velocities: tuple[float, ...]  # sizes of the strokes of its recordings: velocities, m/s, or forces of plucks, N

    @property
    def compared_velocities(self) -> np.ndarray:
        """The `VELOCITIES` within those of the recordings, m/s: beyond them the key says nothing."""
        return np.clip(VELOCITIES, min(self.velocities), max(self.velocities))

    @cached_property
    def _spectra(self) -> list[list[Spectrum]]:
        """Spectra of the force of the own hammer and of that of the laws, each at the `compared_velocities`."""
        return [[spectrum(note, v) for v in self.compared_velocities] for note in (self.note, self.law_note)]

    def drive_differences(self, frequency: np.ndarray) -> np.ndarray:
        """Level of the force of the own hammer over that of the hammer of the laws, dB [velocities, frequencies]."""
        own, law = (np.array([expected_force(of, frequency) for of in spectra]) for spectra in self._spectra)
        return 20 * np.log10(np.maximum(own, NOTHING) / np.maximum(law, NOTHING))


def spectrum(note: Note, velocity: float) -> Spectrum:
    """Return the magnitude of the spectrum of the force of a stroke, N s, as a function of frequency, Hz."""
    struck = note.with_size(velocity)
    pulse = force_pulse(struck.strike(CONTACT_RATE), struck.hammer)
    size = 2 ** math.ceil(math.log2(OVERSAMPLED * len(pulse.force)))
    magnitude = np.abs(np.fft.rfft(pulse.force, size)) * pulse.step
    return lambda frequency: np.interp(frequency, np.fft.rfftfreq(size, pulse.step), magnitude)


def expected_force(of: Spectrum, frequency: np.ndarray) -> np.ndarray:
    """Root mean square of the spectrum of the force of a hammer with an uncertain contact time, N s [frequencies].

    The spectrum of a force has zeros, and their frequencies depend on the duration of the contact. The ratio of two
    forces near their zeros says more about these than about anything that another key shares.
    """
    return np.sqrt(DURATION_WEIGHTS @ [of(frequency * ratio) ** 2 for ratio in DURATIONS])


class Cells(NamedTuple):
    """Fields in cells of frequency of one or several keys."""

    points: FieldPoints
    level: np.ndarray  # of the mean of the channels, dB, mean over the `VELOCITIES` [points]
    change: np.ndarray  # of the level with velocity beyond that of the laws' hammer, dB [points, velocities]
    curve: np.ndarray  # decay curves, dB [points, times]
    phasor: np.ndarray  # mean phasor of the mean of the channels, complex [points]
    side: np.ndarray  # amplitudes of the channels over their mean, complex [points, channels]
    side_power: np.ndarray  # mean square of their deviation from 1 [points]


class KeyFields(NamedTuple):
    """Fields of all recorded keys."""

    cells: Cells
    keys: np.ndarray  # recorded keys [keys]
    highest: np.ndarray  # frequency of their highest partials, Hz [keys]
    rate: int  # of the responses, Hz
    level: Field  # of the levels of the cells
    curve: Field  # of their decay curves
    knocks: KnockFields | None


class Partials(NamedTuple):
    """The partials of a string [partials]."""

    frequency: np.ndarray  # Hz
    impulse: np.ndarray  # response at the pickup to a unit of the pulse of a stroke: 1 N s, or the release of 1 N


def string_partials(note: Note, strike_sd: float, count: int = MOST_PARTIALS) -> Partials:
    """Return the first partials of the string model of a note.

    The strike position has the relative standard deviation `strike_sd`. A partial with a node near it has the root mean
    square of its amplitude: one position would make it fainter than almost any other.
    """
    g, s = note.geometry, note.string
    beta = np.arange(1, count + 1) * (np.pi / g.length)
    frequency = mode_frequencies(s, g.length, count)
    omega, weight = 2 * np.pi * frequency, raised_cosine_weights(g, count, np)
    # Mean of sin² β x over a Gaussian x, over sin² β x0.
    at, blur = beta * g.strike_position, np.exp(-2 * (beta * strike_sd * g.strike_position) ** 2)
    sine = np.sin(at)
    weight = weight / np.where(np.abs(sine) < 1e-9, 1e-9, sine) * np.sqrt((1 - blur * np.cos(2 * at)) / 2)
    weight = weight * law_of(note.hammer).mode_excitation(omega)
    transducer = TRANSDUCERS[note.quantity]
    if not transducer.on_string:  # 2 Φ/M_S over ω, times (-1)^(k+1) M_S/L ω²/β of the tension
        sign = np.where(np.arange(count) % 2, -1.0, 1.0)
        return Partials(frequency, sign * 2 * weight * omega / (beta * g.length))
    impulse = 2 * weight / g.mass * np.sin(beta * g.pickup) / (1.0 if transducer.reads_velocity else omega)
    return Partials(frequency, impulse)


class PathField(NamedTuple):
    """Output paths of the recorded keys, with their gains, as a field."""

    field: Field
    level: np.ndarray  # dB [points]

    def at(self, midi: int) -> OutputPath:
        """Return the smooth output path of a key, for a gain of 1."""
        weights = self.field.weights(FieldPoints.of_key(np.log2(THIRDS), midi))
        return OutputPath(THIRDS, self.field.points.predict(weights, self.level))


def measure_path(keys: Sequence[RecordedKey]) -> PathField | None:
    """Measure the output path of an instrument from recorded keys in ascending order; None without any path.

    The path of a knock does not count, because keybed and action sound there too.
    """
    rows = []
    for key in keys:
        path = key.note.path
        if path is None:
            continue
        partials = path.frequency > BAND[1] * key.note.f0
        frequency = path.frequency[partials]
        own = 20 * np.log10(abs(key.note.gain)) + key.drive_differences(frequency).mean(axis=0)
        octave, (mean, size) = np.log2(frequency), _cells(np.log2(frequency))
        rows.append((*FieldPoints.of_key(mean(octave), key.midi, size), mean(path.db[partials] + own)))
    if not rows:
        return None
    *columns, level = (np.concatenate(column) for column in zip(*rows, strict=True))
    points = FieldPoints(*columns)
    return PathField(Field(points, field_shape(points, level)), level)


def _cells(octave: np.ndarray) -> tuple[Callable[[np.ndarray], np.ndarray], np.ndarray]:
    """Return the function that averages values of partials in the cells [cells, ...], and the sizes of the cells."""
    _, cell, count = np.unique(np.floor(octave / CELL), return_inverse=True, return_counts=True)

    def mean(values: np.ndarray) -> np.ndarray:
        total = np.zeros((len(count), *values.shape[1:]), values.dtype)
        np.add.at(total, cell, values)
        return total / count.reshape(-1, *(1,) * (total.ndim - 1))

    return mean, count.astype(float)


def measure_fields(keys: Sequence[RecordedKey]) -> KeyFields | None:
    """Measure the fields from recorded keys in ascending order; None if none has a modal response."""
    with_response = [(key, response) for key in keys if (response := key.note.modal_response) is not None]
    if not with_response:
        return None
    rows = [_measure(key, response) for key, response in with_response]
    channels = max(row.side.shape[1] for row in rows)
    # A key with fewer channels says of all channels what it says of its own.
    rows = [row._replace(side=np.resize(row.side.T, (channels, len(row.level))).T) for row in rows]
    points = FieldPoints(*(np.concatenate(column) for column in zip(*(row.points for row in rows), strict=True)))
    fields = [np.concatenate(column) for column in zip(*(row[1:] for row in rows), strict=True)]
    cells = Cells(points, *fields)
    gains = [abs(key.note.gain) * _impulse_ratio(key) for key, _ in with_response]
    numbers = np.array([key.midi for key, _ in with_response], float)
    responses = [response for _, response in with_response]
    rate = max(response.rate for response in responses)
    return KeyFields(
        cells,
        numbers,
        np.array([_partials_of(*pair)[1].frequency[-1] for pair in with_response]),
        rate,
        Field(points, field_shape(points, cells.level)),
        Field(points, field_shape(points, np.log(early_ratio(cells.curve)))),
        measure_knocks(numbers, responses, np.array(gains), channels, rate),
    )


def _impulse_ratio(key: RecordedKey) -> float:
    """Momentum of the strokes of the own hammer over those of the hammer of the laws."""
    return 10 ** (float(key.drive_differences(np.zeros(1)).mean()) / 20)


def _partials_of(key: RecordedKey, response: ModalResponse) -> tuple[np.ndarray, Partials]:
    """Numbers of the measured partials of a key, and the string model of them."""
    numbers = np.unique(response.partial)
    numbers = numbers[(numbers > 0) & (numbers <= MOST_PARTIALS)]
    string = string_partials(key.note, key.law.strike_sd)
    return numbers, Partials(*(column[numbers - 1] for column in string))


def _measure(key: RecordedKey, response: ModalResponse) -> Cells:
    """Measure the fields of one key."""
    note = key.note
    numbers, string = _partials_of(key, response)
    own_decay = note.string.b1 + note.string.b2 * (numbers * np.pi / note.geometry.length) ** 2
    parts = [response.partial == number for number in numbers]
    mono = response.pattern.mean(axis=0)
    energies = np.array([partial_energies(response, part, key.compared_velocities) for part in parts])
    reference = string.impulse**2 * level_energy(2 * own_decay) / note.gain**2
    drives = key.drive_differences(string.frequency)
    power = np.maximum(energies, NOTHING) / reference[:, None] * 10 ** (drives.T / 10)  # [partials, velocities]
    shape = np.array([decay_curve(response, mono, *x) for x in zip(parts, key.law.decay(numbers), strict=True)])
    strongest = np.array([np.flatnonzero(part)[np.argmax(np.abs(mono[part]))] for part in parts])
    side = (response.pattern[:, strongest] / mono[strongest]).T
    side *= np.minimum(1.0, LARGEST_SIDE / np.maximum(np.abs(side), NOTHING))
    octave = np.log2(string.frequency)
    mean, size = _cells(octave)
    by_velocity = mean(10 * np.log10(power))
    level = by_velocity.mean(axis=1)
    curve = mean(10 * np.log10(np.maximum(shape, LEAST_POWER * shape.max(axis=1, keepdims=True))))
    phasor = np.sign(string.impulse * note.gain) * np.exp(1j * np.angle(mono[strongest]))
    return Cells(
        points=FieldPoints.of_key(mean(octave), key.midi, size),
        level=level,
        change=by_velocity - level[:, None],
        curve=curve - curve[:, :1],
        phasor=mean(phasor),
        side=mean(side),
        side_power=mean((np.abs(side - 1) ** 2).mean(axis=1)),
    )


def partial_energies(response: ModalResponse, part: np.ndarray, velocities: np.ndarray) -> np.ndarray:
    """Energies of the level of one partial after a unit of force at these velocities [velocities].

    Parameters
    ----------
    part : whether a mode belongs to the partial [modes].
    """
    gain, pole = response.velocity_gain, response.pole[part]
    factors = [np.ones(len(pole)) if gain is None else gain.at(v)[part] for v in velocities]
    amplitude = response.pattern[:, part].mean(axis=0) * np.array(factors)
    # Modes that are too close to beat can cancel.
    products = level_energy(-(pole[:, None] + pole.conj()))
    return np.einsum("vi,ij,vj->v", amplitude, products, amplitude.conj()).real


def decay_curve(response: ModalResponse, mono: np.ndarray, part: np.ndarray, decay: float) -> np.ndarray:
    """Power of a partial at the `TIMES`, over its energy [times].

    Each power is a mean over the logarithm of time about it. It is free of beats, but modes that are too close to beat
    cancel each other, as in the sound.
    """
    pole = response.pole[part] / decay
    rate = pole[:, None] + pole.conj()
    beats = np.exp(-0.5 * (BLUR * TIMES[:, None, None] * np.imag(rate)) ** 2)
    power = np.einsum("i,tij,j->t", mono[part], beats * np.exp(TIMES[:, None, None] * rate), mono[part].conj()).real
    energy = partial_energies(response._replace(velocity_gain=None), part, np.ones(1))[0]
    return np.maximum(power, 0.0) / max(float(energy), NOTHING)


def early_ratio(curve: np.ndarray) -> np.ndarray:
    """Early decay rate over that of the laws [points], from decay curves [points, times]."""
    string = -DB * TIMES[EARLY]
    return np.maximum(curve[:, EARLY] @ string / np.sum(string**2), LEAST_RATIO)
