"""The sounds that the benchmarks fit, made by the program: nothing has to be at hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np

RATE, SECONDS, LEAD = 44_100, 6.0, 0.05
PRESET, NOTE = "chabassier-C2", "C2"
VELOCITIES = (0.8, 1.3, 2.0, 2.9, 4.0)  # m/s


def make_notes(
    folder: Path,
    velocities: tuple[float, ...] = VELOCITIES,
    seconds: float = SECONDS,
    key: str | None = None,
    oversampling: int | None = 16,
) -> list[Path]:
    """Write recordings of a note as of a microphone: the force on the bridge, a path that wanders, and noise.

    The contact is computed at `oversampling` times the file's rate, or at the rate of a fit if it is None. The note is
    a published C2, or what the literature has at a `key`, whose name the files then carry.
    """
    import pianofit
    from pianofit.model.output_path import OutputPath, apply_filter, impulse_response

    it = pianofit.preset(PRESET) if key is None else pianofit.typical(key)
    frequency = np.geomspace(40.0, 16_000.0, 60)
    octaves = np.log2(frequency / 40.0)
    path = OutputPath(frequency, 4 * np.cos(1.1 * octaves) + 3 * np.sin(2.3 * octaves) - 0.8 * octaves)
    files = []
    for turn, velocity in enumerate(velocities):
        hammer = it.hammer._replace(v_H0=velocity)
        strike = pianofit.simulate(
            it.string, hammer, it.geometry, rate=RATE, oversampling=oversampling, quantity="pressure",
            n_modes=320 if oversampling else None,
        )  # fmt: skip
        heard = apply_filter(strike.waveform(RATE, round(seconds * RATE)), impulse_response(path, RATE))[
            : round(seconds * RATE)
        ]
        samples = np.pad(heard, (round(LEAD * RATE), 0))
        samples *= 0.5 / np.abs(samples).max()
        samples += np.random.default_rng(turn).normal(0.0, 1e-5, len(samples))
        files.append(folder / f"{'layer' if key is None else key}-{turn + 1}.wav")
        files[-1].write_bytes(pianofit.encode_wav(samples, RATE))
    return files


def make_measurement(folder: Path) -> tuple[Path, Path]:
    """Write the demo's synthetic recording, a calibrated measurement of the paper's string, and its setup."""
    from pianofit import encode_wav
    from pianofit.synthetic import demo_recording, setup_text

    twin = demo_recording()
    sound, setup = folder / "synthetic.wav", folder / "setup.toml"
    sound.write_bytes(encode_wav(twin.samples, twin.rate))
    setup.write_text(setup_text(twin.setup))
    return sound, setup
