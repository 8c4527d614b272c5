"""Run the studies, and write the files and the pages."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from pianofit import __version__
from pianofit.io.files import encode_wav, replace_file, write_error
from pianofit.io.number_format import format_relative_uncertainty, number
from pianofit.io.table_output import write_csv
from pianofit.listening.page import ListeningSound, Question, write_listening
from pianofit.parameters import PARAMETERS
from pianofit.program_folder import enable_program_cache
from pianofit.report.drawing import page_style, saved
from pianofit.report.html import data_uri, write_page
from pianofit.report.sound import Clip, make_clips

from .claims import WORDS, Claim, judge
from .direct import NOTE, ROUND_TRIP
from .figures import FIGURES, SYMBOLS
from .findings import FULL, Findings, Plan, compute
from .hammer_search import WITHIN
from .laboratory import SCALE
from .strokes import RECIPES, SOUNDS, Stroke
from .tables import tables

__all__ = ["reproduce"]

SECONDS = 2.2  # length of each sound on the pages, s
LEAD = 0.05  # s of silence before each sound of the listening test
# Sounds at velocities that were not fitted: name -> name on the page.
PREDICTED = {
    "measured": "measured",
    "paper": "predicted, three bands",
    "read": "predicted, string read",
    "initial": "initial",
}
# Pairs of the listening test: which of the two sounds is nearer the measured one? Only one stroke has the last pair.
PAIRS = (("paper", "initial"), ("paper", "global"), ("read", "initial"), ("read", "global"), ("default", "read"))


def reproduce(
    folder: Path, seed: int = 0, *, plan: Plan = FULL, progress: Callable[[str, float], None] = lambda *_: None
) -> list[Claim]:
    """Write `index.html`, `listening.html` and their files to `folder`, and return the tested claims.

    The files contain the figures as PNG, the tables as CSV and the sounds as WAV.

    Parameters
    ----------
    folder : existing folder for the output.
    seed : of all random numbers. The same seed gives the same files.
    progress : called with the name of the stage and the fraction done.

    Raises
    ------
    OutputError
        If a file or folder cannot be written.
    """
    enable_program_cache()
    findings = compute(plan, seed, progress)
    progress("pages", 0.99)
    claims, numbers = judge(findings), tables(findings)
    shown = {plan.origin: (findings.origin, SOUNDS)}
    shown |= {velocity: (stroke, PREDICTED) for velocity, stroke in findings.predictions.items()}
    for name in ("data", "figures", "sounds"):
        try:
            (folder / name).mkdir(exist_ok=True)
        except OSError as error:
            raise write_error(folder / name, error, "choose another --out") from None
    for name, table in numbers.items():
        write_csv(folder / f"data/{name}.csv", table.columns, table.rows)
    figures = {name: _drawn(folder / f"figures/{name}.png", draw, findings) for name, draw in FIGURES.items()}
    players = {f"{v:.3f}": played(folder / "sounds", f"{v:.3f}", *sounds) for v, sounds in shown.items()}
    files = [f"data/{name}.csv" for name in numbers] + [f"figures/{name}.png" for name in figures]
    files += [f"sounds/{_file(name, clip.name)}" for name, clips in players.items() for clip in clips]
    _write_test(folder, findings)
    write_page(
        folder / "index.html",
        "index.html.j2",
        package="studies.bensa2005",
        styles=("claims.css",),
        scripts=("audio.js", "player.js"),
        filters=FILTERS,
        title="Parameter fitting for piano sound synthesis, reproduced",
        version=__version__,
        f=findings,
        claims=claims,
        words=WORDS,
        figures=figures,
        tables=numbers,
        players=players,
        files=files,
        recipes=RECIPES,
        note=NOTE,
        trip=ROUND_TRIP,
        within=WITHIN,
        scale=SCALE,
    )
    progress("done", 1.0)
    return [*claims.values()]


def _drawn(target: Path, draw: Callable, findings: Findings) -> str:
    """Write the PNG of a figure, and return its SVG as a data URI for the page."""
    with page_style():
        figure = draw(findings)
        shown = data_uri("image/svg+xml", saved(figure, "svg"))
        replace_file(target, saved(figure, "png"))
    return shown


def played(folder: Path, name: str, stroke: Stroke, names: dict[str, str]) -> list[Clip]:
    """Write the sounds of a stroke at their own levels, and return clips of equal loudness for the page."""
    rate, sounds = stroke.recording.rate, {label: stroke.sounds[sound] for sound, label in names.items()}
    for label, samples in sounds.items():
        replace_file(folder / _file(name, label), encode_wav(samples / SCALE, rate))
    return make_clips({label: _cut(samples, rate) for label, samples in sounds.items()}, rate)


def _file(name: str, label: str) -> str:
    """File name of a sound."""
    return f"{name}-{label.replace(',', '').replace(' ', '-')}.wav"


def _symbol(name: str) -> str:
    """Name on the page of a parameter (with its unit) or a recipe; any other text is unchanged."""
    if name in SYMBOLS:
        unit = PARAMETERS[name].unit.replace("^p", "ᵖ")
        return SYMBOLS[name] if unit == "1" else f"{SYMBOLS[name]}, {unit}"
    return RECIPES.get(name, name)


def _listed(values: Iterable[float], digits: int = 3, scale: float = 1) -> str:
    *most, last = [number(scale * float(v), digits) for v in values]
    return f"{', '.join(most)} and {last}" if most else last


def _percent(share: float) -> str:
    return f"{number(100 * share, 2)} %"


def _factor(deviation: float) -> str:
    """Format a standard deviation of the logarithm."""
    return format_relative_uncertainty(deviation, "a factor {}").removeprefix("± ")


FILTERS = {"symbol": _symbol, "letter": SYMBOLS.get, "listed": _listed, "percent": _percent, "factor": _factor}


def _write_test(folder: Path, f: Findings) -> None:
    """Write `listening.html`."""
    questions, rate = [], f.origin.recording.rate
    for velocity in f.plan.listening:
        sounds = {
            name: ListeningSound(SOUNDS[name], f"{velocity:g} m/s", np.pad(_cut(x, rate), (int(LEAD * rate), 0)))
            for name, x in f.strokes[velocity].sounds.items()
        }
        questions += [Question(sounds["measured"], (sounds[a], sounds[b])) for a, b in PAIRS if a in sounds]
        questions.append(Question(sounds["measured"], (sounds["measured"], sounds["initial"]), 1))
    write_listening(
        folder / "listening.html",
        questions,
        rate,
        LEAD,
        f.seed,
        program="python -m studies.bensa2005",
        about="the sounds of the reproduction of Bensa et al. (2005)",
        origin="synthetic measurements of pianofit, which replace the paper's: those are not public",
        key=folder / "listening-key.json",
    )


def _cut(samples: np.ndarray, rate: int) -> np.ndarray:
    return samples[: int(SECONDS * rate)]
