"""What the page shows of every recording, and the note at velocities between them."""

from __future__ import annotations

import numpy as np

from ..errors import FitError, ParameterError
from ..inference import Result
from ..parameters import PARAMETERS
from .curves import RecordingCurves, Strokes

__all__ = ["paths_of", "strokes_of", "recordings_of"]

STROKES = 7
SECONDS = 2.5
# Recordings closer than this in velocity, as a ratio, give no range; the slider then goes to half and to double.
NARROW, WIDER = 1.3, 2.0
LOOP_POINTS = 400


def recordings_of(result: Result) -> tuple[RecordingCurves, ...]:
    """Every recording, in the order given."""
    return tuple(_recording(place, heard) for place, heard in enumerate(result.recordings, start=1))


def _recording(place: int, heard) -> RecordingCurves:
    p, recording, pulse = heard.partials, heard.recording, heard.fitted.simulation.pulse
    compression, force = np.asarray(pulse.compression), np.asarray(pulse.force)
    last = int(np.flatnonzero(compression > 0)[-1]) + 2 if (compression > 0).any() else 0
    thin = slice(0, last, max(1, last // LOOP_POINTS))
    touching = np.where(compression > 0, 1.0, np.nan)[thin]
    return RecordingCurves(
        place, float(heard.fitted.note.hammer.v_H0), heard.levels["fitted_db"],
        p.number, heard.level, p.level_error, heard.fitted.level,
        1e3 * compression[thin] * touching, force[thin] * touching,
        recording.rate, recording.onset / recording.rate, recording.samples, heard.played.samples,
    )  # fmt: skip


def paths_of(result: Result) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """The output path of each group at its partials: Hz and dB; none for a known pickup."""
    found = {}
    for heard, recording in zip(result.recordings, result.document["recordings"], strict=True):
        path = heard.fitted.note.path
        if path is not None:
            found.setdefault(recording["group"], (path.frequency, path.db))
    return tuple(found[group] for group in sorted(found))


def strokes_of(result: Result) -> Strokes | None:
    """The reference's note from the softest recording's velocity to the loudest's; of one, to half and to double.

    The mean of its channels, as it rings, from its `lead` before the contact.
    """
    own = np.array([heard.fitted.note.hammer.v_H0 for heard in result.recordings])
    low, high = float(own.min()), float(own.max())
    inside = high / low > NARROW
    if not inside:
        middle, box = np.sqrt(low * high), PARAMETERS["v_H0"]
        low, high = max(middle / WIDER, box.lower), min(middle * WIDER, box.upper)
    note, recording = result.note, result.recording
    played = []
    for velocity in np.geomspace(low, high, STROKES):
        struck = note._replace(hammer=note.hammer._replace(v_H0=float(velocity)))
        try:
            touch = round(struck.lead * recording.rate)
            played.append((float(velocity), struck.stroke(recording.rate, int(SECONDS * recording.rate), touch)[0]))
        except (FitError, ParameterError):  # a contact that does not end is no sound to choose
            continue
    if len(played) < 2:
        return None
    velocities = np.array([velocity for velocity, _ in played])
    first = int(np.abs(np.log(velocities / note.hammer.v_H0)).argmin())
    return Strokes(velocities, tuple(sound for _, sound in played), recording.rate, first, inside)
