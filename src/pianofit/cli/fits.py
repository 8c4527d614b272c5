"""Commands from recordings to parameters: analyse, fit, predict, cross-validate, compare."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..conversions import HALF_WIDTH_95
from ..errors import ParameterError, SetupError
from ..excitation import STROKES
from ..io.containers import readable_formats
from ..io.files import check_target, encode_wav, json_text, output_folder, printable, replace_file
from ..io.number_format import columns, counted, format_with_interval, with_standard_error
from ..progress import progress_bar
from ..recording.recording import load_recording
from ..setup import SETUP_KEYS, Setup
from . import options
from .options import choice, integer, real, text
from .terminal import print_result

if TYPE_CHECKING:
    from ..analysis import Analysis
    from ..result.cross_validation import CrossValidation


def analyse(
    file: Annotated[
        Path,
        typer.Argument(metavar="RECORDING", help=f"A recording of one struck or plucked note: {readable_formats()}."),
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
        ("b1", analysis.b1, analysis.b1_error, "1/s", "decay rate of partial k: b1 + d2 k²; T60 is 6.91 over it"),
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
        " ".join(
            f"{f'{column.name}, {column.unit}' if column.unit else column.name:>{column.width}}" for column in COLUMNS
        ),
    ]
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
    out: Annotated[Path, text("DIR", "Folder for fit.json, the sounds and the page.")],
    note: options.Note = None,
    f0: options.Pitch = None,
    setup: options.SetupFile = None,
    velocity: Annotated[
        float | None, real("M/S", "Hammer velocity of a single recording, in m/s.", default="estimated")
    ] = None,
    channel: options.Channel = "average",
    felt: options.Felt = None,
    excitation: options.Excitation = None,
    quantity: options.Quantity = None,
    pickup: options.Pickup = None,
    method: Annotated[
        str,
        choice(
            "NAME",
            "Search; paper and global are the paper's, for comparison",
            ("default", "paper", "global"),
            "--recipe",
        ),
    ] = "default",
    evaluations: Annotated[
        int | None,
        integer("N", "Evaluations of the criterion in the annealing of --recipe paper.", default="20000"),
    ] = None,
    intervals: Annotated[
        str,
        choice(
            "METHOD",
            "Method for intervals; profile takes some seconds more, and posterior (NUTS) minutes and the extra bayes",
            ("laplace", "profile", "posterior"),
        ),
    ] = "laplace",
    seed: options.Seed = 0,
    force: options.Force = False,
    page: Annotated[bool, typer.Option(help="Write report.html.")] = True,
    as_json: options.Json = False,
) -> None:
    """Estimate string and hammer, or string and pluck, from one or several recordings of a key."""
    _check_method(method, evaluations, intervals, len(recordings))
    with output_folder(out, force) as folder, progress_bar() as progress:
        given: dict[str, Any] = {
            "setup": setup_of_options(setup, felt, excitation, quantity, pickup),
            "note": note,
            "f0": f0,
            "velocity": velocity,
            "channel": channel,
            "seed": seed,
            "progress": progress,
        }
        if method == "default":
            from ..fitting import fit as run

            result = run(*recordings, **given, intervals=intervals)
        else:
            from ..bensa2005 import fit as fit_by_paper

            result = fit_by_paper(recordings[0], **given, method=method, evaluations=evaluations)
        progress("page", 0.95)
        result.save(folder, force=True, page=page)
    print_result(result.fit, f"{result.summary()}\nwritten to {printable(folder)}\n", as_json)


def _check_method(method: str, evaluations: int | None, intervals: str, recordings: int) -> None:
    """Reject options that the search does not have."""
    if evaluations is not None and method != "paper":
        raise ParameterError(f"evaluations={evaluations} needs an annealing: use method='paper'")
    if method != "default" and recordings > 1:
        raise ParameterError(f"method={method!r} fits one recording; {recordings} were given")
    if method != "default" and intervals != "laplace":
        raise ParameterError(f"intervals={intervals!r} needs method='default'; method={method!r} has no intervals")


def setup_of_options(
    path: Path | None, felt: str | None, excitation: str | None, quantity: str | None, pickup: float | None
) -> Setup:
    """Load the setup, with the values of the command line, which must not contradict it."""
    options = {"excitation": excitation, "pickup_quantity": quantity, "pickup_position": pickup}
    given = {name: value for name, value in options.items() if value is not None}
    if path is None:
        return Setup(felt=felt, **given)
    setup = Setup.from_toml(path, felt)
    for name, value in given.items():
        table, key = SETUP_KEYS[name]
        own = getattr(setup, name)
        if own != getattr(Setup(), name) and own != value:
            raise SetupError(f"{printable(path)}: [{table}] {key} = {own} contradicts {value} of the command line")
    return replace(setup, **given)


def predict(
    fit: Annotated[Path, typer.Argument(metavar="FIT.JSON", help="A fit.json, or its folder.")],
    recording: Annotated[Path, typer.Argument(metavar="RECORDING", help="A recording of the same key.")],
    out: Annotated[Path | None, text("FILE.WAV", "File for the predicted sound.")] = None,
    channel: options.Channel = "average",
    force: options.Force = False,
    as_json: options.Json = False,
) -> None:
    """Predict a recording that took no part in the fit. Only velocity or plucking position, gain and pitch are free."""
    from ..result import Result
    from ..result.alignment import estimate_contact_onset

    if out is not None:
        check_target(out, force, ".wav")
    fitted = Result.load(fit)
    sound = load_recording(recording, channel=channel)
    p = fitted.predict(sound)
    if out is not None:
        strike = p.note.strike(sound.rate)
        contact = estimate_contact_onset(p.note, strike, sound)
        samples = p.note.render_mono(strike, sound.rate, len(sound.samples), contact)
        replace_file(out, encode_wav(samples, sound.rate))
    was_fitted = sound.sha256 in {row.sha256 for row in fitted.fit.recordings}
    end = f", at the limit of the searched range: {p.stroke.name} could not be determined" if p.at_search_limit else ""
    words = (
        f"{p.error_db:.2f} dB over {counted(p.partials, 'partial')}, {p.pitch_offset_cents:+z.2f} cents from the fit, "
        f"at {p.stroke.name} = {p.stroke_value:.3g} {p.stroke.unit}{end}\n"
    )
    if was_fitted:
        words += "This recording took part in the fit, so this is not a prediction.\n"
    info = {
        "file": sound.path,
        "sha256": sound.sha256,
        "in_training_set": was_fitted,
        "predicted_db": p.error_db,
        "partials": p.partials,
        "stroke_parameter": p.stroke.name,
        "stroke_value": p.stroke_value,
        "at_search_limit": p.at_search_limit,
        "gain_db": p.gain_db,
        "pitch_offset_cents": p.pitch_offset_cents,
    }
    print_result(info, words, as_json)


def cross_validate(
    recordings: options.Recordings,
    out: Annotated[Path | None, text("DIR", "Folder for the fit of all recordings and its page.")] = None,
    note: options.Note = None,
    f0: options.Pitch = None,
    setup: options.SetupFile = None,
    channel: options.Channel = "average",
    felt: options.Felt = None,
    excitation: options.Excitation = None,
    quantity: options.Quantity = None,
    pickup: options.Pickup = None,
    seed: options.Seed = 0,
    force: options.Force = False,
    as_json: options.Json = False,
) -> None:
    """Leave out each recording of a key in turn, fit the others, and predict it."""
    from ..result.cross_validation import cross_validate as run

    with nullcontext() if out is None else output_folder(out, force) as folder, progress_bar() as progress:
        given = setup_of_options(setup, felt, excitation, quantity, pickup)
        sources = {"note": note, "f0": f0, "channel": channel}
        held_out = run(*recordings, setup=given, **sources, seed=seed, progress=progress)
        if folder is not None:
            held_out.result.save(folder, force=True, page=False)
            held_out.result.report(folder, held_out=held_out)
            replace_file(folder / "cross_validation.json", json_text(held_out.to_dict()).encode())
    print_result(held_out.to_dict(), _left_out_table(held_out), as_json)


def _left_out_table(held_out: CrossValidation) -> str:
    """Prediction errors of recordings that were left out, next to errors of methods without a model."""
    stroke = STROKES[held_out.result.fit.excitation]
    lines = [f"{'':32}{f'{stroke.name}, {stroke.unit}':>10}{'predicted':>11}{'nearest':>9}{'blend':>7}   rms error, dB"]
    for row in held_out.recordings:
        errors = (row.predicted_db, row.nearest_db, row.blend_db)
        predicted, nearest, blend = ("-" if error is None else f"{error:.2f}" for error in errors)
        note = "" if row.has_neighbours else "  (beyond the others)"
        lines.append(f"{Path(row.file).name:32}{row.stroke_value:10.3g}{predicted:>11}{nearest:>9}{blend:>7}{note}")
    if held_out.median_inner_db is not None:
        errors = f"median {held_out.median_inner_db:.2f} dB, worst {held_out.worst_inner_db:.2f} dB"
        lines.append(f"between the others: {errors}")
    return "\n".join([*lines, *held_out.warnings]) + "\n"


def compare(
    a: Annotated[Path, typer.Argument(metavar="A", help="A fit: its folder, or its fit.json.")],
    b: Annotated[Path, typer.Argument(metavar="B", help="Another fit.")],
    out: Annotated[Path | None, text("FILE", "Figure of both felts to write, .svg, .png or .pdf.")] = None,
    force: options.Force = False,
    as_json: options.Json = False,
) -> None:
    """Compare two fits: values, differences, z, and felt force over compression."""
    from ..report.compare import FIGURE_KINDS
    from ..report.compare import compare as run

    if out is not None:
        check_target(out, force, *(f".{kind}" for kind in FIGURE_KINDS))
    comparison = run(a, b)
    if out is not None:
        replace_file(out, comparison.figure(out.suffix[1:].lower()))
    print_result(comparison, f"{comparison!r}\n", as_json)
