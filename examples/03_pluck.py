"""A plucked guitar string: the plucking point and the width of the finger are estimated from a recording.

A fingertip displaces the A string of a guitar and releases it. A magnetic pickup measures its velocity in an unknown
unit. The program writes `pluck.wav`, with noise. SciPy estimates plucking point and width from the levels of the
partials, with the gradient from JAX. The string parameters come from the analysis. The width is less certain: high
partials decay in the two milliseconds before the wave reaches the pickup, which this example neglects.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

import pianofit

RATE, CONTACT_RATE = 22_050, 88_200  # Hz, of the file and of the table of modes
MODES = 40
SECONDS, LEAD = 3.0, 0.1  # s, of the note and before it
NOISE_DB = 60.0  # below the first second's rms
STRING = pianofit.String(c=143.0, kappa=0.42, b1=0.9, b2=4e-4)
# Plucking point, width of the finger, and pickup, m from the bridge. The mass has no effect on the levels.
GUITAR = pianofit.Geometry(length=0.65, mass=4e-3, strike_position=0.14, width=0.022, pickup=0.52)


def released(string: pianofit.String, geometry: pianofit.Geometry):
    """Return the table of modes, and the motion after a force of 1 N is released."""
    modes = pianofit.mode_table(string, geometry, rate=CONTACT_RATE, n_modes=MODES)
    return modes, pianofit.pluck(modes)


def record(seed: int = 0) -> pianofit.Recording:
    """Make a recording of silence and the note, with noise in both."""
    modes, free = released(STRING, GUITAR)
    note = pianofit.waveform(modes, rate=RATE, samples=round(SECONDS * RATE), free=free)
    noise = np.sqrt(np.mean(note[:RATE] ** 2)) * 10 ** (-NOISE_DB / 20)
    sound = np.pad(note, (round(LEAD * RATE), 0))
    sound += np.random.default_rng(seed).normal(0.0, noise, len(sound))
    sound /= 2 * np.abs(sound).max()
    pianofit.write_wav("pluck.wav", sound, RATE)
    return pianofit.load_recording("pluck.wav")


def main() -> None:
    """Pluck, analyse, estimate, and print true and estimated values."""
    analysis = pianofit.analyse(record(), note="A2")
    partials, length = analysis.partials, GUITAR.length
    c = 2 * length * analysis.f0
    string = pianofit.String(c, c * length * analysis.B**0.5 / np.pi, analysis.b1, analysis.d2 * (length / np.pi) ** 2)

    def misfit(z):
        """Mean square of the level differences, dB², of log position, log width and gain in dB."""
        modes, free = released(string, GUITAR._replace(strike_position=jnp.exp(z[0]), width=jnp.exp(z[1])))
        level = pianofit.levels(modes, free=free)[partials.number - 1] + z[2]
        # Near a node noise dominates. Its energy adds to that of the partial.
        expected = 10 * jnp.log10(10 ** (level / 10) + 10 ** ((partials.level - partials.snr) / 10))
        return ((expected - partials.level) ** 2).mean()

    # The levels are the same for a plucking point at x or L - x, so the search covers the first half. Every node of a
    # partial is a barrier, so each search starts between two nodes of the highest partial.
    box = [(np.log(0.03), np.log(length / 2)), (np.log(0.002), np.log(0.06)), (None, None)]
    gradient = jax.jit(jax.value_and_grad(misfit))
    first = [[np.log(x), np.log(0.01), 0.0] for x in np.arange(0.04, length / 2, length / MODES / 2)]
    ends = [minimize(gradient, z, jac=True, method="L-BFGS-B", bounds=box) for z in first]
    best = min(ends, key=lambda end: end.fun)
    print(f"{'':6}{'true':>12}{'estimate':>12}")
    for name, true, estimate in zip(
        ("pluck", "width"), (GUITAR.strike_position, GUITAR.width), np.exp(best.x[:2]), strict=True
    ):
        print(f"{name:6}{true:12.6g}{estimate:12.6g} m")
    reached = sum(end.fun < 1.01 * best.fun for end in ends)
    print(f"{len(partials)} levels, {best.fun**0.5:.2f} dB rms residual; {reached} of {len(ends)} searches reached it")


if __name__ == "__main__":
    with jax.enable_x64(True):  # the model computes in float64, and so do the derivatives that JAX takes of it
        main()
