"""The modal response of a key on the page: text, decays and beats, envelopes of partials, and spectrograms.

All are of the reference recording, and of the mean of its channels.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..analysis import law_frequency
from ..dsp.loudness import audible_floor, mel_edges, mel_power
from ..io.number_format import counted, number
from ..modal_response import partial_band
from ..model.modal_response import PartialDecay
from ..result import Result
from ..schema.modal_response import RENDER_MODELS, FittedModalResponse
from .drawing import FITTED, HEIGHT, INITIAL, LINES, Panel, span

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LABELS = dict(zip(RENDER_MODELS, ("string model alone", *RENDER_MODELS[1:]), strict=True))
ENVELOPES = 6  # partials whose envelopes are shown
ENVELOPE_SECONDS = 3.0  # after the onset
MARGIN_SECONDS = 0.2  # kept at both ends for the analysis windows
ENVELOPE_POINTS = 400  # of an envelope, which is smoother than their spacing
ENVELOPE_RANGE = 75.0  # dB below the maximum
# Window of the spectrogram, s: a compromise between the length of the knock and the bandwidth of a partial.
WINDOW_SECONDS = 0.09
MEL_BANDS = 96
LARGEST_DIFFERENCE = 20.0  # dB, end of the colour scale
TICKS = (100, 500, 1000, 2000, 5000, 10_000)  # Hz, of an axis of mel bands
# From the background of the page to the highest level.
SHADES = ["#ffffff", "#9cc9e3", "#2f86bd", "#0a2f4f"]


# --- text -------------------------------------------------------------------------------------------------------------


def modal_response_text(response: FittedModalResponse) -> str:
    """Return which render model the key uses, and the errors that decided it."""
    errors = response.leave_one_out_db
    if errors is None:
        return (
            f"This key is played with {_render_model(response)}. This choice was not tested on another stroke, because "
            "only one recording was made through this output path."
        )
    string_model, modes, knock = (f"{errors[name]:.1f}" for name in LABELS)
    tested = (
        "Each layer was predicted with modes and knock that were measured from the other layers. The distance from its "
        f"recording is {string_model} dB with the string model alone, {modes} dB with modes, and {knock} dB with modes "
        "and knock."
    )
    if response.render_model == "string model":
        return f"{tested} Modes did not improve the prediction, so the string model alone is used."
    return f"{tested} Therefore this key is played with {_render_model(response)}."


def modal_response_line(response: FittedModalResponse) -> str:
    """Return the same as one line for a terminal."""
    model, errors = response.render_model, response.leave_one_out_db
    line = f"rendered with {_render_model(response)}"
    if errors is None:
        return f"{line}; one recording through its output path, so not tested on another stroke"
    others = ", ".join(f"{errors[name]:.1f} dB with {label}" for name, label in LABELS.items() if name != model)
    return f"{line}; mean error of left-out recordings: {errors[model]:.1f} dB ({others})"


def _render_model(fitted: FittedModalResponse) -> str:
    """Return the render model of a key, with the number of modes."""
    if fitted.response is None:
        return "the string model alone"
    modes = counted(len(fitted.response.modes.partial), "mode")
    return modes + (" and a knock" if fitted.render_model == "modes and knock" else "")


def decay_rows(decays: Sequence[PartialDecay]) -> list[list[str]]:
    """Return the cells of the table of decays and beats, a row for every partial that has modes."""
    return [
        [
            str(decay.number),
            f"{decay.frequency:.2f}",
            str(decay.modes),
            *(number(x, 2) for x in (decay.early, decay.late, decay.beat_frequency, decay.beat_depth)),
            " to ".join(dict.fromkeys(number(x, 2) for x in decay.error)),
        ]
        for decay in decays
    ]


# --- envelopes --------------------------------------------------------------------------------------------------------


class Envelope(NamedTuple):
    """Level of one partial over time, dB, full scale = 0."""

    number: int  # k
    frequency: float  # Hz
    time: np.ndarray  # s from the onset [n]
    levels: dict[str, np.ndarray]  # [n]: measured, string model, and fitted if the key has modes


def envelopes_of(result: Result, numbers: list[int]) -> list[Envelope]:
    """Return the envelopes of these partials."""
    result = result.with_recordings()
    reference = result.reference
    rate, onset, partials = reference.recording.rate, reference.recording.onset, reference.partials
    begin = max(onset - round(MARGIN_SECONDS * rate), 0)
    section = slice(begin, onset + round((ENVELOPE_SECONDS + MARGIN_SECONDS) * rate))
    sounds = {"measured": reference.recording.samples, "string model": reference.fitted.samples}
    if reference.with_modes is not None:
        sounds["fitted"] = reference.with_modes.samples
    x = np.stack([samples[section] for samples in sounds.values()])
    spectrum, count, f0, B = np.fft.rfft(x), x.shape[-1], result.analysis.f0, result.analysis.B
    envelopes = []
    for k in numbers:
        centre = float(partials.frequency[partials.number == k][0])
        spacing = float(np.diff(law_frequency(f0, B, np.array([k, k + 1])))[0])
        b = partial_band(spectrum, count, rate, centre, spacing)
        time = b.time - (onset - begin) / rate
        end = min(ENVELOPE_SECONDS, (count - onset + begin) / rate - b.window)
        at = np.flatnonzero((time >= 0) & (time <= end))
        at = at[:: max(1, len(at) // ENVELOPE_POINTS)]
        db = 20 * np.log10(np.maximum(2 * np.abs(b.z[:, at]), 1e-15))
        envelopes.append(Envelope(k, centre, time[at], dict(zip(sounds, db, strict=True))))
    return envelopes


def draw_envelopes(result: Result) -> list[Panel]:
    """Draw the envelopes of the strongest partials."""
    partials = result.reference.partials
    strongest = sorted(partials.number[np.argsort(partials.level)[-ENVELOPES:]].tolist())
    return [Panel(draw_envelope, (one,), heights=(0.6 * HEIGHT,)) for one in envelopes_of(result, strongest)]


def draw_envelope(axes: Axes, envelope: Envelope) -> None:
    """Draw the level of one partial over time: recorded, with the string model, and with the modes of the key."""
    for name, db in envelope.levels.items():
        axes.plot(envelope.time, db, label=name, **LINES[name])
    low, top = span(*envelope.levels.values())
    axes.set(title=f"partial {envelope.number}, {envelope.frequency:.0f} Hz", xlabel="time from the onset (s)")
    axes.set(ylabel="level (dB)", ylim=(max(low, top - ENVELOPE_RANGE) - 3, top + 4))
    axes.set_xlim(0.0, 1.02 * max(span(envelope.time)[1], 1e-3))


# --- spectrograms -----------------------------------------------------------------------------------------------------


def spectrograms_of(result: Result) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the spectrograms of the reference recording and of its fitted sound.

    They are times, s from the onset [frames], centres of mel bands, Hz [bands], and both levels, dB [bands, frames].
    """
    reference = result.reference
    recording = reference.recording
    n = 2 * round(WINDOW_SECONDS * recording.rate / 2)
    end = recording.onset + round((ENVELOPE_SECONDS + MARGIN_SECONDS) * recording.rate)
    (time, measured), (_, fitted) = (
        mel_power(samples[:end], recording.rate, recording.onset, n, MEL_BANDS)
        for samples in (recording.samples, reference.final.samples)
    )
    # At least one frame, also of a very short recording.
    frames = time <= max(min(ENVELOPE_SECONDS, time[-1] - WINDOW_SECONDS), 0.0)
    floor = audible_floor(measured[frames])
    recorded, played = (10 * np.log10(power[frames] + floor).T for power in (measured, fitted))
    return time[frames], mel_edges(n, MEL_BANDS, recording.rate)[1:-1], recorded, played


def draw_spectrograms(result: Result) -> list[Panel]:
    """Draw the spectrograms of both sounds, and their difference."""
    from matplotlib.colors import LinearSegmentedColormap

    levels = LinearSegmentedColormap.from_list("level", SHADES)
    signs = LinearSegmentedColormap.from_list("difference", [INITIAL, "#ffffff", FITTED])
    time, frequency, measured, fitted = spectrograms_of(result)
    limits, difference = span(measured), (-LARGEST_DIFFERENCE, LARGEST_DIFFERENCE)
    maps = {
        "recorded": (measured, levels, limits, "level (dB)"),
        "fitted note": (fitted, levels, limits, "level (dB)"),
        "fitted minus recorded": (fitted - measured, signs, difference, "difference (dB)"),
    }
    return [Panel(_draw_map, (time, frequency, *values), title, legend_rows=2) for title, values in maps.items()]


def _draw_map(
    axes: Axes, time: np.ndarray, frequency: np.ndarray, db: np.ndarray, colours: Any, limits: Any, label: str
) -> None:
    """Draw levels [bands, frames] as an image, with its colour scale below."""
    figure: Any = axes.figure
    bands, end = np.arange(len(frequency)), max(span(time)[1], 1e-3)
    extent = (0.0, end, -0.5, len(bands) - 0.5)
    style: dict[str, Any] = {"aspect": "auto", "origin": "lower", "interpolation": "nearest"}
    image = axes.imshow(db, cmap=colours, vmin=limits[0], vmax=limits[1], extent=extent, **style)
    ticks = [tick for tick in TICKS if frequency[0] <= tick <= frequency[-1]]
    axes.set_yticks(np.interp(ticks, frequency, bands), [f"{tick:g}" for tick in ticks])
    axes.set(xlabel="time from the onset (s)", ylabel="frequency (Hz)")
    axes.grid(visible=False)
    box, height = axes.get_position(), figure.get_figheight()
    scale = figure.add_axes((box.x0, 0.36 / height, 0.55 * box.width, 0.1 / height))
    figure.colorbar(image, cax=scale, orientation="horizontal", label="")
    scale.text(1.05, 0.5, label, transform=scale.transAxes, va="center")
    scale.grid(visible=False)
