"""Plucked guitar strings: plucking positions, string and pickup position from recordings.

A player plucks the A string of a guitar at three places. A magnetic pickup measures its velocity in an unknown unit.
The program makes the three recordings, with noise, and writes `pluck-1.wav` to `pluck-3.wav`. It fits them together,
without the position of the pickup: all plucks share it. It prints true values and 95 % intervals, predicts the third
recording by a fit of the first two, and writes the page to the folder `pluck`.
"""

from __future__ import annotations

import numpy as np

import pianofit

RATE = 44_100  # Hz
SECONDS, LEAD = 2.0, 0.1  # s, of the note and before it
NOISE_DB = 60.0  # below the first second's rms
STRING = pianofit.String(c=143.0, kappa=0.42, b1=0.9, b2=4e-4)
LENGTH, WIDTH, PICKUP = 0.65, 0.01, 0.16  # m; the pickup is 16 cm from the bridge
POSITIONS = (0.07, 0.11, 0.18)  # m from the bridge
# Sizes of the plucks, N. A recording of unknown gain does not determine them.
FORCES = (1.0, 0.5, 1.5)


def record(position: float, force: float, seed: int) -> np.ndarray:
    """Return samples of silence and the note, with noise in both."""
    geometry = pianofit.Geometry(LENGTH, 4e-3, position, WIDTH, PICKUP)
    note = pianofit.Note(STRING, pianofit.Pluck(force), geometry, "magnetic-pickup", gain=0.05)
    sound = note.render(seconds=SECONDS, rate=RATE)
    noise = np.sqrt(np.mean(sound[:RATE] ** 2)) * 10 ** (-NOISE_DB / 20)
    sound = np.pad(sound, (round(LEAD * RATE), 0))
    return sound + np.random.default_rng(seed).normal(0.0, noise, len(sound))


def main() -> None:
    """Record, fit, print true and estimated values, predict a recording that was left out."""
    files = []
    for number, (position, force) in enumerate(zip(POSITIONS, FORCES, strict=True), start=1):
        files.append(f"pluck-{number}.wav")
        pianofit.write_wav(files[-1], record(position, force, number), RATE)
    setup = pianofit.Setup(length=LENGTH, excitation="pluck", pickup_quantity="magnetic-pickup")
    result = pianofit.fit(*files, setup=setup, note="A2", progress=False)
    print(f"{'':8}{'true':>12}{'low':>12}{'high':>12}")
    fitted = {name: result.parameters[name] for name in ("c", "kappa", "b1", "b2", "pickup")}
    rows = [(name, quantity.interval) for name, quantity in fitted.items()]
    rows += [(f"x0 {n}", row.stroke_interval) for n, row in enumerate(result.fit.recordings, start=1)]
    for (name, interval), true in zip(rows, (*STRING, PICKUP, *POSITIONS), strict=True):
        low, high = interval or (np.nan, np.nan)
        print(f"{name:8}{true:12.6g}{low:12.6g}{high:12.6g}")
    print(f"width: {result.parameters.width.status}")
    without = pianofit.fit(*files[:2], setup=setup, note="A2", progress=False)
    prediction = without.predict(files[2])
    print(f"left out: {prediction.error_db:.2f} dB at x0 = {prediction.stroke_value:.4f} m")
    result.save("pluck", force=True)


if __name__ == "__main__":
    main()
