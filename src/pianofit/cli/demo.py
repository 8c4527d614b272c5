"""The demonstration: a measurement is made, fitted as any other, and compared with the truth behind it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ..fitting import fit
from ..inference import Result
from ..io import encode_wav, replace_file
from ..model.cache import keep_programs
from ..paper.laboratory import make_twin, setup_text

__all__ = ["run_demo"]


def run_demo(
    folder: Path, noise_db: float | None, seed: int, progress: Callable[[str, float], None]
) -> tuple[Result, dict[str, float]]:
    """Write `twin.wav` and `setup.toml` to `folder`, fit them there, and return the result and the true values."""
    keep_programs()
    progress("making the twin", 0.0)
    twin = make_twin(noise_db, seed)
    replace_file(folder / "twin.wav", encode_wav(twin.samples, twin.rate))
    replace_file(folder / "setup.toml", setup_text().encode())
    result = fit(folder / "twin.wav", setup=folder / "setup.toml", seed=seed, progress=progress)
    progress("page", 0.95)
    result.save(folder, force=True)
    return result, twin.true
