"""Make the README's picture from the demo's fit: `python docs/make_picture.py`."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import imsave

from pianofit import Result, fit
from pianofit.report.drawing import LINES, legend, page_style
from pianofit.report.figures import (
    attack_waves,
    contact_of,
    draw_attack,
    draw_levels,
    draw_loop,
    draw_spectrum,
    spectra_of,
)
from pianofit.synthetic import demo_recording

PICTURE = Path(__file__).with_name("picture.png")


def main() -> None:
    """Fit the demo's measurement and draw it."""
    measurement = demo_recording(60.0, seed=0)
    result = fit((measurement.samples, measurement.rate), setup=measurement.setup, progress=False)
    PICTURE.write_bytes(picture(result))


def picture(result: Result) -> bytes:
    """A PNG of 1400 × 900 pixels: spectra, attack, partial levels and the felt's loop."""
    with page_style():
        figure = Figure(figsize=(14, 9))
        spectra, attack, levels, loop = (
            figure.add_axes((left, bottom, width, 0.38))
            for bottom in (0.58, 0.10)
            for left, width in ((0.05, 0.42), (0.55, 0.43))
        )
        draw_spectrum(spectra, *spectra_of(result))
        spectra.set(title="Spectra and the bands of the fit")
        ms, waves = attack_waves(result)
        draw_attack(attack, ms, waves, "fitted")
        attack.plot(ms, waves["initial"], label="initial", **LINES["initial"])
        attack.set(title="Attack", xlabel="time from the onset (ms)")
        draw_levels(levels, result.fit.reference.partials)
        levels.set(title="Levels of the partials", xlabel="partial number")
        draw_loop(loop, contact_of(result))
        loop.set(title="Felt: force over compression")
        legend(figure, attack)
        figure.set_dpi(100)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        file = io.BytesIO()  # 16 levels of each colour: half the size, and no eye sees it in lines on white
        imsave(file, (np.asarray(canvas.buffer_rgba()) // 16 * 17).astype(np.uint8), format="png")
    return file.getvalue()


if __name__ == "__main__":
    main()
