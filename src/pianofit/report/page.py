"""The page of a fit as one HTML file (`html.py`): results, quality of the fit, pictures and sounds.

The player reads its sounds from the download links, so that each sound is in the file once.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import FitError, ParameterError
from ..excitation import STROKES as STROKE_PARAMETERS
from ..io.files import json_text, printable, replace_paths
from ..io.number_format import number
from ..model.modal_response import decays_and_beats
from ..result import Result
from ..schema.decode import builtins_of
from ..schema.fit import Fit
from . import text
from .drawing import page_style, svg
from .equations import equations
from .figures import draw_attacks, draw_contact, draw_partials, draw_reference_levels, draw_spectra
from .figures_recordings import draw_left_out, draw_paths, draw_recordings
from .html import page_bytes, picture
from .identifiability import draw_identifiability, felt_scale, identifiability_sections
from .in_short import in_short
from .modal_response import decay_rows, draw_envelopes, draw_spectrograms, modal_response_text
from .release import draw_release
from .sound import LIGHT_RATE, SECONDS, Clip, make_clips, seconds_each
from .static_law import draw_felt

if TYPE_CHECKING:
    from ..result.cross_validation import CrossValidation

# Length of the sounds of the reference recording in stereo, s; in mono it is `SECONDS`.
STEREO_SECONDS = 5.0
# Samples of the sounds of all other recordings together: 2 MB.
OTHER_SAMPLES = 1_000_000
LONGEST_OTHER, SHORTEST_OTHER = 4.0, 1.5  # s, of each of these sounds
STROKES = 7  # velocities of the slider
STROKE_SECONDS = 2.5
# Recordings whose velocities differ by less than this ratio do not define a range of velocities. The slider then goes
# down and up by the second ratio.
SMALLEST_RANGE, DEFAULT_RANGE = 1.3, 2.0
# Figures that an excitation can name.
EXCITATION_FIGURES = {"release": draw_release, "force": draw_contact, "felt": draw_felt}


def report_bytes(result: Result, title: str | None = None, held_out: CrossValidation | None = None) -> bytes:
    """Return the page.

    Parameters
    ----------
    title : plain text; name of the first recording and the note of the reference recording if None.
    held_out : result of `cross_validate` for the same recordings, to be added to the page.

    Raises
    ------
    FitError
        If the fit was loaded from a file and a recording is missing or was changed.
    """
    result, held_out = _without_folders(result.with_recordings(), held_out)
    fit, law, response = result.fit, result.draw_set.law, result.note.modal_response
    decays = [] if response is None else decays_and_beats(response)
    figures, clips = draw_figures(result, held_out), _clips(result)
    return page_bytes(
        "page.html.j2",
        scripts=("audio.js", "player.js", "zoom.js"),
        title=title or _title(fit),
        contents=True,
        fit=fit,
        text=text,
        identifiability_sections=identifiability_sections(fit),
        felt_scale=felt_scale(fit),
        has_slow_law=law.slow is not None,
        equations=equations(fit, law),
        words=law.words,
        stroke=law.stroke,
        has_contact=law.has_contact,
        clips=clips,
        short=in_short(result, clips, decays),
        modal_response=fit.modal_response and modal_response_text(fit.modal_response),
        decays=decay_rows(decays),
        strokes=_slider(result),
        players=_players(result),
        held_out=held_out,
        figures={name: picture(panels) for name, panels in figures.items()},
        data=json_text(builtins_of(fit)).rstrip(),
    )


def _title(fit: Fit) -> str:
    first, others = printable(fit.recordings[0].file), len(fit.recordings) - 1
    name = f"{first} and {others} other{'s' * (others > 1)}" if others else first
    return ", ".join(filter(None, (name, fit.reference.note)))


def draw_figures(result: Result, held_out: CrossValidation | None = None) -> dict[str, list[bytes]]:
    """Draw all figures of the page: name -> SVGs of the panels, none where the fit lacks the data."""
    fit = result.fit
    with page_style():
        figures = {
            "spectra": draw_spectra(result),
            "attack": draw_attacks(result),
            "partials": draw_partials(result),
            "levels": draw_reference_levels(result),
            "recordings": draw_recordings(fit),
            "paths": draw_paths(fit),
            "held_out": draw_left_out(held_out.recordings if held_out else (), STROKE_PARAMETERS[fit.excitation].unit),
            "identifiability": draw_identifiability(result),
            "envelopes": draw_envelopes(result) if fit.modal_response else [],
            "spectrograms": draw_spectrograms(result) if fit.modal_response else [],
        }
        own = result.draw_set.law.figures
        figures |= {name: draw(result) if name in own else [] for name, draw in EXCITATION_FIGURES.items()}
        return {name: [svg(figure) for figure in panels] for name, panels in figures.items()}


def _without_folders(result: Result, held_out: CrossValidation | None) -> tuple[Result, CrossValidation | None]:
    """Return both with file names without folders, because pages are passed on."""
    rows = (*result.fit.recordings, *(held_out.recordings if held_out else ()))
    names = {row.file: PurePath(row.file).name or row.file for row in rows}
    if held_out is not None:
        recordings = tuple(replace(row, file=names[row.file]) for row in held_out.recordings)
        warnings = tuple(replace_paths(warning, names) for warning in held_out.warnings)
        held_out = replace(held_out, recordings=recordings, warnings=warnings)
    return replace(result, fit=result.fit.with_paths(names)), held_out


# --- sounds -----------------------------------------------------------------------------------------------------------


def _clips(result: Result) -> list[Clip]:
    """Return the sounds of the reference recording: recorded and two of the model."""
    reference, recording = result.reference, result.recording
    if reference.with_modes is None:
        fitted = {"initial": result.initial.samples, "fitted": reference.sound}
    else:
        fitted = {"fitted": reference.sound, "string model": result.fitted.samples}
    recorded = recording.samples if reference.final.frames is None else recording.frames
    # Few listeners can play more than two channels.
    sounds = {
        name: x if x.ndim == 1 or len(x) <= 2 else x.mean(axis=0)
        for name, x in ({"original": recorded} | fitted).items()
    }
    seconds = SECONDS if all(x.ndim == 1 for x in sounds.values()) else STEREO_SECONDS
    return make_clips(sounds, recording.rate, result.fit.reference.onset_s, seconds=seconds)


def strokes_of(result: Result) -> tuple[dict[float, np.ndarray], bool]:
    """Return sounds of the reference recording's note by value of the stroke, and if these are within the recordings.

    The range is that of the recordings, or from half to twice the value of a single one. The sounds are means of the
    channels and begin `pre_onset_s` before the contact. Strokes that cannot be rendered are left out.
    """
    velocities = [row.stroke_value for row in result.fit.recordings]
    low, high = min(velocities), max(velocities)
    is_recorded_range = high / low > SMALLEST_RANGE
    if not is_recorded_range:
        middle = np.sqrt(low * high)
        lower, upper = result.draw_set.law.stroke.bounds(result.note.geometry)
        low, high = max(middle / DEFAULT_RANGE, lower), min(middle * DEFAULT_RANGE, upper)
    note, rate, sounds = result.note, result.recording.rate, {}
    for velocity in np.geomspace(low, high, STROKES).tolist():
        with suppress(FitError, ParameterError):  # a contact that does not end cannot be rendered
            stroke, onset = note.with_stroke(velocity), round(note.pre_onset_s * rate)
            sounds[velocity] = stroke.render_stroke(rate, int(STROKE_SECONDS * rate), onset)[0]
    return sounds, is_recorded_range


def _slider(result: Result) -> dict[str, Any] | None:
    """Return the slider of the stroke: sounds with one gain, and its initial position; None without two sounds."""
    strokes, is_recorded_range = strokes_of(result)
    if len(strokes) < 2:
        return None
    unit = result.draw_set.law.stroke.unit
    sounds = {f"{number(velocity, 3)} {unit}": samples for velocity, samples in strokes.items()}
    clips = make_clips(sounds, result.recording.rate, lead_in=0.0, matched=False, highest_rate=LIGHT_RATE)
    first = int(np.abs(np.log(np.array([*strokes]) / result.note.stroke_value)).argmin())
    return {"clips": clips, "first": first, "is_recorded_range": is_recorded_range}


def _players(result: Result) -> list[dict[str, Any]]:
    """Return recorded and fitted sound of every recording except the reference, which has its own player."""
    others = [i for i in range(len(result.recordings)) if i != result.reference_index]
    seconds = seconds_each(len(others), OTHER_SAMPLES, LONGEST_OTHER, SHORTEST_OTHER)
    players = []
    for i in others:
        recording, row = result.recordings[i].recording, result.fit.recordings[i]
        sounds = {"original": recording.samples, "fitted": result.recordings[i].final.samples}
        onset = recording.onset / recording.rate
        clips = make_clips(sounds, recording.rate, onset, seconds=seconds, highest_rate=LIGHT_RATE)
        players.append({"place": i + 1, "row": row, "clips": clips})
    return players
