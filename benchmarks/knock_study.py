"""How well the knock of a recording follows the force of the hammer.

    python benchmarks/knock_study.py                        all notes of the recordings
    python benchmarks/knock_study.py --notes A6,C5

Every key with three layers or more is fitted without its knocks, so velocities, gains and forces come from the levels
of the partials alone. A row has the slope of the knock's level over that of the force, which is 1 if the knock follows
the force. Then come the rms of their difference, dB, without the means, and the layers, soft to loud: velocity, m/s,
knock and force, dB. Levels of knocks are relative to the gain of the recording. Below the treble a fit does not use the
knock; these rows are for comparison. Recordings are found as `crossval.py` finds them.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import crossval
import numpy as np

if TYPE_CHECKING:
    from pianofit import Setup


def follows(note: str, files: list[Path], setup: Setup) -> np.ndarray:
    """Velocity, m/s, knock over the gain and force, dB, of every layer with a knock, by velocity [layers, 3]."""
    from pianofit import analyse, fit, load_recording
    from pianofit.analysis.measure_knock import measure_knock

    recordings = [load_recording(file) for file in files]
    analyses = [replace(analyse(recording, note=note), knock=np.nan) for recording in recordings]
    result = fit(*recordings, analyses=analyses, setup=setup, progress=False)
    gains, rows = result.fit.relative_gains(0), []
    for recording, analysis, own, gain in zip(recordings, analyses, result.minima_notes[0], gains, strict=True):
        level, _ = measure_knock(recording, analysis.f0)
        rows.append(
            (float(own.hammer.v_H0), level - gain, float(own._replace(gain=1.0).levels_of_strokes(own.stroke_value)[1]))
        )
    found = np.array(sorted(rows))
    return found[np.isfinite(found).all(axis=1)]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--notes", default="", help="only notes whose names contain one of these, separated by commas")
    wanted = [name for name in parser.parse_args().notes.split(",") if name]
    from pianofit.dsp import knock_band
    from pianofit.program_folder import enable_program_cache
    from pianofit.threads import numerical_settings

    enable_program_cache()
    knock_band.FEWEST_PERIODS = 0.0
    squares, count = 0.0, 0
    jobs = {name: job for folder in crossval.folders() for name, job in crossval.notes(folder).items()}
    for name, job in jobs.items():
        if wanted and not any(x in name for x in wanted):
            continue
        with numerical_settings():
            found = follows(*job)
        if len(found) < 3:
            continue
        velocity, measured, force = found.T
        measured, force = measured - measured.mean(), force - force.mean()
        squares, count = squares + float(((measured - force) ** 2).sum()), count + len(found) - 1
        layers = "  ".join(f"{v:.2f} {a:+.1f} {b:+.1f}" for v, a, b in zip(velocity, measured, force, strict=True))
        rms = np.sqrt(((measured - force) ** 2).sum() / (len(found) - 1))
        print(f"{name:20} {(measured @ force) / (force @ force):5.2f} {rms:5.2f}   {layers}", flush=True)
    print(f"all: {np.sqrt(squares / max(count, 1)):.2f} dB rms, {count} degrees of freedom")


if __name__ == "__main__":
    main()
