"""Sounds of many notes: strokes of one shape share a compiled program, and the modes of each note are summed once.

The shape of a stroke is its number of modes and the length of its stored pulse. Every note keeps its own contact rate.
A stroke whose contact is longer than the stored pulse is computed again with a longer one. The sums over modes are
those of `Note.render`, so both give the same sound up to rounding.
"""

from collections import defaultdict
from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import numpy as np

from ..errors import FitError, ParameterError
from ..felt import law_of
from .free_response import pickup_amplitudes, sounding
from .note import Note, check_render
from .program_cache import KEYBOARD_SHAPES, persistent_jit
from .simulate import MAX_STEPS, Simulation, StrikeConfig, contact_rate, count_modes
from .strokes import BATCH, BATCH_SIZE, parameter_arrays, simulations, stroke_until_over

# Stored steps of a first try, and their factor for strokes that last longer. Half of all contacts end within 512 steps.
FIRST_STORED, LONGER = 1024, 4


@partial(persistent_jit, loaded=KEYBOARD_SHAPES)
def _sounding_strokes(strings, hammers, geometries, rates, cfg: StrikeConfig):
    """As `strokes` with their own `rates`, Hz, and both `pickup_amplitudes`."""

    def one(string, hammer, geometry, rate):
        modes, pulse, steps, _ = stroke_until_over(string, hammer, geometry, rate, cfg)
        return (tuple(modes), tuple(pulse), None, steps), pickup_amplitudes(modes, pulse.drive)

    return jax.vmap(one, axis_name=BATCH)(strings, hammers, geometries, rates)


def render_notes(notes: Sequence[Note], *, seconds: float = 1.0, rate: int = 44_100) -> np.ndarray:
    """Render many notes, each with the velocity of its hammer, from the first contact on.

    Notes with a modal response begin `Note.pre_onset_s` before the contact, as in `Note.render`. Any notes can be
    mixed. Those that need similar numbers of modes share a compiled program.

    Parameters
    ----------
    notes : the notes.
    seconds : length of every sound, s.
    rate : sample rate, Hz.

    Returns
    -------
    The sounds in file units [notes, samples], mean of the channels.

    Raises
    ------
    ParameterError
        For an argument out of range.
    FitError
        If a contact does not end within 65,536 steps. The message names the note by its index.

    Examples
    --------
    >>> import pianofit
    >>> keys = [pianofit.typical(midi) for midi in (60, 64, 67)]
    >>> chord = [pianofit.Note(it.string, it.hammer, it.geometry, "bridge-force", gain=0.1) for it in keys]
    >>> pianofit.render_notes(chord, seconds=0.5).shape
    (3, 22050)
    """
    check_render(None, seconds, rate)
    if not notes or not all(isinstance(note, Note) for note in notes):
        raise ParameterError("notes= must be a list of one or more Note")
    sounds = render_where_possible(notes, seconds, rate)
    failed = [i for i, sound in enumerate(sounds) if sound is None]
    if failed:
        raise FitError(
            f"notes[{failed[0]}]: the hammer is still on the string after {MAX_STEPS} steps; use a lighter or faster "
            "hammer"
        )
    return np.stack([sound for sound in sounds if sound is not None])


def render_where_possible(notes: Sequence[Note], seconds: float, rate: int) -> list[np.ndarray | None]:
    """Return the sound [samples] of every note; None if its contact does not end, or no contact rate is high enough."""
    sounds: list[np.ndarray | None] = [None] * len(notes)
    for i, note in enumerate(notes):
        if not law_of(note.hammer).has_contact:  # a pluck has no contact to compute
            sounds[i] = note.render(seconds=seconds, rate=rate)
    rates, groups = _shapes(notes, rate)
    for (rows, quantity, law), remaining in groups.items():
        stored = FIRST_STORED
        while remaining and stored <= MAX_STEPS:
            cfg = StrikeConfig(rows, stored, quantity, law)
            for at in range(0, len(remaining), BATCH_SIZE):
                batch = remaining[at : at + BATCH_SIZE]
                for i, stroke in zip(batch, _strokes([notes[i] for i in batch], rates[batch], cfg), strict=True):
                    if stroke[0].pulse.contact_ended:
                        sounds[i] = _sound(notes[i], *stroke, seconds, rate)
            remaining, stored = [i for i in remaining if sounds[i] is None], stored * LONGER
    return sounds


def _shapes(notes: Sequence[Note], rate: int) -> tuple[np.ndarray, dict[tuple, list[int]]]:
    """Contact rates of the notes, Hz, and indices of the notes of every shape, without those of too high a rate."""
    rates, groups = np.zeros(len(notes)), defaultdict(list)
    for i, note in enumerate(notes):
        if not law_of(note.hammer).has_contact:
            continue
        try:
            rates[i] = contact_rate(note.string, note.geometry, rate)
        except ParameterError:
            continue
        rows = count_modes(note.string, note.geometry, rates[i])
        groups[rows, note.quantity, law_of(note.hammer)].append(i)
    return rates, groups


def _strokes(notes: list[Note], rates: np.ndarray, cfg: StrikeConfig) -> list[tuple[Simulation, Any]]:
    """Every stroke with its `pickup_amplitudes`. The batch is filled up with its last note."""
    missing = BATCH_SIZE - len(notes)
    rates = np.append(rates, np.repeat(rates[-1:], missing))
    computed = _sounding_strokes(*parameter_arrays([*notes, *notes[-1:] * missing]), rates, cfg)
    result, amplitudes = jax.tree.map(np.asarray, computed)
    return list(zip(simulations(result), zip(*amplitudes, strict=True), strict=True))[: len(notes)]


def _sound(note: Note, stroke: Simulation, amplitudes: Any, seconds: float, rate: int) -> np.ndarray:
    """Render one stroke in file units [samples]."""
    samples = round(seconds * rate)
    if note.modal_response is not None:
        return note.render_mono(stroke, rate, samples, round(note.pre_onset_s * rate))
    scaled, pole = [note.gain * x for x in amplitudes], stroke.modes.pole
    ratio = round(1 / (float(stroke.modes.step) * rate))
    sound = np.asarray(sounding(pole, stroke.pulse.drive, scaled, ratio, rate, samples))
    return note.through_path(sound, pole, rate)
