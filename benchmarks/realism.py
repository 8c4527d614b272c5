"""Distance of the synthesis of a left-out layer from its recording.

    python benchmarks/realism.py                       all notes of the recordings
    python benchmarks/realism.py --notes C4,A0 --json realism.json
    python benchmarks/realism.py --notes A6 --velocity 2        played at 2 m/s, not at the predicted velocity
    python benchmarks/realism.py --notes A6 --layer 1           the softest layer left out, in place of the middle one
    python benchmarks/realism.py --constants           each constant of the modal response halved and doubled

Of every note with three layers or more one inner layer is left out entirely: string, hammer, modes and knock come from
the others, its velocity and gain from `Result.predict`. The distance is that of `../shared/tools/realism.py`
(or of the file that PIANOFIT_REALISM names), dB: the mean of three log-mel distances, attack, early and late, blind to
gain and shift. The next column has the nearer of the two neighbouring recordings. A recording has noise, which no model
plays. The last column adds noise to the synthesis, with the spectrum of the other layers between their partials at
their ends. It shows how much of a distance is noise. Recordings are found as in `crossval.py`. Constants are judged on
every second note and checked on the others.

A second table, dB, once both are aligned in time and loudness by the same tool:

- envelope: of a partial, rms over 3 s (frames of 20 ms) of the difference of the levels of the bands about it, raised
  to a floor 10 dB above the recording's noise there, but to 60 dB below its loudest band at least; frames where neither
  is above it do not count. The median over partials, one gain a note taken out; in brackets one gain a partial, which
  leaves the envelope's shape.
- loudness: rms over 3 s of the difference of K-weighted levels, frames of 50 ms, down to 60 dB below the loudest.
- gain: K-weighted level of the synthesis over the recording's before they were aligned. The prediction knows the
  recording's levels of partials, and takes its gain from them.
- low: energy from 10 ms before the onset to 30 ms after it below 0.7 of the lowest partial's frequency, synthesis over
  recording; for notes whose periods are much shorter, from C5 up.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
import os
import statistics
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple

import crossval
import numpy as np
from scipy import signal
from scipy.ndimage import median_filter

if TYPE_CHECKING:
    from pianofit import Analysis, Recording, Result, Setup
    from pianofit.model import Note, Simulation

TOOL = Path(__file__).parents[2] / "shared" / "tools" / "realism.py"
SECONDS = 3.3
RENDER_MODELS = ("string model", "modes", "modes and knock", "nearest layer", "and noise")
# Partials of the recording that count lie within so many dB of the strongest.
RANGE = 50.0
# Envelopes: between frames, s, and the floor over the recording's noise, dB.
FRAME, ABOVE = 0.02, 10.0
# Loudness: the window of its curve, s.
LOUDNESS = 0.05
# Noise: the end of a recording that shows it, s, the window of its spectrum, s, and over how much it is smoothed, Hz.
END, WINDOW, SMOOTH = 1.5, 0.37, 200.0
# The energy below the lowest partial is computed for notes from here on, Hz: 15 periods in 30 ms.
TREBLE = 500.0
CONSTANTS = {
    "aligned_layers": ("KERNEL", "LEAST_COHERENCE", "LARGEST_DETUNING", "PITCH_PARTIALS", "LEAST_PITCH_COHERENCE"),
    "valid_frames": (
        "LOG_TIME_START",
        "RANGE",
        "LEAST_SNR",
        "ENVELOPE",
        "CONTACT",
        "NOISE_MARGIN",
        "LEAST_DEVIATION_DB",
    ),
    "modes": ("FASTEST", "FASTEST_RATIO", "FAINTEST", "LARGEST_LAYER_SNR", "OF_SPACING", "OF_BAND"),
    "shared_response": (
        "KNOCK_SECONDS",
        "FADE",
        "LEAST_DRIVE",
        "FLOOR",
        "ATTACK_WEIGHT",
        "DELAY_PENALTY",
        "LARGEST_DELAY",
        "ATTACK_SECONDS",
        "WHITENING_EXPONENT",
        "LOUDNESS",
    ),
}


class Fitted(NamedTuple):
    """A note's layers, soft to loud, and the fit of all but one."""

    recordings: tuple[Recording, ...]
    analyses: tuple[Analysis, ...]
    out: int  # which was left out
    result: Result


class LeftOut(NamedTuple):
    """A layer that was left out, and its prediction from the others."""

    note: Callable[[], Note]  # with the modal response of the others, at the left-out stroke
    stroke: Simulation
    rate: int  # Hz
    noise: np.ndarray  # as in the others [samples]
    target: np.ndarray  # the recording at the tool's rate [samples]
    partials: np.ndarray  # Hz, those detected in it
    f0: float  # Hz
    near: dict  # distances of the nearer neighbour


def measure() -> ModuleType:
    """The program that measures."""
    spec = importlib.util.spec_from_file_location("realism_tool", os.environ.get("PIANOFIT_REALISM", TOOL))
    if spec is None or spec.loader is None:
        raise SystemExit(f"{TOOL}: no such file; say where it is in PIANOFIT_REALISM")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def brightness(analysis) -> float:
    """Mean frequency of the partials, weighted by amplitude, Hz. It rises with velocity, whatever the gain."""
    amplitude = 10 ** (analysis.partials.level / 20)
    return float((amplitude * analysis.partials.frequency).sum() / amplitude.sum())


def fitted(note: str, files: list[Path], setup: Setup, layer: int | None = None) -> Fitted:
    """One layer left out, the others fitted: the one in the middle, or `layer`, from 1, the softest."""
    from pianofit import analyse, fit, load_recording

    pairs = [(recording, analyse(recording, note=note)) for recording in map(load_recording, files)]
    recordings, analyses = zip(*sorted(pairs, key=lambda pair: brightness(pair[1])), strict=True)
    out = (len(files) - 1) // 2 if layer is None else min(layer, len(files)) - 1
    rest = [i for i in range(len(files)) if i != out]
    result = fit(*(recordings[i] for i in rest), analyses=[analyses[i] for i in rest], setup=setup)
    return Fitted(recordings, analyses, out, result)


def left_out(fit: Fitted, tool: ModuleType, velocity: float | None = None) -> LeftOut:
    """Return the prediction of the left-out layer from the others, at `velocity`, m/s, or at the prediction's."""
    from measuring import modal_response_of

    recordings, analyses, out, result = fit
    played = result.predict(analyses[out]).note
    played = played if velocity is None else played.with_velocity(velocity)
    recording, analysis = recordings[out], analyses[out]
    others, partials = [x.recording for x in result.recordings], analysis.partials
    left = LeftOut(
        lambda: played._replace(modal_response=modal_response_of(result)),
        played.strike(recording.rate), recording.rate,
        noise(others, analysis.f0, recording.rate), tool.load(recording.path),
        partials.frequency[partials.level > partials.level.max() - RANGE], analysis.f0, {},
    )  # fmt: skip
    neighbours = [recordings[i] for i in (out - 1, out + 1) if 0 <= i < len(recordings)]
    near = [distances(tool.load(other.path), left, tool) for other in neighbours]
    return left._replace(near=min(near, key=lambda x: x["distance"]))


def noise(recordings: list[Recording], f0: float, rate: int) -> np.ndarray:
    """Noise with the mean spectrum, in dB, that recordings have at their ends between the partials.

    From half of f0 on a level is the median over two spacings of partials, but no more than `SMOOTH`.
    """
    hz, levels = np.empty(0), []
    for recording in recordings:
        end = recording.samples[-round(END * recording.rate) :]
        hz, power = signal.welch(end, recording.rate, nperseg=round(WINDOW * recording.rate))
        between = median_filter(power, round(min(2 * f0, SMOOTH) * WINDOW) | 1)
        levels.append(np.log(np.where(hz < f0 / 2, power, between) + 1e-30))
    white = np.random.default_rng(0).normal(size=round(SECONDS * rate))
    shape = np.interp(np.fft.rfftfreq(len(white), 1 / rate), hz, np.exp(np.mean(levels, axis=0) / 2))
    return np.fft.irfft(np.fft.rfft(white) * shape * np.sqrt(rate / 2), len(white))


def sound(note: Note, left: LeftOut, tool: ModuleType, noise_share: float = 0.0) -> np.ndarray:
    """The stroke that was left out by this note at the tool's rate, with so much of the noise [samples]."""
    by = np.gcd(tool.RATE, left.rate)
    samples = note.render_mono(left.stroke, left.rate, round(SECONDS * left.rate), round(0.012 * left.rate))
    return signal.resample_poly(samples + noise_share * left.noise, tool.RATE // by, left.rate // by)


def distances(samples: np.ndarray, left: LeftOut, tool: ModuleType) -> dict[str, Any]:
    """Of a sound at the tool's rate from the recording, dB; `low` is None in the bass."""
    recorded, played, _, gain = tool.align(left.target, samples)
    mean, parts = tool.logmel(recorded, played)
    curves = (tool.envelope(tool.k_weighted(x), LOUDNESS) for x in (recorded, played))
    own, other = (20 * np.log10(x[:: round(LOUDNESS / 2 * tool.RATE)].clip(1e-10)) for x in curves)
    apart = (own - np.maximum(other, own.max() - tool.RANGE - 20))[own > own.max() - tool.RANGE]
    envelope, shape = envelopes(recorded, played, left, tool)
    return {
        "distance": mean, **parts, "envelope": envelope, "shape": shape, "gain": -gain,
        "loudness": float(np.sqrt(np.mean(apart**2))), "low": low(recorded, played, left.f0, tool),
    }  # fmt: skip


def envelopes(recorded: np.ndarray, played: np.ndarray, left: LeftOut, tool: ModuleType) -> tuple[float, float]:
    """Medians over partials of the rms difference of envelopes, one gain a note and one a partial taken out, dB."""
    length = round(float(np.clip(4 / left.f0, 0.03, 0.16)) * tool.RATE) | 1
    window = np.hanning(length + 2)[1:-1]
    frames = slice(round(tool.PRE * tool.RATE) + length // 2, None, round(FRAME * tool.RATE))

    def power(x: np.ndarray, hz: float) -> np.ndarray:
        turned = x * np.exp(-2j * np.pi * hz / tool.RATE * np.arange(len(x)))
        return np.abs(signal.oaconvolve(turned, window / window.sum(), "same")) ** 2

    end = left.target[-round(END * tool.RATE) :]
    bands = [[power(x, hz)[frames] for x in (recorded, played)] for hz in left.partials]
    least = max(own.max() for own, _ in bands) * 10 ** (-tool.RANGE / 10)
    away = []
    for hz, (own, other) in zip(left.partials, bands, strict=True):
        floor = max(10 ** (ABOVE / 10) * float(np.mean(power(end, hz + left.f0 / 2)[length:-length])), least)
        there = np.maximum(own, other) > floor
        if there.any():
            away.append(10 * np.log10((own[there] + floor) / (other[there] + floor)))
    gain = np.median([x.mean() for x in away])
    return (
        float(np.median([np.sqrt(np.mean((x - gain) ** 2)) for x in away])),
        float(np.median([x.std() for x in away])),
    )


def low(recorded: np.ndarray, played: np.ndarray, f0: float, tool: ModuleType) -> float | None:
    """Energy below the lowest partial in the first 30 ms, synthesis over recording, dB; None in the bass."""
    if f0 < TREBLE:
        return None
    below = signal.butter(8, 0.7 * f0, fs=tool.RATE, output="sos")
    first = slice(0, round((tool.PRE + 0.03) * tool.RATE))
    own, other = (np.sum(signal.sosfiltfilt(below, x)[first] ** 2) for x in (recorded, played))
    return float(10 * np.log10(other / own))


def by_model(left: LeftOut, tool: ModuleType) -> dict:
    """Distances of the left-out layer for each model."""
    note = left.note()
    knockless = note._replace(modal_response=note.modal_response and note.modal_response.without_knock())
    return {
        "string model": distances(sound(note._replace(modal_response=None), left, tool), left, tool),
        "modes": distances(sound(knockless, left, tool), left, tool),
        "modes and knock": distances(sound(note, left, tool), left, tool),
        "nearest layer": left.near,
        "and noise": distances(sound(note, left, tool, noise_share=1.0), left, tool),
        "modes_count": 0 if note.modal_response is None else len(note.modal_response.pole),
    }


def constants(left: dict[str, LeftOut], tool: ModuleType) -> dict:
    """Mean distances of both halves of the notes with each constant halved and doubled."""

    def halves() -> list[float]:
        each = [distances(sound(x.note(), x, tool), x, tool)["distance"] for x in left.values()]
        return [float(np.mean(each[half::2])) for half in (0, 1)]

    judged, checked = list(left)[::2], list(left)[1::2]
    print(f"judged on {', '.join(judged)}\nchecked on {', '.join(checked)}")
    found = {"as they are": halves()}
    print("as they are: {:.3f} {:.3f} dB".format(*found["as they are"]), flush=True)
    for part, names in CONSTANTS.items():
        module = importlib.import_module(f"pianofit.modal_response.{part}")
        for name in names:
            own = getattr(module, name)
            for factor in (0.5, 2.0):
                value = own * factor if isinstance(own, float) else round(own * factor) | 1
                setattr(module, name, value)
                now = found[f"{name} {own:g} -> {value:g}"] = halves()
                print(
                    f"{name:12}{own:9g}{value:9g}"
                    + "".join(f"{x - y:+9.3f}" for x, y in zip(now, found["as they are"], strict=True)),
                    flush=True,
                )
            setattr(module, name, own)
    return found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--notes", default="", help="only notes whose names contain one of these, separated by commas")
    parser.add_argument("--constants", action="store_true", help="halve and double each constant of the modal response")
    parser.add_argument("--velocity", type=float, help="m/s; by default the predicted one")
    parser.add_argument("--layer", type=int, help="which is left out, from 1, the softest; by default the middle one")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    from pianofit.program_folder import enable_program_cache
    from pianofit.threads import numerical_settings

    enable_program_cache()
    tool, wanted = measure(), [x for x in options.notes.split(",") if x]
    chosen = {
        name: job
        for folder in crossval.folders()
        for name, job in crossval.notes(folder).items()
        if not wanted or any(x in name for x in wanted)
    }
    with numerical_settings():
        if options.constants:
            found = constants({name: left_out(fitted(*job), tool) for name, job in chosen.items()}, tool)
        else:
            jobs = {
                name: (lambda job=job: left_out(fitted(*job, layer=options.layer), tool, options.velocity))
                for name, job in chosen.items()
            }
            found = table(jobs, tool)
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


def table(jobs: dict[str, Callable[[], LeftOut]], tool: ModuleType) -> dict:
    """A row a note, and the means."""
    found = {}
    print(f"{'':20}" + "".join(f"{model:>18}" for model in RENDER_MODELS) + "   dB, attack in brackets", flush=True)
    for name, job in jobs.items():
        found[name] = by_model(job(), tool)
        cells = [f"{found[name][r]['distance']:.2f} ({found[name][r]['attack']:.2f})" for r in RENDER_MODELS]
        print(f"{name:20}" + "".join(f"{cell:>18}" for cell in cells), flush=True)
    for how, of in (("mean", statistics.mean), ("median", statistics.median), ("worst", max)):
        print(f"{how:20}" + "".join(f"{of(x[r]['distance'] for x in found.values()):>18.2f}" for r in RENDER_MODELS))
    shown = ("string model", "modes and knock", "nearest layer")
    print("\n" + " " * 20 + "".join(f"{model:>34}" for model in shown))
    print(" " * 20 + f"{'envelope':>14}{'loudness':>9}{'gain':>6}{'low':>5}" * len(shown) + "   dB")
    for name, row in found.items():
        cells = [_seconds(row[r]) for r in shown]
        print(f"{name:20}" + "".join(cells))
    for what in ("envelope", "shape", "loudness"):
        middle = [statistics.median(row[r][what] for row in found.values()) for r in shown]
        print(f"{'median ' + what:20}" + "".join(f"{x:>34.2f}" for x in middle))
    return found


def _seconds(x: dict) -> str:
    """Cells of one model in the second table."""
    below = "" if x["low"] is None else f"{x['low']:+.1f}"
    return f"{x['envelope']:8.2f} ({x['shape']:.1f}){x['loudness']:8.1f}{x['gain']:+7.1f}{below:>6}"


if __name__ == "__main__":
    main()
