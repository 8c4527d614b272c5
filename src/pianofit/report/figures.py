"""Figures of the reference recording: spectra, attack, partials, levels and hammer force."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..analysis import law_frequency
from ..conversions import CENTS
from ..model import Simulation
from ..result import Result
from ..schema.fit import Criterion, PartialLevels
from ..schema.notes import initial_note
from .drawing import (
    BORDER,
    FAINT,
    FITTED,
    HATCH,
    HEIGHT,
    INK,
    LINES,
    MEASURED,
    Panel,
    log_axis,
    number_axis,
    points,
    span,
)
from .text import BANDS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ATTACK_S = 0.03
# Damping of the spectra, 1/s. The peaks are narrow enough to separate partials and wide enough to be visible.
SPECTRUM_SIGMA = 8.0
HIGHEST_FREQUENCY = 12_000.0  # Hz, of the spectra: higher partials are weak
# Positions of the arrows on a loop, as shares of the largest force. They differ so that the arrows do not overlap.
RISING, FALLING = 0.6, 0.35
ARROW = np.array([1.0, -0.7 + 0.45j, -0.4, -0.7 - 0.45j, 1.0])  # outline of an arrowhead, pointing right
# Decay rates below this share of the slowest of the string are drawn at the edge of the axis.
SLOWEST = 0.1
NODE = 60.0  # dB below all measured levels; lower levels are not drawn
Curves = dict[str, tuple[np.ndarray, np.ndarray]]  # x and y by name
Band = tuple[float, float, str, bool]  # of the criterion: low and high end, Hz, label, is excluded


# --- spectra and attack -----------------------------------------------------------------------------------------------


def spectrum_db(samples: np.ndarray, rate: int, top: float) -> tuple[np.ndarray, np.ndarray]:
    """Return frequencies, Hz, and levels, dB, up to `top`, Hz, of the spectrum of the samples times exp(-σt)."""
    n = min(len(samples), int(14 / SPECTRUM_SIGMA * rate))
    size = 2 ** int(np.ceil(np.log2(n)))
    value = np.abs(np.fft.rfft(samples[:n] * np.exp(-SPECTRUM_SIGMA * np.arange(n) / rate), size)) / rate
    keep = slice(1, int(top * size / rate))
    return np.fft.rfftfreq(size, 1 / rate)[keep], 20 * np.log10(np.maximum(value[keep], 1e-15))


def draw_spectra(result: Result) -> list[Panel]:
    """Draw the spectra: two panels if the last band is much wider than the others, to show the first partials."""
    spectra, edges = spectra_of(result)
    low, high, split = edges[0][0], edges[-1][1], edges[-1][0]
    limits = [low, split, high] if len(edges) > 1 and high - split > 1.5 * (split - low) else [low, high]
    return [Panel(draw_spectrum, (spectra, edges, part)) for part in pairwise(limits)]


def spectra_of(result: Result) -> tuple[Curves, list[Band]]:
    """Return frequencies, Hz, and levels, dB, of the measured, initial and fitted sound, and the visible bands."""
    recording, analysis = result.recording, result.analysis
    above_partials = float(law_frequency(analysis.f0, analysis.B, analysis.partials.number.max() + 2))
    top = min(0.5 * recording.rate, HIGHEST_FREQUENCY, above_partials)
    sounds = {"measured": recording.samples, "initial": result.initial.samples, "fitted": result.fitted.samples}
    spectra = {name: spectrum_db(samples[recording.onset :], recording.rate, top) for name, samples in sounds.items()}
    return spectra, _band_edges(result.fit.criterion, top)


def draw_spectrum(
    axes: Axes,
    spectra: Curves,
    edges: list[Band],
    part: tuple[float, float] | None = None,
) -> None:
    """Draw `spectra_of` a result. With a `part` of the frequencies, Hz, the bands have names."""
    for name, (frequency, db) in spectra.items():
        axes.plot(frequency, db, label=name, **LINES[name])
    bottom, highest = span(spectra["measured"][1], spectra["fitted"][1])
    axes.set(xlim=part or (edges[0][0], edges[-1][1]), ylim=(max(bottom, highest - 110) - 6, highest + 12))
    axes.set(xlabel="frequency (Hz)", ylabel="level (dB)")
    _shade_bands(axes, edges, named=part is not None)


def _band_edges(criterion: Criterion, end: float) -> list[Band]:
    """Return each visible band."""
    excluded = criterion.excluded_bands
    return [
        (low, min(high, end), label + (", excluded" if name in excluded else ""), name in excluded)
        for (low, high), (name, label) in zip(pairwise(criterion.borders), BANDS.items(), strict=True)
        if low < end
    ]


def _shade_bands(axes: Axes, edges: list[Band], named: bool) -> None:
    start, stop = axes.get_xlim()
    for index, (low, high, label, is_excluded) in enumerate(edges):
        low, high = max(low, start), min(high, stop)
        if low >= high:
            continue
        if is_excluded:
            axes.axvspan(low, high, facecolor="none", edgecolor=HATCH, hatch="///", lw=0, zorder=0)
        elif index % 2:
            axes.axvspan(low, high, color=FAINT, lw=0, zorder=0)
        for edge in {low, high} - {start, stop}:
            axes.axvline(edge, color=BORDER, lw=0.8, ls=":", zorder=1)
        if not named:
            continue
        is_narrow = (high - low) < 0.25 * (stop - start)
        text = label.split(":")[0] + (", excluded" if is_excluded else "") if is_narrow else label
        # Aligned with the frame in a narrow band at its end, so that the text stays inside.
        x, side = (low + high) / 2, "center"
        if is_narrow and (low == start or high == stop):
            x, side = (low, "left") if low == start else (high, "right")
        axes.text(x, 0.985, text, transform=axes.get_xaxis_transform(), ha=side, va="top", color=INK, fontsize=8.5)


def draw_attacks(result: Result) -> list[Panel]:
    """Draw the waveform before and after the fit."""
    titles, waves = {"initial": "Before the fit", "fitted": "After the fit"}, attack_waves(result)
    return [Panel(draw_attack, (*waves, name), title) for name, title in titles.items()]


def attack_waves(result: Result) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return times, ms from the onset, and the first samples of the measured, initial and fitted sound."""
    recording = result.recording
    attack = slice(recording.onset, recording.onset + int(ATTACK_S * recording.rate))
    sounds = {
        "measured": recording.samples,
        "initial": result.initial.samples,
        "fitted": result.reference.final.samples,
    }
    waves = {name: samples[attack] for name, samples in sounds.items()}
    return 1e3 * np.arange(len(waves["measured"])) / recording.rate, waves


def draw_attack(axes: Axes, ms: np.ndarray, waves: dict[str, np.ndarray], name: str) -> None:
    """Draw the waveforms of the first milliseconds, with one scale for all panels."""
    for curve in ("measured", name):
        axes.plot(ms, waves[curve], label=curve, **LINES[curve])
    low, high = span(*waves.values())
    margin = 0.05 * max(high - low, 1e-12)
    axes.set(xlabel="time from the onset (ms)", ylabel="signal (full scale = 1)", ylim=(low - margin, high + margin))


# --- partials ---------------------------------------------------------------------------------------------------------


def draw_partials(result: Result) -> list[Panel]:
    """Draw frequencies and decay rates of the partials."""
    return [
        Panel(_draw_frequencies, (result,), heights=(0.68 * HEIGHT, 0.32 * HEIGHT)),
        Panel(_draw_decays, (result,), heights=(HEIGHT + 0.12,)),
    ]


def _draw_frequencies(cents: Axes, residual: Axes, result: Result) -> None:
    """Draw the deviations of the partials from k f0, and below them their residuals from the stiff string."""
    partials, f0, B = result.analysis.partials, result.fit.derived.f0, result.fit.derived.B
    k = partials.number
    measured, fitted = (1200 * np.log2(f / (k * f0)) for f in (partials.frequency, law_frequency(f0, B, k)))
    error = CENTS * partials.total_error("frequency") / partials.frequency
    points(cents, k, measured, error)
    cents.plot(k, fitted, label="fitted string", **LINES["fitted"])
    cents.set(title="Frequency", ylabel="cents above k·f₀")
    points(residual, k, measured - fitted, error)
    residual.axhline(0.0, **LINES["fitted"])
    residual.set(ylabel="residual (cents)", xlabel="partial number k")
    number_axis(cents, k)


def _draw_decays(axes: Axes, result: Result) -> None:
    partials, note = result.analysis.partials, result.note
    k, decay = partials.number, partials.decay
    fitted = note.string.b1 + note.string.b2 * (k * np.pi / note.geometry.length) ** 2
    # With beats, an envelope can be flat or rise. It would compress the range of all others.
    bottom = SLOWEST * float(np.min(fitted))
    below = decay < bottom
    points(axes, k[~below], decay[~below], partials.total_error("decay")[~below])
    if below.any():
        axes.plot(k[below], np.full(below.sum(), bottom), "v", mfc="none", color=MEASURED, label="below this axis")
    axes.plot(k, fitted, label="fitted string", **LINES["fitted"])
    if bottom > 0:
        axes.set_yscale("log")
        log_axis(axes.yaxis)
    axes.set(title="Early decay of the envelope", ylabel="decay rate α (1/s)", xlabel="partial number k")
    number_axis(axes, k)


def draw_reference_levels(result: Result) -> list[Panel]:
    """Draw the levels of the partials, and their residuals, below which is the output path if there is one."""
    levels, path, partials = result.fit.reference.partials, result.note.path, result.analysis.partials

    def draw_residuals(error: Axes, *below: Axes) -> None:
        for name, marker, model in _model_levels(levels):
            error.plot(levels.number, model - levels.measured, marker=marker, ms=3.4, label=name, **LINES[name])
        error.axhline(0.0, color=MEASURED, lw=1)
        error.set(ylabel="model − measured (dB)")
        if path is not None:
            below[0].plot(partials.number, path.at(partials.frequency), color=FITTED, lw=1.4, marker="D", ms=3)
            below[0].set_ylabel("output path (dB)")
        (below or [error])[-1].set_xlabel("partial number k")
        number_axis(error, levels.number)

    heights = (HEIGHT,) if path is None else (0.6 * HEIGHT, 0.4 * HEIGHT - 0.12)
    return [Panel(draw_levels, (levels,), "Levels"), Panel(draw_residuals, (), "Residuals", heights)]


def draw_levels(axes: Axes, levels: PartialLevels) -> None:
    """Draw the levels of the partials, measured, initial and fitted."""
    for name, marker, model in _model_levels(levels):
        axes.plot(levels.number, model, marker=marker, ms=3.4, label=name, **LINES[name])
    points(axes, levels.number, levels.measured, levels.error)
    axes.set(xlabel="partial number k", ylabel="level (dB)")
    number_axis(axes, levels.number)


def _model_levels(levels: PartialLevels) -> list[tuple[str, str, np.ndarray]]:
    """Return name, marker and levels, dB, before and after the fit.

    Levels far below all measured ones are NaN, because a given strike position can be on a node.
    """
    lowest = span(levels.measured)[0] - NODE
    columns = (("initial", "s", levels.initial), ("fitted", "o", levels.fitted))
    return [(name, marker, np.where(level > lowest, level, np.nan)) for name, marker, level in columns]


# --- contact ----------------------------------------------------------------------------------------------------------


def draw_contact(result: Result) -> list[Panel]:
    """Draw the hammer force over time, and over the compression of the felt."""
    contacts = (contact_of(result),)
    return [Panel(draw_force, contacts, "Force over time"), Panel(draw_loop, contacts, "Force over compression")]


def _strokes(result: Result) -> dict[str, Simulation]:
    """Return the initial and the fitted stroke of the reference recording, simulated again if there are none."""
    if result.recordings:
        return {"initial": result.initial.simulation, "fitted": result.fitted.simulation}
    row = result.fit.reference
    notes = {"initial": initial_note(result.fit, row, result.note), "fitted": result.note}
    return {name: note.strike(round(row.rate)) for name, note in notes.items()}


class Contact(NamedTuple):
    """One contact of hammer and string [time]."""

    ms: np.ndarray  # from the first contact
    compression: np.ndarray  # of the felt, mm
    force: np.ndarray  # N


def contact_of(result: Result) -> dict[str, Contact]:
    """Return the contact of the reference recording before and after the fit, by name."""
    strokes = _strokes(result)
    # 10 % longer than the last contact. Each stroke has a time step of its own.
    end = 1.1 * max(stroke.last_touch for stroke in strokes.values())
    contacts = {}
    for name, stroke in strokes.items():
        pulse, step = stroke.pulse, float(stroke.modes.step)
        force, compression = (np.asarray(x)[: int(end / step) + 2] for x in (pulse.force, pulse.compression))
        contacts[name] = Contact(1e3 * step * np.arange(len(force)), 1e3 * compression, force)
    return contacts


def draw_force(axes: Axes, contacts: dict[str, Contact]) -> None:
    """Draw the hammer force over time before and after the fit, from `contact_of` a result."""
    for name, contact in contacts.items():
        axes.plot(contact.ms, contact.force, label=name, **LINES[name])
    axes.set(xlabel="time from the first contact (ms)", ylabel="force (N)")
    axes.set_ylim(bottom=0.0)


def draw_loop(axes: Axes, contacts: dict[str, Contact]) -> None:
    """Draw force over compression, with arrowheads for the direction, from `contact_of` a result."""
    for name, (_, compression, force) in contacts.items():
        touches = np.where(compression > 0, 1.0, np.nan)
        axes.plot(compression * touches, force * touches, label=name, **LINES[name])
    axes.set(xlabel="compression of the felt (mm)", ylabel="force (N)")
    axes.set_xlim(0.0, 1.05 * max(span(*(contact.compression for contact in contacts.values()))[1], 1e-9))
    axes.set_ylim(bottom=0.0)
    for name, (_, compression, force) in contacts.items():
        for position, step in _arrow_positions(compression, force):
            dx, dy = axes.transData.transform(position + step) - axes.transData.transform(position)
            marker = [(float(z.real), float(z.imag)) for z in ARROW * np.exp(1j * np.arctan2(dy, dx))]
            axes.plot(*position, marker=marker, ms=13, mew=0, color=LINES[name]["color"], zorder=6)


def _arrow_positions(compression: np.ndarray, force: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return point and step where the force first exceeds `RISING` and last exceeds `FALLING` of its maximum."""
    if not (len(force) > 2 and np.isfinite(force).all() and force.max() > 0 and compression.max() > 0):
        return []
    curve = np.stack([compression, force], axis=1)
    arrows = []
    for share, end in ((RISING, 0), (FALLING, -1)):
        level = share * force.max()
        above = np.flatnonzero(force > level)
        start = above[end] - (end == 0)
        if 0 <= start < len(force) - 1:
            step = curve[start + 1] - curve[start]
            arrows.append((curve[start] + step * (level - force[start]) / step[1], step))
    return arrows
