"""Not only pianos: a plucked string, heard, and its plucking point found again from the recording.

A fingertip pulls a guitar's A string aside and lets it go; a magnetic pickup hears its velocity, in no known unit.
Written is `pluck.wav`, with noise. From its partials' levels the plucking point and the finger's width are found again,
by SciPy down the gradient that JAX derives; the string is the analysis'. The width is the less sure of the two: in the
two milliseconds before the wave comes to the pickup the high partials have decayed, which is left out here.
"""

from __future__ import annotations

from pathlib import Path

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
# Where the finger pulls and how broad it is, and the pickup, m from the bridge. The mass has no effect on the levels.
GUITAR = pianofit.Geometry(length=0.65, mass=4e-3, strike_position=0.14, width=0.022, pickup=0.52)


def released(string: pianofit.String, geometry: pianofit.Geometry):
    """The table of modes, and the motion after a force of 1 N is let go."""
    modes = pianofit.mode_table(string, geometry, rate=CONTACT_RATE, n_modes=MODES)
    return modes, pianofit.pluck(modes)


def record(seed: int = 0) -> pianofit.Recording:
    """Silence, then the note, and noise over both."""
    modes, free = released(STRING, GUITAR)
    note = pianofit.waveform(modes, rate=RATE, samples=round(SECONDS * RATE), free=free)
    noise = np.sqrt(np.mean(note[:RATE] ** 2)) * 10 ** (-NOISE_DB / 20)
    sound = np.pad(note, (round(LEAD * RATE), 0))
    sound += np.random.default_rng(seed).normal(0.0, noise, len(sound))
    sound /= 2 * np.abs(sound).max()
    Path("pluck.wav").write_bytes(pianofit.encode_wav(sound, RATE))
    return pianofit.load_recording("pluck.wav")


def main() -> None:
    """Pluck, analyse, find, and print the truth beside what was found."""
    analysis = pianofit.analyse(record(), note="A2")
    partials, length = analysis.partials, GUITAR.length
    c = 2 * length * analysis.f0
    string = pianofit.String(c, c * length * analysis.B**0.5 / np.pi, analysis.b1, analysis.d2 * (length / np.pi) ** 2)

    def misfit(z):
        """Mean square of the level differences, dB², of log position, log width and gain in dB."""
        modes, free = released(string, GUITAR._replace(strike_position=jnp.exp(z[0]), width=jnp.exp(z[1])))
        level = pianofit.levels(modes, free=free)[partials.number - 1] + z[2]
        # Near a node little is left but the noise, whose energy adds to the string's.
        heard = 10 * jnp.log10(10 ** (level / 10) + 10 ** ((partials.level - partials.snr) / 10))
        return ((heard - partials.level) ** 2).mean()

    # Plucked at x or at L - x a string has the same levels, so it was in the first half. Every node of a partial on the
    # way is a hill, so each search starts between two nodes of the highest.
    box = [(np.log(0.03), np.log(length / 2)), (np.log(0.002), np.log(0.06)), (None, None)]
    gradient = jax.jit(jax.value_and_grad(misfit))
    first = [[np.log(x), np.log(0.01), 0.0] for x in np.arange(0.04, length / 2, length / MODES / 2)]
    ends = [minimize(gradient, z, jac=True, method="L-BFGS-B", bounds=box) for z in first]
    best = min(ends, key=lambda end: end.fun)
    print(f"{'':6}{'true':>12}{'found':>12}")
    for name, true, found in zip(
        ("pluck", "width"), (GUITAR.strike_position, GUITAR.width), np.exp(best.x[:2]), strict=True
    ):
        print(f"{name:6}{true:12.6g}{found:12.6g} m")
    reached = sum(end.fun < 1.01 * best.fun for end in ends)
    print(f"{len(partials)} levels, {best.fun**0.5:.2f} dB rms left; {reached} of {len(ends)} searches ended there")


if __name__ == "__main__":
    with jax.enable_x64(True):  # the model computes in float64, and so do the derivatives that JAX takes of it
        main()
