"""Commands from recordings to parameters: analyse, fit, predict, cross-validate, compare."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..conversions import HALF_WIDTH_95
from ..errors import OutputError
from ..io.files import (
    check_sound_target,
    check_target,
    encode_wav,
    json_text,
    output_folder,
    printable,
    replace_file,
    write_file,
)
from ..io.number_format import columns, counted, format_with_interval, with_standard_error
from ..parameters import check_seed, check_velocity
from ..progress import progress_bar
from ..recording.recording import load_recording, load_recordings, readable_formats
from ..setup import Setup, load_setup
from . import options
from .options import choice, whole
from .terminal import print_result

if TYPE_CHECKING:
    from ..analysis import Analysis

__all__ = ["analyse", "compare", "cross_validate", "fit", "predict"]


def analyse(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help=f"A recording of one struck note: {readable_formats()}.")
    ],
    note: options.Note = None,
    f0: options.Pitch = None,
    channel: options.Channel = "average",
    as_json: options.Json = False,
) -> None:
    """Measure pitch, inharmonicity, losses and partials of a recording, without a hammer model."""
    from ..analysis import analyse as run
    from ..analysis import analysis_to_dict

    recording = load_recording(file, channel=channel)
    analysis = run(recording, note=note, f0=f0)
    analysis = replace(analysis, warnings=recording.warnings + analysis.warnings)
    print_result(analysis_to_dict(analysis), _table(analysis), as_json)


def _table(analysis: Analysis) -> str:
    """String parameters with 95 % intervals, then a line for every partial with standard errors."""
    from ..analysis import COLUMNS, nearest_note, partial_rows

    laws = (
        ("f0", analysis.f0, analysis.f0_error, "Hz", ""),
        ("B", analysis.B, analysis.B_error, "", ""),
        ("b1", analysis.b1, analysis.b1_error, "1/s", "decay rate of partial k: b1 + d2 k²"),
        ("d2", analysis.d2, analysis.d2_error, "1/s", ""),
    )
    cells = []
    for name, value, error, unit, note in laws:
        text, span = format_with_interval(value, (value - HALF_WIDTH_95 * error, value + HALF_WIDTH_95 * error))
        cells.append((name, text, unit, span, note))
    lines = [
        nearest_note(analysis.f0),
        *columns(cells, right=1),
        f"partials scatter by {analysis.scatter_cents:.2f} cents",
        "",
        "Brackets: 95 % interval. After ±: one standard error.",
        " ".join(f"{f'{column.name}, {column.unit}' if column.unit else column.name:>{column.width}}"
                 for column in COLUMNS),
    ]  # fmt: skip
    for row in partial_rows(analysis):
        cells = []
        for at, column in enumerate(COLUMNS):
            if COLUMNS[at + 1 : at + 2] and COLUMNS[at + 1].error:
                cells += with_standard_error(row[at], row[at + 1])
            elif not column.error:
                cells.append(f"{row[at]:.{column.digits}f}")
        lines.append(" ".join(f"{cell:>{column.width}}" for cell, column in zip(cells, COLUMNS, strict=True)))
    return "\n".join([*lines, *analysis.warnings]) + "\n"


def fit(
    recordings: options.Recordings,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for fit.json, the sounds and the page.")],
    note: options.Note = None,
    f0: options.Pitch = None,
    setup: options.SetupFile = None,
    velocity: options.Velocity = None,
    channel: options.Channel = "average",
    felt: options.Felt = None,
    recipe: Annotated[
        str,
        typer.Option(
            parser=choice("default", "paper", "global"),
            metavar="NAME",
            help="Search: default, or a method of the paper for comparison, paper or global.",
        ),
    ] = "default",
    evaluations: Annotated[
        int | None,
        typer.Option(
            parser=whole, metavar="N", help="Evaluations of the criterion in the annealing of --recipe paper."
        ),
    ] = None,
    intervals: Annotated[
        str,
        typer.Option(
            parser=choice("laplace", "profile", "posterior"),
            metavar="METHOD",
            help="Method for intervals: laplace; profile, some seconds slower; or posterior, sampled by NUTS, which "
            "takes minutes and needs the extra bayes.",
        ),
    ] = "laplace",
    seed: options.Seed = 0,
    force: options.Force = False,
    page: Annotated[bool, typer.Option(help="Write report.html.")] = True,
    as_json: options.Json = False,
) -> None:
    """Estimate string and hammer parameters from one or several recordings of a key."""
    from ..fitting import fit as run
    from ..model.program_cache import enable_program_cache
    from .summary import summary

    check_velocity(velocity)
    check_seed(seed)
    with output_folder(out, force) as folder, progress_bar() as progress:
        enable_program_cache()
        result = run(
            *recordings, setup=_setup_with_felt(setup, felt), note=note, f0=f0, velocity=velocity, channel=channel,
            recipe=recipe, evaluations=evaluations, intervals=intervals, seed=seed, progress=progress,
        )  # fmt: skip
        progress("page", 0.95)
        result.save(folder, force=True, page=page)
    print_result(result.document, summary(result.document, folder), as_json)


def _setup_with_felt(setup: Path | None, felt: str | None) -> Setup:
    """Load the setup, with the felt law of the command line."""
    return Setup(felt=felt) if setup is None else load_setup(setup, felt)


def predict(
    fit: Annotated[Path, typer.Argument(metavar="FIT.JSON", help="A fit.json, or its folder.")],
    recording: Annotated[Path, typer.Argument(metavar="RECORDING", help="A recording of the same key.")],
    out: Annotated[Path | None, typer.Option(metavar="FILE.WAV", help="File for the predicted sound.")] = None,
    channel: options.Channel = "average",
    force: options.Force = False,
    as_json: options.Json = False,
) -> None:
    """Predict a recording that took no part in the fit. Only velocity, gain and pitch are free."""
    result = _predict(fit, recording, out, channel, force)
    end = ", at the limit of the searched range: the velocity could not be determined" if result["v_H0_at_end"] else ""
    words = (
        f"{result['predicted_db']:.2f} dB over {counted(result['partials'], 'partial')}, {result['cents']:+.2f} cents "
        f"from the fit, at {result['v_H0']:.3g} m/s{end}\n"
    )
    if result["was_fitted"]:
        words += "This recording took part in the fit, so this is not a prediction.\n"
    print_result(result, words, as_json)


def _predict(fit: Path, file: Path, out: Path | None, channel: str, force: bool) -> dict:
    """Predict the recording `file` from a `fit.json`. Write the predicted sound to `out`, if given."""
    from ..fit_file import fit_path, notes_of_minima, read_fit, relative_gains
    from ..model.program_cache import enable_program_cache
    from ..result.comparison import estimate_contact_onset
    from ..result.prediction import predict_recording

    if out is not None:
        check_sound_target(out, force)
    fit = fit_path(fit)
    document = read_fit(fit)
    mixture = notes_of_minima(document, fit)
    recording = load_recording(file, channel=channel)
    enable_program_cache()
    result = predict_recording(mixture, recording, gains=relative_gains(document))
    if out is not None:
        strike = result.note.strike(recording.rate)
        contact = estimate_contact_onset(result.note, strike, recording)
        samples = result.note.render_mono(strike, recording.rate, len(recording.samples), contact)
        write_file(out, encode_wav(samples, recording.rate), force)
    fitted = {row.get("sha256") for row in document["recordings"] if isinstance(row, dict)}
    return {
        "file": recording.path,
        "sha256": recording.sha256,
        "was_fitted": recording.sha256 in fitted,
        "predicted_db": result.error_db,
        "partials": result.partials,
        "v_H0": result.velocity,
        "v_H0_at_end": result.velocity_at_search_limit,
        "gain_db": result.gain_db,
        "cents": result.cents,
    }


def cross_validate(
    recordings: options.Recordings,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder for the fit of all recordings and its page.")
    ] = None,
    note: options.Note = None,
    f0: options.Pitch = None,
    setup: options.SetupFile = None,
    channel: options.Channel = "average",
    felt: options.Felt = None,
    seed: options.Seed = 0,
    force: options.Force = False,
    as_json: options.Json = False,
) -> None:
    """Leave out each recording of a key in turn, fit the others, and predict it."""
    from ..fitting import analyse_all
    from ..model.program_cache import enable_program_cache
    from ..result.cross_validation import cross_validate as run
    from .summary import cross_validation

    check_seed(seed)
    with nullcontext() if out is None else output_folder(out, force) as folder, progress_bar() as progress:
        loaded = load_recordings(recordings, channel)
        analyses = analyse_all(loaded, note, f0)
        enable_program_cache()
        result, full_fit = run(loaded, analyses, _setup_with_felt(setup, felt), seed=seed, progress=progress)
        if folder is not None:
            full_fit.save(folder, force=True, page=False)
            full_fit.report(folder, held_out=result)
            replace_file(folder / "cross_validation.json", json_text(result).encode())
    print_result(result, cross_validation(result), as_json)


def compare(
    a: Annotated[Path, typer.Argument(metavar="A", help="A fit: its folder, or its fit.json.")],
    b: Annotated[Path, typer.Argument(metavar="B", help="Another fit.")],
    out: Annotated[
        Path | None, typer.Option(metavar="FILE.SVG", help="File for a figure of both felts: SVG, PNG or PDF.")
    ] = None,
    force: options.Force = False,
    as_json: options.Json = False,
) -> None:
    """Compare two fits: values, differences, z, and felt force over compression."""
    from ..report.compare import compare as run
    from ..report.figures_compared import KINDS

    kind = "" if out is None else out.suffix.lower().removeprefix(".")
    if out is not None:
        if kind not in KINDS:
            raise OutputError(f"{printable(out)}: a figure ends in .{', .'.join(KINDS)}; give --out another name")
        check_target(out, force)
    comparison = run(a, b)
    if out is not None:
        write_file(out, comparison.figure(kind), force)
    print_result(comparison.to_dict(), f"{comparison!r}\n", as_json)
