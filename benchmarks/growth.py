"""How the cost grows with the size of a problem: seconds over sizes, and the exponent of the law through the last."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import baseline
import made
import numpy as np
import works
from measuring import paired

# From the bass up; the contact's rate and the modes are chosen per note.
NOTES = {"A0": 21, "A1": 33, "A2": 45, "A3": 57, "A4": 69, "A5": 81, "A6": 93, "C8": 108}


def measured(folder: Path, *, quick: bool = False, say: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """Seconds [sizes] of every series, with its exponent."""
    few: dict[str, Any] = {"rounds": 2, "least": 0.0} if quick else {"rounds": 5, "least": 0.05}
    end = 2 if quick else None
    made_series = {
        "modes, a batch of 64 hammers": (_modes, (32, 64, 128, 256, 512)),
        "steps, a batch of 64 hammers": (_steps, (128, 256, 512, 1024)),
        "hammers in a batch": (_batch, (1, 4, 16, 64, 256, 1024)),
        "duration, s, of a strike": (_duration, (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)),
        "duration, s, by the baseline": (_by_baseline, (0.25, 0.5, 1.0, 2.0)),
        "oversampling of a strike": (_oversampling, (2, 4, 8, 16)),
    }
    found: dict[str, Any] = {}
    for name, (make, sizes) in made_series.items():
        say(f"growth: {name}")
        taken = paired({str(size): make(size) for size in sizes[:end]}, **few)
        found[name] = _law(list(sizes[:end]), [taken[str(size)]["median"] for size in sizes[:end]])
    say("growth: recordings")
    # From two on: what one velocity leaves open of the path is integrated over at several nodes.
    found["recordings, of the objective"] = _recordings(folder, (2, 3) if quick else (2, 3, 5), few)
    say("growth: notes")
    return found | {"notes": _notes(dict(list(NOTES.items())[:end]), few)}


def _law(sizes: list, seconds: list[float]) -> dict[str, Any]:
    last = slice(-3, None)
    exponent = float(np.polyfit(np.log(sizes[last]), np.log(seconds[last]), 1)[0])
    return {"sizes": sizes, "seconds": seconds, "exponent": exponent}


def _modes(modes: int) -> Callable[[], Any]:
    run, many = works.contact_batch(modes=modes), works.hammers(64)
    return lambda: run(many)


def _steps(steps: int) -> Callable[[], Any]:
    run, many = works.contact_batch(steps=steps), works.hammers(64)
    return lambda: run(many)


def _batch(size: int) -> Callable[[], Any]:
    run, many = works.contact_batch(), works.hammers(size)
    return lambda: run(many)


def _duration(seconds: float) -> Callable[[], Any]:
    return works.sounds(seconds, 44_100)["pianofit"]


def _by_baseline(seconds: float) -> Callable[[], Any]:
    import pianofit

    it = pianofit.preset("bensa-final")
    scheme = baseline.prepared(it.string, it.geometry, works.RATE)
    return lambda: baseline.simulate(scheme, it.hammer, round(seconds * works.RATE))


def _oversampling(times: int) -> Callable[[], Any]:
    import pianofit

    it = pianofit.preset("bensa-final")
    return lambda: pianofit.simulate(it.string, it.hammer, it.geometry, rate=works.RATE, oversampling=times).pulse.force


def _recordings(folder: Path, sizes: tuple[int, ...], few: dict[str, Any]) -> dict[str, Any]:
    files = made.make_notes(folder, made.VELOCITIES[: max(sizes)], 2.0)
    built = {str(n): works.search(files[:n], made.NOTE)[0] for n in sizes}
    taken = paired({name: work[works.OBJECTIVE] for name, work in built.items()}, **few)
    return _law(list(sizes), [taken[str(n)]["median"] for n in sizes])


def _notes(notes: dict[str, int], few: dict[str, Any]) -> list[dict[str, Any]]:
    """One strike with 1 s of signal from note to note, with the sizes that the program chose."""
    import pianofit

    made_notes, rows = {}, []
    for name, midi in notes.items():
        it = pianofit.typical(midi)
        made_notes[name] = lambda it=it: pianofit.simulate(
            it.string, it.hammer, it.geometry, rate=works.RATE, quantity="bridge-force"
        )
    taken = paired(
        {name: (lambda make=make: make().waveform(works.RATE, works.RATE)) for name, make in made_notes.items()}, **few
    )
    for name, make in made_notes.items():
        strike = make()
        rows.append({
            "note": name, "seconds": taken[name]["median"],
            "rate": 1 / float(strike.modes.step), "modes": int(strike.modes.pole.shape[0]),
            "steps": len(strike.pulse.force), "contact_ms": 1e3 * strike.contact_time,
        })  # fmt: skip
    return rows
