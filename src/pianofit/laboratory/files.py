"""Measurements as files: what a user of the laboratory would have on disk."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from ..errors import OutputError, ParameterError
from .chosen import FINAL, INITIAL, VELOCITIES
from .measurement import Laboratory, Measurement, measure, within

__all__ = ["setup_text", "write"]


def setup_text(measurement: Measurement, file: str | None = None, *, hold_velocity: bool = True) -> str:
    """The `setup.toml` of one measurement: what the laboratory knew, and the paper's initial values.

    Parameters
    ----------
    hold_velocity : the velocity that the sensor read is held fixed, as `pianofit` does with a measured one; otherwise
        it is where the fit starts, as in the paper.
    """
    return _knowledge(measurement, hold_velocity) + (_take(measurement, file) if hold_velocity else "")


def write(
    folder: Path | str, lab: Laboratory, velocities: Sequence[float] = VELOCITIES, seed: int = 0
) -> list[Measurement]:
    """Measure and write, for each velocity, `velocity-0.844.wav` with `velocity-0.844.toml`, then `setup.toml` for all.

    `truth.json` holds, file by file, what a fit should find. The n-th measurement has the seed `seed` + n, from n = 0.

    Raises
    ------
    ParameterError
        For no velocities, two that would share a file's name, or one that `measure` refuses.
    OutputError
        If the folder cannot be made or written to.
    """
    from ..io import (
        encode_wav,  # which needs JAX, as measuring does not
        replace_file,
    )

    names = [f"velocity-{within('velocity', velocity):.3f}" for velocity in velocities]
    if not names or len({*names}) < len(names):
        raise ParameterError(f"velocities={[*velocities]} must be one or more, each 0.001 m/s from the others")
    measured = [measure(lab, velocity, seed + n) for n, velocity in enumerate(velocities)]
    target = Path(folder)
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{target}: no folder can be made here ({error.strerror}); choose another") from None
    for name, one in zip(names, measured, strict=True):
        replace_file(target / f"{name}.wav", encode_wav(one.samples, one.rate))
        replace_file(target / f"{name}.toml", setup_text(one, f"{name}.wav").encode())
    takes = "".join(_take(one, f"{name}.wav") for name, one in zip(names, measured, strict=True))
    replace_file(target / "setup.toml", (_knowledge(measured[0], True) + takes).encode())
    truth = {f"{name}.wav": one.true for name, one in zip(names, measured, strict=True)}
    replace_file(target / "truth.json", (json.dumps(truth, indent=2) + "\n").encode())
    return measured


def _knowledge(measurement: Measurement, hold_velocity: bool) -> str:
    g = FINAL.geometry
    values = INITIAL.string._asdict() | INITIAL.hammer._asdict() | {"v_H0": measurement.nominal_velocity}
    if hold_velocity:
        del values["v_H0"]
    lines = [
        "[string]", f"length = {g.length}", f"mass = {g.mass}", "",
        "[strike]", f"position = {g.strike}", f"width = {g.width}", "",
        "[pickup]", 'quantity = "velocity"', f"position = {g.pickup}",
        f"scale = {measurement.scale}  # m/s at full scale", "",
        "[initial]  # Bensa et al. (2005), Tables II and III, initial values",
        *(f"{name} = {value!r}" for name, value in values.items()),
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


def _take(measurement: Measurement, file: str | None) -> str:
    named = "" if file is None else f"file = {json.dumps(file)}\n"
    return f"\n[[take]]\n{named}v_H0 = {measurement.nominal_velocity!r}  # m/s, as the sensor read it\n"
