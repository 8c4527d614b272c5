"""The page of a fit as one HTML file (`html.py`): results, quality of the fit, pictures and sounds.

The player reads its sounds from the download links, so that each sound is in the file once.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import PurePath
from typing import TYPE_CHECKING

from ..excitation import STROKES as STROKE_PARAMETERS
from ..io.files import json_text, printable, replace_paths
from ..model.modal_response import decays_and_beats
from ..result import Result
from ..schema.decode import builtins_of
from ..schema.fit import Fit
from . import text
from .equations import equations
from .figures import draw_attacks, draw_contact, draw_partials, draw_reference_levels, draw_spectra
from .figures_recordings import draw_left_out, draw_paths, draw_recordings
from .html import page_bytes, pictures
from .identifiability import draw_identifiability, felt_scale, identifiability_sections
from .in_short import in_short
from .modal_response import decay_rows, draw_envelopes, draw_spectrograms, modal_response_text
from .release import draw_release
from .sound import clips_of, players_of, slider_of
from .static_law import draw_felt

if TYPE_CHECKING:
    from ..result.cross_validation import CrossValidation

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
    clips, strokes, players = clips_of(result), slider_of(result), players_of(result)
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
        strokes=strokes,
        players=players,
        held_out=held_out,
        figures=draw_figures(result, held_out),
        data=json_text(builtins_of(fit)).rstrip(),
    )


def _title(fit: Fit) -> str:
    first, others = printable(fit.recordings[0].file), len(fit.recordings) - 1
    name = f"{first} and {others} other{'s' * (others > 1)}" if others else first
    return ", ".join(filter(None, (name, fit.reference.note)))


def draw_figures(result: Result, held_out: CrossValidation | None) -> dict[str, list[str]]:
    """Draw all figures of the page: name -> panels as HTML elements, none where the fit lacks the data."""
    fit, own = result.fit, result.draw_set.law.figures
    return pictures(
        {
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
            **{name: draw(result) if name in own else [] for name, draw in EXCITATION_FIGURES.items()},
        }
    )


def _without_folders(result: Result, held_out: CrossValidation | None) -> tuple[Result, CrossValidation | None]:
    """Return both with file names without folders, because pages are passed on."""
    rows = (*result.fit.recordings, *(held_out.recordings if held_out else ()))
    names = {row.file: PurePath(row.file).name or row.file for row in rows}
    if held_out is not None:
        recordings = tuple(replace(row, file=names[row.file]) for row in held_out.recordings)
        warnings = tuple(replace_paths(warning, names) for warning in held_out.warnings)
        held_out = replace(held_out, recordings=recordings, warnings=warnings)
    return replace(result, fit=result.fit.with_paths(names)), held_out
