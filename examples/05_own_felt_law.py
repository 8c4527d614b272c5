"""Your own felt law: one object, used in a simulation, tested for passivity, and fitted to recordings.

This felt hardens more than a power law: F = K u^2 (1 + u/s) (1 + μ u̇). At the compression s it is twice as hard as its
soft beginning. The example fits three synthetic recordings. The law appears in the fit, its file and its page.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

import pianofit
from pianofit import Parameter, RecordingInfo

VELOCITIES = (0.6, 1.5, 4.0)  # m/s, measured
NOISE = 3e-5  # of full scale


def force(u, w, felt):
    """Felt force, N, at compression `u`, m, and its speed `w`, m/s."""
    return felt.K * u**2 * (1 + u / felt.s) * (1 + felt.mu * w)


def storage(u, felt):
    """Energy that the felt returns, J: ∫ F du at rest."""
    return felt.K * (u**3 / 3 + u**4 / (4 * felt.s))


# Unit, meaning, bounds; then the median of the prior and the standard deviation of its logarithm. Without the last two
# the bounds are the 95 % interval of the prior.
HARDENING = pianofit.FeltLaw(
    "hardening",
    {
        "K": Parameter("N/m²", "stiffness of the soft beginning", 1e5, 1e11, 3e7, 1.5),
        "s": Parameter("m", "compression at which it has doubled", 1e-5, 1e-2, 3e-4, 1.0),
        "mu": Parameter("s/m", "loss", 1e-3, 1e1),
    },
    force,
    storage,
)


def main() -> None:
    """Strike, record, fit, print true and estimated values, and render a harder stroke."""
    it, random = pianofit.preset("chabassier-F3"), np.random.default_rng(0)
    true = HARDENING.hammer(K=8e7, s=2e-4, mu=0.2, M_H=it.hammer.M_H, v_H0=2.0)
    pulse = pianofit.simulate(it.string, true, it.geometry).pulse
    print(f"contact: {pulse.force.max():.1f} N at most, {1e3 * pulse.compression.max():.2f} mm")

    note = pianofit.Note(it.string, true, it.geometry, "bridge-force", gain=0.002)
    sounds = [note.render(v, seconds=1.5) for v in VELOCITIES]
    recordings = [
        pianofit.recording_from_samples(x + random.normal(0.0, NOISE, len(x)), 44_100, name=f"{v}.wav")
        for x, v in zip(sounds, VELOCITIES, strict=True)
    ]
    setup = pianofit.Setup(
        length=it.geometry.length,
        mass=it.geometry.mass,
        recordings=tuple(RecordingInfo(file=f"{v}.wav", v_H0=v) for v in VELOCITIES),
        felt=HARDENING,
    )
    result = pianofit.fit(*recordings, setup=setup, progress=False)
    for name in HARDENING.parameters:
        estimate = result.parameters[name]
        low, high = estimate.interval or (np.nan, np.nan)  # None where a value was given
        estimated = f"{estimate.value:.4g} [{low:.4g}, {high:.4g}] {estimate.unit}"
        print(f"{name:3} true {getattr(true, name):.4g}   estimate {estimated}")

    folder = result.save(Path("hardening"), force=True)  # fit.json, the sounds, and the page with the force curve
    played, _ = pianofit.load_note(folder / "fit.json", felt=HARDENING)  # the file contains only the name of the law
    print(f"rendered: {len(played.render(3.0, seconds=1.0))} samples")


if __name__ == "__main__":
    main()
