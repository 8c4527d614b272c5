"""From a recording to parameters, and back to sound at another velocity.

python examples/01_fit_a_note.py                      fits a synthetic recording, whose parameters are known
python examples/01_fit_a_note.py note.flac F#2        fits a recording of yours
"""

from __future__ import annotations

import sys

import pianofit
from pianofit.synthetic import demo_recording


def synthetic() -> tuple[pianofit.Recording, pianofit.Setup, dict[str, float]]:
    """Return a calibrated velocity signal, its setup, and its true parameters."""
    made = demo_recording(noise_db=60.0, seed=1)
    return made.recording, made.setup, made.true


def main() -> None:
    """Fit, print, and write `softer.wav` and `louder.wav`."""
    note, true = None, {}
    if len(sys.argv) > 2:
        recording, setup, note = pianofit.load_recording(sys.argv[1]), pianofit.Setup(), sys.argv[2]
    else:
        recording, setup, true = synthetic()

    # The analysis needs no model of the hammer.
    analysis = pianofit.analyse(recording, note=note)
    print(f"f0 {analysis.f0:.3f} ± {analysis.f0_error:.3f} Hz, B {analysis.B:.3g}, {len(analysis.partials)} partials")

    # The fit. `result.save(folder)` writes what `pianofit fit` writes.
    result = pianofit.fit(recording, analyses=[analysis], setup=setup)
    print(result.identifiability_statement)
    for name, estimate in result.invariants.items():
        span = "none: given" if estimate.interval is None else "[{:.5g}, {:.5g}]".format(*estimate.interval)
        print(f"{name:8} {estimate.value:.5g} {estimate.unit}, 95 % interval {span}")
    for name, estimate in result.parameters.items():
        truth = f"   true {true[name]:.5g}" if name in true else ""
        print(f"{name:6} {estimate.value:.5g} {estimate.unit}, {estimate.status}{truth}")

    # The same string and hammer, struck softer and harder, through the same gain and path.
    note = result.note
    for name, factor in (("softer.wav", 0.5), ("louder.wav", 2.0)):
        velocity = factor * note.hammer.v_H0
        samples, strike = note.with_velocity(velocity).render_stroke(recording.rate, 2 * recording.rate)
        pianofit.write_wav(name, samples, recording.rate)
        print(f"{name}: {velocity:.3g} m/s, contact {1e3 * strike.contact_time:.2f} ms")


if __name__ == "__main__":
    main()
