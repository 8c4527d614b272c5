"""How many modes of a partial are found, and how well, where the answer is known.

    python benchmarks/ringing_study.py                         24 drawn notes, orders and errors of poles
    python benchmarks/ringing_study.py --seeds 100 --json ringing_study.json
    python benchmarks/ringing_study.py --time headroom-C4-close     how long the modes of a key take, and memory

Notes of eight partials are drawn: one to four modes each, beats of 0.05 to 5 Hz, double decays of ratio 2 to 16, every
mode up to 30 dB below its partial's strongest, three strokes that excite each partial as a whole, white noise 40 to 70
dB below the note's peak; every other note falls in pitch by up to 6 cents. The noise is the only thing that is unknown,
so the Cramér-Rao bound of poles is known: amplitudes are eliminated, poles are common to all strokes, time begins where
the band's kernel ends.

What can be resolved: a mode's gain of the log likelihood at the truth, over the best that the others do without it
(their amplitudes and, to first order, their poles free), against the cost that Schwarz (1978) gives its parameters. A
partial is `clear` if every mode gains ten times, 10 dB more than, its cost. Errors are over the bound and, `z`, over
the standard errors that were stated: medians of absolute values, 0.67 where bound and errors are right.
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
TAU = 0.5  # s, of a pitch that falls; and of exp(-t/TAU) the mean over 0.2 to 1.0 s, where an analysis has its f0
MEAN = TAU / 0.8 * (np.exp(-0.2 / TAU) - np.exp(-1.0 / TAU))
PARTIALS = 8
STROKES = 3
ORDERS = (1, 2, 3, 4)
# A mode this far above what can be resolved, dB, should be found.
CLEAR = 10.0


class Drawn(NamedTuple):
    """A note whose modes are known."""

    f0: float
    poles: list[np.ndarray]  # absolute, 1/s, of each partial
    amplitudes: list[np.ndarray]  # [strokes, modes] of each partial
    noise: float  # standard deviation of a sample
    samples: np.ndarray  # [strokes, samples] from `LEAD` before the stroke
    glide: float  # relative, at the begin


def draw(seed: int) -> Drawn:
    """One note."""
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
    """The modes of all partials, by number: the law and the glide are given, as an analysis would."""
    from pianofit.analysis.glide import PitchGlide
    from pianofit.modal_response import align_layers, modes_of
    from pianofit.recording.recording import recording_from_samples

    number = np.arange(1, PARTIALS + 1)
    f0, fall = drawn.f0 * (1 + drawn.glide * MEAN), 1731 * drawn.glide * (1 - MEAN)
    analysis: Any = SimpleNamespace(  # as much of an `Analysis` as is read
        f0=f0, B=0.0, partials=SimpleNamespace(number=number, frequency=number * f0), glide_start=fall,
        glide_error=0.1, glide_model=PitchGlide(fall, TAU),
    )  # fmt: skip
    recordings = [replace(recording_from_samples(x, RATE), onset=round(LEAD * RATE)) for x in drawn.samples]
    return {m.number: m for m in modes_of(align_layers(recordings, [analysis] * STROKES), [analysis] * STROKES)}


def bound(pole: np.ndarray, amplitude: np.ndarray, noise: float, start: float) -> tuple[np.ndarray, np.ndarray]:
    """The Cramér-Rao bound of each pole's real and imaginary part, 1/s, and each mode's gain of the log likelihood."""
    from pianofit.modal_response.aligned_layers import SPAN

    time = np.linspace(start, SPAN, 1200)
    # A complex amplitude known from n real samples of this noise has variance 4 noise²/n.
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
        left = without(e[:, [m]], np.hstack([e[:, others], moved[:, others]])) if len(others) else e[:, [m]]
        gain.append(per * float((np.abs(left) ** 2).sum() * (np.abs(amplitude[:, m]) ** 2).sum()))
    return errors, np.array(gain)


def study(seed: int) -> list[dict]:
    """Of every partial of a drawn note: what was there, what was found."""
    from pianofit.modal_response.aligned_layers import SPAN
    from pianofit.modal_response.bands import kernel_seconds

    drawn, rows = draw(seed), []
    modes, kernel = found(drawn), kernel_seconds(drawn.f0)
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
    """Print the seconds that the modes of a recorded key take, and the process's largest memory before and after."""
    import resource

    import crossval

    from pianofit import analyse, load_recording
    from pianofit.modal_response import align_layers, modes_of
    from pianofit.threads import one_blas_thread

    known = {name: job for folder in crossval.folders() for name, job in crossval.notes(folder).items()}
    if key not in known:
        raise SystemExit(f"--time {key}: no such key; there are {', '.join(known)}")
    note, files, _ = known[key]
    recordings = [load_recording(file) for file in files]
    analyses = [analyse(recording, note=note) for recording in recordings]
    before, begun = resource.getrusage(resource.RUSAGE_SELF), time.perf_counter()
    with one_blas_thread():
        heard = align_layers(recordings, analyses)
        found = modes_of(heard, analyses)
    wall, after = time.perf_counter() - begun, resource.getrusage(resource.RUSAGE_SELF)
    layers, channels, _ = heard.samples.shape
    print(
        f"{key}: {layers} layers, {channels} channels, {len(found)} partials, {sum(len(m.pole) for m in found)} modes: "
        f"{wall:.1f} s, of processors {after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime:.1f} s; "
        f"{before.ru_maxrss / 1e3:.0f} MB before, {after.ru_maxrss / 1e3:.0f} MB at the most (Linux)"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=24, help="how many notes")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--time", metavar="KEY", help="only how long the modes of this recorded key take")
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
