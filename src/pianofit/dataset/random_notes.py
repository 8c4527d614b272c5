"""Parameters of one note, from the seed and its number alone.

String and hammer are drawn about a central note. The standard deviations are those of two priors of this package:

    hammer, felt, contact, velocity     the prior of a fit (`inference.priors`). The felt has its coordinates: the force
                                        at a reference compression, so that a change of p does not change the force
    tuning, B, losses of the string     the prior of one key of any instrument (`instrument.LAW_QUANTITIES`), because a
                                        fit takes its string from the recording

Length and mass are those of the central note: the sound depends on ratios to them only. Every random number belongs to
a stream with the seed, the number of the note and a purpose, so options that add noise do not change the parameters.
"""

import math
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from ..conversions import midi_of
from ..felt import plain_law
from ..inference import STRING_SIZE, InitialValues, Parametrisation, prior_parametrisation, priors
from ..inference.multistart import TAIL
from ..instrument.key_quantities import LAW_QUANTITIES
from ..literature import reference_compression
from ..model.note import Note
from ..model.output_path import OutputPath
from ..parameters import HAMMER_NAMES, Hammer
from ..schema.dataset import NoteOptions
from .source import Source, noise_range

# Frequencies at which output paths are drawn, Hz: thirds of octaves, closer than the length of the prior.
PATH_FREQUENCIES = 25.0 * 2 ** (np.arange(30) / 3)


class Stream(IntEnum):
    """Purposes of random numbers."""

    KEY, PARAMETERS, PATH, NOISE = range(4)


class DrawnNote(NamedTuple):
    """One note before it is rendered."""

    number: int
    midi: int
    layers: tuple[Note, ...]  # the same note at each velocity, ascending; their gain is not yet chosen
    noise_db: float | None  # level of the noise below the rms of the loudest layer, dB


class NotePrior:
    """Distribution of the notes of a data set about its central notes."""

    def __init__(self, options: NoteOptions, source: Source, seed: int) -> None:
        self.options, self.source, self.seed = options, source, seed
        self._keys = sorted(source.notes)
        self._priors: dict[int, Parametrisation] = {}

    def random(self, number: int, stream: Stream, *more: int) -> np.random.Generator:
        """Return the generator of one purpose of one note."""
        return np.random.default_rng([self.seed, number, stream, *more])

    def draw(self, number: int, attempt: int = 0) -> DrawnNote:
        """Draw a note, after a number of draws of it whose contact did not end. The key stays the same."""
        midi = self._keys[int(self.random(number, Stream.KEY).integers(len(self._keys)))]
        notes = self._layers(midi, self.random(number, Stream.PARAMETERS, attempt))
        path = notes[0].path if self.options.path else None
        if self.options.path and self.options.around is None:
            path = draw_path(self.random(number, Stream.PATH))
        noise = noise_range(self.options)
        db = None if noise is None else float(self.random(number, Stream.NOISE).uniform(*noise))
        return DrawnNote(number, midi, tuple(note._replace(path=path) for note in notes), db)

    def noise(self, number: int, layer: int, samples: int) -> np.ndarray:
        """Return white noise with an rms of 1 for one sound [samples]."""
        return self.random(number, Stream.NOISE, layer + 1).standard_normal(samples)

    def _layers(self, midi: int, random: np.random.Generator) -> list[Note]:
        """Draw string, hammer and contact of a key, and its layers from soft to loud."""
        centre, options = self.source.notes[midi], self.options
        if midi not in self._priors:
            self._priors[midi] = _prior_about(centre, options.layers)
        u = self._priors[midi]
        z = ndtri(TAIL + (1 - 2 * TAIL) * random.random(u.size))  # a search does not sample the tails either
        sd = np.where(np.arange(u.size) < u.shared, options.spread, 1.0) * u.sd
        theta = u.mean + sd * z
        theta[:STRING_SIZE] = u.mean[:STRING_SIZE] + options.spread * self._string_changes(midi, z)
        theta[u.velocities] = np.sort(theta[u.velocities])
        theta = u.project(theta)
        string, geometry = u.string(theta), u.geometry_at(theta).with_window_on_string()
        response = centre.modal_response if options.modal_response else None
        if response is not None:
            response = response.scale_pitch(float(string.c / centre.string.c))
        note = centre._replace(string=string, geometry=geometry, modal_response=response)
        return [note._replace(hammer=u.hammer(theta, stroke)) for stroke in range(u.strokes)]

    def _string_changes(self, midi: int, z: np.ndarray) -> np.ndarray:
        """Changes of the logarithms of c, κ, b1 and b2 from four standard normal numbers."""
        sd = {name: LAW_QUANTITIES[name].prior.sd_at(midi) for name in ("cents", "B", "b1", "d2")}
        c = math.log(2) / 1200 * sd["cents"] * z[0]
        if self.options.modal_response:  # the measured modes keep their inharmonicity and decay
            return np.array([c, c, 0.0, 0.0])
        return np.array([c, c + 0.5 * sd["B"] * z[1], sd["b1"] * z[2], sd["d2"] * z[3]])


def _prior_about(note: Note, layers: int) -> Parametrisation:
    """The prior of a fit about a central note. Every layer is a stroke with an unknown velocity."""
    law, values = plain_law(note.hammer), _values(note)
    fixed = law.power is None or law.power[0] not in law.parameters
    start = InitialValues(
        values=values,
        initial=values,
        fixed={},
        assumptions={},
        bounds={},
        geometry=note.geometry,
        assumed=(),
        quantity="bridge-force",  # with an unknown path a fit would fix the width of the contact
        scale=None,
        reference_hammer=Hammer(*note.hammer[: len(HAMMER_NAMES)]),
        law=law,
    )
    u_ref = None if fixed else reference_compression(midi_of(float(note.f0)))
    return prior_parametrisation(start, [None] * layers, u_ref)


def _values(note: Note) -> dict[str, float]:
    """Parameters of a note by the names of a fit."""
    parts = {**note.string._asdict(), **note.hammer._asdict()}
    contact = {"x0": note.geometry.strike_position, "width": note.geometry.width}
    return {name: float(value) for name, value in (parts | contact).items()}


def draw_path(random: np.random.Generator) -> OutputPath:
    """Draw an output path from the prior of a fit, at thirds of octaves.

    A smooth part has the size and length of `priors.LEVEL`, with Matérn's covariance of order 3/2. Single values
    deviate from it by `priors.PATH`. In F this deviation is independent from partial to partial.
    """
    z = random.standard_normal(3 + len(PATH_FREQUENCIES))
    (size, length), spread = priors.LEVEL.median[1:3], priors.LEVEL.spread[1:3]
    size, length = size * math.exp(spread[0] * z[0]), length * math.exp(spread[1] * z[1])
    tau = priors.PATH[0] * math.exp(priors.PATH[1] * z[2])
    octaves = np.log2(PATH_FREQUENCIES)
    d = math.sqrt(3) * np.abs(octaves[:, None] - octaves) / length
    covariance = size**2 * (1 + d) * np.exp(-d) + tau**2 * np.eye(len(octaves))
    return OutputPath(PATH_FREQUENCIES, np.linalg.cholesky(covariance) @ z[3:])
