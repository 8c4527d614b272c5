"""Labelled synthetic notes in memory, block by block.

A block of notes is rendered as a whole, so that strokes of one shape share a program. Its size follows from the
options, so a block has the same sounds in every run.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from numbers import Integral
from typing import Any

import numpy as np

from ..errors import FitError, check_range, check_type
from ..io.files import PEAK_LIMIT
from ..model.many_notes import render_where_possible
from ..model.note import Note
from ..parameters import check_seed
from ..schema.dataset import NoteOptions
from .random_notes import DrawnNote, NotePrior
from .source import load_source
from .table import labels_of

# Most notes of a block: enough strokes of every shape for full batches, and few enough that an interruption loses
# seconds.
BLOCK = 512
# Most samples of a block: 256 MiB.
BLOCK_SAMPLES = 2**25
# Most notes of a data set.
MAX_NOTES = 10_000_000
# Draws of a note whose contact does not end, before the priors are given up.
MAX_ATTEMPTS = 20
# s of the loudest layer whose rms is the reference of the noise, as in `synthetic_recording`.
REFERENCE_SECONDS = 1.0


@dataclass(frozen=True, eq=False)
class LabelledNote:
    """One sound of a data set with its parameters.

    Parameters
    ----------
    number : number of the note, from 0.
    layer : its layer, from 1, the softest.
    midi : MIDI number of its key.
    note : string, hammer with velocity, geometry, gain, output path and modal response.
    samples : the sound [samples], full scale = 1.
    rate : sample rate, Hz.
    noise_rms : rms of the white noise in it, full scale = 1.
    """

    number: int
    layer: int
    midi: int
    note: Note
    samples: np.ndarray
    rate: int
    noise_rms: float

    def __repr__(self) -> str:
        return f"LabelledNote {self.number}, layer {self.layer}: key {self.midi}, {len(self.samples)} samples"

    @property
    def labels(self) -> dict[str, Any]:
        """The row of the table, by column, in SI units."""
        return labels_of(self)


def notes(count: int, *, seed: int = 0, options: NoteOptions | None = None) -> Iterator[LabelledNote]:
    """Make labelled synthetic notes, one after the other, from the priors or around a fitted key or instrument.

    Note `k` depends only on the seed, `k` and the options. The sounds begin at the first contact. The loudest layer of
    every note has a peak of -1 dBFS. `write_dataset` writes the same notes to files, on all cores.

    Parameters
    ----------
    count : number of notes. Each has one sound for every layer of the options.
    seed : seed of all random numbers.
    options : see `NoteOptions`.

    Returns
    -------
    An iterator of `LabelledNote`, ordered by number and layer.

    Raises
    ------
    ParameterError
        For an argument or an option out of range, before the first note.
    FitError
        If the file to draw around is not valid, or if no draw of a note has a contact that ends.

    Examples
    --------
    >>> import pianofit
    >>> made = list(pianofit.notes(3, seed=1, options=pianofit.NoteOptions(keys=("C4", "C5"), seconds=0.2)))
    >>> [one.samples.shape for one in made]
    [(8820,), (8820,), (8820,)]
    >>> 0.05 < made[0].labels["v_H0"] < 15
    True
    """
    options = options or NoteOptions()
    check_count(count)
    check_seed(seed)
    prior = NotePrior(options, load_source(options), seed)
    return (one for numbers in blocks(count, options) for one in make_block(prior, numbers))


def blocks(count: int, options: NoteOptions) -> list[range]:
    """Return the numbers of the notes of every block."""
    size = max(1, min(BLOCK, int(BLOCK_SAMPLES / (options.seconds * options.rate * options.layers))))
    return [range(first, min(first + size, count)) for first in range(0, count, size)]


def check_count(count: int) -> None:
    """Raise a `ParameterError` for an invalid number of notes."""
    check_type("count=", count, Integral, "a whole number of notes")
    check_range("count=", count, 1, MAX_NOTES)


def make_block(prior: NotePrior, numbers: range) -> list[LabelledNote]:
    """Draw and render some notes, ordered by number and layer."""
    made: dict[int, list[LabelledNote]] = {}
    for attempt in range(MAX_ATTEMPTS):
        drawn = [prior.draw(number, attempt) for number in numbers if number not in made]
        if not drawn:
            break
        layers = [note for one in drawn for note in one.layers]
        sounds = render_where_possible(layers, prior.options.seconds, prior.options.rate)
        count = prior.options.layers
        for i, one in enumerate(drawn):
            own = [sound for sound in sounds[i * count : (i + 1) * count] if sound is not None]
            if len(own) == count and np.abs(own).max() > 0:
                made[one.number] = _labelled(prior, one, own)
    if lost := [number for number in numbers if number not in made]:
        raise FitError(
            f"note {lost[0]}: the contact of hammer and string did not end in {MAX_ATTEMPTS} draws; reduce spread=, or "
            "choose other keys="
        )
    return [one for number in numbers for one in made[number]]


def _labelled(prior: NotePrior, drawn: DrawnNote, sounds: list[np.ndarray]) -> list[LabelledNote]:
    """Add the noise, and scale all layers of a note by one factor."""
    rms = 0.0
    if drawn.noise_db is not None:
        reference = max(sounds, key=lambda sound: float(np.abs(sound).max()))
        reference = reference[: round(REFERENCE_SECONDS * prior.options.rate)]
        rms = float(np.sqrt(np.mean(reference**2))) * 10 ** (-drawn.noise_db / 20)
        sounds = [sound + rms * prior.noise(drawn.number, layer, len(sound)) for layer, sound in enumerate(sounds)]
    scale = PEAK_LIMIT / max(float(np.abs(sound).max()) for sound in sounds)
    return [
        LabelledNote(
            number=drawn.number,
            layer=layer + 1,
            midi=drawn.midi,
            note=note._replace(gain=note.gain * scale),
            samples=scale * sound,
            rate=prior.options.rate,
            noise_rms=scale * rms,
        )
        for layer, (note, sound) in enumerate(zip(drawn.layers, sounds, strict=True))
    ]
