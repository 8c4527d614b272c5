"""The commands from recordings to parameters: analyse, fit, predict, crossval, compare."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..conversions import NORMAL
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

__all__ = ["analyse", "compare", "crossval", "fit", "predict"]


def analyse(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help=f"A recording of one struck note: {readable_formats()}.")
    ],
    note: options.Note = None,
    f0: options.Pitch = None,
    channel: options.Channel = "average",
    as_json: options.Json = False,
) -> None:
    """Read pitch, inharmonicity, losses and partials off a recording, without a hammer."""
    from ..analysis import analyse as run
    from ..analysis import as_dict

    recording = load_recording(file, channel=channel)
    found = run(recording, note=note, f0=f0)
    found = replace(found, warnings=recording.warnings + found.warnings)
    print_result(as_dict(found), _table(found), as_json)


def _table(found: Analysis) -> str:
    """The string's laws with 95 % intervals, then a line for every partial with standard errors."""
    from ..analysis import COLUMNS, near_note, rows

    laws = (
        ("f0", found.f0, found.f0_error, "Hz", ""),
        ("B", found.B, found.B_error, "", ""),
        ("b1", found.b1, found.b1_error, "1/s", "decay rate of partial k: b1 + d2 k²"),
        ("d2", found.d2, found.d2_error, "1/s", ""),
    )
    cells = []
    for name, value, error, unit, note in laws:
        text, span = format_with_interval(value, (value - NORMAL * error, value + NORMAL * error))
        cells.append((name, text, unit, span, note))
    lines = [
        near_note(found.f0),
        *columns(cells, right=1),
        f"partials scatter by {found.scatter_cents:.2f} cents",
        "",
        "In brackets 95 % intervals, after ± one standard error.",
        " ".join(f"{f'{column.name}, {column.unit}' if column.unit else column.name:>{column.width}}"
                 for column in COLUMNS),
    ]  # fmt: skip
    for row in rows(found):
        cells = []
        for at, column in enumerate(COLUMNS):
            if COLUMNS[at + 1 : at + 2] and COLUMNS[at + 1].error:
                cells += with_standard_error(row[at], row[at + 1])
            elif not column.error:
                cells.append(f"{row[at]:.{column.digits}f}")
        lines.append(" ".join(f"{cell:>{column.width}}" for cell, column in zip(cells, COLUMNS, strict=True)))
    return "\n".join([*lines, *found.warnings]) + "\n"


def fit(
    recordings: options.Recordings,
    out: Annotated[Path, typer.Option(metavar="DIR", help="The folder for fit.json, the sounds and the page.")],
    note: options.Note = None,
    f0: options.Pitch = None,
    setup: options.Known = None,
    velocity: options.Velocity = None,
    channel: options.Channel = "average",
    felt: options.Felt = None,
    recipe: Annotated[
        str,
        typer.Option(
            parser=choice("default", "paper", "global"),
            metavar="NAME",
            help="default; or, for comparison, the paper's own: paper or global.",
        ),
    ] = "default",
    evaluations: Annotated[
        int | None,
        typer.Option(
            parser=whole, metavar="N", help="Evaluations of the criterion by the annealing of --recipe paper."
        ),
    ] = None,
    intervals: Annotated[
        str,
        typer.Option(
            parser=choice("laplace", "profile", "posterior"),
            metavar="METHOD",
            help="How intervals are found: laplace; profile, which takes some seconds more; or posterior, sampled by "
            "NUTS, which takes minutes and needs the extra bayes.",
        ),
    ] = "laplace",
    seed: options.Seed = 0,
    force: options.Force = False,
    page: Annotated[bool, typer.Option(help="Write report.html.")] = True,
    as_json: options.Json = False,
) -> None:
    """Find the string's and the hammer's parameters behind one recording, or behind several of one key."""
    from ..fitting import fit as run
    from ..model.program_cache import enable_program_cache
    from .summary import summary

    check_velocity(velocity)
    check_seed(seed)
    with output_folder(out, force) as folder, progress_bar() as progress:
        known = _known(setup, felt)
        enable_program_cache()
        result = run(
            *recordings, setup=known, note=note, f0=f0, velocity=velocity, channel=channel, recipe=recipe,
            evaluations=evaluations, intervals=intervals, seed=seed, progress=progress,
        )  # fmt: skip
        progress("page", 0.95)
        result.save(folder, force=True, page=page)
    print_result(result.document, summary(result.document, folder), as_json)


def _known(setup: Path | None, felt: str | None) -> Setup:
    """What was known beforehand, with the felt's law that the command names."""
    return Setup(felt=felt) if setup is None else load_setup(setup, felt)


def predict(
    fit: Annotated[Path, typer.Argument(metavar="FIT.JSON", help="What pianofit fit wrote, or its folder.")],
    recording: Annotated[Path, typer.Argument(metavar="RECORDING", help="A recording of the same key.")],
    out: Annotated[Path | None, typer.Option(metavar="FILE.WAV", help="The predicted sound, if wanted.")] = None,
    channel: options.Channel = "average",
    force: options.Force = False,
    as_json: options.Json = False,
) -> None:
    """Predict a recording that took no part in the fit: only velocity, gain and pitch are free."""
    found = _predicted(fit, recording, out, channel, force)
    end = ", an end of the range searched: the velocity is not found" if found["v_H0_at_end"] else ""
    words = (
        f"{found['predicted_db']:.2f} dB over {counted(found['partials'], 'partial')}, {found['cents']:+.2f} cents "
        f"from the fit, at {found['v_H0']:.3g} m/s{end}\n"
    )
    if found["was_fitted"]:
        words += "This recording took part in the fit: how near it comes is no prediction.\n"
    print_result(found, words, as_json)


def _predicted(fit: Path, file: Path, out: Path | None, channel: str, force: bool) -> dict:
    """What came of predicting the recording `file` from a `fit.json`; its sound goes to `out`, if asked for."""
    from ..fit_file import fit_path, gains_of, mixture_of, read_fit
    from ..model.program_cache import enable_program_cache
    from ..result.alignment import estimate_contact_onset
    from ..result.prediction import predict_recording

    if out is not None:
        check_sound_target(out, force)
    fit = fit_path(fit)
    document = read_fit(fit)
    mixture = mixture_of(document, fit)
    recording = load_recording(file, channel=channel)
    enable_program_cache()
    found = predict_recording(mixture, recording, gains=gains_of(document))
    if out is not None:
        strike = found.note.strike(recording.rate)
        touch = estimate_contact_onset(found.note, strike, recording)
        samples = found.note.render_mono(strike, recording.rate, len(recording.samples), touch)
        write_file(out, encode_wav(samples, recording.rate), force)
    known = {row.get("sha256") for row in document["recordings"] if isinstance(row, dict)}
    return {
        "file": recording.path,
        "sha256": recording.sha256,
        "was_fitted": recording.sha256 in known,
        "predicted_db": found.error_db,
        "partials": found.partials,
        "v_H0": found.velocity,
        "v_H0_at_end": found.velocity_at_search_limit,
        "gain_db": found.gain_db,
        "cents": found.cents,
    }


def crossval(
    recordings: options.Recordings,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="A folder for the fit of all recordings and its page, if wanted.")
    ] = None,
    note: options.Note = None,
    f0: options.Pitch = None,
    setup: options.Known = None,
    channel: options.Channel = "average",
    felt: options.Felt = None,
    seed: options.Seed = 0,
    force: options.Force = False,
    as_json: options.Json = False,
) -> None:
    """Leave out each recording of a key in turn, fit the others, and predict it."""
    from ..fitting import analyse_all
    from ..model.program_cache import enable_program_cache
    from ..result.cross_validation import cross_validate
    from .summary import cross_validation

    check_seed(seed)
    with nullcontext() if out is None else output_folder(out, force) as folder, progress_bar() as progress:
        known, sounds = _known(setup, felt), load_recordings(recordings, channel)
        heard = analyse_all(sounds, note, f0)
        enable_program_cache()
        found, whole = cross_validate(sounds, heard, known, seed=seed, progress=progress)
        if folder is not None:
            whole.save(folder, force=True, page=False)
            whole.report(folder, held_out=found)
            replace_file(folder / "crossval.json", json_text(found).encode())
    print_result(found, cross_validation(found), as_json)


def compare(
    a: Annotated[Path, typer.Argument(metavar="A", help="A fit: its folder, or its fit.json.")],
    b: Annotated[Path, typer.Argument(metavar="B", help="Another fit.")],
    out: Annotated[
        Path | None, typer.Option(metavar="FILE.SVG", help="A figure of both felts: SVG, PNG or PDF.")
    ] = None,
    force: options.Force = False,
    as_json: options.Json = False,
) -> None:
    """Compare two fits: values, differences and z, and the felts' force over compression."""
    from ..report.compare import compare as run
    from ..report.figures_compared import KINDS

    kind = "" if out is None else out.suffix.lower().removeprefix(".")
    if out is not None:
        if kind not in KINDS:
            raise OutputError(f"{printable(out)}: a figure ends in .{', .'.join(KINDS)}; give --out another name")
        check_target(out, force)
    found = run(a, b)
    if out is not None:
        write_file(out, found.figure(kind), force)
    print_result(found.to_dict(), f"{found!r}\n", as_json)
