"""Test the detected number of modes of a partial, and the errors of their poles, on synthetic recordings.

    python benchmarks/ringing_study.py                         24 drawn notes, orders and errors of poles
    python benchmarks/ringing_study.py --seeds 100 --json ringing_study.json
    python benchmarks/ringing_study.py --time headroom-C4-close     time and memory for the modes of a key

Each drawn note has eight partials with one to four modes, beating of 0.05 to 5 Hz and ratios of decay rates of 2 to 16.
Every mode lies at most 30 dB below the strongest of its partial. Three strokes excite each partial as a whole. White
noise lies 40 to 70 dB below the peak of the note. Every other note falls in pitch by up to 6 cents. Only the noise is
random, so the Cramér-Rao bound of the poles can be computed. Amplitudes are eliminated, poles are common to all
strokes, and time begins at the end of the kernel of the band.

The resolution of a mode compares two numbers. The first is its gain of log likelihood at the true values, over the best
fit of the other modes (with free amplitudes and, to first order, free poles). The second is the penalty of its
parameters after Schwarz (1978). A partial is `clear` if the gain of every mode is at least ten times the penalty, 10 dB
above it. Errors are given relative to the bound and, as `z`, relative to the reported standard errors. Both are medians
of absolute values, 0.67 for a correct bound and correct errors.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

RATE = 22_050  # Hz
SECONDS = 4.0
LEAD = 0.1  # s before a stroke
TAU = 0.5  # time constant of the glide, s
# Mean of exp(-t/TAU) over 0.2 to 1.0 s, the interval in which an analysis defines f0.
MEAN = TAU / 0.8 * (np.exp(-0.2 / TAU) - np.exp(-1.0 / TAU))
PARTIALS = 8
STROKES = 3
ORDERS = (1, 2, 3, 4)
# A mode this far above the limit of resolution, dB, should be detected.
CLEAR = 10.0


class Drawn(NamedTuple):
    """A synthetic recording with its modes."""

    f0: float
    poles: list[np.ndarray]  # absolute, 1/s, of each partial
    amplitudes: list[np.ndarray]  # [strokes, modes] of each partial
    noise: float  # standard deviation of a sample
    samples: np.ndarray  # [strokes, samples] from `LEAD` before the stroke
    glide: float  # relative, at the start


def draw(seed: int) -> Drawn:
    """Draw one note."""
    random = np.random.default_rng(seed)
    f0 = float(np.exp(random.uniform(np.log(60), np.log(600))))
    time = np.arange(round(SECONDS * RATE)) / RATE
    glide = 6 / 1731 * random.uniform(0.3, 1) * (seed % 2)
    warped = time - glide * TAU * np.expm1(-time / TAU)
    poles, sizes, sound = [], [], np.zeros((STROKES, len(time)))
    for k in range(1, PARTIALS + 1):
        order = int(random.integers(1, ORDERS[-1] + 1))
        slow = np.exp(random.uniform(np.log(0.4), np.log(2.0)))
        decay = slow * np.exp(random.uniform(np.log(2), np.log(16), order))
        decay[0] = slow
        beat = np.exp(random.uniform(np.log(0.05), np.log(min(5.0, 0.2 * f0)), order)) * random.choice([-1, 1], order)
        beat[0] = 0.0
        size = 10 ** (random.uniform(-30, 0, order) / 20) / k * np.exp(2j * np.pi * random.uniform(size=order))
        size[random.integers(order)] *= 1 / (k * np.abs(size).max())
        stroke = random.normal(size=STROKES) + 1j * random.normal(size=STROKES)
        stroke /= np.abs(stroke) ** 0.7
        pole = -decay + 2j * np.pi * (k * f0 + beat)
        poles.append(pole)
        sizes.append(np.outer(stroke, size))
        phase = np.outer(pole.imag, warped) * 1j + np.outer(pole.real, time)
        sound += (sizes[-1] @ np.exp(phase)).real
    noise = np.abs(sound).max() * 10 ** (-random.uniform(40, 70) / 20)
    sound = np.pad(sound, ((0, 0), (round(LEAD * RATE), 0)))
    return Drawn(f0, poles, sizes, noise, sound + noise * random.normal(size=sound.shape), glide)


def found(drawn: Drawn):
    """Return the modes of all partials by number. Frequencies and glide are given, in place of an analysis."""
    from pianofit.analysis.glide import PitchGlide
    from pianofit.modal_response.aligned_layers import align_layers
    from pianofit.modal_response.modes import modes_of
    from pianofit.recording.recording import recording_from_samples

    number = np.arange(1, PARTIALS + 1)
    f0, fall = drawn.f0 * (1 + drawn.glide * MEAN), 1731 * drawn.glide * (1 - MEAN)
    analysis: Any = SimpleNamespace(  # the fields of an `Analysis` that are used
        f0=f0, B=0.0, partials=SimpleNamespace(number=number, frequency=number * f0), glide_start=fall,
        glide_error=0.1, glide_model=PitchGlide(fall, TAU),
    )  # fmt: skip
    recordings = [replace(recording_from_samples(x, RATE), onset=round(LEAD * RATE)) for x in drawn.samples]
    return {m.number: m for m in modes_of(align_layers(recordings, [analysis] * STROKES), [analysis] * STROKES)}


def bound(pole: np.ndarray, amplitude: np.ndarray, noise: float, start: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the Cramér-Rao bound of the real and imaginary parts of poles, 1/s, and the gain of each mode."""
    from pianofit.modal_response.aligned_layers import SPAN

    time = np.linspace(start, SPAN, 1200)
    # A complex amplitude estimated from n real samples with this noise has variance 4 noise²/n.
    per = RATE * (time[1] - time[0]) / (4 * noise**2)
    e = np.exp(np.outer(time, pole - 1j * np.imag(pole).mean()))
    moved = time[:, None] * e

    def without(x: np.ndarray, basis: np.ndarray) -> np.ndarray:
        q = np.linalg.svd(basis / np.linalg.norm(basis, axis=0), full_matrices=False)[0]
        return x - q @ (q.conj().T @ x)

    free = without(moved, e)
    information = sum(per * (a.conj()[:, None] * (free.conj().T @ free) * a) for a in amplitude)
    errors = np.sqrt(np.diag(np.linalg.pinv(information, rcond=1e-14, hermitian=True)).real / 2)
    gain = []
    for m in range(len(pole)):
        others = np.delete(np.arange(len(pole)), m)
        residual = without(e[:, [m]], np.hstack([e[:, others], moved[:, others]])) if len(others) else e[:, [m]]
        gain.append(per * float((np.abs(residual) ** 2).sum() * (np.abs(amplitude[:, m]) ** 2).sum()))
    return errors, np.array(gain)


def study(seed: int) -> list[dict]:
    """Return one row for each partial of a drawn note, with its true and its detected modes."""
    from pianofit.modal_response.aligned_layers import SPAN, band_window

    drawn, rows = draw(seed), []
    modes, kernel = found(drawn), band_window(drawn.f0)
    samples = STROKES * 1.5 / kernel * SPAN
    cost = (STROKES + 1) * np.log(samples)
    for k, (pole, amplitude) in enumerate(zip(drawn.poles, drawn.amplitudes, strict=True), start=1):
        pole = np.real(pole) + 1j * np.imag(pole) * (1 + drawn.glide * MEAN)
        errors, gain = bound(pole, amplitude, drawn.noise, kernel / 2)
        m = modes.get(k)
        row = {"seed": seed, "partial": k, "order": len(pole), "found": len(m.pole) if m else 0}
        row |= {"glide": drawn.glide > 0, "clear_db": float(10 * np.log10(gain.min() / cost))}
        if m and len(m.pole) == len(pole):
            nearest = np.abs(m.poles[:, None] - pole).argmin(axis=0)
            away = m.poles[nearest] - pole
            parts = np.abs(np.concatenate([np.real(away), np.imag(away)]))
            row |= {
                "over_bound": (parts / np.tile(errors, 2)).tolist(),
                "z": (parts / np.tile(m.pole_error[nearest], 2)).tolist(),
            }
        rows.append(row)
    return rows


def take_time(key: str) -> None:
    """Print the time for the modes of a recorded key, and the peak memory of the process before and after."""
    import resource

    import crossval

    from pianofit import analyse, load_recording
    from pianofit.modal_response.aligned_layers import align_layers
    from pianofit.modal_response.modes import modes_of
    from pianofit.threads import numerical_settings

    keys = {name: job for folder in crossval.folders() for name, job in crossval.notes(folder).items()}
    if key not in keys:
        raise SystemExit(f"--time {key}: not a recorded key; use one of {', '.join(keys)}")
    note, files, _ = keys[key]
    recordings = [load_recording(file) for file in files]
    analyses = [analyse(recording, note=note) for recording in recordings]
    before, begun = resource.getrusage(resource.RUSAGE_SELF), time.perf_counter()
    with numerical_settings():
        aligned = align_layers(recordings, analyses)
        modes = modes_of(aligned, analyses)
    wall, after = time.perf_counter() - begun, resource.getrusage(resource.RUSAGE_SELF)
    layers, channels, _ = aligned.samples.shape
    print(
        f"{key}: {layers} layers, {channels} channels, {len(modes)} partials, {sum(len(m.pole) for m in modes)} modes: "
        f"{wall:.1f} s, processor time {after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime:.1f} s; "
        f"{before.ru_maxrss / 1e3:.0f} MB before, {after.ru_maxrss / 1e3:.0f} MB peak (Linux)"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=24, help="number of notes (24)")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--time", metavar="KEY", help="print only the time for the modes of this recorded key")
    options = parser.parse_args()
    if options.time:
        take_time(options.time)
        return
    rows = [row for seed in range(options.seeds) for row in study(seed)]
    print(f"{'modes':>24}{'partials':>10}{'right':>8}{'fewer':>8}{'more':>8}{'over bound':>12}{'z':>8}")
    groups = [(f"{n}, clear", [r for r in rows if r["order"] == n and r["clear_db"] > CLEAR]) for n in ORDERS]
    clear = [r for r in rows if r["clear_db"] > CLEAR]
    groups += [("all clear", clear), ("clear, with glide", [r for r in clear if r["glide"]])]
    groups += [("0 to 10 dB", [r for r in rows if 0 < r["clear_db"] <= CLEAR])]
    groups += [("below", [r for r in rows if r["clear_db"] <= 0])]
    for name, group in groups:
        if not group:
            continue
        right, fewer, more = (
            np.mean([s(r["found"], r["order"]) for r in group]) for s in (int.__eq__, int.__lt__, int.__gt__)
        )
        middle = [
            np.median(np.concatenate([r[key] for r in group if key in r] or [[np.nan]])) for key in ("over_bound", "z")
        ]
        print(f"{name:>24}{len(group):10}{right:8.0%}{fewer:8.0%}{more:8.0%}{middle[0]:12.2f}{middle[1]:8.2f}")
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
