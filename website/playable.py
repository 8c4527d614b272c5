"""The page to play of the site: an instrument of 88 keys from synthetic recordings of six."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from digest import digest

import pianofit

RECORDED = ("C2", "C3", "C4", "F#4", "C5", "C6")
# Below the rms of the first second, dB.
NOISE_DB = 60.0
# Newtons at the bridge at digital full scale.
FULL_SCALE = 20.0


def playable_files(root: Path) -> dict[str, bytes]:
    """Write the page to play. It is kept in build/gallery for as long as this file and the package do not change.

    Parameters
    ----------
    root : folder of the repository.

    Returns
    -------
    Path below the site's folder, to the content of the page.
    """
    sources = [path for path in sorted((root / "src").rglob("*.*")) if path.suffix in (".py", ".js", ".css", ".j2")]
    kept = root / "build" / "gallery" / f"piano-{digest(Path(__file__), *sources)}.html"
    if not kept.exists():
        kept.parent.mkdir(parents=True, exist_ok=True)
        pianofit.write_playable_page(kept, six_keys_to_88())
    return {"piano.html": kept.read_bytes()}


def six_keys_to_88() -> pianofit.Instrument:
    """Fit synthetic recordings of six keys and return the instrument."""
    with TemporaryDirectory() as folder:
        for number, name in enumerate(RECORDED):
            it = pianofit.typical(name)
            made = pianofit.synthetic_recording(
                it.string,
                it.hammer,
                it.geometry,
                quantity="bridge-force",
                noise_db=NOISE_DB,
                seed=number,
                scale=FULL_SCALE,
            )
            result = pianofit.fit(made.recording, setup=made.setup, note=name, progress=False)
            result.save(Path(folder, name), page=False)
        return pianofit.build_instrument(pianofit.load_keys(pianofit.find_fits([Path(folder)])), "Six keys to 88")
